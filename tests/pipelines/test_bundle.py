"""Runs that travel: packed here, taken in there, and nothing is trained again."""

import json
import shutil
import zipfile
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from pipelines.bundle import Packed, pack, unpack
from pipelines.errors import InputError
from pipelines.evaluation import of_study
from pipelines.export import export_study
from pipelines.mlflow_tracker import MlflowTracker, open_existing
from pipelines.plan import items, study_card
from pipelines.policy import Saved, load, save
from pipelines.store import Checkpoints, Home, StoreError, save_atomically
from pipelines.study import Study
from tests.pipelines.support import CODE, setting, tiny

POINTS = [{"step": float(s), "eval/return": s / 3, "time/seconds": s / 100} for s in (0, 200)]
LAST = {"step": 400.0, "eval/return": 1.5, "final/return": 2.5, "time/seconds": 4.0}
STUDY = tiny(
    arms={"slow": setting(lr=1e-4), "fast": setting(lr=1e-2), "late": setting(lr=1.0), "none": setting(lr=0.5)}
)


@pytest.fixture(autouse=True)
def _code(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("bundle", "export", "evaluation"):
        monkeypatch.setattr(f"pipelines.{module}.fingerprint", lambda: CODE)


@pytest.fixture
def here(home: Path) -> Path:
    """Two finished runs, one that has a checkpoint, one that was never begun."""
    tracker = MlflowTracker(study_card(STUDY), Home(home))
    slow, fast, late, _ = items(STUDY, CODE, "abc")
    for item in (slow, fast):
        run = tracker.start(item.card)
        run.log([*POINTS, LAST])
        policy = home / "policy.pt"
        save(policy, Saved(item.spec, {"key": item.key}))
        run.artifact(policy)
        run.finish("finished")
    tracker.start(late.card).log(POINTS)
    Checkpoints(Home(home).checkpoints(late.key)).save(2, {"a": 1})
    tracker.close("interrupted")
    return home


@pytest.fixture
def there(tmp_path_factory: pytest.TempPathFactory, template: Path) -> Path:
    folder = tmp_path_factory.mktemp("there")
    shutil.copy(template, folder / "mlflow.db")
    return folder


@pytest.mark.parametrize("name", ["bundle", "bundle.zip"])
def test_there_is_what_was_here(here: Path, there: Path, tmp_path: Path, name: str) -> None:
    out = tmp_path / name
    assert pack(STUDY, out, here) == Packed(planned=4, finished=2, begun=1)
    assert out.is_dir() == (name == "bundle")
    taken = unpack(out, there)
    assert (taken.study, taken.profile, taken.new, taken.known, taken.begun, taken.foreign) == (
        "tiny",
        "quick",
        2,
        0,
        1,
        "",
    )

    tables = []
    for home in (here, there):
        export_study(STUDY, home / "out", home)
        done = pq.read_table(home / "out/tiny.parquet").to_pylist()
        tables.append([row for row in done if row["arm"] != "late"])
    assert tables[0] == tables[1] != []
    slow, _, late, _ = items(STUDY, CODE, "")
    tracker = open_existing(study_card(STUDY), Home(there))
    assert tracker is not None
    runs = {run.arm: run for run in tracker.recorded()}
    assert {arm: (run.status, run.commit) for arm, run in runs.items()} == {
        "slow": ("finished", "abc"),
        "fast": ("finished", "abc"),
    }
    policy = tracker.file(runs["slow"].ref, "policy.pt", tmp_path)
    assert policy is not None
    assert load(policy) == Saved(slow.spec, {"key": slow.key})
    assert {made.tags["variant"] for made in tracker.client.search_model_versions()} == {"slow", "fast"}
    assert [row.value for row in tracker.rows([runs["slow"].ref]) if row.metric == "time/seconds"] == [0.0, 2.0, 4.0]
    assert Checkpoints(Home(there).checkpoints(late.key)).newest() == {"a": 1}


def test_values_travel_without_policies_and_count_as_finished(here: Path, there: Path, tmp_path: Path) -> None:
    out = tmp_path / "bundle"
    assert pack(STUDY, out, here, values_only=True) == Packed(planned=4, finished=2, begun=0)
    assert sorted(file.name for file in out.rglob("*")) == ["bundle.json", "points.parquet", "runs.parquet"]
    assert unpack(out, there)[2:5] == (2, 0, 0)
    tracker = open_existing(study_card(STUDY), Home(there))
    assert tracker is not None
    ends = [row.value for run in tracker.recorded() for row in tracker.rows([run.ref]) if row.metric == "final/return"]
    assert ends == [2.5, 2.5]
    assert {run.status for run in tracker.recorded()} == {"finished"}
    assert tracker.file(tracker.recorded()[0].ref, "policy.pt", tmp_path) is None


def test_who_asks_for_policies_that_did_not_travel_is_told_so(here: Path, there: Path, tmp_path: Path) -> None:
    pack(STUDY, tmp_path / "b", here, values_only=True)
    unpack(tmp_path / "b", there)
    with pytest.raises(InputError, match=r"^tiny \(quick\): the 2 finished runs came without policies"):
        list(of_study(STUDY, there))


def test_a_second_import_adds_nothing_and_keeps_what_got_further(here: Path, there: Path, tmp_path: Path) -> None:
    pack(STUDY, tmp_path / "b", here)
    unpack(tmp_path / "b", there)
    late = items(STUDY, CODE, "")[2]
    Checkpoints(Home(there).checkpoints(late.key)).save(3, {"a": 2})
    taken = unpack(tmp_path / "b", there)
    assert (taken.new, taken.known, taken.begun) == (0, 2, 0)
    assert Checkpoints(Home(there).checkpoints(late.key)).newest() == {"a": 2}
    tracker = open_existing(study_card(STUDY), Home(there))
    assert tracker is not None
    assert len(tracker.recorded()) == 2


def test_runs_of_other_code_are_said_to_be(
    here: Path, there: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pack(STUDY, tmp_path / "b", here)
    monkeypatch.setattr("pipelines.bundle.fingerprint", lambda: "0ther")
    assert unpack(tmp_path / "b", there).foreign == CODE


def test_nothing_to_pack_and_a_name_that_is_taken(here: Path, there: Path, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"tiny \(quick\): no run is finished or under way; nothing to export"):
        pack(STUDY, tmp_path / "b", there)
    assert not (tmp_path / "b").exists()
    (tmp_path / "b").mkdir()
    with pytest.raises(StoreError, match="b: is there already; name a new one"):
        pack(STUDY, tmp_path / "b", here)
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match=r"file/b\.zip: cannot be written"):
        pack(STUDY, tmp_path / "file" / "b.zip", here)


def other(folder: Path, name: str, **values: object) -> None:
    """Change a column of a bundle's table in every row."""
    table = pq.read_table(folder / name)
    rows = [row | values for row in table.to_pylist()]
    pq.write_table(type(table).from_pylist(rows, table.schema), folder / name)


DAMAGE = {
    "no manifest": (lambda b: (b / "bundle.json").unlink(), "no bundle.json in it"),
    "no table": (lambda b: (b / "points.parquet").unlink(), "no points.parquet in it"),
    "cut table": (lambda b: (b / "runs.parquet").write_bytes((b / "runs.parquet").read_bytes()[:-9]), "arquet"),
    "foreign table": (lambda b: shutil.copy(b / "points.parquet", b / "runs.parquet"), "has other columns"),
    "other settings": (lambda b: other(b, "runs.parquet", key="abc"), "slow s0 are not those of its key"),
    "no settings": (lambda b: other(b, "runs.parquet", config="{}"), "Field required"),
    "policy": (lambda b: next((b / "policies").iterdir()).write_bytes(b"x"), "has changed since it was written"),
    "no policy": (lambda b: next((b / "policies").iterdir()).unlink(), ".pt in it"),
    "no final value": (lambda b: other(b, "points.parquet", metric="x"), "is called finished and has no final value"),
}  # fmt: skip


@pytest.mark.parametrize("what", DAMAGE)
def test_a_damaged_bundle_is_one_line_and_nothing_is_written(
    here: Path, there: Path, tmp_path: Path, what: str
) -> None:
    bundle = tmp_path / "b"
    pack(STUDY, bundle, here)
    spoil, said = DAMAGE[what]
    spoil(bundle)
    before = (there / "mlflow.db").read_bytes()
    with pytest.raises(StoreError) as error:
        unpack(bundle, there)
    text = str(error.value)
    assert text.startswith(f"{bundle}: not a bundle of `rhmc study export`, or a damaged one (")
    assert said in text
    assert "\n" not in text
    assert (there / "mlflow.db").read_bytes() == before
    assert [p.name for p in there.iterdir()] == ["mlflow.db"]


def test_what_is_no_bundle_at_all(there: Path, tmp_path: Path) -> None:
    (tmp_path / "x.zip").write_text("no archive")
    with zipfile.ZipFile(tmp_path / "y.zip", "w") as archive:
        archive.writestr("../out.txt", "x")
    (tmp_path / "empty").mkdir()
    for name in ("x.zip", "y.zip", "empty", "nowhere"):
        with pytest.raises(StoreError, match=f"{name}: not a bundle"):
            unpack(tmp_path / name, there)


def test_a_later_format_is_named(here: Path, there: Path, tmp_path: Path) -> None:
    pack(STUDY, tmp_path / "b", here)
    manifest = json.loads((tmp_path / "b/bundle.json").read_text()) | {"format": 3}
    (tmp_path / "b/bundle.json").write_text(json.dumps(manifest))
    with pytest.raises(StoreError, match="b: a bundle of format 3; this version reads 2"):
        unpack(tmp_path / "b", there)


def test_a_study_that_is_being_run_is_left_alone(here: Path, there: Path, tmp_path: Path) -> None:
    pack(STUDY, tmp_path / "b", here)
    with Home(there).lock("tiny", "quick"), pytest.raises(StoreError, match="is already being run by process"):
        unpack(tmp_path / "b", there)


def test_a_variant_travels_under_its_own_name(here: Path, there: Path, tmp_path: Path) -> None:
    variant: Study = STUDY.model_copy(update={"name": "tiny@letter"})
    item = items(variant, CODE, "")[0]
    save_atomically(Home(here).checkpoints(item.key) / "00000001.pt", {})
    pack(variant, tmp_path / "b.zip", here)
    assert unpack(tmp_path / "b.zip", there).study == "tiny@letter"
