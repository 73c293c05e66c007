"""The statements of a bundle on its study, its runs and their values: one strict model, checked as a whole."""

import hashlib
import json
import math
from collections.abc import Iterable, Sequence
from functools import partial
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic import AfterValidator, Field, Json, StringConstraints, TypeAdapter, ValidationError, model_validator

from pipelines.bundles import files as bundle_files
from pipelines.bundles.files import KEY, MANIFEST, BundleError, Files
from pipelines.specs.document import choices, nearest, show
from pipelines.specs.plugins import UnnamedError, discover, unnamed
from pipelines.specs.study import IMPORTS, PROFILES, RunSpec, arm_fault, fields, study_fault
from pipelines.tracking.plan import KIND, Item, flat_settings, flatten
from pipelines.tracking.policy import NO_SPEC
from pipelines.tracking.tracker import Card
from pipelines.workspace.work_folder import one_line
from rhmc.algorithms import ALGORITHMS
from rhmc.training.trainer import Config, grid_step, misfit
from rhmc.types import Frozen, Metrics

FORMAT = 4
RUNS = pa.schema(
    [
        ("key", pa.string()),  # spec id and fingerprint
        ("arm", pa.string()),
        ("seed", pa.int64()),
        ("commit", pa.string()),
        ("params", pa.string()),  # JSON
        ("config", pa.string()),  # the spec as canonical JSON
        ("finished", pa.bool_()),
        ("policy", pa.string()),  # SHA-256 of its file, empty without one
    ]
)
POINTS = pa.schema([("run", pa.int64()), ("step", pa.int64()), ("metric", pa.string()), ("value", pa.float64())])
ANEW = "train its study anew with `rhmc study run`"
ROWS = {bundle_files.RUNS: 10_000, bundle_files.POINTS: 5_000_000}  # that are read at most
UNFOLDED = 2**26  # characters in a column of texts, each as often as it occurs
DECODED = 2**29  # bytes of a table in memory
GROUPS = ("eval/", "final/", "time/", "train/")


# The model


def _sound(fault: Any, value: str) -> str:
    """The value, unless a rule has something against it."""
    if text := fault(value):
        raise ValueError(text)
    return value


def _among(allowed: Iterable[str], value: str) -> str:
    return "" if value in (names := tuple(allowed)) else choices(value, names)


def _setting_fault(name: str) -> str:
    settings = (*fields(), "seed")
    return "" if name in settings else f"no setting of a run{nearest(name, settings)}"


def _text_fault(text: str) -> str:
    return "" if text.replace("\n", "").isprintable() else "must be text without control characters"


def metric_fault(metric: str) -> str:
    """The fault of the name of a metric, or nothing."""
    kind = next((group for group in GROUPS if metric.startswith(group)), "")
    plain = metric.removeprefix(kind).replace("_", "").replace(".", "").replace("-", "")
    if kind and plain.isascii() and plain.isalnum() and len(metric) <= 200:
        return ""
    return f"must be one of {', '.join(GROUPS)} and letters, digits, '_', '.' and '-'"


Digest = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{12}$")]
Key = Annotated[str, StringConstraints(pattern=f"^{KEY}$")]
Module = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][\w.]*$")]
Commit = Annotated[str, StringConstraints(pattern=r"^([0-9a-f]{3,64}(-dirty)?|unknown)?$")]
Seal = Annotated[str, StringConstraints(pattern=r"^([0-9a-f]{64})?$")]  # of a file
Arm = Annotated[str, AfterValidator(partial(_sound, arm_fault))]
StudyName = Annotated[str, AfterValidator(partial(_sound, study_fault))]
ProfileName = Annotated[str, AfterValidator(partial(_sound, partial(_among, PROFILES)))]
Method = Annotated[str, AfterValidator(partial(_sound, partial(_among, ALGORITHMS)))]
Setting = Annotated[str, AfterValidator(partial(_sound, _setting_fault))]
Text = Annotated[str, AfterValidator(partial(_sound, _text_fault))]
Metric = Annotated[str, AfterValidator(partial(_sound, metric_fault))]


class Manifest(Frozen):
    """The statements of a bundle on itself."""

    format: Literal[4]
    study: StudyName
    profile: ProfileName
    note: Text
    params: dict[Method, tuple[Setting, ...]]
    arms: tuple[Arm, ...] = Field(min_length=1)
    commit: Commit
    plan: tuple[tuple[Arm, Key], ...] = ()  # every run of the study, in the bundle or not
    code: dict[Digest, dict[Module, Digest]] = Field(default_factory=dict)  # the modules of each code that made a run
    adopted: dict[Key, Text] = Field(default_factory=dict)  # runs that older code made: which, and what was compared
    imports: tuple[Module, ...] = Field((), exclude_if=lambda modules: not modules)  # that define what its runs are

    @model_validator(mode="after")
    def _whole(self) -> "Manifest":
        if len(set(self.arms)) < len(self.arms):
            raise ValueError("arms: one of them is there twice")
        if not self.plan:
            raise ValueError("plan: must name the runs of the study")
        return self


class Run(Frozen):
    """A row of the runs."""

    key: Key
    arm: Arm
    seed: int = Field(ge=0)
    commit: Commit
    params: Json[dict[str, str]]
    config: str
    finished: bool
    policy: Seal


METRICS = TypeAdapter(list[Metric])


class Values(NamedTuple):
    """The values of a run: three columns, sorted by step and metric."""

    step: np.ndarray
    metric: Sequence[str]
    value: np.ndarray

    def points(self) -> list[Metrics]:
        """As training gave them."""
        points: dict[int, Metrics] = {}
        for step, metric, value in zip(self.step.tolist(), self.metric, self.value.tolist(), strict=True):
            points.setdefault(step, {"step": float(step)})[metric] = value
        return list(points.values())


class Entry(NamedTuple):
    """A run in a bundle."""

    item: Item
    finished: bool
    policy: str  # SHA-256 of its file, empty without one
    values: Values
    key: str  # in the bundle

    @property
    def place(self) -> tuple[str, str]:
        """Arm and key."""
        return self.item.card.arm, self.item.key

    @property
    def files(self) -> str:
        """The beginning of the names of its files."""
        return f"policies/{self.key}.pt" if self.finished else f"checkpoints/{self.key}/"


class Told(NamedTuple):
    """All that a bundle says."""

    about: Manifest
    entries: list[Entry]

    @property
    def plan(self) -> set[tuple[str, str]]:
        """Arm and key of every run of the study."""
        return set(self.about.plan)


# Reading


def read(files: Files) -> Told:
    """The statements of a bundle, all of it checked but for the content of its policies and checkpoints.

    Raises:
        BundleError: something is not as `pack` writes it.
    """
    about = _manifest(files)
    runs = _runs(_table(files, bundle_files.RUNS, RUNS))
    values = _values(_table(files, bundle_files.POINTS, POINTS), len(runs))
    entries = [_entry(about, at, run, values[at]) for at, run in enumerate(runs)]
    _check_whole(about, entries, files)
    return Told(about, entries)


def _manifest(files: Files) -> Manifest:
    content = files.read(MANIFEST)
    try:
        written = json.loads(content)
        form, needed = written.get("format"), written.get(IMPORTS)
    except (ValueError, AttributeError, RecursionError) as error:
        raise BundleError(f"{MANIFEST}: must be a mapping in JSON ({one_line(error)})") from error
    if type(form) is int and form != FORMAT:
        age, remedy = ("a later", "import it with that version") if form > FORMAT else ("an older", ANEW)
        raise BundleError(f"a bundle of format {form}, made by {age} version; this one reads format {FORMAT}: {remedy}")
    if text := _unnamed(needed):
        raise BundleError(f"{MANIFEST}: {text}")
    try:
        return Manifest.model_validate_json(content, strict=True)
    except ValidationError as error:
        raise BundleError(f"{MANIFEST}: {_first(error)}") from error


def _unnamed(needed: Any) -> str:
    """The packages that somebody has to name before the bundle can be understood."""
    discover()
    return unnamed(one for one in needed if isinstance(one, str)) if isinstance(needed, list) else ""


def _first(error: ValidationError) -> str:
    """The first fault: where, what, and what is allowed."""
    detail = error.errors(include_url=False)[0]
    place = "".join(
        f"{part if str(part).isidentifier() else show(part)}: " for part in detail["loc"] if part != "[key]"
    )
    own = detail["type"] == "value_error"  # a rule of ours
    rule = str(detail["ctx"]["error"]) if own else detail["msg"].replace("Input should", "must")
    rule = rule[:1].lower() + rule[1:]
    if detail["type"] in ("missing", "extra_forbidden") or not detail["loc"]:
        return place + rule
    return f"{place}{show(detail['input'])} is not allowed; {rule}"


def _table(files: Files, name: str, schema: pa.Schema) -> pa.Table:
    """A table with its texts still folded: a text that occurs a million times is there once."""
    texts = [field.name for field in schema if field.type == pa.string()]
    try:
        source = pa.BufferReader(files.read(name))
        _check_head(name, pq.ParquetFile(source), schema, texts)
        table = pq.ParquetFile(source, read_dictionary=texts)
        content = table.read(use_threads=False)
        content.validate(full=True)
    except (OSError, ValueError, KeyError, MemoryError, pa.ArrowException) as error:
        raise BundleError(f"{name}: not a parquet table that can be read ({one_line(error)})") from error
    for column in content.column_names:
        if content[column].null_count:
            row = int(np.flatnonzero(content[column].is_null().to_numpy())[0])
            raise BundleError(f"{name}: row {row}: {column}: null is not allowed; every row has a value")
    for column in texts:
        _check_unfolded(name, column, content[column])
    return content


def _check_head(name: str, table: pq.ParquetFile, schema: pa.Schema, texts: Sequence[str]) -> None:
    head = table.metadata
    unfolded = [pa.field(f.name, f.type.value_type if f.name in texts and pa.types.is_dictionary(f.type) else f.type)
                for f in table.schema_arrow]  # fmt: skip
    if not pa.schema(unfolded).equals(schema):
        raise BundleError(f"{name}: has other columns; it has {', '.join(f'{f.name} ({f.type})' for f in schema)}")
    if not 0 <= head.num_rows <= ROWS[name]:
        raise BundleError(f"{name}: {head.num_rows:,} rows; at most {ROWS[name]:,} are read")
    # Of the groups: to look at a column whose head is damaged ends the process, in the library's own code.
    size = sum(head.row_group(i).total_byte_size for i in range(head.num_row_groups))
    if size > DECODED:
        raise BundleError(f"{name}: {size:,} bytes unpacked; at most {DECODED:,} are read")


def _check_unfolded(name: str, column: str, texts: pa.ChunkedArray) -> None:
    size = 0
    for chunk in texts.chunks:
        lengths = pc.binary_length(chunk.dictionary).to_numpy(zero_copy_only=False)
        size += int(lengths[chunk.indices.to_numpy(zero_copy_only=False)].sum()) if len(chunk) else 0
    if column != "metric" and size > UNFOLDED:
        raise BundleError(f"{name}: {column}: {size:,} characters; at most {UNFOLDED:,} are read")


def _runs(table: pa.Table) -> list[Run]:
    runs: list[Run] = []
    seen: set[tuple[str, int]] = set()
    for at, row in enumerate(table.to_pylist()):
        try:
            runs.append(Run.model_validate(row, strict=True))
        except ValidationError as error:
            raise BundleError(f"{bundle_files.RUNS}: row {at}: {_first(error)}") from error
        place = (runs[-1].arm, runs[-1].seed)
        if place in seen:
            raise BundleError(
                f"{bundle_files.RUNS}: row {at}: {show(place[0])} s{place[1]} is there twice; once is allowed"
            )
        seen.add(place)
    return runs


def _values(table: pa.Table, runs: int) -> list[Values]:
    """The values of each run."""
    run, step, value = (table[name].to_numpy() for name in ("run", "step", "value"))
    metric, names = _metrics(table["metric"])
    _each(run, "run", (run >= 0) & (run < runs), f"must be a row of {bundle_files.RUNS}, which has {runs}")
    _each(step, "step", step >= 0, "must be 0 or more")
    _each(value, "value", np.isfinite(value), "must be a finite number")
    order = np.lexsort((metric, step, run))
    run, step, metric, value = (column[order] for column in (run, step, metric, value))
    same = (run[1:] == run[:-1]) & (step[1:] == step[:-1]) & (metric[1:] == metric[:-1])
    if same.any():
        at = int(np.flatnonzero(same)[0])
        what = f"{names[metric[at]]} of run {run[at]} at step {step[at]}"
        raise BundleError(f"{bundle_files.POINTS}: row {order[at + 1]}: {what} is there twice; once is allowed")
    starts = np.searchsorted(run, np.arange(runs + 1))
    cuts = [slice(*pair) for pair in pairwise(starts)]
    return [Values(step[cut], [names[i] for i in metric[cut]], value[cut]) for cut in cuts]


def _metrics(column: pa.ChunkedArray) -> tuple[np.ndarray, list[str]]:
    """For each row the number of its metric, and the metrics in alphabetical order."""
    folded = column.unify_dictionaries().combine_chunks()
    folded = folded.chunk(0) if isinstance(folded, pa.ChunkedArray) and folded.num_chunks else folded
    if not len(folded):
        return np.zeros(0, np.int64), []
    written = folded.dictionary.to_pylist()
    try:
        METRICS.validate_python(written, strict=True)
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        rule = str(detail.get("ctx", {}).get("error", detail["msg"]))
        raise BundleError(f"{bundle_files.POINTS}: metric: {show(detail['input'])} is not allowed; {rule}") from error
    names = sorted(set(written))
    places = {name: i for i, name in enumerate(names)}
    number = np.array([places[name] for name in written], np.int64)
    return number[folded.indices.to_numpy(zero_copy_only=False)], names


def _each(column: np.ndarray, name: str, fine: np.ndarray, rule: str) -> None:
    if not fine.all():
        row = int(np.flatnonzero(~fine)[0])
        raise BundleError(f"{bundle_files.POINTS}: row {row}: {name}: {column[row]} is not allowed; {rule}")


# Across the parts


def _entry(about: Manifest, at: int, run: Run, values: Values) -> Entry:
    where = f"{bundle_files.RUNS}: row {at}"
    spec = _spec(where, run.config)
    code = _code(where, run, spec)
    if run.seed != spec.seed:
        raise BundleError(f"{where}: seed: {run.seed} is not allowed; of these settings it is {spec.seed}")
    if run.arm not in about.arms:
        raise BundleError(f"{where}: arm: {show(run.arm)} is not among the arms of {MANIFEST}")
    _check_params(where, run.params, spec)
    card = Card(
        run.arm, spec.seed, spec.id, code, spec.algo.kind, spec.env.kind, run.commit, run.params,
        modules=about.code.get(code, {}), imported=_origin(run, values), env=spec.env.model_dump(mode="json"),
    )  # fmt: skip
    entry = Entry(Item(card, spec, about.study), run.finished, run.policy, values, run.key)
    _check_curve(where, entry)
    return entry


def _code(where: str, run: Run, spec: RunSpec) -> str:
    """The code that made a run, from its key, whose other part has to be that of its settings."""
    code = run.key.rpartition("-")[2]
    if run.key != (key := f"{spec.id}-{code}"):
        raise BundleError(f"{where}: key: {run.key} is not allowed; of these settings and this code it is {key}")
    return code


def _spec(where: str, config: str) -> RunSpec:
    try:
        spec = RunSpec.model_validate_json(config)
    except ValidationError as error:
        raise BundleError(f"{where}: config: {_first(error)}") from error
    except UnnamedError as error:
        raise BundleError(f"{where}: config: {error}") from error
    except NO_SPEC as error:
        raise BundleError(f"{where}: config: no settings that this code knows ({one_line(error)})") from error
    if not isinstance(spec.algo, Frozen):  # nothing but a mapping is made a configuration of its kind
        raise BundleError(f"{where}: config: algo: {show(spec.algo)} is not allowed; must be a mapping")
    numbers = {name: value for name, value in flatten(spec.model_dump()).items() if isinstance(value, float)}
    if astray := [name for name, value in numbers.items() if not math.isfinite(value)]:
        raise BundleError(f"{where}: config: {astray[0]}: {numbers[astray[0]]} is not allowed; must be a finite number")
    if not _within(_but_imports(config), _but_imports(spec.canonical())):
        raise BundleError(f"{where}: config: {show(config)} is not allowed; must be as the settings are written")
    if fault := misfit(spec.env, spec.algo):
        raise BundleError(f"{where}: config: env: {fault}")
    return spec


def _but_imports(config: str) -> dict[str, Any]:
    """The modules are named as they are here, and may have moved within their package."""
    return {name: value for name, value in json.loads(config).items() if name != IMPORTS}


def _within(part: Any, whole: Any) -> bool:
    """True if all that is given is there as it is given, so that nothing was read as something else."""
    if isinstance(part, dict) and isinstance(whole, dict):
        return part.keys() <= whole.keys() and all(_within(value, whole[key]) for key, value in part.items())
    return type(part) is type(whole) and bool(part == whole)


def _check_params(where: str, params: dict[str, str], spec: RunSpec) -> None:
    flat = {name: str(value) for name, value in flat_settings(spec).items()}
    flat = {"method": flat.pop(KIND)} | flat
    for name in ("method", "seed"):
        if name not in params:
            raise BundleError(f"{where}: params: {name}: missing")
    for name, value in params.items():
        if flat.get(name) != value:
            allowed = show(flat[name]) if name in flat else "no such setting in this run"
            raise BundleError(f"{where}: params: {show(name)}: {show(value)} is not allowed; {allowed}")


def _origin(run: Run, values: Values) -> str:
    """A name for what a bundle has of a run: equal exactly for equal content."""
    digest = hashlib.sha256(run.model_dump_json().encode())
    for column in (values.step, values.value):
        digest.update(np.ascontiguousarray(column).tobytes())
    digest.update("\0".join(values.metric).encode())
    return digest.hexdigest()[:12]


def _check_curve(where: str, entry: Entry) -> None:
    """A finished run has a value at every point of its grid and its final ones at the last; another has none."""
    cfg, steps = entry.item.spec.trainer, sorted(set(entry.values.step.tolist()))
    if not entry.finished:
        if steps:
            raise BundleError(f"{where}: not finished, and has values in {bundle_files.POINTS}; a checkpoint has them")
        return
    if astray := [step for step in steps if not on_grid(cfg, step)]:
        raise BundleError(f"{where}: a value at step {astray[0]:,}, which is no point of the run's grid")
    if len(steps) != grid_size(cfg):
        raise BundleError(f"{where}: called finished, with values at {len(steps):,} of {grid_size(cfg):,} points")
    final = {step for step, name in zip(entry.values.step.tolist(), entry.values.metric, strict=True)
             if name.startswith("final/")}  # fmt: skip
    if final != {steps[-1]}:
        raise BundleError(f"{where}: called finished; its final values must be there, and at step {steps[-1]:,} alone")


def on_grid(cfg: Config, step: int) -> bool:
    """True if some point of a run's evaluation grid is at this step."""
    point = max(0, (step - cfg.num_envs) * cfg.evaluations // cfg.steps + 1)  # the first that may be as late
    return point <= cfg.evaluations and grid_step(cfg, point) == step


def grid_size(cfg: Config) -> int:
    """The number of different steps in a run's evaluation grid; points nearer than `num_envs` fall together."""
    if cfg.steps >= cfg.evaluations * cfg.num_envs:
        return cfg.evaluations + 1
    return grid_step(cfg, cfg.evaluations) // cfg.num_envs + 1


def _check_whole(about: Manifest, entries: Sequence[Entry], files: Files) -> None:
    """All runs of the plan, and their files without any other."""
    arms, plan = set(about.arms), set(about.plan)
    for at, entry in enumerate(entries):
        if entry.place not in plan:
            name = show(entry.item.card.name)
            raise BundleError(f"{bundle_files.RUNS}: row {at}: {name} is not in the plan of {MANIFEST}")
    if unknown := [arm for arm, _ in about.plan if arm not in arms]:
        raise BundleError(f"{MANIFEST}: plan: {show(unknown[0])} is not among the arms")
    _check_files(entries, [name for name in files.sizes if name not in bundle_files.MOST])


def _check_files(entries: Sequence[Entry], names: Sequence[str]) -> None:
    policies = {entry.files for entry in entries if entry.policy}
    folders = {entry.files for entry in entries if not entry.finished}
    if wrong := [entry for entry in entries if entry.policy and not entry.finished]:
        raise BundleError(f"{bundle_files.RUNS}: {show(wrong[0].item.card.name)}: not finished, and has a policy")
    if missing := sorted(policies - set(names)):
        raise BundleError(f"no {missing[0]} in it, which {bundle_files.RUNS} tells of")
    begun = {name.rpartition("/")[0] + "/" for name in names}
    if missing := sorted(folders - begun):
        raise BundleError(f"no file in {missing[0]}, whose run {bundle_files.RUNS} calls begun")
    if unknown := [name for name in names if name not in policies and name.rpartition("/")[0] + "/" not in folders]:
        raise BundleError(f"{unknown[0]}: a file that no run of {bundle_files.RUNS} has")
