"""The command `rhmc` as it is installed: this project's packages come before a user's own folders of the same names.

A folder `pipelines` on PYTHONPATH would be imported in place of this project's; no name of this module is as common.
Processes of `multiprocessing` inherit the search path; Ray's workers get it from `pipelines.execution.ray_driver`.
"""

import sys
from pathlib import Path


def main() -> None:
    """Run the command."""
    sys.path.insert(0, str(Path(__file__).parent))
    from pipelines.cli.main import main as command

    command()
