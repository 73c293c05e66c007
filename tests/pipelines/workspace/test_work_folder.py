"""The work folder may be moved, copied, closed to writers, and called anything."""

import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import mlflow
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import create_engine, make_url

from pipelines.bundles.bundle import pack, unpack
from pipelines.execution import run
from pipelines.export.tables import export_study
from pipelines.policies.evaluation import of_study
from pipelines.specs.search import Search
from pipelines.tracking.mlflow_tracker import MlflowTracker, fetch, open_existing, prepared
from pipelines.tracking.plan import items, study_card
from pipelines.tracking.policy import FILE, Saved, load, save
from pipelines.tuning.search_run import show_search
from pipelines.tuning.trials import ArmStudy, look, opened
from pipelines.workspace import relocation, sqlite
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import Home, StoreError, work_folder
from rhmc.training.trainer import Trainer, grid_step
from tests.pipelines.support import HOSTILE, fresh, setting, tiny

STUDY = tiny(arms={"one": setting(), "two": setting(lr=1e-2)})
SEARCH = """\
question: Which?
base: {env: {kind: coverage, agents: 2, targets: 2}, algo: {kind: iql}}
arms: {one: {space: {lr: {low: 1.0e-4, high: 1.0e-2, log: true}}}}
trials: {quick: 1, paper: 1}
seeds: 1
steps: 200
"""


@pytest.fixture(autouse=True)
def _code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPTUNA_STORAGE", raising=False)


def log(home: Path, arm: int) -> str:
    """A finished run with its policy; gives its id."""
    tracker = MlflowTracker(study_card(STUDY), Home(home))
    item = items(STUDY, "abc")[arm]
    logged = tracker.start(item.card)
    steps = [grid_step(item.spec.trainer, point) for point in range(4)]
    logged.log([*({"step": float(step), "eval/return": 1.0} for step in steps), {"step": 600.0, "final/return": 2.0}])
    logged.text("config.yaml", "a: 1\n")
    trainer = Trainer(item.spec.env, item.spec.algo, item.spec.trainer, item.spec.seed)
    save(home / FILE, Saved(item.spec, trainer.state_dict()["algorithm"]))
    logged.artifact(home / FILE)
    logged.model(home / FILE)
    (home / FILE).unlink()
    logged.finish("finished")
    tracker.publish("So far", {"note.txt": b"x"})
    tracker.close("finished")
    return logged.ref


@pytest.fixture
def old(tmp_path: Path, template: Path) -> Path:
    """A work folder with one finished run."""
    folder = fresh(tmp_path / "old", template)
    log(folder, 0)
    return folder


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Every file with its time and content."""
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    return {str(file): (file.stat().st_mtime_ns, file.read_bytes()) for file in files}


def stored(home: Path) -> set[str]:
    """Every address of files in the database of a work folder, but for MLflow's own experiment."""
    with closing(sqlite3.connect(home / "mlflow.db")) as database:
        asked = [
            database.execute(f"SELECT {column} FROM {table}").fetchall()
            for table, column in relocation.LOCATED
            if table != "experiments"
        ]
        asked.append(database.execute("SELECT artifact_location FROM experiments WHERE experiment_id > 0").fetchall())
    return {address for rows in asked for (address,) in rows}


# Moved and copied


@pytest.mark.parametrize("put", [shutil.move, shutil.copytree])
def test_files_are_found_where_the_folder_is_and_nothing_is_written(put: object, old: Path, tmp_path: Path) -> None:
    new = tmp_path / "new"
    assert callable(put)
    put(old, new)
    before, there = snapshot(new), snapshot(old)
    if old.exists():  # a copy is read, not the original
        shutil.rmtree(old / "artifacts")
        there = snapshot(old)
    (policy,) = of_study(STUDY, new, ["one"])
    assert policy.saved.reached == "finished"
    assert pack(STUDY, tmp_path / "b", new).finished == 1
    assert len(list((tmp_path / "b" / "policies").iterdir())) == 1
    (done,) = open_existing(study_card(STUDY), Home(new)).recorded()
    (tmp_path / "f").mkdir()
    assert fetch(done.ref, [FILE, "config.yaml", "none"], Home(new), tmp_path / "f") == [FILE, "config.yaml"]
    assert run.show_status(STUDY, new) == 3
    assert snapshot(new) == before
    assert snapshot(old) == there


@pytest.mark.parametrize("put", [shutil.move, shutil.copytree])
def test_what_is_written_goes_to_where_the_folder_is(put: object, old: Path, tmp_path: Path) -> None:
    new = tmp_path / "new"
    assert callable(put)
    put(old, new)
    before = snapshot(old)
    log(new, 1)
    assert snapshot(old) == before
    assert {address.partition("/artifacts")[0] for address in stored(new)} == {new.as_uri()}
    assert len(list(of_study(STUDY, new))) == 2
    uri = sqlite.address(new / "mlflow.db")
    client = mlflow.MlflowClient(uri, uri)
    for version in client.search_model_versions():
        place = relocation.folder(client.get_model_version_download_uri(version.name, version.version))
        assert place is not None
        assert (place / "MLmodel").is_file()
        assert place.is_relative_to(new)


def test_a_server_of_a_moved_folder_is_given_present_addresses(old: Path, tmp_path: Path) -> None:
    new = shutil.move(old, tmp_path / "new")
    assert prepared(Home(new)) == sqlite.address(new / "mlflow.db")
    assert {address.partition("/artifacts")[0] for address in stored(new)} == {new.as_uri()}


def test_files_that_lie_elsewhere_by_a_wish_stay_there(old: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere" / "artifacts").mkdir(parents=True)
    uri = sqlite.address(old / "mlflow.db")
    wish = (tmp_path / "elsewhere" / "artifacts").as_uri()
    mlflow.MlflowClient(uri, uri).create_experiment("mine", wish)
    log(old, 1)
    assert wish in stored(old)


def test_two_folders_that_share_a_database_keep_their_own_files(
    old: Path, tmp_path: Path, template: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared = tmp_path / "shared.db"
    shutil.copy(template, shared)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", sqlite.address(shared))
    a, b = tmp_path / "a", tmp_path / "b"
    for folder in (a, b):
        folder.mkdir()
    ref = log(a, 0)
    other = MlflowTracker(study_card(STUDY), Home(b))
    assert other.files_of(ref) == str(a / "artifacts" / ref / "artifacts")
    a = shutil.move(a, tmp_path / "c")
    assert other.files_of(ref) == str(tmp_path / "a" / "artifacts" / ref / "artifacts")  # b knows nothing of c
    tracker = MlflowTracker(study_card(STUDY), Home(a))
    assert tracker.files_of(ref) == str(a / "artifacts" / ref / "artifacts")
    assert tracker.client.get_run(ref).info.artifact_uri == (a / "artifacts" / ref / "artifacts").as_uri()
    log(a, 1)
    assert not (tmp_path / "a").exists()


# A policy that is missing


def test_a_policy_that_is_gone_is_named_with_its_place(old: Path, tmp_path: Path) -> None:
    (kept,) = (old / "artifacts").glob(f"*/artifacts/{FILE}")
    kept.unlink()
    with pytest.raises(InputError) as said:
        list(of_study(STUDY, old))
    assert str(said.value).startswith("tiny / one s0: its run ")
    assert str(said.value).endswith(f" keeps no {FILE} in {kept.parent}")
    with pytest.raises(StoreError, match=f"keeps no {FILE} in {kept.parent}; put it back, or leave .* --values-only"):
        pack(STUDY, tmp_path / "b", old)
    assert not (tmp_path / "b").exists()
    assert pack(STUDY, tmp_path / "b", old, values_only=True).finished == 1


def test_runs_that_came_without_policies_travel_on_without_them(old: Path, tmp_path: Path, template: Path) -> None:
    there = fresh(tmp_path / "there", template)
    pack(STUDY, tmp_path / "b", old, values_only=True)
    unpack(tmp_path / "b", there)
    assert pack(STUDY, tmp_path / "c", there).finished == 1
    assert not (tmp_path / "c" / "policies").exists()


# Any name; a launch in one is in `tests/robustness/test_installed.py`


@given(st.text(st.characters(blacklist_characters="/\0", blacklist_categories=("Cs",)), min_size=1, max_size=60))
def test_an_address_is_the_way_to_a_file_and_back(name: str) -> None:
    path = Path("/tmp") / name / "x.db"
    for address in (sqlite.address(path), sqlite.reading_address(path)):
        assert sqlite.sqlite_file(address) == path
        assert make_url(address).render_as_string(hide_password=False) == address
        assert address.isascii() or not name.isascii()
    assert relocation.folder(path.as_uri()) == path


@given(st.text(st.sampled_from("#?%2F '\"~{}&=+;:@\\\n\tä"), min_size=1, max_size=20))
def test_a_database_lies_where_its_address_says(tmp_path_factory: pytest.TempPathFactory, name: str) -> None:
    folder = tmp_path_factory.mktemp("any") / f"x{name}"
    folder.mkdir()
    path = folder / "x.db"
    for address, statement in (
        (sqlite.address(path), "CREATE TABLE t (a)"),
        (sqlite.reading_address(path), "SELECT 1"),
    ):
        engine = create_engine(address)
        with engine.begin() as database:
            database.exec_driver_sql(statement)
        engine.dispose()
    with closing(sqlite.connect(path)) as database, pytest.raises(sqlite3.OperationalError, match="readonly"):
        database.execute("CREATE TABLE u (a)")
    with closing(sqlite.connect(path, write=True)) as database:
        database.execute("CREATE TABLE u (a)")
    assert [file.name for file in folder.iterdir()] == ["x.db"]
    assert [file.name for file in folder.parent.iterdir()] == [folder.name]


def test_a_folder_of_any_name_keeps_everything_inside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    home = tmp_path / HOSTILE
    home.mkdir()
    log(home, 0)  # makes the database
    with opened(Home(home)) as storage:
        assert storage is not None
    (policy,) = of_study(STUDY, home, ["one"])
    assert policy.saved.reached == "finished"
    with Home(home).lock("a", "quick"):
        assert Home(home).driven("a", "quick")
    assert not Home(home).driven("a", "quick")
    assert prepared(Home(home)) == sqlite.address(home / "mlflow.db")
    new = shutil.move(home, tmp_path / f"{HOSTILE}%41")
    log(new, 1)
    assert len(list(of_study(STUDY, new))) == 2
    assert sorted(file.name for file in tmp_path.iterdir()) == [new.name, "here"]
    assert not list((tmp_path / "here").iterdir())
    assert {"artifacts", "locks", "mlflow.db", "optuna.db"} <= {file.name for file in new.iterdir()}


@pytest.mark.parametrize(
    ("given_", "wanted"),
    [("~/w", "{home}/w"), ("~", "{home}"), ("a/../b", "{here}/b"), ("a~", "{here}/a~"), ("", "{here}/work")],
)
def test_the_work_folder_is_what_a_shell_would_make_of_it(
    given_: str, wanted: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "me"))
    monkeypatch.setenv("RHMC_HOME", given_)
    assert str(work_folder()) == wanted.format(home=tmp_path / "me", here=tmp_path)


def test_a_name_that_no_database_can_have_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RHMC_HOME", os.fsdecode(bytes(tmp_path) + b"/\xff"))
    with pytest.raises(StoreError, match=r"^RHMC_HOME='.*udcff': not in UTF-8; name another folder$"):
        work_folder()
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    monkeypatch.setenv("RHMC_HOME", str(tmp_path / "loop"))
    with pytest.raises(StoreError, match="loop"):
        work_folder()


# Closed to writers


@contextmanager
def closed(folder: Path) -> Iterator[None]:
    """The folder on a file system that is mounted for reading, or with its rights taken away."""
    if os.geteuid() == 0:
        bound = subprocess.run(["mount", "--bind", folder, folder], capture_output=True, check=False)
        again = subprocess.run(["mount", "-o", "remount,ro,bind", folder], capture_output=True, check=False)
        try:
            if bound.returncode or again.returncode:
                pytest.skip("root writes everywhere, and may not mount here")
            yield
        finally:
            if not bound.returncode:
                subprocess.run(["umount", "--lazy", folder], check=True)
        return
    there = [folder, *folder.rglob("*")]
    modes = {path: path.stat().st_mode for path in there}
    for path, mode in modes.items():
        path.chmod(mode & ~0o222)
    try:
        yield
    finally:
        for path, mode in modes.items():
            path.chmod(mode)


def searched(home: Path) -> Search:
    """A search that has been begun."""
    (home.parent / "search_x.yaml").write_text(SEARCH)
    search = Search.load(home.parent / "search_x.yaml", "quick", [])
    with opened(Home(home)) as storage:
        assert storage is not None
        assert ArmStudy(search, "one", storage).ask() is not None
    return search


@pytest.mark.parametrize("log_beside", [False, True])
def test_a_closed_folder_is_read(
    log_beside: bool, old: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    search, study = searched(old), STUDY
    with Home(old).lock("tiny", "quick"):
        pass
    if log_beside:
        with closing(sqlite3.connect(old / "mlflow.db")) as database:
            database.execute("PRAGMA journal_mode = WAL")
    before = snapshot(old)
    with closed(old):
        with pytest.raises(OSError, match=r"Read-only|denied"):
            (old / "x").touch()
        assert run.show_status(study, old) == 3
        assert show_search(search, old) == 3
        assert export_study(study, tmp_path / "tables", old) == 3
        assert pack(study, tmp_path / "b.zip", old).finished == 1
        assert [one.arm for one in of_study(study, old)] == ["one"]
        (done,) = open_existing(study_card(study), Home(old)).recorded()
        (tmp_path / "f").mkdir()
        assert fetch(done.ref, [FILE], Home(old), tmp_path / "f") == [FILE]
        assert load(tmp_path / "f" / FILE).reached == "finished"
        said = capsys.readouterr()
        assert "one         1          1" in said.out
        assert "rhmc: " not in said.err
    assert snapshot(old) == before


def test_a_closed_folder_that_is_written_to_is_one_line(old: Path) -> None:
    with closed(old):
        with pytest.raises(StoreError, match=r"mlflow\.db: the MLflow database cannot be written to \(read-only\)"):
            MlflowTracker(study_card(STUDY), Home(old))
        with pytest.raises(StoreError, match="cannot be written to"):
            Home(old).prepare()


def test_a_database_of_an_older_mlflow_is_one_line_and_left_alone(old: Path) -> None:
    with closing(sqlite3.connect(old / "mlflow.db")) as database:
        database.execute("DROP TABLE logged_models")
        database.execute("UPDATE alembic_version SET version_num = '0a8213491aaa'")
        database.commit()
    before = snapshot(old)
    with pytest.raises(StoreError, match=r"mlflow\.db: the database of another MLflow; its schema is 0a8213491aaa"):
        open_existing(study_card(STUDY), Home(old))
    assert snapshot(old) == before


def test_a_half_write_in_a_closed_folder_is_one_line(old: Path) -> None:
    write = (
        "import os, sqlite3, sys\n"
        "d = sqlite3.connect(sys.argv[1], isolation_level=None)\n"
        "d.execute('PRAGMA cache_size = 1')\n"
        "d.execute('BEGIN')\n"
        "d.executemany('INSERT INTO experiment_tags VALUES (?, ?, 1)', [(f'k{i}', 'v' * 900) for i in range(2000)])\n"
        "os._exit(9)\n"
    )
    subprocess.run([sys.executable, "-c", write, str(old / "mlflow.db")], check=False)
    with closed(old), pytest.raises(StoreError, match="its last writer was killed; open it once where its folder can"):
        open_existing(study_card(STUDY), Home(old))
    tracker = open_existing(study_card(STUDY), Home(old))  # a reader who may write plays it back
    assert tracker is not None
    assert len(tracker.recorded()) == 1


def test_who_drives_a_study_is_seen_without_a_file_being_touched(old: Path) -> None:
    place = Home(old)
    assert not place.driven("tiny", "quick")
    assert not (old / "locks").exists()
    with place.lock("tiny", "quick"), closed(old):
        assert place.driven("tiny", "quick")
    with closed(old):
        assert not place.driven("tiny", "quick")


def test_looking_at_a_search_makes_no_study_in_it(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    search = searched(old)
    before = (old / "optuna.db").read_bytes()
    with opened(Home(old), write=False) as storage:
        assert storage is not None
        assert look(search, "one", storage)[0].counts()["running"] == 1
        monkeypatch.setattr("pipelines.specs.search.code_id", lambda *place: "0ther")
        assert look(search, "one", storage)[1] == 1
    assert (old / "optuna.db").read_bytes() == before


# Restored


def test_an_experiment_that_was_deleted_and_is_restored_is_said_once(
    old: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracker = MlflowTracker(study_card(STUDY), Home(old))
    tracker.client.delete_experiment(tracker.experiment)
    said: list[str] = []
    monkeypatch.setattr(run, "Recorder", lambda *words: pytest.fail("nothing is trained here"))

    class Display:
        say = staticmethod(said.append)

    code = run.Code("abc", run.host())
    for _ in range(2):
        with pytest.raises(pytest.fail.Exception), run._logged(STUDY, code, Home(old), Display()):  # type: ignore[arg-type]
            pass
    assert said == ["tiny: experiment 'tiny (quick)' had been deleted in MLflow: it is restored, with its runs"]
