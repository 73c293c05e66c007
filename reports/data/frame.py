"""The exported tables, checked: everything a report shows comes from here.

A folder holds, per study, `<study>.parquet` (one row per run, step and metric), `<study>.runs.parquet` (one row per
planned run) and, if they came along, `<study>.made.parquet` (how and where runs were made) and
`<study>.readings.parquet` (the levels of each arm's reading); and per search `<search>.trials.parquet` (one row per
trial of the budget). `exported` reads them. What is wrong in them is an error of one line per fault; what is not there
yet is listed as missing.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from reports.data.drawn import (
    METHOD,
    METHODS,
    Build,
    Scenes,
    content,
    files_in,
    read_methods,
    read_modules,
    read_scenes,
    read_units,
)
from reports.data.escaping import markdown
from reports.data.exported import (
    ASSIGNED,
    FORMS,
    LEVELS,
    MADE,
    MOVED,
    OWN,
    PLACE,
    PLAYED,
    POINTS,
    READINGS,
    RUNS,
    TOLD,
    TRIALS,
    TRIED,
    config_fault,
    earlier,
    first,
    older,
    part,
    read,
)
from reports.data.stats import curve
from reports.data.trials import trial_faults, trial_gaps

__all__ = ["ASSIGNED", "MADE", "METHOD", "METHODS", "MOVED", "OWN", "PLACE", "PLAYED", "POINTS", "RUNS", "TOLD"]

STATUSES = ("finished", "failed", "partial", "missing")
EPISODES = "episode_*.gif"  # animations, one a task
YARDSTICKS, THEOREM = "yardsticks", "theorem"  # tables that are no studies
ASSIGN = "assign/"  # prefix of its metrics
FINAL, CURVE = "final/return", "eval/return"
EPISODE_ERROR = "final/return_sem"  # standard error of a final return over its evaluation episodes
ERRORS = (EPISODE_ERROR, "final/coverage_sem")  # of a yardstick; one of both is there
CHECKED = ("final/", "eval/", "theorem/", ASSIGN)  # metrics that are shown: they must be finite
REMEDY = "`rhmc export` and `rhmc yardsticks all` write them anew, and how runs were made to *.made.parquet"
OLDER = "made by an older version and set aside, until"

# The order of arms everywhere; others follow by name.
ORDER = (
    "full",
    "no regulation",
    "no filter",
    "RHMC",
    "HiT-MAC",
    "QMIX",
    "VDN",
    "IQL",
    "COMA",
    "MAPPO",
    "IPPO",
    "MADDPG",
)


class TableError(ValueError):
    """The tables cannot be reported on; the message holds one line per fault."""


@dataclass(frozen=True)
class Results:
    """Checked tables of one profile.

    Attributes:
        points: columns `POINTS`.
        runs: columns `RUNS` and `OWN`; one row per planned run. What is not known of `OWN` is no word, or NaN.
        profile: the profile that made them.
        methods: one record per method: `METHOD` as texts, `actions`, `parameters` per task and encoder, `defaults`.
        modules: the networks of Figures 1 to 3, one build per encoder.
        scenes: what Figures 4, 5 and 8 show.
        moved: trained policies with other numbers of agents and targets: columns `PLAYED`.
        trials: columns `TRIED`: the budget of every arm of the searches.
        levels: columns `LEVELS`: the level of each factor, of every arm of a study with readings.
        notes: what was left out of the tables, in sentences.
        older: studies and searches whose tables an older version exported.
        episodes: an animation of an episode by task, as a GIF.
        units: of the return, of each task that is not this project's.
    """

    points: pd.DataFrame
    runs: pd.DataFrame
    profile: str
    methods: Sequence[Mapping[str, Any]] = ()
    modules: Sequence[Build] = ()
    scenes: Scenes | None = None
    moved: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=PLAYED))
    levels: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=LEVELS))
    trials: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=TRIED))
    notes: tuple[str, ...] = ()
    older: tuple[str, ...] = ()
    episodes: Mapping[str, bytes] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def set_aside(self) -> str:
        """Sentences on tables of an older version; empty without any."""
        verbs = dict.fromkeys(self.older, "`rhmc study run` and `rhmc export`")
        verbs |= {name: "`rhmc search run` and `rhmc search export`" for name in self.older if name in self.searches}
        return " ".join(
            f"Tables of {', '.join(name for name in self.older if verbs[name] == made)}: {OLDER} {made} make them anew."
            for made in dict.fromkeys(verbs.values())
        )

    @property
    def studies(self) -> list[str]:
        """Names of the studies, yardsticks and theorem left out."""
        return sorted(set(self.runs["study"]) - {YARDSTICKS, THEOREM})

    @property
    def searches(self) -> list[str]:
        """Names of the searches."""
        return sorted(set(self.trials["search"]))

    def arms(self, study: str) -> list[str]:
        """Planned arms of a study in the order of `ORDER`; none if the study is not there."""
        return in_order(self.plan(study)["arm"])

    def tried(self, search: str) -> dict[str, pd.DataFrame]:
        """By arm in the order of `ORDER`, the trials of a search in that of the budget."""
        rows = self.trials[self.trials["search"] == search].sort_values("trial", kind="stable")
        return {arm: rows[rows["arm"] == arm].reset_index(drop=True) for arm in in_order(rows["arm"])}

    def has_readings(self, study: str) -> bool:
        """True if the arms of a study are trained under several readings of the paper."""
        return study in set(self.levels["study"])

    def plan(self, study: str, arm: str | None = None) -> pd.DataFrame:
        """Planned runs of a study or of one of its arms, by arm and seed."""
        if (study, arm) not in self._plans:
            rows = self.runs[(self.runs["study"] == study) & (True if arm is None else self.runs["arm"] == arm)]
            self._plans[study, arm] = rows.sort_values(["arm", "seed"], kind="stable")
        return self._plans[study, arm]

    def finished(self, study: str, arm: str) -> pd.DataFrame:
        """Planned runs of an arm that are finished."""
        rows = self.plan(study, arm)
        return rows[rows["status"] == "finished"]

    def finals(self, study: str, arm: str, metric: str = FINAL) -> NDArray[np.float64]:
        """Final values of an arm's finished runs, by seed: (n,), empty if there are none."""
        if (study, arm, metric) not in self._finals:
            rows = self._select(study, metric)
            keep = (rows["arm"] == arm) & rows["seed"].isin(self.finished(study, arm)["seed"])
            self._finals[study, arm, metric] = rows[keep].sort_values("seed")["value"].to_numpy(np.float64)
        return self._finals[study, arm, metric].copy()

    def curve(self, study: str, arm: str, metric: str = CURVE) -> pd.DataFrame:
        """Points of an arm's runs, unfinished ones included: columns seed, step, value."""
        rows = self._select(study, metric)
        rows = rows[rows["arm"] == arm].sort_values(["seed", "step"])
        return rows[["seed", "step", "value"]].reset_index(drop=True)

    def mean_curve(self, study: str, arm: str, metric: str = CURVE) -> pd.DataFrame:
        """Mean over seeds of `curve` with its interval, by step: columns as `stats.curve`, no rows without points."""
        if (study, arm, metric) not in self._curves:
            self._curves[study, arm, metric] = curve(self.curve(study, arm, metric))
        return self._curves[study, arm, metric]

    def budget(self, study: str) -> int | None:
        """Environment steps per run as configured, the largest where arms differ; None without runs."""
        return self._trainer(study, "steps")

    def final_episodes(self, study: str) -> int | None:
        """Episodes behind a run's final return; None if not written in its configuration."""
        return self._trainer(study, "final_episodes")

    def env(self, study: str) -> dict[str, Any]:
        """Task configuration of a study's first run; empty if the study is not there."""
        texts = self.plan(study)["config"]
        return dict(_config(texts.iloc[0]).get("env", {})) if len(texts) else {}

    def configs(self, study: str) -> dict[str, dict[str, Any]]:
        """Resolved configuration of each arm's first run, in the order of `arms`."""
        first = self.plan(study).drop_duplicates("arm").set_index("arm")["config"]
        return {arm: _config(str(first[arm])) for arm in self.arms(study)}

    def by_agents(self, study: str) -> dict[int, dict[str, str]]:
        """Arms of a study by number of agents, then by method, as their configurations say.

        A method is named by what is left of its arms' names without the number of agents (`RHMC` of `RHMC, agents=4`
        and `RHMC, 4 sensors`), so that two arms of one kind of algorithm are two methods.
        """
        out: dict[int, dict[str, str]] = {}
        for arm, config in self.configs(study).items():
            agents = config.get("env", {}).get("agents")
            if agents is not None:
                group, name = out.setdefault(int(agents), {}), without_count(arm, int(agents))
                group[arm if name in group else name] = arm
        return dict(sorted(out.items()))

    def kind(self, study: str, arm: str) -> str:
        """Kind of an arm's algorithm as its runs say."""
        return str(self.plan(study, arm)["algorithm"].iloc[0])

    @cached_property
    def theorem(self) -> pd.DataFrame:
        """Algorithm 1 against the optimum: a row per family of instances, columns instances, lost, ...; or no rows."""
        rows = self.points[self.points["study"] == THEOREM]
        table = rows.pivot_table(index="arm", columns="metric", values="value", aggfunc="sum")
        table.columns = pd.Index([str(name).removeprefix("theorem/") for name in table.columns])
        return table if {"instances", "lost"} <= set(table) else table.iloc[:0]

    def task(self, study: str) -> str:
        """Kind of a study's task; empty if the study is not there."""
        return str(self.env(study).get("kind", ""))

    @cached_property
    def yardsticks(self) -> list[tuple[dict[str, Any], pd.DataFrame]]:
        """Per task: its configuration, and one row per yardstick (index) with a column per metric."""
        found: dict[str, set[str]] = {}
        for row in self.runs[self.runs["study"] == YARDSTICKS].itertuples():
            key = json.dumps(_config(str(row.config)).get("env", {}), sort_keys=True)
            found.setdefault(key, set()).add(str(row.run))
        points = self.points[self.points["study"] == YARDSTICKS]
        out = []
        for key in sorted(found):
            table = points[points["run"].isin(found[key])].pivot_table(index="arm", columns="metric", values="value")
            out.append((json.loads(key), table.sort_values(FINAL) if FINAL in table else table))
        return out

    def by_task(self, study: str) -> list[tuple[dict[str, Any], list[str]]]:
        """The tasks of a study, each with its arms in their order; how a task is observed does not count."""
        if study not in self._tasks:
            found: list[tuple[dict[str, Any], list[str]]] = []
            for arm, config in self.configs(study).items():
                env = dict(config.get("env", {}))
                same = next((arms for task, arms in found if task == env or same_task(task, env)), None)
                if same is None:
                    found.append((env, [arm]))
                else:
                    same.append(arm)
            self._tasks[study] = found
        return self._tasks[study]

    def yardsticks_of(self, study: str) -> pd.DataFrame:
        """Yardsticks on a study's task; empty if none were run, or if its arms do not all have one task."""
        return self.yardsticks_on(self.env(study)) if len(self.by_task(study)) == 1 else pd.DataFrame()

    def yardsticks_on(self, env: Mapping[str, Any]) -> pd.DataFrame:
        """The same for a task's configuration."""
        return next((table for task, table in self.yardsticks if env and same_task(env, task)), pd.DataFrame())

    def gaps(self, expected: Mapping[str, Sequence[str]]) -> list[str]:
        """The gaps, in sentences of Markdown; `escape.words` gives them without its marks.

        Args:
            expected: arms that the paper has, per study.
        """
        found = [line for study in sorted({*expected, *self.studies}) for line in self._gaps(study, expected)]
        return [*found, *trial_gaps(self.trials), *self.notes]

    def _gaps(self, study: str, expected: Mapping[str, Sequence[str]]) -> Iterator[str]:
        arms = self.arms(study)
        if not arms:
            yield f"Study `{study}`: no results."
            return
        for arm in arms:
            rows = self.plan(study, arm)
            for status, words in (("missing", "not run"), ("partial", "unfinished"), ("failed", "failed")):
                seeds = rows.loc[rows["status"] == status, "seed"]
                if len(seeds):
                    listed = ", ".join(map(str, seeds))
                    words += f" (seed {listed})"
                    yield f"Study `{study}`, arm {markdown(arm)}: {len(seeds)} of {len(rows)} seeds {words}."
        absent = [arm for arm in expected.get(study, ()) if arm not in arms]
        if absent:
            yield f"Study `{study}`: no such arm yet: {markdown(', '.join(absent))}."
        if all(self.yardsticks_on(env).empty for env, _ in self.by_task(study)):
            yield f"Study `{study}`: no yardsticks were run on this task."

    def _trainer(self, study: str, name: str) -> int | None:
        found = [_config(text).get("trainer", {}).get(name) for text in self.plan(study)["config"]]
        return max((int(x) for x in found if x is not None), default=None)

    @cached_property
    def memo(self) -> dict[str, Any]:
        """Results that several parts of a report work out of these tables once, by name."""
        return {}

    @cached_property
    def _plans(self) -> dict[tuple[str, str | None], pd.DataFrame]:
        return {}

    @cached_property
    def _tasks(self) -> dict[str, list[tuple[dict[str, Any], list[str]]]]:
        return {}

    @cached_property
    def _finals(self) -> dict[tuple[str, str, str], NDArray[np.float64]]:
        return {}

    @cached_property
    def _curves(self) -> dict[tuple[str, str, str], pd.DataFrame]:
        return {}

    def _select(self, study: str, metric: str) -> pd.DataFrame:
        return self._metrics.get((study, metric), self.points.iloc[:0])

    @cached_property
    def _metrics(self) -> dict[tuple[str, str], pd.DataFrame]:
        return {(str(key[0]), str(key[1])): rows for key, rows in self.points.groupby(["study", "metric"])}


def load(folder: Path, profile: str, only: str | None = None) -> Results:
    """Read and check the tables of a folder.

    Args:
        folder: where exports are.
        profile: that made them.
        only: one study, read with the yardsticks and nothing else; None for all.

    Raises:
        TableError: the folder holds no tables, or not those of the study, or they are faulty.
    """
    try:
        files = files_in(folder, "*.parquet")
    except OSError as error:
        raise TableError(f"{folder}: cannot be read ({error.strerror})") from error
    if not files:
        raise TableError(f"{folder}: no tables here; `rhmc export` writes them")
    if only is not None:
        files = _only(files, only, folder)
    if old := [path.name for path in files if earlier(path)]:
        raise TableError(f"{folder}: of an earlier form: {', '.join(old)}; {REMEDY}")
    faults: list[str] = []
    tables: dict[str, list[pd.DataFrame]] = {name: [] for name in FORMS}
    for path in files:
        tables[part(path)].append(read(path, faults))
    names = {path.name.removesuffix(".parquet") for path in files if part(path) in ("points", "runs")}
    for name in sorted(names):
        if not name.endswith(".runs") and f"{name}.runs" not in names and name != THEOREM:
            faults.append(f"{name}.parquet: {name}.runs.parquet (the planned runs) is not beside it")
        if name.endswith(".runs") and name.removesuffix(".runs") not in names:
            faults.append(f"{name}.parquet: {name.removesuffix('.runs')}.parquet (the points) is not beside it")
    units = read_units(folder, faults)
    drawn = (read_methods(folder, faults), read_modules(folder, faults), read_scenes(folder, faults))
    if not faults:
        joined = {kind: _join(found, FORMS[kind].names) for kind, found in tables.items()}
        watched, moved, notes = _of_plan(joined)
        points = _join([joined["points"], watched], POINTS)
        gifs = {path.stem.partition("_")[2]: _animation(path) for path in sorted(folder.glob(EPISODES))}
        runs = _with_made(joined["runs"], joined[MADE])
        aside = tuple(path.name.partition(".")[0] for path in files if older(path))
        methods, modules, scenes = drawn
        about: dict[str, Any] = {"methods": methods, "levels": joined[READINGS], "notes": notes, "older": aside}
        about |= {"trials": joined[TRIALS], "units": units}
        results = Results(points, runs, profile, moved=moved, **about)
        if only is None:
            results = replace(results, modules=modules, scenes=scenes, episodes=gifs)
        faults = [*_made_faults(joined[MADE]), *_plan_faults(results), *_level_faults(results), *_point_faults(results)]
        faults += trial_faults(results.trials, profile, results.studies)
        if not faults:
            return results
    raise TableError("\n".join(faults))


def in_order(arms: Iterable[str]) -> list[str]:
    """Every arm once: those of `ORDER` in that order, others by name."""
    return sorted(set(arms), key=lambda arm: (ORDER.index(arm) if arm in ORDER else len(ORDER), arm))


def without_count(arm: str, agents: int) -> str:
    """An arm's name without the number of agents: a part `agents=4`, `4 sensors` or `n = 4` between commas."""
    counted = re.compile(rf"(\w+(\.\w+)*\s*=\s*{agents}|{agents}\s+(sensors?|agents?))")
    return ", ".join(part for part in arm.split(", ") if not counted.fullmatch(part)) or arm


def same_task(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """True if two configurations are one task: how it is observed does not count, nor what only one writes out."""
    shared = (a.keys() & b.keys()) - {"observation"}
    return "kind" in shared and all(a[key] == b[key] for key in shared)


def _animation(path: Path) -> bytes:
    """An animation; nothing where it cannot be read, which the page says in its place."""
    try:
        return content(path)
    except OSError:
        return b""


def _of_plan(tables: Mapping[str, pd.DataFrame]) -> tuple[pd.DataFrame, pd.DataFrame, tuple[str, ...]]:
    """The tables of assignments and transfer, without runs that are no longer planned; and which studies had such.

    These tables are made by commands of their own, so they can be older than the plan: not a fault, but not shown.
    """
    planned = set(zip(tables["runs"]["study"], tables["runs"]["arm"], tables["runs"]["run"], strict=True))
    kept, notes = [], []
    for kind, verb in ((ASSIGNED, "assignments"), (MOVED, "transfer")):
        table = tables[kind]
        keys = zip(table["study"], table["arm"], table["run"], strict=True)
        there = np.array([key in planned for key in keys], dtype=bool)
        kept.append(table[there])
        for study in sorted(set(table["study"][~there])):
            notes.append(f"Study `{study}`: `rhmc {verb}` was run on runs that are no longer planned; left out.")
    return kept[0], kept[1], tuple(notes)


def _only(files: Sequence[Path], study: str, folder: Path) -> list[Path]:
    """The files of a study and of the yardsticks."""
    other = (YARDSTICKS, THEOREM, MOVED)
    names = sorted({name for path in files if (name := path.name.split(".")[0]) not in other})
    if study not in names:
        near = f"there are {', '.join(names)}" if names else "there is none"
        raise TableError(f"{folder}: no table of study {study!r} here ({near}); `rhmc export` writes it")
    return [path for path in files if path.name.split(".")[0] in (study, YARDSTICKS)]


def _join(tables: list[pd.DataFrame], columns: Sequence[str]) -> pd.DataFrame:
    kept = [table for table in tables if len(table)]
    return pd.concat(kept, ignore_index=True) if kept else pd.DataFrame(columns=list(columns))


def _with_made(runs: pd.DataFrame, made: pd.DataFrame) -> pd.DataFrame:
    """The planned runs, and of each how it was made, as far as that is known."""
    once = made.drop_duplicates(PLACE).astype({"seed": "int64", "seconds": "float64"})
    both = runs.astype({"seed": "int64"}).merge(once, how="left", on=PLACE)
    return both.fillna(dict.fromkeys([name for name in OWN if name != "seconds"], ""))


def _made_faults(made: pd.DataFrame) -> Iterator[str]:
    for row in made[made.duplicated(PLACE)].itertuples():
        yield f"{_name(row)}, run {row.run}: how it was made is there twice"


def _plan_faults(results: Results) -> Iterator[str]:
    runs = results.runs
    for row in runs[~runs["status"].isin(STATUSES)].itertuples():
        yield f"{_name(row)}: status {row.status!r} is none of {', '.join(STATUSES)}"
    for row in runs[runs["profile"] != results.profile].itertuples():
        yield f"{_name(row)}: made with profile {row.profile!r}, and this report is of {results.profile!r}"
    yield from first(
        f"{_name(row)}: column 'config' {fault}"
        for row in runs.itertuples()
        if (fault := config_fault(str(row.config)))
    )
    studies = runs[runs["study"] != YARDSTICKS]
    for row in studies[studies.duplicated(["study", "arm", "seed"])].itertuples():
        yield f"{_name(row)}: planned twice"
    for row in studies[studies.duplicated(["study", "arm", "run"]) & (studies["status"] != "missing")].itertuples():
        yield f"{_name(row)}: run {row.run} already stands for another seed of this arm"
    for study, rows in studies.groupby("study"):
        seeds = sorted(set(rows["seed"]))
        for arm, group in rows.groupby("arm"):
            for seed in sorted(set(seeds) - set(group["seed"])):
                yield f"{study}, arm {arm!r}, seed {seed}: planned for other arms, and not for this one"


def _level_faults(results: Results) -> Iterator[str]:
    """An arm that is not planned, or has two levels of one factor or none."""
    levels = results.levels
    planned = set(zip(results.runs["study"], results.runs["arm"], strict=True))
    for study, arm in sorted(set(zip(levels["study"], levels["arm"], strict=True)) - planned):
        yield f"{study}, arm {arm!r}: has a reading, and is not in the plan"
    for row in levels[levels.duplicated(["study", "arm", "factor"])].itertuples():
        yield f"{row.study}, arm {row.arm!r}: two levels of factor {row.factor!r}"
    for name, rows in levels.groupby("study"):
        counts = rows.groupby("arm")["factor"].nunique()
        for arm in counts.index[counts < rows["factor"].nunique()]:
            yield f"{name}, arm {arm!r}: a factor has no level"


def _point_faults(results: Results) -> Iterator[str]:
    points, runs = results.points, results.runs
    keys = ["study", "arm", "seed", "run"]
    shown = points[points["metric"].astype(str).str.startswith(CHECKED)]
    yield from first(
        f"{_name(row)}, run {row.run}, step {row.step}: {row.metric} is {row.value}"
        for row in shown[~np.isfinite(shown["value"].astype(float))].itertuples()
    )
    yield from first(
        f"{_name(row)}, run {row.run}: {row.metric} at step {row.step} is there twice"
        for row in points[points.duplicated([*keys, "step", "metric"])].itertuples()
    )
    studied = points[points["study"] != THEOREM]
    planned = pd.MultiIndex.from_frame(runs[keys].astype({"seed": int}))
    found = studied.drop_duplicates(keys)
    for row in found.itertuples():
        if (row.study, row.arm, int(str(row.seed)), row.run) not in planned:
            arms = ", ".join(f"'{arm}'" for arm in results.arms(str(row.study))) or "none"
            yield f"{_name(row)}, run {row.run}: has points, and is not in the plan (planned arms: {arms})"
    counts = points.dropna(subset=["value"]).groupby(["run", "step", "metric"])["value"].nunique().reset_index()
    differing = counts[counts["value"] > 1].drop_duplicates("run")
    yield from first(
        f"run {row.run}: two values of {row.metric} at step {row.step}, so two runs share one id"
        for row in differing.itertuples()
    )
    logged = points[~points["metric"].astype(str).str.startswith(ASSIGN)]
    with_points = set(zip(logged["study"], logged["run"], strict=True))
    finals = points[points["metric"] == FINAL]
    with_final = set(zip(finals["study"], finals["run"], strict=True))
    for row in runs.itertuples():
        if row.status == "finished" and row.study != THEOREM and (row.study, row.run) not in with_final:
            yield f"{_name(row)}, run {row.run}: marked finished, and {FINAL} is not there"
        if row.status == "missing" and (row.study, row.run) in with_points:
            yield f"{_name(row)}, run {row.run}: marked missing, and has points"


def _name(row: Any) -> str:
    return f"{row.study}, arm {row.arm!r}, seed {row.seed}"


def _config(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def adopted(runs: pd.DataFrame) -> bool:
    """True if older code made some of the runs, and trainings of the present code repeated it."""
    return bool(runs["adopted"].astype(bool).any())


def mixed(runs: pd.DataFrame) -> bool:
    """True if runs of one method in one task were made by different code."""
    known = runs[runs["fingerprint"].fillna("") != ""]
    place = ["algorithm", "task"]
    return len(known[[*place, "fingerprint"]].drop_duplicates()) > len(known[place].drop_duplicates())
