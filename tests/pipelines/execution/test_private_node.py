"""Access of others to a launch: strangers who know address and port, and other users of the same machine."""

import errno
import http.client
import os
import re
import resource
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from subprocess import TimeoutExpired
from typing import Any

import psutil
import pytest
import ray

from pipelines.cli import main as cli
from pipelines.execution.cluster import ALIVE, REFUSAL, STATUS, ask
from pipelines.execution.private_node import AUTH, FILES, INSIDE, LONGEST, allow_files, closed, private_folder
from pipelines.workspace.work_folder import StoreError
from tests.robustness.fleet import ROOT, SETTINGS, program

UNKNOWN = STATUS + b"\x0212"  # gRPC's word for a call that a program does not have
CALLS = (  # what a stranger would like to do, by service: read and write the head's table, lease a worker, run code
    ALIVE,
    "/ray.rpc.InternalKVGcsService/InternalKVGet",
    "/ray.rpc.JobInfoGcsService/AddJob",
    "/ray.rpc.NodeManagerService/RequestWorkerLease",
    "/ray.rpc.ObjectManagerService/Push",
    "/ray.rpc.CoreWorkerService/PushTask",
)
STRANGER = """\
import logging, os, sys
from ray._private import services
services.get_node_ip_address = lambda *_: "127.0.0.1"  # else Ray goes by the network, where nobody listens
kind, address, folder = sys.argv[1:]
if kind == "driver":
    import ray
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.CRITICAL)
        print("ran code in process", ray.get(ray.remote(lambda: os.getpid()).remote()))
    except ConnectionError as error:
        print("refused", error)
else:
    from ray.scripts.scripts import main
    sys.argv = ["ray", "start", "--address", address, "--block", "--num-cpus", "1", "--temp-dir", folder]
    main()
"""


# A session


@ray.remote
class Sleeper:
    """A worker that is there."""

    def pid(self) -> int:
        """Of its process."""
        return os.getpid()


@pytest.fixture(scope="module")
def session(cluster: None) -> Iterator[list[psutil.Process]]:
    """All processes of a session: the driver, which is this one, and Ray's, with a worker among them."""
    worker = Sleeper.options(num_cpus=0).remote()  # type: ignore[attr-defined]
    pid = ray.get(worker.pid.remote())
    me = psutil.Process()
    found = [me, *me.children(recursive=True)]
    assert pid in [process.pid for process in found]
    yield found
    ray.kill(worker)


def of_each(processes: list[psutil.Process], look: Callable[[psutil.Process], Any]) -> list[Any]:
    """The result of a look at each process; an idle worker may be gone by now."""
    found = []
    for process in processes:
        with suppress(psutil.NoSuchProcess):
            found.append(look(process))
    return found


def head() -> str:
    """Its address, host:port."""
    return str(ray.get_runtime_context().gcs_address)


def listeners(processes: list[psutil.Process]) -> dict[tuple[str, int], str]:
    """By address, who listens there."""
    return {
        (line.laddr.ip.removeprefix("::ffff:"), line.laddr.port): name
        for name, lines in of_each(processes, lambda process: (process.name(), process.net_connections("tcp")))
        for line in lines
        if line.status == psutil.CONN_LISTEN
    }


@pytest.mark.ray
def test_a_session_listens_on_loopback_alone_and_tells_nobody_anything(session: list[psutil.Process]) -> None:
    found = listeners(session)
    names = list(found.values())
    assert [names.count(name) for name in ("gcs_server", "raylet")] == [1, 2]
    assert len(names) >= 3 + 3  # a worker, the driver and the agent that sets up environments
    assert {host for host, _ in found} == {"127.0.0.1"}
    asked = dict.fromkeys(found.values(), 0)
    for (host, port), name in found.items():
        if (answer := ask(host, port)).startswith(b"HTTP/"):
            line = http.client.HTTPConnection(host, port, timeout=10)
            line.request("POST", "/get_runtime_envs_info")
            assert line.getresponse().status == 401
            line.close()
            continue
        answers = [answer, *(ask(host, port, call) for call in CALLS[1:])]
        assert all(REFUSAL in one or UNKNOWN in one for one in answers), name
        asked[name] += sum(REFUSAL in one for one in answers)
    assert asked["gcs_server"] >= 3
    assert asked["raylet"] >= 2
    assert sum(asked.values()) >= 3 + 2 + 2


@pytest.mark.ray
def test_the_token_is_nowhere_to_be_read(session: list[psutil.Process]) -> None:
    token = os.environ["RAY_AUTH_TOKEN"]
    lines = of_each(session, lambda process: "\0".join(process.cmdline()))
    assert not [line for line in lines if token in line]
    logs = Path(ray._private.worker._global_node.get_session_dir_path())
    files = [path for path in logs.rglob("*") if path.is_file() and not path.is_symlink()]
    assert files
    assert not [path for path in files if token.encode() in path.read_bytes()]
    worker_env = ray.get(ray.remote(lambda: os.environ["RAY_AUTH_TOKEN"]).options(num_cpus=0).remote())
    assert worker_env == token  # how the session's own processes know it


@contextmanager
def another_user() -> Iterator[None]:
    """Act as nobody."""
    if os.geteuid() != 0:
        pytest.skip("only root can act as another user")
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.mark.ray
def test_the_folder_of_a_session_is_its_owners_alone(session: list[psutil.Process]) -> None:
    logs = Path(ray._private.worker._global_node.get_session_dir_path())
    folder = logs.parents[1]
    assert folder.parent == Path(tempfile.gettempdir())
    status = folder.lstat()
    assert (stat.S_ISDIR(status.st_mode), stat.S_IMODE(status.st_mode), status.st_uid) == (True, 0o700, os.getuid())
    arguments = [word for line in of_each(session, psutil.Process.cmdline) for word in line]
    assert f"--fallback_directory={logs}" in arguments  # where Ray puts what does not fit into memory
    with another_user():
        for path in (folder, logs, logs / "sockets"):
            with pytest.raises(PermissionError):
                os.listdir(path)


@pytest.mark.ray
def test_foreign_drivers_and_nodes_are_refused(session: list[psutil.Process], tmp_path: Path) -> None:
    own = os.environ["RAY_AUTH_TOKEN"]
    assert own != SETTINGS["RAY_AUTH_TOKEN"]
    keys = {"none": {"RAY_AUTH_MODE": "disabled"}, "wrong": {}, "right": {"RAY_AUTH_TOKEN": own}}
    tried = [("driver", "none"), ("driver", "wrong"), ("driver", "right"), ("node", "none"), ("node", "wrong")]
    before = len(ray.nodes())
    with ExitStack() as stack, tempfile.TemporaryDirectory(prefix="rhmc-") as folder:
        processes = {}
        for kind, key in tried:
            command = [sys.executable, "-W", "ignore", "-c", STRANGER, kind, head(), folder]
            env = {"RAY_NUM_REDIS_GET_RETRIES": "2"} | keys[key]
            log = tmp_path / f"{kind}-{key}"
            processes[log] = stack.enter_context(program(command, log, cwd=tmp_path, env=env))
        for log, process in processes.items():
            try:
                process.wait(120)
            except TimeoutExpired:  # a node that was let in stays
                raise AssertionError(f"{log.name} was let in: {log.read_text()}") from None
    said = {log.name: log.read_text() for log in processes}
    assert "ran code in process" in said.pop("driver-right")  # so the attack is one
    for name, text in said.items():
        assert "InvalidAuthToken" in text, name
        assert "ran code" not in text, name
        assert "Ray runtime started" not in text, name
    assert len(ray.nodes()) == before


# What a session is made of


def test_a_session_is_closed_whatever_was_set_for_a_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = {"RAY_AUTH_MODE": "disabled", "RAY_AUTH_TOKEN": "mine", "RAY_AUTH_TOKEN_PATH": "/mine"}
    monkeypatch.setattr("pipelines.execution.private_node.read_again", lambda: None)  # a session of other tests may run
    monkeypatch.setattr(
        "pipelines.execution.private_node.Config", type("Config", (), {"initialize": lambda text: None})
    )
    for name, value in mine.items():
        monkeypatch.setenv(name, value)
    tokens = []
    for _ in range(2):
        with closed():
            assert os.environ["RAY_AUTH_MODE"] == "token"
            assert "RAY_AUTH_TOKEN_PATH" not in os.environ
            tokens.append(os.environ["RAY_AUTH_TOKEN"])
        assert {name: os.environ.get(name) for name in AUTH} == mine
    assert len({"mine", *tokens}) == 3
    assert min(map(len, tokens)) == 64


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder in place of /tmp, as open as that."""
    with tempfile.TemporaryDirectory(prefix="rhmc-") as name:
        folder = Path(name)
        folder.chmod(0o1777)
        monkeypatch.setattr(tempfile, "tempdir", name)
        yield folder


def test_the_folder_of_a_killed_driver_is_used_again(place: Path) -> None:
    with private_folder("x") as folder:
        (folder / "left").touch()
        folder.chmod(0o777)
        with private_folder("x") as same:
            assert same == folder == place / "ray-x"
            assert [file.name for file in same.iterdir()] == [".owner"]
            assert stat.S_IMODE(same.stat().st_mode) == 0o700
    assert not folder.exists()


def test_a_link_in_its_place_is_refused(place: Path) -> None:
    victim = place / "home"
    victim.mkdir(mode=0o700)
    (victim / "precious").touch()
    (place / "ray-x").symlink_to(victim)
    with pytest.raises(StoreError, match=r"ray-x: .*user 0 has put something there: remove it, or set TMPDIR$"):
        private_folder("x").__enter__()
    assert (victim / "precious").exists()
    assert stat.S_IMODE(victim.stat().st_mode) == 0o700


def test_a_folder_of_another_user_is_refused(place: Path) -> None:
    (place / "ray-x").mkdir()  # root's, whom the other one cannot clean up after
    with another_user(), pytest.raises(StoreError, match=r"ray-x: .*user 0 has put something there"):
        private_folder("x").__enter__()
    assert (place / "ray-x").exists()


def test_a_place_where_anybody_may_replace_it_is_refused(place: Path) -> None:
    place.chmod(0o777)
    with pytest.raises(StoreError, match="anybody may replace what lies there: chmod o-w it, or set TMPDIR"):
        private_folder("x").__enter__()
    assert list(place.iterdir()) == []


def test_a_place_with_too_long_a_name_says_by_how_much(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    longest = LONGEST - len(f"/ray-x/{INSIDE}")
    for length, fits in ((longest, True), (longest + 3, False)):
        deep = place / ("d" * (length - len(str(place)) - 1))
        deep.mkdir(mode=0o700)
        monkeypatch.setattr(tempfile, "tempdir", str(deep))
        if fits:
            with private_folder("x") as folder:
                assert len(f"{folder}/{INSIDE}") == LONGEST
        else:
            with pytest.raises(StoreError, match="longer than 107 bytes: set TMPDIR to a folder whose name is 3 bytes"):
                private_folder("x").__enter__()


def test_too_low_a_limit_of_open_files_is_known_before_ray_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    limits, endless = [0, 0], resource.RLIM_INFINITY
    monkeypatch.setattr(resource, "getrlimit", lambda kind: tuple(limits))
    monkeypatch.setattr(resource, "setrlimit", lambda kind, wanted: limits.__setitem__(slice(None), wanted))
    limits[:] = 40, 40
    with pytest.raises(
        StoreError,
        match=r"136 open files are needed for runs on 2 processors, and 40 are allowed \(ulimit -Hn\): raise",
    ):
        allow_files(2)
    for before, after in (
        ([40, 4096], [136, 4096]),
        ([40, endless], [136, endless]),
        ([1024, 4096], [1024, 4096]),
        ([endless, endless], [endless, endless]),
    ):
        limits[:] = before
        allow_files(2)
        assert limits == after


def test_an_error_for_want_of_open_files_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    full = OSError(errno.EMFILE, os.strerror(errno.EMFILE), "/work/mlflow.db")
    wrapped = StoreError(f"outer: {StoreError(f'x: cannot be written: {full.strerror}')}")
    for error in (full, wrapped):

        def fails(failure: Exception = error, **options: str) -> None:
            raise failure

        monkeypatch.setattr(cli, "app", fails)
        with pytest.raises(SystemExit, match="2"):
            cli.main()
        (line,) = capsys.readouterr().err.splitlines()
        assert line.count("Too many open files") == line.count(": raise the limit with `ulimit -n 4096`") == 1


def test_only_the_closed_session_starts_ray() -> None:
    files = [
        path for folder in ("rhmc", "pipelines", "reports", "benchmarks") for path in (ROOT / folder).rglob("*.py")
    ]
    found = [path.name for path in files if re.search(r"ray\.init\(|ray\.scripts|RAY_AUTH_MODE=dis", path.read_text())]
    assert sorted(found) == ["cluster.py", "ray_driver.py"]  # `cluster.py` names the way out


@pytest.mark.ray
def test_a_session_opens_fewer_files_than_it_asks_for(session: list[psutil.Process]) -> None:
    assert max(of_each(session[1:], psutil.Process.num_fds)) < FILES
