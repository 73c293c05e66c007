"""From the log to three small files per study, four if it has readings: all that the reports read.

The files are canonical: the same log gives the same bytes (sorted rows, no clock, no names that the log made up). Two
of them are the same bytes wherever results are equal; how and where each run was made has a file of its own.
"""

import json
import sys
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipelines.specs.plugins import pages
from pipelines.specs.readings import Plan
from pipelines.specs.study import Study
from pipelines.tracking.plan import Item, items, study_card
from pipelines.tracking.source_file import another
from pipelines.tracking.tracker import Recorded, Row, Tracker
from pipelines.workspace.errors import InputError, visible
from pipelines.workspace.exit_codes import Exit
from pipelines.workspace.files import regular
from pipelines.workspace.work_folder import Home, StoreError, lacks_memory, reason, whole, work_folder
from reports.data.schema import MADE, METRICS, READINGS, RUNS, TASKS
from rhmc.yardsticks import offered


def export_study(study: Study, out: Path, home: Path | None = None) -> int:
    """Write `<study>.parquet` (schema `METRICS`), `<study>.runs.parquet` (`RUNS`), `<study>.made.parquet` (`MADE`).

    A study with readings also has `<study>.readings.parquet` (`READINGS`), one with tasks of other packages
    `<study>.tasks.json`: what the report has to know of them.
    Only runs of the present plan and code are taken; `time/` metrics stay behind, but for a run's processor seconds.

    Args:
        study: the plan.
        out: folder, made when missing.
        home: work folder, see `work_folder`.

    Returns:
        0 all planned runs are there and finished, 3 some are not (the files are written all the same), 2 environment
        error.
    """
    from pipelines.tracking.mlflow_tracker import open_existing

    place = Home(home or work_folder())
    if remark := another(place, study.name, study.profile, study.file):
        print(visible(remark), file=sys.stderr)
    try:
        tracker = open_existing(study_card(study), place)
        plan = items(study)
        unfinished = write_tables(study, plan, tracker, out)
    except StoreError as error:
        print(f"rhmc: {error}", file=sys.stderr)
        return Exit.BAD
    if unfinished:
        print(f"{study.name} ({study.profile}): {unfinished} of {len(plan)} runs are not finished", file=sys.stderr)
    return Exit.UNFINISHED if unfinished else Exit.DONE


def write_tables(study: Study, plan: list[Item], tracker: Tracker | None, out: Path) -> int:
    """Write the files and return how many planned runs are not finished."""
    found = {(run.arm, run.key): run for run in tracker.recorded()} if tracker else {}
    there = [(item, found.get((item.card.arm, item.key))) for item in plan]
    refs = [run.ref for _, run in there if run]
    by_ref: dict[str, list[Row]] = {ref: [] for ref in refs}
    for row in tracker.rows(refs) if tracker else []:
        by_ref[row.ref].append(row)
    values, runs, made = [], [], []
    for item, run in there:
        rows = by_ref[run.ref] if run else []
        place = (study.name, item.card.arm, item.card.seed, item.card.spec_id)
        values += [(*place, r.step, r.metric, r.value) for r in rows if not r.metric.startswith("time/")]
        runs.append((*place, *_about(study, item, run)))
        made += [(*place, *_made(run, rows))] if run else []
    write_parquet(out / f"{study.name}.parquet", METRICS, sorted(values, key=lambda row: row[:6]))
    write_parquet(out / f"{study.name}.runs.parquet", RUNS, sorted(runs, key=lambda row: row[:4]))
    write_parquet(out / f"{study.name}.made.parquet", MADE, sorted(made, key=lambda row: row[:4]))
    if study.readings:
        write_parquet(out / f"{study.name}.readings.parquet", READINGS, _levels(study, study.readings))
    if own := sorted({item.card.task for item in plan if pages({"env": item.card.task})}):
        units = {kind: {"unit": offered(kind).unit} for kind in own}
        with whole(out / f"{study.name}{TASKS}", durable=True) as part:
            part.write_text(json.dumps(units, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return sum(1 for _, run in there if run is None or run.status != "finished")


def _levels(study: Study, plan: Plan) -> list[tuple[object, ...]]:
    """Rows of `READINGS`, by arm and factor."""
    numbers = {(factor, level): i for factor, levels in plan.factors.items() for i, level in enumerate(levels)}
    places = {factor: i for i, factor in enumerate(plan.factors)}
    return sorted(
        (study.name, arm, cell.arm, cell.reading, factor, places[factor], level, numbers[factor, level])
        for arm, cell in study.cells.items()
        for factor, level in cell.levels.items()
    )


def _about(study: Study, item: Item, run: Recorded | None) -> tuple[str, ...]:
    status = "missing" if run is None else run.status if run.status in ("finished", "failed") else "partial"
    names = (status, item.card.algorithm, item.card.task, study.profile, item.spec.canonical(), item.card.fingerprint)
    return (*names, study.question)


def _made(run: Recorded, rows: list[Row]) -> tuple[str | float, ...]:
    seconds = max((row.value for row in rows if row.metric == "time/seconds"), default=0.0)
    return (run.commit, seconds, *run.host, run.adopted)


def write_parquet(path: Path, schema: pa.Schema, rows: list[tuple[object, ...]]) -> None:
    """Write rows in the given order, whole or not at all.

    Raises:
        StoreError: the folder cannot be written to, or the disk is full.
    """
    columns = list(zip(*rows, strict=True)) or [()] * len(schema)
    table = pa.table([pa.array(column, field.type) for column, field in zip(columns, schema, strict=True)], schema)
    with whole(path, durable=True) as part:
        pq.write_table(table, part, compression="zstd", version="2.6", row_group_size=2**20)


def read_parquet(path: Path, schema: pa.Schema, what: str) -> list[dict[str, Any]]:
    """The rows of a table that `write_parquet` wrote; none without a file. Columns that an earlier form had are left.

    Args:
        path: the file.
        schema: its columns.
        what: of which the table is, in words, for the error.

    Raises:
        InputError: another file has the name.
        StoreError: it cannot be read.
    """
    if not path.exists():
        return []
    regular(path)
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        if lacks_memory(error) or getattr(error, "errno", None):  # which says nothing of the table
            raise StoreError(f"{path}: cannot be read now: {reason(error)}") from error
        raise InputError(f"{path}: not a readable table; move it away") from error
    if not set(schema.names) <= set(table.schema.names):
        raise InputError(f"{path}: a table, but not one of {what}; move it away")
    return table.select(schema.names).to_pylist()
