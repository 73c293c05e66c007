"""The tables of searches, checked: a row per trial of each arm's budget. What is wrong is a line."""

import json
from collections.abc import Collection, Iterator
from itertools import count
from typing import Any

import numpy as np
import pandas as pd

from reports.data.escaping import markdown
from reports.data.exported import config_fault, first

STATES = ("complete", "pruned", "failed", "partial", "missing")
OPEN = {"missing": "not begun", "partial": "not finished", "failed": "failed"}  # in words


def trial_faults(trials: pd.DataFrame, profile: str, studies: Collection[str]) -> Iterator[str]:
    """The faults of the trials of all searches.

    Args:
        trials: columns of `schema.TRIALS`.
        profile: of the report.
        studies: names that are taken.
    """
    for search in sorted(set(trials["search"]) & set(studies)):
        yield f"{search}.trials.parquet: a study is named {search!r} as well; rename one of the two files"
    yield from first(f"{_name(row)}: {fault}" for row in trials.itertuples() for fault in _row_faults(row, profile))
    for row in trials[trials.duplicated(["search", "arm", "trial"])].itertuples():
        yield f"{_name(row)}: is there twice"
    for search, rows in trials.groupby("search"):
        budget = int(rows["trial"].max()) + 1
        for arm, mine in rows.groupby("arm"):
            planned = set(mine["trial"].astype(int))
            if absent := budget - len(planned):
                lowest = next(index for index in count() if index not in planned)
                yield f"{search!s}, arm {arm!r}: {absent} of {budget} trials have no row; the first is {lowest}"


def _row_faults(row: Any, profile: str) -> Iterator[str]:
    """The faults of a trial by itself."""
    if row.state not in STATES:
        yield f"state {row.state!r} is none of {', '.join(STATES)}"
    elif row.state == "complete" and not np.isfinite(row.value):
        yield f"marked complete, and its value is {row.value}"
    elif row.state != "complete" and not np.isnan(row.value):
        yield f"marked {row.state}, and has a value"
    elif row.state == "missing" and row.steps:
        yield "marked missing, and has steps"
    if row.profile != profile:
        yield f"made with profile {row.profile!r}, and this report is of {profile!r}"
    if fault := config_fault(str(row.config)):
        yield f"column 'config' {fault}"
    if not isinstance(params(str(row.params)), dict):
        yield "column 'params' is no JSON object"


def params(text: str) -> Any:
    """Values that were tried, by dotted name of a setting; None if it is no JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def trial_gaps(trials: pd.DataFrame) -> Iterator[str]:
    """Trials that gave no result, in sentences of Markdown."""
    for (search, arm), rows in trials.groupby(["search", "arm"]):
        counts = rows["state"].value_counts()
        parts = [f"{counts[state]} {words}" for state, words in OPEN.items() if state in counts]
        if parts:
            yield f"Search `{search}`, arm {markdown(str(arm))}: of {len(rows)} trials {', '.join(parts)}."


def _name(row: Any) -> str:
    return f"{row.search}, arm {row.arm!r}, trial {row.trial}"
