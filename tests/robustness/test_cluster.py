"""Past one machine: what a cluster has to be, and a study and a search on one whose node dies in the middle."""

import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from filelock import FileLock

from pipelines.bundles.bundle import pack
from pipelines.execution import cluster
from pipelines.execution.cluster import DEATHS, NODE_DIED, Deaths, Place, Sight, knock, look, outline, probing, wrong
from pipelines.execution.ray_driver import Bridge
from pipelines.execution.run import show_status
from pipelines.execution.seed_group import Seeds
from pipelines.execution.trainable import RunTrainable
from pipelines.export.tables import export_study
from pipelines.specs.identity import code_id
from pipelines.specs.search import Search
from pipelines.specs.study import Setting
from pipelines.tracking.mlflow_tracker import open_existing
from pipelines.tracking.plan import study_card
from pipelines.tuning.search_run import search_card, show_search
from pipelines.workspace.work_folder import Home, StoreError
from rhmc.types import Metrics
from tests.pipelines.support import lasting, plan, setting, tiny
from tests.robustness.chaos import everything, faults, launch_here
from tests.robustness.fleet import (
    ROOT,
    Cluster,
    Node,
    postgres,
    postgres_programs,
    program,
    tracking_server,
    wait_for,
)

PROGRAMS = postgres_programs()
needs_postgres = pytest.mark.skipif(
    PROGRAMS is None, reason="PostgreSQL's initdb and postgres are neither on PATH nor in /usr/lib/postgresql"
)
POINTS = 40
STUDY = lasting(tiny(points=POINTS, arms={arm: setting(lr=rate) for arm, rate in {"slow": 1e-4, "fast": 1e-2}.items()}))
CODE = code_id("iql", "coverage")


# An address


def port_of(end: socket.socket) -> int:
    return int(end.getsockname()[1])


@contextmanager
def listener(says: bytes) -> Iterator[str]:
    """The address of something that answers with these bytes."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            line, _ = server.accept()
            line.recv(1000)
            line.sendall(says)
            line.close()

        threading.Thread(target=answer, daemon=True).start()
        yield f"127.0.0.1:{port_of(server)}"


def test_a_cluster_that_is_not_there_is_one_line() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{port_of(free)}"
        with pytest.raises(StoreError, match=f"RAY_ADDRESS={address}: .*refused"):
            knock(address)


@pytest.mark.parametrize("says", [b"HTTP/1.1 400 Bad Request\r\n\r\n", b"", b"\0\0\0\4\0\0\0\0\0"])
def test_what_is_not_ray_is_known_at_once(says: bytes) -> None:
    with listener(says) as address, pytest.raises(StoreError, match="what answers there is not Ray"):
        knock(address)


HTTP2 = b"\0\0\0\4\0\0\0\0\0"  # an empty frame with settings, as the first
LOCKED = HTTP2 + b"grpc-status\x0216\0grpc-message>InvalidAuthToken: Authentication token is missing or incorrect"
OPEN = HTTP2 + b"\n\0\x12\x062.60.0@grpc-status\x010"


def test_what_speaks_as_ray_does_is_let_through(monkeypatch: pytest.MonkeyPatch) -> None:
    for mode in ("", "token"):
        monkeypatch.setenv("RAY_AUTH_MODE", mode)
        with listener(LOCKED) as address:
            knock(address)
    knock("auto")  # no place to knock at


def test_a_cluster_that_is_open_to_anybody_is_joined_only_if_that_is_meant(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    with (
        listener(OPEN) as address,
        pytest.raises(StoreError, match=f"{address}: it asks nobody .* RAY_AUTH_MODE=token"),
    ):
        knock(address)
    assert cluster.exposed() == []
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    with listener(OPEN) as address:
        knock(address)
    assert "whoever reaches it can run code" in cluster.exposed()[0]


def test_a_cluster_that_wants_a_token_is_told_from_one_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    with (
        listener(LOCKED) as address,
        pytest.raises(StoreError, match="it asks for a token, and RAY_AUTH_MODE=disabled"),
    ):
        knock(address)


def test_rays_client_is_refused() -> None:
    with pytest.raises(StoreError, match=r"RAY_ADDRESS=ray://127.0.0.1:1: only HOST:PORT or auto"):
        knock("ray://127.0.0.1:1")


def test_a_head_that_dies_ends_the_launch(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    ended: list[int] = []
    monkeypatch.setattr("os._exit", ended.append)
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        cluster.watched(where := f"127.0.0.1:{port_of(server)}", 0.02),
    ):
        for _ in range(10):
            server.accept()[0].close()
        assert ended == []
        server.close()
        wait_for(lambda: ended, "the end")
    assert ended == [2]
    assert capsys.readouterr().err == f"rhmc: the cluster at {where} is gone; the same command continues\n"


# Nodes


def test_a_node_sees_what_the_driver_holds(tmp_path: Path) -> None:
    with probing(tmp_path) as probe:
        assert look(str(probe), "other")[2:] == (True, True)
        assert look(str(tmp_path / "elsewhere"), "other").sees is False
        assert sorted(file.name for file in tmp_path.iterdir()) == [probe.name, f"{probe.name}.other"]
    assert not list(tmp_path.iterdir())


def test_a_node_that_takes_a_held_lock_is_seen(tmp_path: Path) -> None:
    probe = tmp_path / "probe"
    with FileLock(probe):
        pass
    probe.touch()
    assert look(str(probe), "other").locks is False


def test_what_a_node_may_lack(tmp_path: Path) -> None:
    good = Sight("c0de", "AVX2", sees=True, locks=True)
    assert wrong(good, tmp_path, written=True, code="c0de") == ""
    assert "RHMC_HOME" in wrong(good._replace(sees=False), tmp_path, written=False, code="c0de")
    assert "cannot write to" in wrong(good, tmp_path, written=False, code="c0de")
    assert "locks that reach every node" in wrong(good._replace(locks=False), tmp_path, written=True, code="c0de")
    assert "another torch, numpy or code (c0de instead of 0ther)" in wrong(good, tmp_path, written=True, code="0ther")


def test_a_node_that_joined_late_does_not_train_with_other_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (job,) = [{"key": i.key, "spec": i.spec.canonical(), "folder": str(tmp_path / "a")} for i in plan(STUDY)[:1]]
    config = {"job": job | {"checkpoint_every": 1, "stop": str(tmp_path / "stop")}}
    for code, trains in ((cluster.own_code(), True), ("0ther", False)):
        monkeypatch.setenv(cluster.CODE, code)
        run = RunTrainable(config)
        result = run.step()
        run.cleanup()
        assert ("error" not in result) == trains
    assert f"({cluster.own_code()} instead of 0ther)" in result["error"]


def test_the_line_on_a_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "head:1")
    nodes = {"a": {"Resources": {"CPU": 8.0}}, "b": {"Resources": {}}, "c": {"Resources": {"CPU": 3.0}}}
    monkeypatch.setattr(cluster, "alive", lambda: nodes)
    start = "cluster at head:1: 3 nodes, 11 processors, "
    assert outline(20, 1) == f"{start}11 runs at a time"
    assert outline(1, 4) == f"{start}1 run at a time (room for 2: see resources.concurrent)"
    assert outline(5, 16) == f"{start}0 runs at a time; waiting for a node that has 16 processors for a run"


# Deaths


def test_only_workers_whose_node_lives_count(monkeypatch: pytest.MonkeyPatch) -> None:
    living = {"a": {}, "b": {}}
    monkeypatch.setattr(cluster, "alive", lambda: living)
    deaths = Deaths()
    deaths.add("a", "its worker died")
    deaths.add("", f"because {NODE_DIED}. Node Id: c")
    deaths.add("b", "the actor is unavailable")
    deaths.add("", "the actor is unavailable")
    assert deaths.left == DEATHS - 3
    del living["b"]  # Ray learns later that it died
    assert deaths.left == DEATHS - 2


class Listener:
    """A recorder that remembers what it was told of one run."""

    def __init__(self) -> None:
        self.logs, self.told = {"key": None}, []

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *args: self.told.append(name)


def lives(deaths: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The events that a recorder is told while workers die, W, or their node, N, or get further, -, as Tune has it."""
    monkeypatch.setattr(cluster, "alive", dict)
    listener = Listener()
    bridge = Bridge(listener, folder / "stop")  # type: ignore[arg-type]
    trial = SimpleNamespace(
        config={"job": {"key": "key"}}, error_file=str(folder / "e"), num_failures=0, max_failures=2
    )
    trials: list[Any] = [trial]
    written, step = Path(trial.error_file), 0
    written.touch()
    for death in deaths:
        if death == "-":
            step += 1
            points = [{"step": float(step)}]
            place = Place("", "host")  # not `here()`: another test may have left a Ray session in this process
            bridge.on_trial_result(0, trials, trials[0], {"points": points, "done": False, "place": place})
            continue
        trial.num_failures += 1
        with written.open("a") as file:
            file.write(f"Failure # {trial.num_failures}\n{NODE_DIED if death == 'N' else 'killed'}\n")
        recovers = trial.num_failures <= trial.max_failures
        (bridge.on_trial_recover if recovers else bridge.on_trial_error)(0, trials, trials[0])
    return [name for name in listener.told if name != "result"]


@pytest.mark.parametrize(
    ("deaths", "end"),
    [
        ("WWW", "failed"),
        ("WW-WW", "died"),
        ("WW-WWW", "failed"),
        ("NNNNNN", "died"),
        ("WNNNW", "died"),
        ("WNNNWW", "failed"),
        ("WWN", "lost"),  # Tune is told before whose death it is how many may come
    ],
)
def test_dead_nodes_cost_no_attempt(deaths: str, end: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = lives(deaths, tmp_path, monkeypatch)
    assert told == ["died"] * (len(deaths.replace("-", "")) - 1) + [end]


# The whole chain


class Site(NamedTuple):
    """The addresses of a cluster of several machines."""

    database: str  # address without a name
    uri: str  # MLflow
    cluster: Cluster
    head: Node


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    assert PROGRAMS is not None
    folder = tmp_path_factory.mktemp("site")
    with Cluster(folder) as ray_cluster, postgres(PROGRAMS, "mlflow", "optuna") as database:
        starting: list[Node] = []
        thread = threading.Thread(target=lambda: starting.append(ray_cluster.start()))
        thread.start()
        try:
            with tracking_server(f"{database}/mlflow", folder) as uri:
                thread.join()
                yield Site(database, uri, ray_cluster, starting[0])
        finally:
            thread.join()


@pytest.fixture
def at_site(site: Site, monkeypatch: pytest.MonkeyPatch) -> Site:
    """The site in the environment of this process and of those that it starts."""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", site.uri)
    monkeypatch.setenv("OPTUNA_STORAGE", f"{site.database}/optuna")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return site


class Launch:
    """A driver that is a process of its own."""

    def __init__(self, process: subprocess.Popen[bytes], log: Path) -> None:
        self.process, self.log = process, log

    def said(self) -> str:
        """The output so far. It must not have ended with another exit code than 0."""
        assert self.process.poll() in (None, 0), self.log.read_text()
        return self.log.read_text()

    def end(self) -> str:
        """All that it says."""
        self.process.wait(300)
        return self.said()


@contextmanager
def driver(arguments: list[str], site: Site, home: Path) -> Iterator[Launch]:
    """A launch on the cluster, killed at the end of the block should it still run."""
    log = home / "driver.log"
    log.unlink(missing_ok=True)
    settings = {"RAY_ADDRESS": site.cluster.address, "RHMC_HOME": str(home)}
    with program([sys.executable, "-W", "ignore", "-m", *arguments], log, cwd=home, env=settings) as process:
        yield Launch(process, log)


def nodes_of(home: Path) -> dict[str, tuple[str, list[str]]]:
    """By key of a run its status and the nodes that trained it."""
    tracker = open_existing(study_card(STUDY), Home(home))
    assert tracker is not None
    return {
        f"{run.data.tags['spec']}-{CODE}": (run.info.status, run.data.tags.get("nodes", "").split(", "))
        for run in tracker._search("tags.role = 'run'")
    }


@pytest.mark.ray
@needs_postgres
def test_a_study_survives_the_death_of_a_node(
    tmp_path: Path, template: Path, at_site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "shared"
    home.mkdir()
    other = at_site.cluster.start()

    def on_the_other() -> str | None:
        """A run with a checkpoint that is on that node, once the head trains as well."""
        launched.said()
        found = nodes_of(home) if list(home.glob("checkpoints/*/0*.pt")) else {}
        there = [key for key, (_, places) in found.items() if other.trained(places[-1])]
        if not there or not any(at_site.head.trained(places[-1]) for _, places in found.values()):
            return None
        return there[0] if list(home.glob(f"checkpoints/{there[0]}/0*.pt")) else None

    with driver(["tests.pipelines.support", str(home), str(POINTS), "2"], at_site, home) as launched:
        victim = wait_for(on_the_other, "training on both nodes")
        other.kill()
        out = launched.end()
    assert "its worker died; another one continues it" in out
    assert "failed" not in out
    assert "2 nodes, 2 processors, 2 runs at a time" in out
    status, places = nodes_of(home)[victim]
    assert status == "FINISHED"
    assert [other.trained(places[0]), at_site.head.trained(places[-1]), len(places)] == [True, True, 2]
    assert_as_undisturbed(tmp_path, home, template, at_site, monkeypatch)


def assert_as_undisturbed(
    folder: Path, home: Path, template: Path, site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log, the tables and the bundle are those of a launch on one machine that nobody disturbed."""
    assert show_status(STUDY, home) == 0
    assert export_study(STUDY, folder / "out", home) == 0
    assert pack(STUDY, folder / "bundle", home).finished == 2
    found = everything(STUDY, home)
    assert not list(home.glob("checkpoints/*/*"))
    with monkeypatch.context() as alone:
        alone.delenv("MLFLOW_TRACKING_URI")
        whole = folder / "whole"
        whole.mkdir()
        shutil.copy(template, whole / "mlflow.db")
        assert launch_here(STUDY, whole) == 0
        assert export_study(STUDY, whole / "out", whole) == 0
        expected = everything(STUDY, whole)
    assert faults(found, expected) == dict.fromkeys(faults([], []), 0)
    for name in ("tiny.parquet",):
        assert (folder / "out" / name).read_bytes() == (whole / "out" / name).read_bytes()


SEARCH = """\
question: Which?
base:
  env: {kind: coverage, agents: 2, targets: 2}
  algo: {kind: iql, learning_starts: 64, batch_size: 32, train_freq: 16, hidden_dim: 16, buffer_size: 400}
  trainer: {num_envs: 8, evaluations: 8, eval_episodes: 4, final_episodes: 8}
arms: {IQL: {space: {lr: {low: 1e-4, high: 1e-2, log: true}}}}
trials: 2
seeds: 2
steps: 1600
sampler: {startup: 2}
resources: {concurrent: 1, checkpoint_every: 1}
"""


@pytest.mark.ray
@needs_postgres
def test_a_search_in_postgresql_is_killed_and_goes_on_with_more_trials(
    tmp_path: Path, at_site: Site, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "search_x.yaml").write_text(SEARCH)
    monkeypatch.chdir(tmp_path)
    command = ["pipelines.cli.main", "search", "run", "search_x.yaml"]
    with driver(command, at_site, tmp_path) as launched:
        wait_for(lambda: launched.said() and list(tmp_path.glob("checkpoints/*/0*.pt")), "a trial under way")
    more = Search.load("search_x.yaml", overrides=["trials=3"])
    assert show_search(more, tmp_path) == 3
    with driver([*command, "--set", "trials=3", "--out", "best_params"], at_site, tmp_path) as launched:
        out = launched.end()
    assert "IQL: 0 of 3 trials are done, 1 are taken up" in out
    assert (tmp_path / "best_params" / "search_x.iql.quick.yaml").exists()
    assert not (tmp_path / "optuna.db").exists()
    assert show_search(more, tmp_path) == 0
    tracker = open_existing(search_card(more), Home(tmp_path))
    assert tracker is not None
    found = {run.data.tags["trial"]: run for run in tracker._search("tags.role = 'run'")}
    assert {run.info.status for run in found.values()} == {"FINISHED"}
    assert sorted(found) == ["0", "1", "2"]
    killed = found["0"]
    rows = [row for row in tracker.rows([killed.info.run_id]) if row.metric == "eval/return"]
    setting = more.arms["IQL"].at({"lr": float(killed.data.params["algo.lr"])})
    expected = [(int(point["step"]), point["eval/return"]) for point in trained(setting, more)]
    assert [(row.step, row.value) for row in rows] == expected
    history = tracker.client.get_metric_history(killed.info.run_id, "return")
    assert sorted(value.step for value in history) == [step for step, _ in expected]


def trained(setting: Setting, search: Search) -> list[Metrics]:
    """The points of a trial that nobody disturbed."""
    seeds = Seeds(setting, search.seed_list())
    points = []
    while not seeds.done:
        points.append(next(seeds))
    return points
