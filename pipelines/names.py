"""What metrics are called in MLflow: a few headline names without a group, everything else under its group.

Inside the program, in exported tables and in checkpoints a metric keeps its full name (`eval/return`). A log written
before there were headline names is read all the same: a name that is no headline stands for itself.
"""

HEADLINES = {
    "return": "eval/return",
    "coverage": "eval/coverage",
    "landmarks_covered": "eval/landmarks_covered",
    "collisions": "eval/collisions",
    "steps_per_second": "time/steps_per_second",
}
SHOWN = {full: short for short, full in HEADLINES.items()}


def shown(metric: str) -> str:
    """The name in MLflow of a metric of the program."""
    return SHOWN.get(metric, metric)


def full(metric: str) -> str:
    """The name in the program of a metric in MLflow."""
    return HEADLINES.get(metric, metric)
