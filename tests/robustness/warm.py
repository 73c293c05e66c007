"""What a launch works out once in a process, worked out when this is imported: processes forked from there have it."""

from mlflow.utils.requirements_utils import warn_dependency_requirement_mismatches

from pipelines.specs.identity import present

present()  # reads all code of the science
warn_dependency_requirement_mismatches(["torch"])  # looks through every installed package
