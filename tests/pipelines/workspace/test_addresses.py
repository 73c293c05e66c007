"""No password goes out, whatever verb fails on whatever store; and servers of this machine are reached past proxies."""

import http.server
import json
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import psutil
import pytest
import requests
from hypothesis import given
from hypothesis import strategies as st

from pipelines.workspace.addresses import HIDDEN, fault, reach_loopback, scrubbed, without_password
from pipelines.workspace.exit_codes import Exit
from tests.pipelines.support import run_rhmc, started_by
from tests.robustness.chaos import free_port
from tests.robustness.fleet import postgres, postgres_programs, wait_for

RAW = "Se@:/%?#cr'et"
CODED = quote(RAW, safe="")
ROOT = Path(__file__).parents[3]
STUDY = """\
question: Which?
base: {env: {kind: coverage, agents: 2, targets: 2}, algo: {kind: iql, encoder: mlp}}
arms: {one: {}}
seeds: 1
steps: 200
"""
SEARCH = """\
question: Which?
base: {env: {kind: coverage, agents: 2, targets: 2}, algo: {kind: iql}}
arms: {one: {space: {lr: {low: 1.0e-4, high: 1.0e-2, log: true}}}}
trials: {quick: 1, paper: 1}
seeds: 1
steps: 200
"""


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("postgresql://me:secret@there/mlflow", "postgresql://me:***@there/mlflow"),
        (f"postgresql+psycopg://me:{CODED}@there:1/x", "postgresql+psycopg://me:***@there:1/x"),
        ("postgresql://there/x?user=me&password=secret", "postgresql://there/x?user=me&password=***"),
        ("postgresql://there/x?sslpassword=a;p%61ssword=b", "postgresql://there/x?sslpassword=***;p%61ssword=***"),
        ("mssql+pyodbc:///?odbc_connect=UID%3Dme%3BPWD%3Dsecret", "mssql+pyodbc:///?odbc_connect=***"),
        (f"postgresql://me:{RAW}@there/x", "postgresql://***"),
        ("postgresql://me:a@b@there/x", "postgresql://***"),
        ("postgresql://there/x?password=a@b", "postgresql://***"),
        ("http://:secret@[::1]:5000", "http://:***@[::1]:5000"),
        ("http://[", "http://["),
        ("me:secret@there", "***"),
        ("host=there password=secret", "***"),
        ("sqlite:////home/me@work/#1/x.db?mode=ro", "sqlite:////home/me@work/#1/x.db?mode=ro"),
        ("127.0.0.1:5000", "127.0.0.1:5000"),
    ],
)
def test_an_address_is_shown_without_what_is_secret(address: str, shown: str) -> None:
    assert without_password(address) == shown


@given(st.text(min_size=4).filter(lambda text: text.isprintable() and " " not in text))
def test_no_form_of_a_password_is_left_in_a_text(password: str) -> None:
    coded = quote(password, safe="")
    secret = f"xq{password}qx"  # is in no word of the message itself
    coded = quote(secret, safe="")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OPTUNA_STORAGE", f"postgresql://me:{coded}@there/x")
        text = f"refused {secret} {coded} {secret!r} {json.dumps(secret)} postgresql://me:{coded}@there/x user me"
        said = scrubbed(text)
    assert secret not in said
    assert coded not in said
    assert said.startswith("refused *** *** ")
    assert said.endswith(" postgresql://me:***@there/x user me")


def test_a_password_that_is_a_common_word_leaves_other_words_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "postgresql://mlflow:mlflow@there/db")
    assert scrubbed("sqlite:///mlflow.db: mlflowish (mlflow)") == "sqlite:///***.db: mlflowish (***)"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "postgresql://me:db@there/db")  # short: where it stands in an address
    assert scrubbed("db of postgresql://me:db@there/db") == "db of postgresql://me:***@there/db"
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", "hidden-well")
    assert scrubbed("401 for hidden-well, password=other") == "401 for ***, password=***"


# Every verb


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project as the current folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("MLFLOW_TRACKING_URI", "OPTUNA_STORAGE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("RHMC_HOME", str(tmp_path / "work"))
    (tmp_path / "x.yaml").write_text(STUDY)
    (tmp_path / "search_x.yaml").write_text(SEARCH)
    return tmp_path


VERBS = (
    "study run x.yaml",
    "study status x.yaml",
    "study export x.yaml b.zip",
    "study import b.zip",
    "export x.yaml --out tables",
    "evaluate x.yaml",
    "render 0123456789abcdef0123456789abcdef --out a.gif",
    "transfer x.yaml --agents 2 --out tables",
    "search run search_x.yaml",
    "search status search_x.yaml",
    "doctor --no-ray",
    "ui",
    "report --study x.yaml --runs tables --out page",
)


class NotMlflow(http.server.BaseHTTPRequestHandler):
    """Answers, and repeats what it was asked, as gateways do."""

    def do_GET(self) -> None:
        said = f"no {self.path} for {self.headers.get('Authorization')}\n".encode()
        self.send_response(404)
        self.end_headers()
        self.wfile.write(said)

    do_POST = do_GET  # noqa: N815

    def log_message(self, *words: object) -> None:
        """Nothing."""


@contextmanager
def another_server() -> Iterator[int]:
    """A server that is none of MLflow's; yields its port."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), NotMlflow)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_port
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


STORES: dict[str, str] = {
    "nobody answers": "http://me:{coded}@127.0.0.1:1",
    "another server": "http://me:{coded}@127.0.0.1:{port}",
    "no database there": "postgresql://me:{coded}@127.0.0.1:1/x",
    "no database": "postgresql://me:{coded}@127.0.0.1:{port}/x?connect_timeout=2",
    "in the query": "postgresql://127.0.0.1:1/x?user=me&password={coded}&connect_timeout=2",
    "not coded": "postgresql://me:{raw}@127.0.0.1:1/x",
    "not coded, served": "http://me:{raw}@127.0.0.1:1",
    "no number": "postgresql://me:{coded}@127.0.0.1:port/x",
    "no address": "me:{raw}@127.0.0.1",
    "unknown": "pigeon://me:{coded}@roof",
}


@pytest.mark.parametrize("store", STORES)
def test_no_verb_gives_a_password_away(
    store: str, place: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    said = ""
    with another_server() as port:
        address = STORES[store].format(coded=CODED, raw=RAW, port=port)
        monkeypatch.setenv("MLFLOW_TRACKING_URI", address)
        monkeypatch.setenv("OPTUNA_STORAGE", address)
        monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
        for verb in VERBS:
            if verb == "study import b.zip":
                (place / "b.zip").write_text("no bundle")
            assert run_rhmc(*verb.split()) in (Exit.DONE, Exit.BAD, Exit.UNFINISHED, Exit.NO), verb
            out, err = capfd.readouterr()
            assert "Traceback" not in err, (verb, err)
            said += out + err
    assert no_secret(said), said
    assert HIDDEN in said
    assert all(no_secret(file.read_bytes()) for file in place.rglob("*") if file.is_file())


def no_secret(said: str | bytes) -> bool:
    """True if neither form of the password, nor a telling part of one, is there."""
    text = said if isinstance(said, str) else said.decode(errors="replace")
    return not any(form in text for form in (RAW, CODED, repr(RAW)[1:-1], "cr'et", "cr%27et"))


class Shown(NamedTuple):
    """What was seen of the web interface, which has ended."""

    password: bool  # whether the address of its store had one
    lines: list[str]  # command lines of all processes while it ran
    files: list[Path]  # of its project
    port: int
    pid: int


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory, template: Path) -> Shown:
    """Of a store with a password if PostgreSQL is installed; started behind a proxy at which nobody answers."""
    place, programs = tmp_path_factory.mktemp("shown"), postgres_programs()
    environment = os.environ | {"RHMC_HOME": str(place / "work"), "PYTHONWARNINGS": "ignore"}
    environment |= {"http_proxy": "http://127.0.0.1:9", "HTTP_PROXY": "http://127.0.0.1:9"}
    environment.pop("MLFLOW_TRACKING_URI", None)
    (place / "work").mkdir()
    with ExitStack() as stack:
        if programs is None:
            (place / "work" / "mlflow.db").write_bytes(template.read_bytes())
        else:
            server = stack.enter_context(postgres(programs, "mlflow"))
            environment["MLFLOW_TRACKING_URI"] = server.replace("rhmc@", f"rhmc:{CODED}@") + "/mlflow"
            log = "from pipelines.tracking.mlflow_tracker import *; from pipelines.workspace.work_folder import *\n"
            log += "MlflowTracker(StudyCard('x', 'quick', ''), Home(work_folder())).close('finished')\n"
            words = [sys.executable, "-c", log]
            made = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
            assert made.returncode == 0, made.stderr
        port = free_port()
        command = [sys.executable, "-m", "pipelines.cli.main", "ui", "--port", str(port)]
        with (place / "said").open("w") as said:
            process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=said, stderr=said)
        try:
            wait_for(lambda: "Ctrl-C ends it" in (place / "said").read_text(), "rhmc ui")
            for path in ("/", "/api/2.0/mlflow/experiments/get?experiment_id=77", "/ajax-api/2.0/none"):
                with suppress(OSError):
                    urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=60).close()
            lines = [" ".join(one.info["cmdline"] or ()) for one in psutil.process_iter(["cmdline"])]
        finally:
            process.terminate()
            process.wait(60)
    files = [file for file in place.rglob("*") if file.is_file()]
    return Shown(programs is not None, lines, files, port, process.pid)


def test_the_password_of_a_store_in_use_is_nowhere(shown: Shown) -> None:
    if not shown.password:
        pytest.skip("PostgreSQL is not installed: its programs are not on the PATH")
    assert sum("mlflow" in line for line in shown.lines) >= 2  # the server and its worker were looked at
    assert all(no_secret(line) for line in shown.lines)
    assert {"ui.log", "said"} <= {file.name for file in shown.files}
    assert all(no_secret(file.read_bytes()) for file in shown.files)


def test_an_address_that_is_not_clear_says_what_to_do() -> None:
    said = fault("OPTUNA_STORAGE", "postgresql://me:a/b@there/x")
    assert said.startswith("OPTUNA_STORAGE=postgresql://***: not an address that can be read; ")
    assert "@ as %40" in said
    assert fault("OPTUNA_STORAGE", "sqlite:////home/a@b/#/x.db") == ""


# Proxies


@pytest.mark.parametrize(
    ("given_", "wanted"),
    [
        ({}, None),
        ({"HTTP_PROXY": ""}, None),
        ({"no_proxy": "a.org"}, "a.org"),
        ({"http_proxy": "http://p"}, "localhost,127.0.0.1,::1,[::1]"),
        ({"HTTPS_PROXY": "http://p", "NO_PROXY": "a.org, 127.0.0.1"}, "a.org,127.0.0.1,localhost,::1,[::1]"),
        ({"all_proxy": "http://p", "no_proxy": "*"}, "*"),
    ],
)
def test_only_this_machine_is_added_to_what_needs_no_proxy(given_: dict[str, str], wanted: str | None) -> None:
    reach_loopback(given_)
    assert given_.get("no_proxy") == wanted


def by_urllib(url: str) -> int:
    try:
        with urllib.request.urlopen(url, timeout=9) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        error.close()
        return error.code


def by_requests(url: str) -> int:
    return requests.get(url, timeout=9).status_code


@pytest.mark.parametrize("ask", [by_urllib, by_requests])
def test_a_server_of_this_machine_is_asked_past_a_proxy(
    ask: Callable[[str], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    proxies = {"http_proxy": "http://127.0.0.1:9", "no_proxy": "", "NO_PROXY": ""}
    for name, value in proxies.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(urllib.request, "_opener", None)  # it remembers the proxies of when it was first used
    with another_server() as port:
        with pytest.raises(OSError, match=r"refused|proxy"):
            ask(f"http://127.0.0.1:{port}/")
        reach_loopback()
        for host in ("127.0.0.1", "localhost"):
            assert ask(f"http://{host}:{port}/") == 404
        with pytest.raises(OSError, match=r"refused|proxy"):
            ask("http://example.org/")


def test_the_web_interface_comes_up_behind_a_proxy_and_ends_whole(shown: Shown) -> None:
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", shown.port)) != 0
    end = time.monotonic() + 60  # on a busy machine
    while started_by(shown.pid) and time.monotonic() < end:
        time.sleep(0.1)
    assert not started_by(shown.pid)
