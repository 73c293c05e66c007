"""From Optuna's database to the table of a search's trials, which the report reads.

The file is canonical as those of studies are: equal trials give the same bytes (sorted rows, no clock).
"""

import json
import sys
from contextlib import suppress
from pathlib import Path

from pipelines.export.tables import write_parquet
from pipelines.specs.search import Search
from pipelines.tracking.source_file import another
from pipelines.tuning.trials import Recorded, explained, look, opened, storage_url
from pipelines.workspace.errors import visible
from pipelines.workspace.exit_codes import Exit
from pipelines.workspace.work_folder import Home, StoreError
from reports.data.schema import TRIALS
from rhmc.training.trainer import grid_step

SPENT = ("complete", "pruned")  # states of a trial that gave its result
Row = tuple[object, ...]


def export_search(search: Search, out: Path, home: Path) -> int:
    """Write `<search>.trials.parquet` (schema `TRIALS`): a row per trial of the budget, by arm and index.

    Only trials of the present settings and code are taken; a trial that is not there is a row with state `missing`.

    Args:
        search: the plan.
        out: folder, made when missing.
        home: the work folder.

    Returns:
        0 every trial is complete or pruned, 3 some are not (the file is written all the same), 2 environment error.
    """
    place = Home(home)
    if remark := another(place, search.name, search.profile, search.file):
        _say(remark)
    rows: list[Row] = []
    try:
        with opened(place, write=False) as storage, explained(storage_url(place)):
            for arm in sorted(search.arms):
                arm_study, stale = look(search, arm, storage)
                rows += [_row(search, arm, index, trial) for index, trial in enumerate(arm_study.recorded())]
                if stale:
                    _say(f"{search.name} ({search.profile}), {arm}: {stale} trials of other settings or code left out")
        write_parquet(out / f"{search.name}.trials.parquet", TRIALS, rows)
    except StoreError as error:
        print(f"rhmc: {error}", file=sys.stderr)
        return Exit.BAD
    unspent = sum(row[TRIALS.names.index("state")] not in SPENT for row in rows)
    if unspent:
        _say(f"{search.name} ({search.profile}): {unspent} of {len(rows)} trials are neither complete nor pruned")
    return Exit.UNFINISHED if unspent else Exit.DONE


def _row(search: Search, arm: str, index: int, trial: Recorded) -> Row:
    """A row of `TRIALS`."""
    setting = search.arms[arm].setting
    with suppress(ValueError):  # refused by the method: never trained
        setting = search.arms[arm].at(trial.params)
    found = (trial.state, trial.value, grid_step(setting.trainer, trial.last), search.seeds, _json(trial.params))
    names = (setting.algo.kind, setting.env.kind, search.profile, setting.canonical(), search.code(arm))
    return (search.name, arm, index, *found, *names, search.question)


def _json(params: dict[str, str | int | float | bool | None]) -> str:
    return json.dumps(params, sort_keys=True, separators=(",", ":"))


def _say(text: str) -> None:
    print(visible(text), file=sys.stderr)
