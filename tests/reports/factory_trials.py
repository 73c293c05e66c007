"""Made-up tables of trials in the exported form."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from reports.data.schema import TRIALS
from tests.reports.factory import COVERAGE, KINDS

Values = Sequence[float | str]  # of an arm's trials in their order: a value where it is complete, else its state


def trials(
    arms: Mapping[str, Values],
    name: str = "search_x",
    *,
    env: Mapping[str, Any] = COVERAGE,
    steps: int = 50_000,
    profile: str = "quick",
) -> pd.DataFrame:
    """A search of two seeds a trial. A pruned trial has trained half the steps, one that failed or is partial none."""
    rows = []
    for arm, found in arms.items():
        kind = KINDS.get(arm, arm.lower())
        for index, one in enumerate(found):
            state = one if isinstance(one, str) else "complete"
            params = {} if state == "missing" else {"lr": (index + 1) / 1000}
            config = {"algo": {"kind": kind, **params}, "env": dict(env), "trainer": {"steps": steps}}
            trained = {"complete": steps, "pruned": steps // 2}.get(state, 0)
            value = np.nan if isinstance(one, str) else float(one)
            about = (kind, env["kind"], profile, json.dumps(config), "0123456789ab", "Which settings?")
            rows.append((name, arm, index, state, value, trained, 2, json.dumps(params), *about))
    return pd.DataFrame(rows, columns=list(TRIALS.names))


def write_trials(folder: Path, table: pd.DataFrame, *, older: bool = False) -> Path:
    """Write a search's table as an export does, or as an older version did."""
    folder.mkdir(parents=True, exist_ok=True)
    found = pa.Table.from_pandas(table, preserve_index=False)
    found = found.replace_schema_metadata(None if older else TRIALS.metadata)
    pq.write_table(found, folder / f"{table['search'].iloc[0]}.trials.parquet")
    return folder
