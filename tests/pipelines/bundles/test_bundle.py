"""Runs that travel: packed here, taken in there, and nothing is trained again. A bundle is trusted in nothing."""

import hashlib
import io
import json
import random
import shutil
import sqlite3
import stat
import zipfile
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipelines.bundles import files as bundle_files
from pipelines.bundles import rows as bundle_rows
from pipelines.bundles.bundle import Packed, Taken, pack, unpack
from pipelines.bundles.rows import grid_size, on_grid
from pipelines.execution.trainable import RunTrainable
from pipelines.export.tables import export_study
from pipelines.policies.evaluation import of_study
from pipelines.specs.study import RunSpec, Study
from pipelines.tracking.mlflow_tracker import MlflowTracker, open_existing
from pipelines.tracking.plan import items, study_card
from pipelines.tracking.policy import SPEC, load
from pipelines.workspace import leftovers
from pipelines.workspace.errors import InputError, visible
from pipelines.workspace.work_folder import Checkpoints, Home, StoreError, load_whole, save_atomically, without_replay
from rhmc.training.trainer import Config, Trainer, grid_step
from tests.depth import often
from tests.pipelines.support import CODE, fresh, setting, tiny
from tests.robustness.chaos import KILLED, everything, faults, import_in_a_process

RATES = {"slow": 1e-4, "fast": 1e-2, "late": 1.0, "none": 0.5}
STUDY = tiny(arms={arm: setting(lr=rate) for arm, rate in RATES.items()})
DONE = STUDY.model_copy(update={"arms": {arm: STUDY.arms[arm] for arm in ("slow", "fast")}})  # its runs are finished


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory, template: Path) -> Path:
    """Two finished runs, one that has two checkpoints, one that was never begun. Not to be changed."""
    home = fresh(tmp_path_factory.mktemp("here"), template)
    slow, fast, late, _ = items(STUDY, "abc")
    for study in (STUDY, DONE.model_copy(update={"name": "done"})):
        tracker = MlflowTracker(study_card(study), Home(home))
        for item in (slow, fast):
            trainer = Trainer(item.spec.env, item.spec.algo, item.spec.trainer, item.spec.seed)
            run = tracker.start(item.card)
            run.log([point | {"time/seconds": float(i)} for i, point in enumerate(trainer)])
            save_atomically(home / "policy.pt", without_replay(trainer.state_dict()) | {SPEC: item.spec.canonical()})
            run.artifact(home / "policy.pt")
            run.finish("finished")
        tracker.close("interrupted")
    (home / "policy.pt").unlink()
    train(home, late.spec, late.key, 2)
    return home


def train(home: Path, spec: RunSpec, key: str, points: int) -> None:
    """Leave checkpoints of a run that is under way."""
    folder = Home(home).checkpoints(key)
    job = {"key": key, "spec": spec.canonical(), "folder": str(folder), "checkpoint_every": 1, "stop": str(home / "s")}
    worker = RunTrainable({"job": job})
    for _ in range(points):
        worker.step()
    worker.cleanup()


@pytest.fixture(scope="module")
def good(here: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle as a folder. Not to be changed."""
    out = tmp_path_factory.mktemp("good") / "b"
    pack(STUDY, out, here)
    return out


@pytest.fixture
def bundle(good: Path, tmp_path: Path) -> Path:
    """The same, to be spoilt."""
    return Path(shutil.copytree(good, tmp_path / "b"))


@pytest.fixture
def there(tmp_path_factory: pytest.TempPathFactory, template: Path) -> Path:
    return fresh(tmp_path_factory.mktemp("there"), template)


def log_of(home: Path, study: Study = STUDY) -> MlflowTracker:
    tracker = open_existing(study_card(study), Home(home))
    assert tracker is not None
    return tracker


def parent(home: Path, study: Study = STUDY) -> str:
    """The status of a study's own run."""
    (run,) = log_of(home, study)._search("tags.role = 'study'")
    return str(run.info.status)


def picture(home: Path) -> dict[str, Any]:
    """Every file below a work folder, and every row of its database."""
    files = {str(path.relative_to(home)): path.stat().st_size for path in home.rglob("*") if path.name != "mlflow.db"}
    with closing(sqlite3.connect(home / "mlflow.db")) as database:
        return files | {"database": list(database.iterdump())}


# The way there


def test_a_policy_of_a_method_that_bounds_nothing_travels(home: Path, there: Path, tmp_path: Path) -> None:
    """RHMC without a regulator keeps half-done periods whose bound is minus infinity."""
    settled = {"kind": "rhmc", "regulator": "none", "coordinator.reward": "team", "filter": "off"}
    study = tiny(arms={"free": setting(**settled)})
    (item,) = items(study)
    trainer = Trainer(item.spec.env, item.spec.algo, item.spec.trainer, item.spec.seed)
    run = MlflowTracker(study_card(study), Home(home)).start(item.card)
    run.log(list(trainer))
    state = without_replay(trainer.state_dict())
    assert not state["algorithm"]["pending"]["bound"].isfinite().any()
    save_atomically(tmp_path / "policy.pt", state | {SPEC: item.spec.canonical()})
    run.artifact(tmp_path / "policy.pt")
    run.finish("finished")
    pack(study, tmp_path / "b", home)
    assert unpack(tmp_path / "b", there) == Taken(study.name, study.profile, 1, 0, 0, 0)


@pytest.mark.parametrize("name", ["bundle", "bundle.zip"])
def test_there_is_what_was_here(here: Path, there: Path, tmp_path: Path, name: str) -> None:
    out = tmp_path / name
    assert pack(STUDY, out, here) == Packed(planned=4, finished=2, begun=1, astray=[])
    assert out.is_dir() == (name == "bundle")
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert unpack(out, there) == Taken("tiny", "quick", new=2, known=0, begun=1, foreign=0)

    tables = []
    for home in (here, there):
        export_study(STUDY, tmp_path / home.name, home)
        tables.append(pq.read_table(tmp_path / home.name / "tiny.parquet").to_pylist())
    assert tables[0] == tables[1] != []
    slow, _, late, _ = items(STUDY)
    tracker = log_of(there)
    runs = {run.arm: run for run in tracker.recorded()}
    assert {arm: (run.status, run.commit) for arm, run in runs.items()} == {
        "slow": ("finished", "abc"),
        "fast": ("finished", "abc"),
    }
    policy = tracker.file(runs["slow"].ref, "policy.pt", tmp_path)
    assert policy is not None
    assert load(policy).spec == slow.spec
    assert {made.tags["arm"] for made in tracker.client.search_model_versions()} == {"slow", "fast"}
    assert [row.value for row in tracker.rows([runs["slow"].ref]) if row.metric == "time/seconds"] == [0, 1, 2, 3]
    for point in (1, 2):
        files = [Home(home).checkpoints(late.key) / f"{point:08d}.pt" for home in (here, there)]
        assert files[0].read_bytes() == files[1].read_bytes()
    assert not [path for path in there.rglob("*") if path.name.startswith("import") or path.suffix == ".part"]


def test_values_travel_without_policies_and_count_as_finished(here: Path, there: Path, tmp_path: Path) -> None:
    out = tmp_path / "bundle"
    assert pack(STUDY, out, here, values_only=True)[:3] == (4, 2, 0)
    assert sorted(file.name for file in out.rglob("*")) == ["bundle.json", "points.parquet", "runs.parquet"]
    assert unpack(out, there)[2:5] == (2, 0, 0)
    tracker = log_of(there)
    assert len([row for run in tracker.recorded() for row in tracker.rows([run.ref], {"final/return"})]) == 2
    assert {run.status for run in tracker.recorded()} == {"finished"}
    assert tracker.file(tracker.recorded()[0].ref, "policy.pt", tmp_path) is None


def test_who_asks_for_policies_that_did_not_travel_is_told_so(here: Path, there: Path, tmp_path: Path) -> None:
    pack(STUDY, tmp_path / "b", here, values_only=True)
    unpack(tmp_path / "b", there)
    with pytest.raises(InputError, match=r"^tiny \(quick\): the 2 finished runs came without policies"):
        list(of_study(STUDY, there))


def test_a_second_import_adds_nothing_and_keeps_what_got_further(good: Path, there: Path) -> None:
    unpack(good, there)
    late = items(STUDY)[2]
    Checkpoints(Home(there).checkpoints(late.key)).save(3, {"a": 2})
    taken = unpack(good, there)
    assert (taken.new, taken.known, taken.begun) == (0, 2, 0)
    assert Checkpoints(Home(there).checkpoints(late.key)).newest() == {"a": 2}
    assert len(log_of(there).recorded()) == 2


def test_runs_of_other_code_are_said_to_be(good: Path, there: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.bundles.bundle.present", lambda: frozenset({"0ther"}))
    assert unpack(good, there).foreign == 3


def test_nothing_to_pack_and_a_name_that_is_taken(here: Path, there: Path, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"tiny \(quick\): no run is finished or under way; nothing to export"):
        pack(STUDY, tmp_path / "b", there)
    assert not list(tmp_path.iterdir())
    (tmp_path / "b").mkdir()
    with pytest.raises(StoreError, match="b: is there already; name a new one"):
        pack(STUDY, tmp_path / "b", here)
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match=r"file/b\.zip: cannot be written"):
        pack(STUDY, tmp_path / "file" / "b.zip", here)


def test_a_run_that_went_astray_stays_behind_and_is_named(there: Path, tmp_path: Path) -> None:
    tracker = MlflowTracker(study_card(STUDY), Home(there))
    for item, value in zip(items(STUDY)[:2], (1.0, float("nan")), strict=True):
        run = tracker.start(item.card)
        steps = [grid_step(item.spec.trainer, point) for point in range(4)]
        run.log([{"step": float(step), "train/loss": value} for step in steps] + [{"step": 600.0, "final/return": 1.0}])
        run.finish("finished")
    packed = pack(STUDY, tmp_path / "b", there, values_only=True)
    assert packed == Packed(4, 1, 0, ["tiny / fast s0: train/loss is nan at step 0"])


def test_a_log_that_import_would_refuse_is_not_packed(there: Path, tmp_path: Path) -> None:
    run = MlflowTracker(study_card(STUDY), Home(there)).start(items(STUDY)[0].card)
    run.log([{"step": 600.0, "final/return": 1.0}])
    run.finish("finished")
    with pytest.raises(StoreError, match=r"b: cannot be packed .*: runs\.parquet: row 0: .* values at 1 of 4 points"):
        pack(STUDY, tmp_path / "b", there, values_only=True)
    assert not list(tmp_path.iterdir())


def test_a_study_that_is_being_run_is_left_alone(good: Path, there: Path) -> None:
    with Home(there).lock("tiny", "quick"), pytest.raises(StoreError, match="is already being run by process"):
        unpack(good, there)
    assert not log_of(there).recorded()


def test_a_run_that_another_process_trains_is_left_alone_and_nothing_is_written(good: Path, there: Path) -> None:
    late = items(STUDY)[2]
    folder = Home(there).checkpoints(late.key)
    folder.mkdir(parents=True)
    with Checkpoints(folder).lock(), pytest.raises(StoreError, match=f"{late.key}: another process is training"):
        unpack(good, there)
    assert not log_of(there).recorded()


def test_a_variant_travels_under_its_own_name(here: Path, there: Path, tmp_path: Path) -> None:
    variant: Study = STUDY.model_copy(update={"name": "tiny@paper_faithful"})
    assert pack(variant, tmp_path / "b.zip", here)[:3] == (4, 0, 1)
    assert unpack(tmp_path / "b.zip", there).study == "tiny@paper_faithful"


# What the study is then


def test_a_whole_study_is_finished_and_a_part_of_it_is_not(here: Path, there: Path, tmp_path: Path, good: Path) -> None:
    whole = DONE.model_copy(update={"name": "done"})
    pack(whole, tmp_path / "b", here)
    unpack(tmp_path / "b", there)
    assert parent(there, whole) == "FINISHED"
    unpack(good, there)
    assert parent(there) == "KILLED"
    unpack(tmp_path / "b", there)
    assert parent(there, whole) == "FINISHED"


def test_two_parts_make_a_whole(here: Path, there: Path, tmp_path: Path) -> None:
    whole = DONE.model_copy(update={"name": "done"})
    pack(whole, tmp_path / "b", here)
    for at, status in ((0, "KILLED"), (1, "FINISHED")):
        part = Path(shutil.copytree(tmp_path / "b", tmp_path / f"part{at}"))
        keep_run(part, at)
        unpack(part, there)
        assert parent(there, whole) == status


def keep_run(folder: Path, at: int) -> None:
    """Leave one run in a bundle."""
    points, runs = (pq.read_table(folder / f"{name}.parquet") for name in ("points", "runs"))
    mine = [row | {"run": 0} for row in points.to_pylist() if row["run"] == at]
    pq.write_table(pa.Table.from_pylist(mine, points.schema), folder / "points.parquet")
    pq.write_table(runs.slice(at, 1), folder / "runs.parquet")
    for file in (folder / "policies").iterdir():
        if file.stem != runs["key"][at].as_py():
            file.unlink()


@pytest.mark.parametrize("form", [1, 2, 3])
def test_a_bundle_of_an_older_version_is_refused_with_the_remedy(bundle: Path, there: Path, form: int) -> None:
    about = json.loads((bundle / "bundle.json").read_text())
    (bundle / "bundle.json").write_text(json.dumps(about | {"format": form}))
    said = f"a bundle of format {form}, made by an older version; this one reads format 4: train its study anew"
    with pytest.raises(StoreError, match=f"^{bundle}: {said} with `rhmc study run`$"):
        unpack(bundle, there)


def test_what_was_begun_here_does_not_meet_what_comes_from_there(good: Path, there: Path) -> None:
    slow, _, late, _ = items(STUDY, "own")
    tracker = MlflowTracker(study_card(STUDY), Home(there))
    for item in (slow, late):
        tracker.start(item.card).log([{"step": 0.0, "eval/return": -777.0, "eval/of_this_machine": 1.0}])
    tracker.close("interrupted")
    unpack(good, there)
    tracker = log_of(there)
    (run,) = [run for run in tracker.recorded() if run.arm == "slow"]
    assert run.commit == "abc"
    assert -777.0 not in {row.value for row in tracker.rows([run.ref])}
    assert not [run for run in tracker.recorded() if run.arm == "late"]  # its checkpoint brings the values


def test_what_a_killed_import_began_does_not_meet_what_is_trained_here(good: Path, there: Path) -> None:
    slow = items(STUDY, "own")[0]
    tracker = MlflowTracker(study_card(STUDY), Home(there))
    tracker.start(slow.card._replace(imported="c0ffee")).log([{"step": 0.0, "eval/return": -777.0}])
    tracker.close("interrupted")
    log = MlflowTracker(study_card(STUDY), Home(there)).start(slow.card)
    log.log([{"step": 0.0, "eval/return": 1.0}])
    (run,) = log_of(there).recorded()
    assert [row.value for row in log_of(there).rows([run.ref])] == [1.0]


# Damage


def rows(name: str, at: int | None = 0, **values: Any) -> Callable[[Path], None]:
    """Change columns of a table, in one row or in all."""

    def spoil(folder: Path) -> None:
        table = pq.read_table(folder / f"{name}.parquet")
        changed = [row | values if at in (None, i) else row for i, row in enumerate(table.to_pylist())]
        pq.write_table(pa.Table.from_pylist(changed, table.schema), folder / f"{name}.parquet")

    return spoil


def about(**values: Any) -> Callable[[Path], None]:
    """Change the manifest."""

    def spoil(folder: Path) -> None:
        there = json.loads((folder / "bundle.json").read_text()) | values
        (folder / "bundle.json").write_text(json.dumps(there))

    return spoil


def config(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    """Change the settings of the first run, and its key with them."""

    def spoil(folder: Path) -> None:
        tree = json.loads(pq.read_table(folder / "runs.parquet")["config"][0].as_py())
        change(tree)
        text = json.dumps(tree, sort_keys=True, separators=(",", ":"))
        try:
            name = RunSpec.model_validate_json(text).id
        except Exception:  # settings that nobody has
            name = "0" * 12
        rows("runs", config=text, key=f"{name}-{CODE}")(folder)

    return spoil


def again(name: str, at: int = 0) -> Callable[[Path], None]:
    """Write a row of a table once more."""

    def spoil(folder: Path) -> None:
        table = pq.read_table(folder / f"{name}.parquet")
        pq.write_table(pa.concat_tables([table, table.slice(at, 1)]), folder / f"{name}.parquet")

    return spoil


def only(name: str, keep: Callable[[dict[str, Any]], bool]) -> Callable[[Path], None]:
    """Drop rows of a table."""

    def spoil(folder: Path) -> None:
        table = pq.read_table(folder / f"{name}.parquet")
        kept = [row for row in table.to_pylist() if keep(row)]
        pq.write_table(pa.Table.from_pylist(kept, table.schema), folder / f"{name}.parquet")

    return spoil


def state(
    change: Callable[[dict[str, Any]], Any], kind: str = "policies/*.pt", **options: Any
) -> Callable[[Path], None]:
    """Change what a policy or a checkpoint holds, and seal it anew."""

    def spoil(folder: Path) -> None:
        file = sorted(folder.glob(kind))[0]
        content = load_whole(file)
        changed = change(content)
        torch.save(content if changed is None else changed, file, **options)
        seal(folder)

    return spoil


def seal(folder: Path) -> None:
    """Tell the digests of the policies as they are now."""
    table = pq.read_table(folder / "runs.parquet")
    seals = [bundle_seal(folder / f"policies/{row['key']}.pt") for row in table.to_pylist()]
    pq.write_table(table.set_column(7, "policy", pa.array(seals)), folder / "runs.parquet")


def bundle_seal(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.exists() else ""


def squeezed(folder: Path) -> None:
    """Write a policy as an archive whose zeros take a thousandth of their size."""
    file = sorted(folder.glob("policies/*.pt"))[0]
    with zipfile.ZipFile(file) as archive:
        content = {info.filename: archive.read(info) for info in archive.infolist()}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, data if name.endswith(".pkl") else bytes(2**22))
    seal(folder)


def put(name: str, content: bytes = b"x") -> Callable[[Path], None]:
    """Add a file."""

    def spoil(folder: Path) -> None:
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).write_bytes(content)

    return spoil


def linked(name: str) -> Callable[[Path], None]:
    """Put a link to a file of the same content in the place of a file or folder."""

    def spoil(folder: Path) -> None:
        file = next(folder.glob(name))
        file.rename(folder.parent / "elsewhere")
        file.symlink_to(folder.parent / "elsewhere")

    return spoil


def wide(column: str, text: str, count: int) -> Callable[[Path], None]:
    """Runs in which one long text occurs again and again, which a dictionary folds into a few bytes."""

    def spoil(folder: Path) -> None:
        row = pq.read_table(folder / "runs.parquet").to_pylist()[0] | {column: text}
        table = pa.Table.from_pylist([row], bundle_rows.RUNS)
        indices = pa.array([0] * count, pa.int32())
        columns = [pa.DictionaryArray.from_arrays(indices, table[n].combine_chunks()) if table[n].type == pa.string()
                   else pa.array([row[n]] * count, table[n].type) for n in table.column_names]  # fmt: skip
        folded = pa.table(columns, table.column_names)
        pq.write_table(folded, folder / "runs.parquet", compression="zstd", store_schema=False)

    return spoil


def many(folder: Path) -> None:
    """Points without end in a few bytes."""
    count = 60_000_000
    columns = [pa.array([0], field.type).take(pa.array([0])) if field.type != pa.string() else pa.array(["eval/x"])
               for field in bundle_rows.POINTS]  # fmt: skip
    one = pa.table(columns, bundle_rows.POINTS)
    with pq.ParquetWriter(folder / "points.parquet", bundle_rows.POINTS, compression="zstd") as writer:
        block = pa.concat_tables([one] * 1000).combine_chunks()
        for _ in range(count // 10_000_000):
            writer.write_table(pa.concat_tables([block] * 1000))


def cut(name: str, by: int) -> Callable[[Path], None]:
    """Cut a file short."""
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-by]) and None


def unlink(name: str) -> Callable[[Path], None]:
    """Remove a file."""
    return lambda folder: next(folder.glob(name)).unlink()


def bomb(state: dict[str, Any]) -> None:
    """Lists of one list in another: a hundred values in the file, a billion on the way through."""
    inner: list[Any] = [0]
    for _ in range(28):
        inner = [inner, inner]
    state["algorithm"]["x"] = inner


POINT, CHECKPOINT = r"points\.parquet: ", r"checkpoints/[0-9a-f]{12}-[0-9a-f]{12}/00000001\.pt: "
POLICY, RUN = r"policies/[0-9a-f]{12}-[0-9a-f]{12}\.pt: ", r"runs\.parquet: row 0: "
ABOUT = r"bundle\.json: "
DAMAGE: dict[str, tuple[Callable[[Path], Any], str]] = {
    # the manifest
    "no manifest": (unlink("bundle.json"), r"not a bundle .*: no bundle\.json in it"),
    "a manifest that is no JSON": (put("bundle.json"), ABOUT + "must be a mapping in JSON"),
    "a list": (put("bundle.json", b"[1]"), ABOUT + "must be a mapping in JSON"),
    "nested without end": (put("bundle.json", b"[" * 100_000), ABOUT + "must be a mapping in JSON"),
    "not UTF-8": (put("bundle.json", b'{"format": 4, "note": "\xff"}'), ABOUT),
    "larger than any": (put("bundle.json", b" " * 2**23), ABOUT + "8,388,608 bytes; at most 4,194,304"),
    "a later format": (about(format=5), "a bundle of format 5, made by a later version; this one reads format 4"),
    "a format in words": (about(format="4"), ABOUT + "format: '4' is not allowed; must be 4"),
    "a list for a number": (about(format=[None]), ABOUT + r"format: \[null\] is not allowed; must be 4"),
    "true for a number": (about(format=True), ABOUT + "format: true is not allowed; must be 4"),
    "a study outside": (about(study="../../x"), ABOUT + r"study: '\.\./\.\./x' is not allowed; .* letters"),
    "no study": (about(study=""), ABOUT + "study: '' is not allowed; .* is named with letters"),
    "a long study": (about(study="x" * 300), ABOUT + "study: .* at most 80,"),
    "a control character": (about(study="a\x1b[31m"), ABOUT + r"study: 'a\\x1b\[31m' is not allowed"),
    "a profile outside": (about(profile="x/../y"), ABOUT + "profile: 'x/../y' is not allowed; allowed: quick, paper"),
    "null": (about(note=None), ABOUT + "note: null is not allowed; must be a valid string"),
    "a note that paints": (about(note="\x1b]0;x\x07"), ABOUT + "note: .* must be text without control characters"),
    "an unknown field": (about(more=1), ABOUT + "more: extra inputs are not permitted"),
    "no arms": (about(arms=[]), ABOUT + "arms: .* is not allowed; tuple should have at least 1"),
    "an arm with a path": (about(arms=["a/b"]), ABOUT + "arms: 0: 'a/b' is not allowed; .* without '/'"),
    "an arm twice": (about(arms=["slow", "slow"]), ABOUT + "arms: one of them is there twice"),
    "an unknown method": (about(params={"x": []}), ABOUT + "params: x: 'x' is not allowed; allowed: rhmc, "),
    "an unknown setting": (about(params={"iql": ["algo.l"]}), ABOUT + "params: iql: 0: 'algo.l' is not allowed; no"),
    "a fingerprint of all code": (about(fingerprint=CODE), ABOUT + "fingerprint: extra inputs are not permitted"),
    "a module that is none": (about(code={CODE: {"../x": CODE}}), ABOUT + "code: .*should match"),
    "an adopted run that is a path": (about(adopted={"../x": "from"}), ABOUT + "adopted: .*should match"),
    "a commit that is no commit": (about(commit="x; rm"), ABOUT + "commit: 'x; rm' is not allowed"),
    "no plan": (about(plan=[]), ABOUT + "plan: must name the runs of the study"),
    "a plan of other runs": (about(plan=[["slow", "0" * 12 + "-" + CODE]]), RUN + "'slow s0' is not in the plan"),
    # the tables
    "no table": (unlink("points.parquet"), r"no points\.parquet in it"),
    "a cut table": (cut("runs.parquet", 9), r"runs\.parquet: not a parquet table that can be read"),
    "an empty table": (put("points.parquet", b""), r"points\.parquet: not a parquet table that can be read"),
    "another table": (lambda b: shutil.copy(b / "points.parquet", b / "runs.parquet"), r"runs\.parquet: has other col"),
    "a table without end": (many, r"points\.parquet: 6,000,000 rows; at most 5,000,000 are read"),
    "a text without end": (wide("config", "x" * 2**20, 9000), r"runs\.parquet: config: 9,437,184,000 characters; at m"),
    "too many runs": (wide("config", "x", 20_000), r"runs\.parquet: 20,000 rows; at most 10,000 are read"),
    "a null in a run": (rows("runs", arm=None), r"runs\.parquet: row 0: arm: null is not allowed"),
    "a null in a point": (rows("points", 5, value=None), r"points\.parquet: row 5: value: null is not allowed"),
    # runs
    "a key outside": (rows("runs", key="../../x"), RUN + r"key: '\.\./\.\./x' is not allowed; .*should match"),
    "a key of another run": (rows("runs", key="0" * 12 + f"-{CODE}"), RUN + "key: 0{12}-.* is not allowed; of these"),
    "a key of other code": (rows("runs", key="0" * 25), RUN + "key: '0{25}' is not allowed"),
    "an arm that nobody has": (rows("runs", arm="x"), RUN + "arm: 'x' is not among the arms"),
    "a seed of another run": (rows("runs", seed=7), RUN + "seed: 7 is not allowed; of these settings it is 0"),
    "a seed below zero": (rows("runs", seed=-1), RUN + "seed: -1 is not allowed; must be greater than or equal to 0"),
    "a commit with words": (rows("runs", commit="abc def"), RUN + "commit: 'abc def' is not allowed"),
    "no params": (rows("runs", params="{}"), RUN + "params: method: missing"),
    "params that are none": (rows("runs", params="[" * 9999), RUN + "params: .* is not allowed; invalid JSON"),
    "a param of another value": (
        rows("runs", params='{"method": "iql", "algo.lr": "9", "seed": "0"}'),
        RUN + "params: 'algo.lr': '9' is not allowed; '0.0001'",
    ),
    "a param that is none": (
        rows("runs", params='{"method": "iql", "seed": "0", "x": "1"}'),
        RUN + "params: 'x': '1' is not allowed; no such setting",
    ),
    "no settings": (rows("runs", config="{}"), RUN + "config: env: field required"),
    "settings that are none": (rows("runs", config="x"), RUN + "config: .*invalid JSON"),
    "a method that nobody knows": (config(lambda c: c["algo"].update(kind="x")), RUN + "config: algo: .*'x' is not"),
    "no method": (config(lambda c: c.update(algo=[])), RUN + r"config: algo: \[\] is not allowed; must be"),
    "settings with a text for a number": (config(lambda c: c["algo"].update(lr="1e-4")), RUN + "config: .* must be as"),
    "settings that are not finite": (config(lambda c: c["algo"].update(lr=float("inf"))), RUN + "config: .*finite"),
    "settings left out": (config(lambda c: c["algo"].pop("lr")), RUN + "params: 'algo.lr': '0.0001' is not allowed"),
    "a run twice": (again("runs"), r"runs\.parquet: row 3: 'slow' s0 is there twice"),
    "a seal that is none": (rows("runs", policy="x"), RUN + "policy: 'x' is not allowed"),
    "another seal": (rows("runs", policy="0" * 64), POLICY + "has changed since it was written"),
    "finished without a point": (only("points", lambda row: row["run"] != 0), RUN + "called finished, with val"),
    "finished at half time": (only("points", lambda row: row["step"] < 400), RUN + "called finished, .* 2 of 4 points"),
    "finished without final values": (
        only("points", lambda row: not row["metric"].startswith("final/")),
        RUN + "called finished; its final values must be there",
    ),
    "begun, with values": (rows("runs", finished=False, policy=""), RUN + "not finished, and has values"),
    "begun, without a checkpoint": (
        lambda b: shutil.rmtree(next(b.glob("checkpoints/*"))),
        "no file in checkpoints/.*, whose run",
    ),
    # points
    "a value that is no number": (rows("points", 3, value=float("nan")), POINT + "row 3: value: nan is not allowed"),
    "a value without end": (rows("points", 3, value=float("-inf")), POINT + "row 3: value: -inf is not allowed; .*fin"),
    "a step below zero": (rows("points", 3, step=-200), POINT + "row 3: step: -200 is not allowed; must be 0 or more"),
    "a step off the grid": (rows("points", 3, step=201), RUN + "a value at step 201, which is no point of the run's"),
    "a point of no run": (rows("points", 3, run=3), POINT + r"row 3: run: 3 is not allowed; must be a row of runs"),
    "a point of run -1": (rows("points", 3, run=-1), POINT + "row 3: run: -1 is not allowed"),
    "a point twice": (again("points"), POINT + "row [0-9]+: .* of run 0 at step 0 is there twice"),
    "a metric of no group": (rows("points", 3, metric="x"), POINT + "metric: 'x' is not allowed; must be one of"),
    "a metric that paints": (rows("points", 3, metric="eval/\x1b[m"), POINT + r"metric: 'eval/\\x1b\[m' is not"),
    # files
    "a file that nobody needs": (put("more.txt"), r"'more\.txt' is no file of a bundle; a bundle has bundle\.json"),
    "a policy that no run has": (put("policies/" + "0" * 12 + f"-{CODE}.pt"), POLICY + "a file that no run of runs"),
    "a checkpoint with a word": (put("checkpoints/x/1.pt"), "'checkpoints/x' is no file of a bundle"),
    "no policy": (unlink("policies/*.pt"), r"no policies/.*\.pt in it, which runs\.parquet tells of"),
    "a linked policy": (linked("policies/*.pt"), "'policies/.*' ?: a link; links are not followed"),
    "a linked folder": (linked("policies"), "'policies': a link; links are not followed"),
    "a linked table": (linked("runs.parquet"), r"'runs\.parquet': a link; links are not followed"),
    # policies and checkpoints
    "a policy that is none": (lambda b: (next(b.glob("policies/*")).write_bytes(b"x"), seal(b)), POLICY + "not a"),
    "a list of weights": (state(lambda s: [1]), POLICY + "readable, but not a checkpoint of a run"),
    "a policy without weights": (state(lambda s: {"a": 1}), POLICY + "readable, but not a checkpoint"),
    "weights that are text": (state(lambda s: s.update(algorithm="x")), POLICY + "does not fit its run"),
    "weights of another shape": (
        state(lambda s: s["algorithm"].update(q={})),
        POLICY + "does not fit its run: no state of 'iql' as this code has it",
    ),
    "a weight that is no number": (
        state(lambda s: s.update(algorithm=astray(s["algorithm"]))),
        POLICY + ".* a weight is not a finite number",
    ),
    "a policy of another run": (state(lambda s: s.update(spec=other_spec())), POLICY + "of another run"),
    "a policy of a spec that is a number": (state(lambda s: s.update(spec=1)), POLICY + "not the settings of a run"),
    "a policy that runs code": (state(lambda s: s.update(x=Evil())), POLICY + "not a checkpoint that can be read"),
    "a policy squeezed": (squeezed, POLICY + "packed more tightly than torch does"),
    "a tensor without end": (
        state(lambda s: s.update(x=torch.zeros(1).expand(2**40))),
        POLICY + "a tensor that is larger than its content",
    ),
    "a state without end": (state(bomb), POLICY + "more than 1,000,000 values, or more than 30 inside each other"),
    "a cut checkpoint": (
        lambda b: cut(str(min(b.glob("checkpoints/*/*")).relative_to(b)), 99)(b),
        CHECKPOINT + "not a checkpoint that can be read",
    ),
    "a checkpoint of another run": (
        state(lambda s: s.update(spec=other_spec()), "checkpoints/*/*.pt"),
        CHECKPOINT + "of another run",
    ),
    "a checkpoint of another point": (
        state(lambda s: s["trainer"].update(point=9), "checkpoints/*/*.pt"),
        CHECKPOINT + "has not the 1 points of its name",
    ),
    "a checkpoint at no step": (
        state(lambda s: s["trainer"].update(step="\x1b"), "checkpoints/*/*.pt"),
        CHECKPOINT + r"step '\\x1b' is not allowed; must be 0",
    ),
    "a checkpoint whose point is a tensor": (
        state(lambda s: s["trainer"].update(point=torch.zeros(2)), "checkpoints/*/*.pt"),
        CHECKPOINT + "has not the 1 points of its name",
    ),
    "a checkpoint whose step is a list": (
        state(lambda s: s["trainer"].update(step=[torch.zeros(2)]), "checkpoints/*/*.pt"),
        CHECKPOINT + "step .*Tensor.* is not allowed; must be 0",
    ),
    "a checkpoint with a number for a metric": (
        state(lambda s: s["history"][0].update({7: 1.0}), "checkpoints/*/*.pt"),
        CHECKPOINT + "history: 7 at step 0 must be a finite number",
    ),
    "a checkpoint with a past that is no number": (
        state(lambda s: s["history"][0].update({"eval/return": float("nan")}), "checkpoints/*/*.pt"),
        CHECKPOINT + "history: 'eval/return' at step 0 must be a finite number",
    ),
    "a checkpoint with a past off the grid": (
        state(lambda s: s["history"][0].update(step=1.0), "checkpoints/*/*.pt"),
        CHECKPOINT + "history: step 1.0 is not allowed; must be on the run's grid",
    ),
}  # fmt: skip


class Evil:
    """Whoever loads it runs a command."""

    def __reduce__(self) -> Any:
        return Path.touch, (Path("/tmp/never"),)


def other_spec() -> str:
    return items(STUDY)[3].spec.canonical()


def astray(state: Any) -> Any:
    """A state whose weights are no numbers."""
    if isinstance(state, dict):
        return {key: astray(value) for key, value in state.items()}
    return torch.full_like(state, float("nan")) if getattr(state, "dtype", None) == torch.float32 else state


def assert_refused(bundle: Path, there: Path, said: str) -> None:
    """One line that names the bundle and the place, and nothing written."""
    before = picture(there)
    with pytest.raises(StoreError, match=said) as error:
        unpack(bundle, there)
    text = str(error.value)
    assert text.startswith(f"{bundle}: ")
    assert visible(text) == text
    assert len(text) < 600
    assert picture(there) == before


@pytest.mark.parametrize("what", DAMAGE)
def test_a_damaged_bundle_is_one_line_and_nothing_is_written(bundle: Path, there: Path, what: str) -> None:
    spoil, said = DAMAGE[what]
    spoil(bundle)
    assert_refused(bundle, there, said)


def test_a_folder_that_was_not_there_is_not_made(bundle: Path, tmp_path: Path) -> None:
    DAMAGE["weights of another shape"][0](bundle)
    with pytest.raises(StoreError):
        unpack(bundle, tmp_path / "w")
    assert not (tmp_path / "w").exists()


# Archives


def zipped(folder: Path, change: Callable[[zipfile.ZipInfo], Any] = lambda info: None, **more: bytes) -> Path:
    """The bundle as an archive, with entries changed and others added."""
    out = folder.with_name("b.zip")
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            info = zipfile.ZipInfo(str(file.relative_to(folder)))
            change(info)
            archive.writestr(info, file.read_bytes(), info.compress_type)
        for name, content in more.items():
            archive.writestr(name, content)
    return out


def named(name: str) -> Callable[[Path], Path]:
    """Add an entry of a name."""

    def spoil(folder: Path) -> Path:
        return zipped(folder, **{name: b"x"})

    return spoil


def with_nul(folder: Path) -> Path:
    """An entry whose name has a zero byte in it, which zipfile cuts off."""
    out = zipped(folder, **{"bundle_json~": b"x"})
    out.write_bytes(out.read_bytes().replace(b"bundle_json~", b"bundle.json\0"))
    return out


def twice(folder: Path) -> Path:
    with pytest.warns(UserWarning, match="Duplicate name"):
        return zipped(folder, **{"bundle.json": b"{}"})


def link(info: zipfile.ZipInfo) -> None:
    if info.filename == "runs.parquet":
        info.create_system, info.external_attr = 3, (stat.S_IFLNK | 0o777) << 16


def in_directory(out: Path, field: int, value: bytes, name: bytes = b"runs.parquet") -> Path:
    """Change a field of an entry in the archive's directory."""
    content = bytearray(out.read_bytes())
    at = content.rindex(name) - 46
    assert content[at : at + 4] == b"PK\x01\x02"
    content[at + field : at + field + len(value)] = value
    out.write_bytes(content)
    return out


def overlapping(folder: Path) -> Path:
    """The policies of the archive are one and the same."""
    out = zipped(folder)
    with zipfile.ZipFile(out) as archive:
        first, second = [i for i in archive.infolist() if i.filename.startswith("policies/")]
    return in_directory(out, 42, first.header_offset.to_bytes(4, "little"), second.filename.encode())


def bzipped(info: zipfile.ZipInfo) -> None:
    info.compress_type = zipfile.ZIP_BZIP2


def shortened(folder: Path) -> Path:
    out = zipped(folder)
    out.write_bytes(out.read_bytes()[:-100])
    return out


def noisy(folder: Path) -> Path:
    """Noise in the middle of the content of a file."""
    out = zipped(folder)
    with zipfile.ZipFile(out) as archive:
        at = archive.getinfo("points.parquet").header_offset + 100
    content = bytearray(out.read_bytes())
    content[at : at + 500] = random.Random(1).randbytes(500)
    out.write_bytes(content)
    return out


ARCHIVES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "a name that climbs": (named("../out.txt"), r"'\.\./out\.txt' is no file of a bundle"),
    "a name from the root": (named("/etc/x"), "'/etc/x' is no file of a bundle"),
    "a name of a drive": (named("C:\\x"), r"is no file of a bundle"),
    "a name that paints": (named("a\x1b[31m"), r"'a\\x1b\[31m' is no file of a bundle"),
    "a policy that climbs": (named("policies/../../x.pt"), r"'policies/\.\./\.\./x\.pt' is no file of a bundle"),
    "a name with a zero": (with_nul, r"'bundle\.json\\x00' is no file of a bundle"),
    "a name twice": (twice, r"bundle\.json: twice in the archive"),
    "a link": (lambda b: zipped(b, link), r"runs\.parquet: a link, or another thing that is not a file"),
    "a password": (lambda b: in_directory(zipped(b), 8, b"\1\0"), r"runs\.parquet: encrypted"),
    "another way to compress": (lambda b: zipped(b, bzipped), "compressed in way 12; files are stored or deflated"),
    "a way that nobody knows": (lambda b: in_directory(zipped(b), 10, b"\x63\0"), "compressed in way 99"),
    "two files in one place": (overlapping, "begins inside another file|File name in directory"),
    "a size that is too small": (lambda b: in_directory(zipped(b), 24, b"\x09\0\0\0"), r"runs\.parquet: not a .*CRC"),
    "a size that is too large": (lambda b: in_directory(zipped(b), 24, b"\0\0\0\1"), r"runs\.parquet: has not the 16"),
    "a size without end": (lambda b: in_directory(zipped(b), 24, b"\xff\xff\xff\x7f"), r"runs\.parquet: 2,147,483"),
    "cut short": (shortened, "not a bundle of `rhmc study export`, or a damaged one|is no file of a bundle"),
    "noise inside": (noisy, r"points\.parquet: "),
    "no archive": (lambda b: put("../b.zip", b"no archive")(b) or b.with_name("b.zip"), "not a bundle of `rhmc study"),
    "empty": (lambda b: put("../b.zip", b"")(b) or b.with_name("b.zip"), "not a bundle of `rhmc study export`"),
    "nowhere": (lambda b: b.with_name("nowhere"), "cannot be read: No such file or directory"),
    "a long name": (lambda b: b.with_name("x" * 300), "cannot be read: File name too long"),
    "a device": (lambda b: Path("/dev/zero"), "neither a folder nor an archive"),
}  # fmt: skip


@pytest.mark.parametrize("what", ARCHIVES)
def test_a_hostile_archive_is_one_line_and_nothing_is_written(bundle: Path, there: Path, what: str) -> None:
    spoil, said = ARCHIVES[what]
    assert_refused(spoil(bundle), there, said)
    assert not (bundle.parent.parent / "out.txt").exists()


def test_an_archive_that_a_person_made_of_the_folder(bundle: Path, there: Path) -> None:
    made = shutil.make_archive(str(bundle.with_name("again")), "zip", bundle)  # with entries for folders
    assert unpack(Path(made), there).new == 2


def test_more_files_or_bytes_than_are_taken_in(bundle: Path, there: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = zipped(bundle)
    for name, most, said in (("FILES", 5, "[67] files; at most 5"), ("UNPACKED", 9999, "unpacked; at most 9,999")):
        with monkeypatch.context() as patch:
            patch.setattr(bundle_files, name, most)
            for kind in (bundle, archive):
                assert_refused(kind, there, said)


def test_a_table_that_lies_about_its_size_finds_no_memory(
    bundle: Path, there: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The head of the table says nothing of the page of a quarter of a gigabyte that follows; the system does."""
    size = 2**28 - 2**20
    monkeypatch.setattr(bundle_files.limited.__wrapped__, "__defaults__", (2**29,))
    column = pa.array(["x" * size], pa.string())
    row = pq.read_table(bundle / "runs.parquet").slice(0, 1)
    at = row.column_names.index("config")
    table = row.set_column(at, "config", column)
    sink = io.BytesIO()
    pq.write_table(table, sink, compression="zstd", use_dictionary=False, write_statistics=False)
    content = sink.getvalue()
    head = pq.ParquetFile(io.BytesIO(content)).metadata.row_group(0).column(at)
    told, small = varint(2 * head.total_uncompressed_size), varint(2 * 2**27)
    assert content.count(told) == 1
    assert len(told) == len(small)
    (bundle / "runs.parquet").write_bytes(content.replace(told, small))
    assert_refused(bundle, there, r"runs\.parquet: (not a parquet table|config: 267,386,880 characters)")


def varint(number: int) -> bytes:
    """As Thrift writes a number."""
    out = bytearray()
    while number >= 128:
        out.append(number % 128 | 128)
        number //= 128
    return bytes([*out, number])


# Whatever comes


@pytest.fixture(scope="module")
def archive(good: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = Path(shutil.copytree(good, tmp_path_factory.mktemp("archive") / "b"))
    return zipped(folder).read_bytes()


def settle(bundle: Path, home: Path) -> None:
    """Either the bundle is refused in one line, or what it has is all there."""
    before, said = picture(home), ""
    try:
        taken = unpack(bundle, home)
    except StoreError as error:
        said = str(error)
    if said:
        assert visible(said) == said
        assert picture(home) == before
    else:
        assert (taken.new + taken.known, taken.begun) in {(2, 1), (2, 0)}
        assert {run.status for run in log_of(home).recorded()} == {"finished"}


KILLS = often(4, 12)
NO_TIME = settings(max_examples=often(20, 60), deadline=None, suppress_health_check=list(HealthCheck))


@NO_TIME
@given(where=st.floats(0, 1, exclude_max=True), value=st.integers(0, 255))
def test_one_byte_of_an_archive(archive: bytes, there: Path, tmp_path: Path, where: float, value: int) -> None:
    spoilt = bytearray(archive)
    spoilt[int(where * len(archive))] = value
    (tmp_path / "b.zip").write_bytes(spoilt)
    settle(tmp_path / "b.zip", there)


@NO_TIME
@given(
    name=st.sampled_from(["bundle.json", "runs.parquet", "points.parquet", "policies", "checkpoints"]),
    where=st.floats(0, 1, exclude_max=True),
    value=st.integers(0, 255),
)
def test_one_byte_of_a_file(good: Path, there: Path, tmp_path: Path, name: str, where: float, value: int) -> None:
    folder = tmp_path / "b"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(good, folder)
    file = folder / name if "." in name else min((folder / name).rglob("*.pt"))
    spoilt = bytearray(file.read_bytes())
    spoilt[int(where * len(spoilt))] = value
    file.write_bytes(spoilt)
    seal_as_it_is(folder)
    settle(folder, there)


@pytest.mark.parametrize("flip", [1, 2, 6, 16])
def test_a_damaged_head_of_a_table_is_an_error_and_not_the_end_of_the_process(flip: int) -> None:
    """A column's head that cannot be decoded is an exception that pyarrow does not catch: it aborts the process."""
    schema = pa.schema([("arm", pa.string()), ("value", pa.float64())])
    buffer = io.BytesIO()
    pq.write_table(pa.table({"arm": ["x"] * 3, "value": [1.0, 2.0, 3.0]}, schema), buffer)
    whole = buffer.getvalue()
    head = len(whole) - 8 - int.from_bytes(whole[-8:-4], "little")
    refused = 0
    for place in range(head, len(whole) - 8):
        spoilt = bytearray(whole)
        spoilt[place] ^= flip
        files = bundle_files.Files({"runs.parquet": len(spoilt)}, lambda _, content=bytes(spoilt): io.BytesIO(content))
        try:
            bundle_rows._table(files, "runs.parquet", schema)
        except bundle_rows.BundleError:
            refused += 1
    assert refused > 50


def seal_as_it_is(folder: Path) -> None:
    """Seal the policies anew, should the table still be one: a byte is to be found inside, not by its digest."""
    with suppress(pa.ArrowException, OSError, ValueError, KeyError, TypeError):
        seal(folder)


LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9)
TREES = st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner))
FIELDS = (*bundle_rows.Manifest.model_fields, "more")


@NO_TIME
@given(field=st.sampled_from(FIELDS), value=TREES)
def test_a_manifest_with_anything_in_it(good: Path, there: Path, tmp_path: Path, field: str, value: Any) -> None:
    folder = tmp_path / "b"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(good, folder)
    about(**{field: value})(folder)
    settle(folder, there)


CELLS = {
    pa.string(): st.none() | st.text(max_size=9) | st.sampled_from(["{}", "[]", "null", "NaN", "../x"]),
    pa.int64(): st.none() | st.integers(-(2**63), 2**63 - 1),
    pa.float64(): st.none() | st.floats(),
    pa.bool_(): st.none() | st.booleans(),
}
TABLES = {"runs": bundle_rows.RUNS, "points": bundle_rows.POINTS}
COLUMNS = [(name, field.name, field.type) for name, schema in TABLES.items() for field in schema]


@NO_TIME
@given(data=st.data(), column=st.sampled_from(COLUMNS), row=st.integers(0, 2))
def test_a_table_with_anything_in_it(
    good: Path, there: Path, tmp_path: Path, data: st.DataObject, column: tuple[str, str, Any], row: int
) -> None:
    folder = tmp_path / "b"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(good, folder)
    table, name, kind = column
    rows(table, row, **{name: data.draw(CELLS[kind])})(folder)
    settle(folder, there)


@given(st.integers(1, 3000), st.integers(1, 40), st.integers(1, 200), st.integers(0, 3500))
def test_the_grid_without_counting(steps: int, evaluations: int, copies: int, step: int) -> None:
    cfg = Config(steps=steps, evaluations=evaluations, num_envs=copies)
    grid = {grid_step(cfg, point) for point in range(evaluations + 1)}
    assert on_grid(cfg, step) == (step in grid)
    assert grid_size(cfg) == len(grid)


# Half an import


@pytest.fixture(scope="module")
def undisturbed(good: Path, tmp_path_factory: pytest.TempPathFactory, template: Path) -> Path:
    """A work folder into which a bundle was taken by a process that nobody disturbed."""
    home = fresh(tmp_path_factory.mktemp("undisturbed"), template)
    assert import_in_a_process(good, home) == 0, (home / "driver.log").read_text()
    return home


def tree(home: Path) -> set[str]:
    """The content of a work folder, except what has a name that MLflow makes up."""
    named = (path.relative_to(home).parts for path in home.rglob("*"))
    return {"/".join(parts) for parts in named if parts[0] != "artifacts"}


def assert_as_undisturbed(home: Path, undisturbed: Path) -> None:
    found, expected = everything(STUDY, home), everything(STUDY, undisturbed)
    wrong = faults(found, expected)
    assert wrong | {"runs left open": 0} == dict.fromkeys(wrong, 0)
    assert found == expected
    assert tree(home) == tree(undisturbed)
    late = items(STUDY)[2]
    for file in Home(undisturbed).checkpoints(late.key).iterdir():
        assert file.read_bytes() == (Home(home).checkpoints(late.key) / file.name).read_bytes()


def assert_no_more_than_there_is(home: Path, undisturbed: Path) -> None:
    """Every run that is called finished is whole; the others are not called so."""
    whole = {run.name: run for run in everything(STUDY, undisturbed)}
    for run in everything(STUDY, home):
        if run.status == "FINISHED":
            assert run == whole[run.name]
    if log_of(home).experiment is not None:
        done = {run.arm for run in log_of(home).recorded() if run.status == "finished"}
        export_study(STUDY, home.parent / "table", home)
        table = pq.read_table(home.parent / "table" / "tiny.runs.parquet").to_pylist()
        assert {row["arm"] for row in table if row["status"] == "finished"} == done


def test_imports_killed_at_random_writes(good: Path, tmp_path: Path, template: Path, undisturbed: Path) -> None:
    rng, kills, campaign = random.Random(13), 0, 0
    writes = int((undisturbed / "writes").read_text())
    while kills < KILLS:
        campaign += 1
        home = fresh(tmp_path / str(campaign), template)
        status = KILLED
        while status != 0:
            status = import_in_a_process(good, home, rng.randrange(1, writes) if kills < KILLS else 0)
            assert status in (0, KILLED), (home / "driver.log").read_text()
            kills += status == KILLED
            assert_no_more_than_there_is(home, undisturbed)
        assert_as_undisturbed(home, undisturbed)


def test_a_disk_that_is_full_at_first(good: Path, tmp_path: Path, template: Path, undisturbed: Path) -> None:
    home = fresh(tmp_path / "home", template)
    with closing(sqlite3.connect(home / "mlflow.db")) as database:
        database.execute("VACUUM")  # no free pages: whatever is logged makes it grow
    assert import_in_a_process(good, home, room=(home / "mlflow.db").stat().st_size + 2**13) == 2
    said = (home / "driver.log").read_text()
    assert said.count("\n") == 1
    assert str(home) in said
    assert_no_more_than_there_is(home, undisturbed)
    assert import_in_a_process(good, home) == 0
    (home / "driver.log").write_text("")
    assert_as_undisturbed(home, undisturbed)


def test_what_killed_processes_left_is_swept(here: Path, good: Path, there: Path, tmp_path: Path) -> None:
    gone = f"{leftovers.HOST}-4194305"
    late = items(STUDY)[2]
    unfinished = [there / f"import.{gone}.part", tmp_path / f"b.zip.{gone}.part", tmp_path / f"b.zip.files.{gone}.part"]
    kept = [tmp_path / f"b.zip.elsewhere-{1}.part", tmp_path / f"other.zip.{gone}.part"]
    for folder in (*unfinished, *kept):
        folder.mkdir()
        (folder / "policy.pt").touch()
    part = Home(there).checkpoints(late.key) / f"00000002.pt.{gone}.part"
    part.parent.mkdir(parents=True)
    part.touch()
    pack(STUDY, tmp_path / "b.zip", here)
    unpack(good, there)
    assert not [path for path in (*unfinished, part) if path.exists()]
    assert all(path.exists() for path in kept)
