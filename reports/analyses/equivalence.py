"""Results here against published ones: the same bytes, or how far apart, arm by arm.

Both are exported tables. Of an arm every published value has to be there with the same bits, the time that training
took aside. Where one differs, as on a processor of another kind, the final returns are compared: their difference with
its interval, and two one-sided tests that it is within a margin.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd

from reports.data.drawn import files_in
from reports.data.exported import older
from reports.data.frame import FINAL, TableError
from reports.data.stats import Interval, Values, difference, equivalence, equivalence_of_pairs
from reports.render.tables import SPAN, estimate

MARGIN = 1.0  # points of return
LEVEL = 0.05
PLACE = ["study", "arm", "seed", "run", "step", "metric"]

Outcome = Literal["byte-equal", "equivalent", "not shown to be equivalent", "other settings", "missing"]
HOLDS: tuple[Outcome, ...] = ("byte-equal", "equivalent")


class Compared(NamedTuple):
    """The comparison of an arm. `difference` (here less published) and `p` where bytes differ, else NaN."""

    study: str
    arm: str
    outcome: Outcome
    seeds: int  # that both have
    difference: Interval
    p: float
    note: str

    @property
    def holds(self) -> bool:
        """True if the published result stands."""
        return self.outcome in HOLDS


NOTHING = Interval(float("nan"), float("nan"), float("nan"), 0)


def read(folder: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Values and runs of all studies in a folder of exported tables.

    Raises:
        TableError: there is none, or one is not readable, or of an older version.
    """
    names = [file.name.removesuffix(".runs.parquet") for file in files_in(folder, "*.runs.parquet")]
    names = [name for name in names if (folder / f"{name}.parquet").is_file()]
    if not names:
        raise TableError(f"{folder}: no exported tables (*.runs.parquet) here")
    if any(older(folder / f"{name}.runs.parquet") for name in names):
        remedy = "`rhmc study run` and `rhmc export` make them anew, `rhmc verify --publish` publishes them"
        raise TableError(f"{folder}: tables of an older version, which are not compared; {remedy}")
    try:
        values = [pd.read_parquet(folder / f"{name}.parquet") for name in names]
        runs = [pd.read_parquet(folder / f"{name}.runs.parquet") for name in names]
        return pd.concat(values, ignore_index=True)[[*PLACE, "value"]], pd.concat(runs, ignore_index=True)
    except (OSError, ValueError, KeyError) as error:
        raise TableError(f"{folder}: not exported tables ({error})") from error


def compare(here: pd.DataFrame, published: pd.DataFrame, margin: float = MARGIN) -> list[Compared]:
    """Every published arm against what is here.

    Args:
        here: values, columns study, arm, seed, run, step, metric, value; what is not published is not looked at.
        published: the same.
        margin: in units of return.
    """
    mine = dict(iter(here.groupby(["study", "arm"])))
    empty = here.iloc[:0]
    return [_arm(mine.get(key, empty), theirs, margin) for key, theirs in published.groupby(["study", "arm"])]


def _arm(here: pd.DataFrame, published: pd.DataFrame, margin: float) -> Compared:
    key = str(published["study"].iloc[0]), str(published["arm"].iloc[0])
    seeds = sorted(set(published["seed"]))
    missing = [seed for seed in seeds if seed not in set(here["seed"])]
    here = here[here["seed"].isin(seeds)]
    if missing:
        words = f"seed{'s' * (len(missing) > 1)} {', '.join(map(str, missing))}"
        return Compared(*key, "missing", len(seeds) - len(missing), NOTHING, float("nan"), f"{words} not here")
    if set(here["run"]) != set(published["run"]):
        return Compared(*key, "other settings", len(seeds), NOTHING, float("nan"), "the runs here have other settings")
    first = next(differing(here, published), None)
    if first is None:
        return Compared(*key, "byte-equal", len(seeds), NOTHING, float("nan"), "")
    x, y = finals(here), finals(published)
    p = equivalence(x, y, margin)
    outcome: Outcome = "equivalent" if p < LEVEL else "not shown to be equivalent"
    return Compared(*key, outcome, len(seeds), difference(x, y), p, f"first difference: {first}")


def compare_runs(here: pd.DataFrame, published: pd.DataFrame, margin: float = MARGIN) -> list[Compared]:
    """Each run here against its published self; where some differ, the differences of their finals are tested together.

    Args:
        here: values of some of the published runs.
        published: values.
        margin: in units of return.
    """
    place = ["study", "arm", "seed"]
    theirs = dict(iter(published.groupby(place)))
    pairs = [(mine, theirs[key]) for key, mine in here.groupby(place)]
    firsts = [next(differing(mine, other), None) for mine, other in pairs]
    gaps = [finals(mine) - finals(other) for mine, other in pairs]
    moved = [float(gap[0]) for gap, first in zip(gaps, firsts, strict=True) if first]
    p = equivalence_of_pairs(np.array(moved), margin)
    return [_run(mine, first, float(gap[0]), p) for (mine, _), first, gap in zip(pairs, firsts, gaps, strict=True)]


def _run(here: pd.DataFrame, first: "Difference | None", gap: float, p: float) -> Compared:
    study, arm, seed = here.iloc[0][["study", "arm", "seed"]]
    name = (str(study), f"{arm}, seed {seed}")
    if first is None:
        return Compared(*name, "byte-equal", 1, NOTHING, float("nan"), "")
    outcome: Outcome = "equivalent" if p < LEVEL else "not shown to be equivalent"
    return Compared(*name, outcome, 1, Interval(gap, float("nan"), float("nan"), 1), p, f"first difference: {first}")


class Difference(NamedTuple):
    """A value that is not the same."""

    seed: int
    step: int
    metric: str
    here: float  # NaN where there is none
    published: float

    def __str__(self) -> str:
        return f"seed {self.seed}, step {self.step:,}, {self.metric}: {self.here!r} here, {self.published!r} published"


def differing(here: pd.DataFrame, published: pd.DataFrame) -> Iterator[Difference]:
    """Published values of an arm that are not here with the same bits, by step."""
    place = ["step", "seed", "run", "metric"]  # a yardstick has a run for each task
    both = published[[*place, "value"]].merge(here[[*place, "value"]], on=place, how="left", suffixes=("", "_here"))
    both = both.sort_values(place)
    bits = [both[name].to_numpy(np.float64).view(np.int64) for name in ("value_here", "value")]
    for row in both[bits[0] != bits[1]].itertuples():
        yield Difference(int(row.seed), int(row.step), str(row.metric), float(row.value_here), float(row.value))


def finals(rows: pd.DataFrame) -> Values:
    """Final returns by seed."""
    return rows[rows["metric"] == FINAL].sort_values(["seed", "run"])["value"].to_numpy(np.float64)


def table(compared: Sequence[Compared]) -> list[list[str]]:
    """Rows of what is not byte-equal: study, arm, seeds, difference with its interval, p, outcome."""
    return [
        [one.study, one.arm, str(one.seeds), _shown(one.difference), _number(one.p), one.outcome, one.note]
        for one in compared
        if one.outcome != "byte-equal"
    ]


COLUMNS = ["study", "arm", "seeds", f"difference {SPAN}", "p", "outcome", "note"]


def summary(compared: Sequence[Compared], name: str) -> str:
    """One line: how the results here compare with the published ones of that name."""
    if all(one.outcome == "byte-equal" for one in compared):
        return f"byte-equal to the published {name} results: {_arms(len(compared))}"
    counts = {outcome: sum(one.outcome == outcome for one in compared) for one in compared for outcome in [one.outcome]}
    parts = [f"{_arms(n)} {outcome}" for outcome, n in counts.items()]
    return f"against the published {name} results: {', '.join(parts)}"


def _arms(count: int) -> str:
    return f"{count} arm{'s' * (count != 1)}"


def _shown(interval: Interval) -> str:
    if np.isnan(interval.value):
        return ""
    return estimate(interval, lambda x: f"{x:+.2f}")


def _number(p: float) -> str:
    return "" if np.isnan(p) else f"{p:.3f}"
