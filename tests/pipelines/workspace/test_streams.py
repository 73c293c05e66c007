"""Text in and out: whatever the locale, whoever stops reading, and where the code's commit cannot be read.

A launch that nobody reads any more is in `tests/robustness/test_installed.py`.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pipelines.cli import main as cli
from pipelines.cli.checks import code
from pipelines.tracking import plan
from pipelines.tracking.plan import Commit, read_commit
from pipelines.workspace import streams
from tests.robustness.malformed import GOOD

ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
LATIN = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "latin-1"}
NAMES = {"question": "Wie groß ist 日本?", "arms": {"Größe": {"algo": {"lr": 2e-3}}, "日本": {}}}
ROOT = Path(__file__).parents[3]


def rhmc(*words: str, env: dict[str, str] | None = None, **options: Any) -> "subprocess.CompletedProcess[bytes]":
    """The command, as a process of its own."""
    command = [sys.executable, "-m", "pipelines.cli.main", *words]
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | (env or {})
    given: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options
    return subprocess.run(command, env=environment, cwd=ROOT, check=False, **given)


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """A study whose names are no ASCII, in a folder whose name is none."""
    file = tmp_path / "größe" / "eins.yaml"
    file.parent.mkdir()
    file.write_text(json.dumps(GOOD | NAMES, ensure_ascii=False), encoding="utf-8")
    return file


@pytest.mark.parametrize("locale", [ASCII, {}])
def test_utf8_whatever_the_locale(study: Path, locale: dict[str, str]) -> None:
    done = rhmc("study", "check", str(study), env=locale)
    assert (done.returncode, done.stderr) == (0, b"")
    said = done.stdout.decode("utf-8")
    assert "eins (quick): Wie groß ist 日本?" in said
    assert "Größe" in said


def test_letters_that_a_stream_lacks_are_escaped(study: Path) -> None:
    done = rhmc("study", "check", str(study), env=LATIN)
    assert (done.returncode, done.stderr) == (0, b"")
    assert "Wie groß ist \\u65e5\\u672c?".encode("latin-1") in done.stdout


def test_files_and_workers_are_utf8_as_well(tmp_path: Path) -> None:
    out = tmp_path / "größe"
    done = rhmc("fingerprint", str(out), env=ASCII)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")
    assert len(out.read_text(encoding="utf-8")) == 13
    code = (
        "import os, sys; from pipelines.workspace import streams; streams.settle(); print(os.environ.get('PYTHONUTF8'))"
    )
    script = tmp_path / "program.py"
    script.write_text(code, encoding="utf-8")
    command = [sys.executable, str(script)]
    environment = os.environ | ASCII | {"PYTHONPATH": str(ROOT)}
    assert subprocess.run(command, env=environment, capture_output=True, check=True).stdout == b"1\n"


@pytest.mark.parametrize("words", [["--help"], ["study", "check", "{}"], ["study", "list", "--folder", "studies"]])
def test_a_reader_that_leaves_ends_nothing(study: Path, words: list[str]) -> None:
    told, ours = os.pipe()
    os.close(told)  # nobody reads, from the first word on
    done = rhmc(*(word.format(study) for word in words), stdout=ours)
    os.close(ours)
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_stream_that_is_closed_is_no_fault(study: Path) -> None:
    command = f'"{sys.executable}" -m pipelines.cli.main study check "{study}" >&-'
    done = subprocess.run(["sh", "-c", command], cwd=ROOT, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_is_one_line(study: Path) -> None:
    with Path("/dev/full").open("wb") as full:
        done = rhmc("study", "check", str(study), stdout=full)
    assert done.returncode == 1
    assert done.stderr == b"rhmc: standard output: No space left on device; what was printed is not all there\n"


def test_the_entry_point_settles_first(monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    monkeypatch.setattr(streams, "settle", lambda: order.append("settle"))
    monkeypatch.setattr(cli, "app", lambda prog_name: order.append("app"))
    cli.main()
    assert order == ["settle", "app"]


# The commit


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """One with a commit."""
    folder = tmp_path / "code"
    folder.mkdir()
    who = ["-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], [*who, "commit", "-q", "--allow-empty", "-m", "x"]):
        subprocess.run(["git", *words], cwd=folder, check=True)
    return folder


def test_a_commit_that_can_be_read(repository: Path) -> None:
    found = read_commit(repository)
    assert len(found.name) == 40
    assert found.why == ""
    assert plan.commit(repository) == found.name
    assert code(repository)[0][:2] == ("ok", "code")


def test_a_hook_of_another_repository_changes_nothing(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = read_commit(repository).name
    monkeypatch.setenv("GIT_DIR", str(repository / "none"))
    assert read_commit(repository).name == name


def unreadable(kind: str, repository: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of code whose commit cannot be read."""
    if kind == "another owner":
        monkeypatch.setenv("GIT_TEST_ASSUME_DIFFERENT_OWNER", "1")
    elif kind == "no git":
        monkeypatch.setenv("PATH", str(repository))
    elif kind == "a git that hangs":
        monkeypatch.setattr(plan, "PATIENCE", 0.2)
        (repository / "git").write_text("#!/bin/sh\nexec /bin/sleep 60\n", encoding="utf-8")
        (repository / "git").chmod(0o755)
        monkeypatch.setenv("PATH", str(repository))
    else:
        shutil.rmtree(repository / ".git")
    return repository


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        (
            "another owner",
            "dubious ownership in repository at .*; git config --global --add safe.directory .* lets you",
        ),
        ("no git", "git is not installed"),
        ("a git that hangs", "git did not answer within 0 s in .*code"),
        ("no repository", "git in .*code: not a git repository"),
    ],
)
def test_why_a_commit_cannot_be_read_is_said(
    kind: str, why: str, repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = unreadable(kind, repository, monkeypatch)
    found = read_commit(folder)
    assert found.name == plan.commit(folder) == "unknown"
    assert "\n" not in found.why
    (finding,) = code(folder)
    assert finding[:2] == ("note", "code")
    assert re.search(why, found.why), found.why
    assert found.why in finding.text


def test_a_launch_says_it_once(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], home: Path) -> None:
    from contextlib import nullcontext

    from pipelines.execution import ray_driver, run
    from tests.pipelines.support import tiny
    from tests.robustness.chaos import fit_here

    monkeypatch.setattr(run, "read_commit", lambda: Commit("unknown", "git is not installed"))
    monkeypatch.setattr(ray_driver, "ray_session", lambda *args: nullcontext([]))
    monkeypatch.setattr(ray_driver, "fit", fit_here)
    assert run.run_studies([tiny("a"), tiny("b")], home) == 0
    said = capsys.readouterr()
    assert (said.out + said.err).count("the commit is logged as unknown: git is not installed\n") == 1
