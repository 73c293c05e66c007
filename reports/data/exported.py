"""The exported tables as files: which there are, and what is in their columns. One check of form for all of them.

A file of another form, or none at all, is a fault of one line. Columns that a form does not name are left alone.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from reports.data import schema
from reports.data.drawn import content, told

MADE = "made"  # `<study>.made.parquet`, which may be missing
MOVED = "transfer"  # the table of trained policies with other numbers of agents and targets
ASSIGNED = "assignments"  # `<study>.assignments.parquet`: what the runs of a study assigned while they trained
READINGS = "readings"  # `<study>.readings.parquet`: the level of each factor, of every arm of a study with readings
TRIALS = "trials"  # `<search>.trials.parquet`: the budget of every arm of a search
FORMS: Mapping[str, pa.Schema] = {
    "points": schema.METRICS,
    "runs": schema.RUNS,
    MADE: schema.MADE,
    ASSIGNED: schema.METRICS,
    MOVED: schema.TRANSFER,
    READINGS: schema.READINGS,
    TRIALS: schema.TRIALS,
}
PLACE, POINTS, RUNS = schema.PLACE.names, schema.METRICS.names, schema.RUNS.names
PLAYED, LEVELS, TRIED = schema.TRANSFER.names, schema.READINGS.names, schema.TRIALS.names
OWN = [name for name in schema.MADE.names if name not in PLACE]  # how and where a run was made
TOLD = [name for name in OWN if name not in ("commit", "seconds")]

TYPES = {field.name: field.type for form in FORMS.values() for field in form}
WHOLE = {name for name, kind in TYPES.items() if kind == schema.WHOLE}  # integers from 0
NUMBERS = {name for name, kind in TYPES.items() if kind == schema.NUMBER}  # an empty cell is NaN. All others hold words
UNKNOWN = ("fingerprint", "question", "commit", *TOLD)  # words that may not be known
SHOWN = 5  # faults of one kind that are spelled out
STUDY = re.compile(r"[\w-]+(@[\w-]+)?")  # a study's name, and of a variant


def part(path: Path) -> str:
    """The form, of `FORMS`, of a file."""
    if path.name == f"{MOVED}.parquet":
        return MOVED
    second = path.name.removesuffix(".parquet").partition(".")[2]
    return second if second in ("runs", MADE, ASSIGNED, READINGS, TRIALS) else "points"


def earlier(path: Path) -> bool:
    """True if a table of runs has the form in which they still told how and where they were made."""
    try:
        names = _schema(path).names if part(path) == "runs" else []
    except (OSError, ValueError, pa.ArrowException):
        return False  # `read` says what is wrong with it
    return not set(OWN).isdisjoint(names)


def older(path: Path) -> bool:
    """True if a table of runs or trials was exported by an older version, with that version's names."""
    try:
        return part(path) in ("runs", TRIALS) and not _of_now(_schema(path))
    except (OSError, ValueError, pa.ArrowException):
        return False  # `read` says what is wrong with it


def _of_now(found: pa.Schema) -> bool:
    wanted = schema.RUNS.metadata
    return {key: (found.metadata or {}).get(key) for key in wanted} == wanted


def _schema(path: Path) -> pa.Schema:
    return pq.read_schema(pa.BufferReader(content(path)))


def read(path: Path, faults: list[str]) -> pd.DataFrame:
    """The columns of a file's form; what is wrong goes to `faults`, a line each."""
    form = FORMS[part(path)].names
    try:
        table = pq.ParquetFile(pa.BufferReader(content(path))).read()
    except MemoryError:
        raise
    except (OSError, ValueError, pa.ArrowException) as error:
        faults.append(f"{path.name}: not a readable Parquet table ({_why(path, error)})")
        return pd.DataFrame(columns=list(form))
    found = list(_columns(table, form))
    if not found:
        kept = pa.table({name: _taken(table[name], name) for name in form})
        found = list(_study_faults(kept, path))
    faults += [f"{path.name}: {fault}" for fault in found]
    return pd.DataFrame(columns=list(form)) if found else kept.to_pandas()


def _why(path: Path, error: Exception) -> str:
    if not isinstance(error, OSError) or isinstance(error, pa.ArrowException):
        return f"{path.stat().st_size} bytes"
    return error.strerror or str(error) or type(error).__name__


def _columns(table: pa.Table, wanted: Sequence[str]) -> Iterator[str]:
    """The fault of the columns of a table."""
    names = table.column_names
    absent = [name for name in wanted if name not in names]
    if absent:
        yield f"no column {', '.join(map(repr, absent))}; there are {', '.join(names)}"
    for name in wanted:
        if names.count(name) > 1:
            yield f"column {name!r} stands there {names.count(name)} times"
        elif name in names:
            yield from _faults(table[name], name)


def _faults(column: pa.ChunkedArray, name: str) -> Iterator[str]:
    """The fault of a column: its type, its empty cells, its range."""
    kind, what = _held(column.type), "words"
    fits = _worded(kind)
    if name in (*WHOLE, *NUMBERS):
        what, fits = "numbers", pa.types.is_integer(kind) or pa.types.is_floating(kind)
    empty = column.null_count if name not in (*NUMBERS, *UNKNOWN) else 0
    if not fits and not (pa.types.is_null(kind) and name in (*NUMBERS, *UNKNOWN)) and len(column):
        yield f"column {name!r} holds {'words' if _worded(kind) else kind}, not {what}"
    elif empty:
        yield f"column {name!r} has {empty} empty cell{'s' if empty > 1 else ''} of {len(column)}"
    elif name in WHOLE and len(column):
        try:
            least = pc.min(_taken(column, name)).as_py()
        except pa.ArrowInvalid as error:
            yield f"column {name!r} holds what is no whole number of 64 bits ({str(error).splitlines()[0]})"
        else:
            if least < 0:
                yield f"column {name!r} goes down to {least}; 0 is the least"


def first(lines: Iterator[str]) -> Iterator[str]:
    """The first faults of a kind, and how many more."""
    found = list(lines)
    yield from found[:SHOWN]
    if len(found) > SHOWN:
        yield f"... and {len(found) - SHOWN} more of this kind"


def _worded(kind: pa.DataType) -> bool:
    return pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind)


def _held(kind: pa.DataType) -> pa.DataType:
    """The type of a column's values, in a dictionary or as it is."""
    return kind.value_type if pa.types.is_dictionary(kind) else kind


def _taken(column: pa.ChunkedArray, name: str) -> pa.ChunkedArray:
    """A column as the report has it: integers, floats or words, and no word where none is known."""
    held = column.cast(_held(column.type))
    if name in WHOLE:
        return held.cast(pa.int64())
    if name in NUMBERS:
        return held.cast(pa.float64())
    return pc.fill_null(held.cast(pa.string()), "")


def _study_faults(table: pa.Table, path: Path) -> Iterator[str]:
    """A study's or a search's table is named as it is: what a report writes is named after it as well."""
    own, kind = path.name.partition(".")[0], "search" if part(path) == TRIALS else "study"
    for study in sorted(set(table[kind].to_pylist())):
        if part(path) != MOVED and study != own:
            yield f"column {kind!r} says {study!r}; a table of that name is of {kind} {own!r}"
        elif not STUDY.fullmatch(study):
            yield f"column {kind!r} says {study!r}; a name has letters, digits, '-' and '_', and of a variant one '@'"


class Loose(BaseModel):
    """A part of a configuration; what is not named here is left alone."""

    model_config = ConfigDict(frozen=True, extra="allow")


Count = Annotated[int, Field(strict=True, ge=0)]


class Env(Loose):
    """A task."""

    kind: str = ""
    agents: Count | None = None
    targets: Count | None = None


class Trainer(Loose):
    """The budget of a run."""

    steps: Count | None = None
    final_episodes: Count | None = None


class Config(Loose):
    """The part of a run's configuration that a report looks at."""

    env: Env = Env()
    algo: dict[str, Any] = {}
    trainer: Trainer = Trainer()


@cache
def config_fault(text: str) -> str:
    """The fault of the configuration of a run; nothing if it can be used."""
    try:
        return "" if Config.model_validate_json(text).model_fields_set else "is no JSON object"
    except ValidationError as error:
        return "is no JSON object" if not error.errors()[0]["loc"] else f"holds {told(error)}"
