"""Values that change with the steps taken."""


def linear(start: float, end: float, span: int, step: int) -> float:
    """From `start` to `end` in `span` steps, then constant."""
    return start + (end - start) * min(step / max(span, 1), 1.0)
