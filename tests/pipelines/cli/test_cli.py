"""The command: what it prints, what it refuses, and what it does not import."""

import io
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
from typer.main import get_command

from pipelines.cli import ui
from pipelines.cli.checks import Finding
from pipelines.cli.doctor import MARK
from pipelines.cli.main import app
from pipelines.execution.standing import Standing
from pipelines.export import yardsticks
from pipelines.specs.identity import fingerprint
from pipelines.workspace.process_pool import KILLED
from pipelines.workspace.provenance import host
from pipelines.workspace.work_folder import work_folder
from rhmc.yardsticks.scores import names
from tests.pipelines.support import Said, jobs_of, run_rhmc
from tests.pipelines.workspace.pooled import die
from tests.robustness.fleet import wait_for

ROOT = Path(__file__).parents[3]
STUDY = """\
question: Which?
base: {env: {kind: coverage}, algo: {kind: rhmc}}
arms:
  full: {}
  none: {algo: {regulator: none}}
seeds: 2
steps: 1000
"""


Rhmc = Callable[..., Said]


SEARCH = (
    STUDY[: STUDY.index("arms")]
    + """\
arms: {IQL: {space: {lr: {choices: [0.1]}}}}
trials: 5
seeds: 1
steps: 1000
"""
)


@pytest.fixture
def rhmc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Rhmc:
    """Calls the command in a folder that holds `studies/x.yaml`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RHMC_HOME", str(tmp_path / "work"))
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    (tmp_path / "studies").mkdir()
    (tmp_path / "studies" / "x.yaml").write_text(STUDY)

    def call(*words: str) -> Said:
        return Said(run_rhmc(*words), *capfd.readouterr())

    return call


def imported(modules: set[str], words: list[str]) -> list[str]:
    """Lines that the command prints in a fresh process; the last one lists those of `modules` that it imported."""
    end = f"print(sorted({modules} & set(sys.modules)))"
    code = f"import sys, pipelines.cli.main as c\ntry: c.main()\nexcept SystemExit: {end}"
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, cwd=ROOT, check=True)
    return done.stdout.splitlines()


def test_nothing_heavy_is_imported_for_help() -> None:
    heavy = {"torch", "ray", "mlflow", "pandas", "numpy", "pyarrow", "pydantic", "matplotlib"}
    lines = imported(heavy, ["--help"])
    assert lines[-1] == "[]"
    assert any("yardsticks" in line for line in lines)


def test_reading_a_study_needs_no_ray_and_no_mlflow() -> None:
    words = ["study", "check", "studies/coverage.yaml"]
    assert imported({"ray", "mlflow", "pandas"}, words)[-1] == "[]"


VERBS = [
    *([], ["study"], ["study", "run"], ["study", "export"], ["study", "import"], ["yardsticks"], ["evaluate"]),
    *(["yardsticks", "all"], ["transfer"], ["assignments"]),
    *(["search"], ["search", "check"], ["search", "run"], ["search", "status"], ["search", "export"]),
    *(["export"], ["report"], ["ui"], ["doctor"], ["profile"]),
]


@pytest.mark.parametrize("words", VERBS)
def test_every_verb_explains_itself(rhmc: Rhmc, words: list[str]) -> None:
    said = rhmc(*words, "--help")
    assert (said.code, said.err) == (0, "")
    assert "Usage: rhmc" in said.out


def test_help_ends_with_the_exit_codes(rhmc: Rhmc) -> None:
    said = " ".join(rhmc("--help").out.split())
    assert said.endswith("130 interrupted; 143 terminated. Results are kept in $RHMC_HOME, or in the folder work.")
    page = (ROOT / "docs/cli.md").read_text()
    assert all(f"| {code} |" in page for code in (0, 1, 2, 130, 143))


def test_the_page_of_the_command_line_names_every_verb() -> None:
    page = (ROOT / "docs/cli.md").read_text()
    group = get_command(app)
    verbs = [name for name, one in group.commands.items() if not hasattr(one, "commands")]
    verbs += [f"{name} {verb}" for name, one in group.commands.items() for verb in getattr(one, "commands", ())]
    assert [verb for verb in verbs if verb not in page and verb != "yardsticks navigation"] == []


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("rhmc st", {"study", "status"}),
        ("rhmc study ", {"check", "run", "status", "list", "copy", "export", "import", "adopt"}),
        ("rhmc study run studies/al", {"studies/alpha.yaml", "studies/alpha_regulation.yaml"}),
        ("rhmc study run studies/alpha.yaml --profile q", {"quick"}),
        ("rhmc search run studies/search_r", {"studies/search_rhmc.yaml"}),
    ],
)
def test_the_shell_completes(line: str, offered: set[str]) -> None:
    words = {"COMP_WORDS": line, "COMP_CWORD": str(line.count(" ")), "_RHMC_COMPLETE": "complete_bash"}
    command = [sys.executable, "-m", "pipelines.cli.main"]
    done = subprocess.run(command, env=os.environ | words, capture_output=True, text=True, cwd=ROOT, check=False)
    assert set(done.stdout.split()) == offered


def test_arms_and_variants_are_completed(tmp_path: Path) -> None:
    (tmp_path / "studies").mkdir()
    (tmp_path / "studies/x.yaml").write_text(STUDY + "variants: {large: {algo: {hidden_dim: 128}}}\n")
    grid = STUDY.replace("seeds:", "grid: {algo.lr: [0.1, 0.2]}\nseeds:")
    (tmp_path / "studies/grid.yaml").write_text(grid)
    for line, offered in [
        ("rhmc study run studies/x.yaml --arm ", ["full", "none"]),
        ("rhmc study run studies/x.yaml --arm n", ["none"]),
        ("rhmc evaluate studies/x.yaml --arm f", ["full"]),
        ("rhmc study run studies/x.yaml --variant ", ["large"]),
        ("rhmc study run studies/grid.yaml --arm none", ["none, lr=0.1", "none, lr=0.2"]),
        ("rhmc study run studies/gone.yaml --arm ", []),
    ]:
        words = {"COMP_WORDS": line, "COMP_CWORD": str(line.count(" ")), "_RHMC_COMPLETE": "complete_bash"}
        command = [sys.executable, "-m", "pipelines.cli.main"]
        env = os.environ | words | {"PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, env=env, capture_output=True, text=True, cwd=tmp_path, check=False)
        assert ([word for word in done.stdout.splitlines() if word], done.stderr) == (offered, ""), line


# Studies


def test_check_prints_the_plan(rhmc: Rhmc) -> None:
    said = rhmc("study", "check", "studies/x.yaml", "--set", "trainer.num_envs=8")
    assert (said.code, said.err) == (0, "")
    assert "x (quick): Which?" in said.out
    assert [line.split() for line in said.out.splitlines() if "full" in line and "note" not in line] == [
        ["full", "the", "base", "2", "1,000", "8"]
    ]
    assert "algo.regulator=none" in said.out
    assert "4 runs, 4,000 environment steps in all" in said.out


def test_check_prints_factors_readings_and_what_is_confounded(rhmc: Rhmc) -> None:
    factors = "{algo.alpha: [0.1, 0.5], algo.lr: [5e-4, 1e-3], algo.horizon: [1, 6], algo.tau: [0.1, 0.2]}"
    text = STUDY.replace("seeds", f"readings: {{factors: {factors}, design: {{resolution: 4}}}}\nseeds")
    Path("studies/x.yaml").write_text(text.replace("regulator: none", "regulator: none, horizon: 1"))
    out = rhmc("study", "check", "studies/x.yaml").out
    assert "full, reading=1111" in out
    assert "full, reading=2222" not in out  # each arm stands there once
    assert "8 readings: a fraction of resolution 4; each arm is trained under each" in out
    assert "1 0.0005 (4), 2 0.001 (4)" in out
    assert "  1111 1122 1212 1221 2112 2121 2211 2222" in out
    assert "main effects confounded with interactions of two factors: none" in out
    assert "  algo.alpha x algo.lr = algo.horizon x algo.tau" in out
    assert "32 runs, 32,000 environment steps in all, 2 runs at a time" in out
    out = rhmc("study", "check", "studies/x.yaml", "--set", "readings.design=full").out
    assert "16 readings: every combination" in out
    assert "64 runs, 48 of them different, 48,000 environment steps in all" in out
    assert "sets of confounded" not in out


@pytest.mark.parametrize("verb", [["study", "check"], ["study", "run"], ["study", "status"], ["export"]])
def test_a_faulty_study_is_refused_by_every_verb(rhmc: Rhmc, tmp_path: Path, verb: list[str]) -> None:
    said = rhmc(*verb, "studies/x.yaml", "--set", "algo.lrr=1", "--set", "seeds=0")
    assert (said.code, said.out) == (2, "")
    first, second = said.err.splitlines()
    assert first.startswith("--set algo.lrr=1: base.algo.lrr: unknown key 'lrr'; allowed: ")
    assert first.endswith("; did you mean 'lr'?")
    assert second == "--set seeds=0: seeds: 0 is not allowed; must be greater than or equal to 1"
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["study", "check", "studies/z.yaml"], "studies/z.yaml: no such file; did you mean 'studies/x.yaml'?\n"),
        (["study", "check", "studies"], "studies: a directory; give one study of it: x.yaml\n"),
        (
            ["study", "run", "studies/x.yaml", "--profile", "papr"],
            "--profile: 'papr' is not allowed; allowed: quick, paper; did you mean 'paper'?\n",
        ),
        (
            ["study", "list", "--folder", "nowhere"],
            "nowhere: no studies (*.yaml) here; `rhmc study copy NAME` writes one of this package\n",
        ),
    ],
)
def test_what_cannot_be_used_is_one_line(rhmc: Rhmc, words: list[str], said: str) -> None:
    assert rhmc(*words) == (2, "", said)


@pytest.mark.parametrize("words", [["study", "chek"], ["study", "check"], ["--quiet"], ["ui", "--port", "0"]])
def test_wrong_words_are_refused_without_a_traceback(rhmc: Rhmc, words: list[str]) -> None:
    said = rhmc(*words)
    assert (said.code, said.out) == (2, "")
    assert "Usage: rhmc" in said.err
    assert "Traceback" not in said.err


def test_list_shows_questions_and_what_cannot_be_read(rhmc: Rhmc) -> None:
    Path("studies/bad.yaml").write_text("a: [")
    said = rhmc("study", "list")
    lines = [line.split(None, 1) for line in said.out.splitlines() if ".yaml" in line]
    assert said.code == 0
    assert [line[0] for line in lines] == ["studies/bad.yaml", "studies/x.yaml"]
    assert "not YAML" in lines[0][1]
    assert lines[1][1].strip() == "Which?"


def test_list_leaves_searches_out(rhmc: Rhmc) -> None:
    Path("studies/search_x.yaml").write_text("question: Which?\narms: {full: {space: {lr: {low: 1, high: 2}}}}\n")
    assert [one["study"] for one in json.loads(rhmc("study", "list", "--json").out)] == ["studies/x.yaml"]


def test_studies_and_searches_are_listed_apart(rhmc: Rhmc) -> None:
    said = rhmc("search", "list")
    assert said == (2, "", "studies: no searches (an arm has a space) here; `rhmc search check FILE` takes one\n")
    Path("studies/search_y.yaml").write_text(SEARCH)
    (one,) = json.loads(rhmc("search", "list", "--json").out)
    assert (one["search"], one["arms"], one["fault"]) == ("studies/search_y.yaml", ["IQL"], "")
    assert [one["study"] for one in json.loads(rhmc("study", "list", "--json").out)] == ["studies/x.yaml"]


def test_the_work_folder_and_the_studies_are_those_of_the_checkout(
    rhmc: Rhmc, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RHMC_HOME")
    inside = tmp_path / "docs" / "deep"
    inside.mkdir(parents=True)
    monkeypatch.chdir(inside)
    assert work_folder() == inside / "work"
    for name in ("dvc.yaml", "params.yaml"):
        (tmp_path / name).touch()
    assert work_folder() == tmp_path / "work"
    assert [one["study"] for one in json.loads(rhmc("study", "list", "--json").out)] == ["../../studies/x.yaml"]
    said = rhmc("study", "check", "x")
    assert said == (2, "", "x: no such file; did you mean '../../studies/x.yaml'?\n")
    monkeypatch.setattr(os, "getuid", lambda: 1_234_567)  # the folder is another user's
    assert work_folder() == inside / "work"


def test_the_status_of_everything_is_one_table(rhmc: Rhmc, tmp_path: Path) -> None:
    Path("studies/search_y.yaml").write_text(SEARCH)
    Path("studies/bad.yaml").write_text("a: [")
    said = rhmc("status", "--json")
    bad, plain, search = json.loads(said.out)
    assert (said.code, said.err) == (3, "")
    assert bad["state"].startswith("faulty: studies/bad.yaml:1:")
    counts = {"finished": 0, "running": 0, "failed": 0, "stale": 0}
    assert plain == {"file": "studies/x.yaml", "kind": "study", "state": "not begun", "planned": 4} | counts
    assert search == {"file": "studies/search_y.yaml", "kind": "search", "state": "not begun", "planned": 5} | counts
    assert not (tmp_path / "work").exists()
    table = rhmc("status").out
    assert [line.split()[:4] for line in table.splitlines() if "x.yaml" in line] == [
        ["studies/x.yaml", "study", "not", "begun"]
    ]


def test_a_study_that_is_finished_is_so_in_the_table(rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch) -> None:
    arms = {"full": {"planned": 2, "finished": 2}, "none": {"planned": 2, "finished": 1, "running": 1, "stale": 3}}
    monkeypatch.setattr("pipelines.execution.run.standing_of", lambda study, home: Standing(False, arms, {}, [], []))
    said = rhmc("status", "--json")
    (one,) = json.loads(said.out)
    assert (said.code, one["state"], one["finished"], one["planned"], one["stale"]) == (3, "running", 3, 4, 3)
    arms["none"] = {"planned": 2, "finished": 2}
    said = rhmc("status", "--json")
    assert (said.code, json.loads(said.out)[0]["state"]) == (0, "finished")


def test_list_for_scripts(rhmc: Rhmc) -> None:
    Path("studies/bad.yaml").write_text("a: [")
    Path("studies/two.yaml").write_text(STUDY + "variants: {paper_faithful: {algo: {encoder: mlp}}}\n")
    bad, two, plain = json.loads(rhmc("study", "list", "--json").out)
    assert (bad["study"], bad["question"], "not YAML" in bad["fault"]) == ("studies/bad.yaml", "", True)
    assert (two["variants"], plain["variants"], plain["fault"]) == (["paper_faithful"], [], "")


def test_status_for_scripts(rhmc: Rhmc) -> None:
    said = rhmc("study", "status", "studies/x.yaml", "--json")
    none = {"planned": 2, "finished": 0, "running": 0, "interrupted": 0, "failed": 0, "missing": 2, "stale": 0}
    assert (said.code, said.err) == (3, "")
    arms = {"full": none, "none": none}
    expected = {
        "study": "x",
        "profile": "quick",
        "finished": False,
        "arms": arms,
        "errors": {},
        "stale": [],
        "remarks": [],
    }
    assert json.loads(said.out) == expected


def test_every_verb_of_studies_takes_a_variant(rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("studies/x.yaml").write_text(STUDY + "variants: {large: {algo: {hidden_dim: 128}}}\n")
    names: list[str] = []
    monkeypatch.setattr(
        "pipelines.execution.run.run_studies", lambda studies, *given: names.append(studies[0].name) or 0
    )
    for place in ("execution.run.show_status", "export.tables.export_study"):
        monkeypatch.setattr(f"pipelines.{place}", lambda study, *a, **k: names.append(study.name) or 0)
    for verb in (["study", "run"], ["study", "status"], ["export"]):
        rhmc(*verb, "studies/x.yaml", "--variant", "large")
    assert names == ["x@large"] * 3
    assert "x@large (quick)" in rhmc("study", "check", "studies/x.yaml", "--variant", "large").out
    said = "--variant: 'larg' is not allowed; allowed: large; did you mean 'large'?\n"
    assert rhmc("study", "check", "studies/x.yaml", "--variant", "larg") == (2, "", said)


def test_what_travels_is_refused_in_one_line(rhmc: Rhmc, tmp_path: Path) -> None:
    said = rhmc("study", "export", "studies/x.yaml", "b.zip")
    assert said == (2, "", "x (quick): no run is finished or under way; nothing to export\n")
    said = rhmc("study", "import", "b.zip")
    assert (said.code, said.out, said.err.count("\n")) == (2, "", 1)
    assert said.err == "b.zip: no such file\n"
    assert not (tmp_path / "work").exists()


def test_evaluate_without_a_policy(rhmc: Rhmc) -> None:
    said = rhmc("evaluate", "studies/x.yaml")
    assert said == (2, "", "x (quick): no such run has a policy yet; `rhmc study run` trains it\n")
    assert rhmc("evaluate", "studies/x.yaml", "--arm", "ful").err.endswith("did you mean 'full'?\n")
    assert rhmc("evaluate", "p.pt") == (2, "", "p.pt: no such file\n")


@pytest.mark.parametrize("level", ["ok", "note", "fault"])
def test_the_doctor_answers_with_lines_and_an_exit_code(
    rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch, level: str
) -> None:
    given = Finding(level, "disk", "text")
    monkeypatch.setattr("pipelines.cli.checks.examine", lambda home, *, ray: iter([given] * (2 - ray)))
    assert rhmc("doctor").code == (4 if level == "fault" else 0)
    assert rhmc("doctor", "--no-ray").out.splitlines() == [f"{MARK[level]}  disk: text"] * 2
    assert json.loads(rhmc("doctor", "--json").out) == [{"level": level, "what": "disk", "text": "text"}]


@pytest.mark.parametrize("code", [0, 1, 2, 130])
def test_run_hands_on_the_studies_the_work_folder_and_the_exit_code(
    rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, code: int
) -> None:
    calls: list[tuple[Any, ...]] = []
    monkeypatch.setattr("pipelines.execution.run.run_studies", lambda *given: calls.append(given) or code)
    shutil.copy("studies/x.yaml", "studies/y.yaml")
    words = ["studies/x.yaml", "studies/y.yaml", "--profile", "paper", "--set", "seeds=1"]
    assert rhmc("study", "run", *words).code == code
    ((studies, home, arms),) = calls
    assert [(study.name, study.profile, study.seeds) for study in studies] == [("x", "paper", 1), ("y", "paper", 1)]
    assert (home, arms) == (tmp_path / "work", ())


def test_what_is_wrong_with_several_studies_is_said_at_once(rhmc: Rhmc, tmp_path: Path) -> None:
    Path("studies/y.yaml").write_text(STUDY.replace("regulator: none", "regulator: non"))
    said = rhmc("study", "run", "studies/x.yaml", "studies/y.yaml", "studies/z.yaml", "--set", "seed=1")
    lines = said.err.splitlines()
    assert said.code == 2
    assert [line.partition(":")[0] for line in lines] == [f"studies/{name}.yaml" for name in "xyyz"]
    assert not (tmp_path / "work").exists()


def test_what_is_wrong_with_an_option_names_the_study_unless_it_is_wrong_for_all(rhmc: Rhmc) -> None:
    Path("studies/y.yaml").write_text(STUDY + "variants: {large: {algo: {hidden_dim: 128}}}\n")
    words = ["studies/x.yaml", "studies/y.yaml"]
    said = rhmc("study", "run", *words, "--variant", "large")
    assert said == (2, "", "studies/x.yaml: --variant: 'large' is not allowed; this study has no variants\n")
    said = rhmc("study", "run", *words, "--profile", "quik")
    assert (said.code, said.err.count("\n"), said.err[:10]) == (2, 1, "--profile:")


def test_studies_that_cannot_run_together(rhmc: Rhmc, tmp_path: Path) -> None:
    Path("studies/y.yaml").write_text(STUDY + "resources: {concurrent: 3}\n")
    said = rhmc("study", "run", "studies/x.yaml", "studies/y.yaml", "studies/x.yaml")
    twice, shared = said.err.splitlines()
    assert said.code == 2
    assert twice == "x: given 2 times; studies that go together need names of their own"
    assert shared.startswith("resources.concurrent is 3 in y and 2 in x; ")
    assert not (tmp_path / "work").exists()


def test_export_goes_to_the_folder_of_the_profile(rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[Any, ...]] = []
    monkeypatch.setattr("pipelines.export.tables.export_study", lambda study, out: calls.append((study.name, out)) or 3)
    report = "next:  rhmc report --study studies/x.yaml"
    assert rhmc("export", "studies/x.yaml", "--profile", "paper") == (3, "", f"{report} --profile paper\n")
    assert rhmc("export", "studies/x.yaml", "--out", "there") == (3, "", f"{report} --runs there\n")
    monkeypatch.setattr("pipelines.export.tables.export_study", lambda study, out: 2)
    assert rhmc("export", "studies/x.yaml") == (2, "", "")
    assert calls == [("x", Path("results/paper/runs")), ("x", Path("there"))]


def test_export_of_several_studies(rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy("studies/x.yaml", "studies/y.yaml")
    codes = {"x": 3, "y": 0}
    monkeypatch.setattr("pipelines.export.tables.export_study", lambda study, out: codes[study.name])
    words = ["export", "studies/x.yaml", "studies/y.yaml"]
    assert rhmc(*words) == (3, "", "next:  rhmc report\n")
    codes["x"] = 2
    assert rhmc(*words) == (2, "", "")


def test_an_interrupt_is_130(rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("pipelines.execution.run.run_studies", interrupted)
    assert rhmc("study", "run", "studies/x.yaml").code == 130


@pytest.mark.parametrize(
    ("options", "given"),
    [
        (["--profile", "paper"], (None, None, "paper", None)),
        (["--runs", "a", "--out", "b"], (Path("a"), Path("b"), "quick", None)),
        (["--study", "studies/x.yaml", "--variant", "far"], (None, None, "quick", "x@far")),
    ],
)
def test_report_hands_on_its_options(
    rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch, options: list[str], given: tuple[object, ...]
) -> None:
    calls: list[tuple[object, ...]] = []
    build = SimpleNamespace(write_report=lambda *given: calls.append(given[:4]) or "refused")
    monkeypatch.setitem(sys.modules, "reports.pages.build", build)
    assert rhmc("report", *options).code == 2
    assert calls == [given]


def test_the_verdicts_are_counted_and_the_page_is_a_link(rhmc: Rhmc, tmp_path: Path) -> None:
    said = rhmc("verdicts")
    assert (said.code, said.err) == (2, "results/quick/claims.json: no such file; `rhmc report` writes it\n")
    folder = tmp_path / "a b"
    folder.mkdir()
    (folder / "claims.json").write_text('[{"verdict": "yes"}, {"verdict": "no"}, {"verdict": "yes"}]')
    said = rhmc("verdicts", "--out", str(folder))
    page = f"file://{tmp_path}/a%20b/index.html"
    assert said == (0, f"Verdicts:  3 claims: 2 yes, 1 no\nReport:    {page}\n", "")
    (folder / "claims.json").write_text('["yes"]')
    assert rhmc("verdicts", "--out", str(folder)).code == 2


# Yardsticks


def test_yardsticks_print_one_json_object_and_nothing_else(rhmc: Rhmc) -> None:
    said = rhmc("yardsticks", "coverage", "--episodes", "20", "--policies", "random, best_window,range_bound", "--json")
    scores = json.loads(said.out)
    assert (said.code, said.err, said.out.count("\n")) == (0, "", 1)
    assert list(scores) == ["random", "best_window", "range_bound"]
    assert set(scores["random"]) == {"coverage", "sem", "return"}
    assert scores["random"]["coverage"] < scores["best_window"]["coverage"] < scores["range_bound"]["coverage"] < 100


def test_yardsticks_as_a_table(rhmc: Rhmc) -> None:
    said = rhmc("yardsticks", "navigation", "--agents", "2", "--reward", "mpe2", "--episodes", "20")
    names = [line.split()[0] for line in said.out.splitlines() if line.strip() and "─" not in line]
    assert names == ["policy", "random", "hold", "nearest", "matching"]


def test_yardsticks_depend_on_the_seed_and_on_nothing_else(rhmc: Rhmc) -> None:
    words = ["yardsticks", "navigation", "--episodes", "20", "--policies", "random", "--json"]
    first, again, other = rhmc(*words), rhmc(*words), rhmc(*words, "--seed", "1")
    assert first.out == again.out != other.out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["--preset", "flatt"],
            "--preset: 'flatt' is not allowed; allowed: flat, executor, coordinator; did you mean 'flat'?",
        ),
        (["--agents", "0"], "--agents: 0 is not allowed; must be greater than or equal to 1"),
        (["--agents", "9"], "--agents: 9 sensors need as many boxes, and there are 6"),
        (["--out", "studies/x.yaml"], "--out: studies/x.yaml is not a folder"),
        (["--out", "o", "--profile", "fast"], "--profile: 'fast' is not allowed; allowed: quick, paper"),
    ],
)
def test_yardsticks_refuse_what_is_no_task(rhmc: Rhmc, words: list[str], said: str) -> None:
    assert rhmc("yardsticks", "coverage", "--json", *words) == (2, "", said + "\n")


def test_yardsticks_name_the_nearest_policy(rhmc: Rhmc) -> None:
    said = rhmc("yardsticks", "coverage", "--policies", "random,planer")
    assert (said.code, said.out) == (2, "")
    assert said.err.startswith("--policies: 'planer' is not allowed; allowed: random, hold, ")
    assert said.err.endswith("; did you mean 'planner'?\n")


def test_yardsticks_are_exported_beside_the_runs(rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.export.yardsticks.fingerprint", lambda: "0" * 12)
    first = ["yardsticks", "coverage", "--episodes", "20", "--json", "--out", "o", "--policies", "hold,range_bound"]
    scores = json.loads(rhmc(*first).out)
    rhmc("yardsticks", "navigation", "--episodes", "20", "--out", "o", "--policies", "random")
    values, runs = pd.read_parquet("o/yardsticks.parquet"), pd.read_parquet("o/yardsticks.runs.parquet")
    table = values.pivot_table(index="arm", columns="metric", values="value").to_dict("index")
    for name in ("hold", "range_bound"):
        score = {key: table[name][f"final/{key}"] for key in ("coverage", "return", "coverage_sem")}
        assert score == {k.replace("sem", "coverage_sem"): pytest.approx(v) for k, v in scores[name].items()}
    assert table["random"]["final/return_sem"] > 0
    assert sorted(runs["arm"]) == ["hold", "random", "range_bound"]
    assert set(values["run"]) == set(runs["run"])
    assert set(runs["fingerprint"]) == {"0" * 12}
    made = pd.read_parquet("o/yardsticks.made.parquet")
    assert (sorted(made["run"]), set(made["machine"])) == (sorted(runs["run"]), {host().machine})
    assert {json.loads(config)["env"]["kind"] for config in runs["config"]} == {"coverage", "navigation"}


def test_an_export_replaces_a_policy_of_the_same_task_and_drops_other_code(
    rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["yardsticks", "navigation", "--out", "o", "--policies"]
    monkeypatch.setattr("pipelines.export.yardsticks.fingerprint", lambda: "0" * 12)
    rhmc(*words, "random,hold", "--episodes", "20")
    before = Path("o/yardsticks.parquet").read_bytes()
    rhmc(*words, "random,hold", "--episodes", "20")
    assert Path("o/yardsticks.parquet").read_bytes() == before
    rhmc(*words, "random", "--episodes", "30")
    runs = pd.read_parquet("o/yardsticks.runs.parquet").set_index("arm")["config"].map(json.loads)
    assert {arm: config["episodes"] for arm, config in runs.items()} == {"random": 30, "hold": 20}
    monkeypatch.setattr("pipelines.export.yardsticks.fingerprint", lambda: "1" * 12)
    rhmc(*words, "nearest", "--episodes", "20")
    assert list(pd.read_parquet("o/yardsticks.runs.parquet")["arm"]) == ["nearest"]
    assert set(pd.read_parquet("o/yardsticks.parquet")["arm"]) == {"nearest"}


def test_an_export_brings_the_earlier_form_up_to_date(rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.export.yardsticks.fingerprint", lambda: "0" * 12)
    words = ["yardsticks", "navigation", "--episodes", "20", "--out", "o", "--policies"]
    rhmc(*words, "random,hold")
    files = [Path(f"o/yardsticks.{part}.parquet") for part in ("runs", "made")]
    new = pd.read_parquet(files[0])
    new.assign(commit="abc", seconds=0.0).to_parquet(files[0])
    files[1].unlink()
    assert rhmc(*words, "random").code == 0
    assert pd.read_parquet(files[0]).equals(new)
    assert list(pd.read_parquet(files[1])["arm"]) == ["random"]  # of the other it is not known


def test_an_export_leaves_a_foreign_file_alone(rhmc: Rhmc) -> None:
    Path("o").mkdir()
    pd.DataFrame({"a": [1]}).to_parquet("o/yardsticks.parquet")
    before = Path("o/yardsticks.parquet").read_bytes()
    said = rhmc("yardsticks", "navigation", "--episodes", "2", "--policies", "hold", "--out", "o")
    assert (said.code, said.err) == (2, "o/yardsticks.parquet: a table, but not one of yardsticks; move it away\n")
    assert Path("o/yardsticks.parquet").read_bytes() == before


def test_an_export_without_a_return_is_left_out(rhmc: Rhmc) -> None:
    rhmc(
        "yardsticks",
        "coverage",
        "--preset",
        "executor",
        "--episodes",
        "2",
        "--policies",
        "hold,range_bound",
        "--out",
        "o",
    )
    assert list(pd.read_parquet("o/yardsticks.runs.parquet")["arm"]) == ["hold"]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Evaluations that take a second: few episodes, and three of the tasks."""
    tasks = [yardsticks.TASKS[n] for n in (1, 5, -1)]
    monkeypatch.setattr("pipelines.export.yardsticks.EPISODES", {"quick": yardsticks.Episodes(4, 2)})
    monkeypatch.setattr("pipelines.export.yardsticks.TASKS", tuple(tasks))
    monkeypatch.setattr("pipelines.export.yardsticks.fingerprint", lambda: "0" * 12)
    monkeypatch.setattr("pipelines.export.yardsticks.commit", lambda: "abc")


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("yardsticks")


@pytest.fixture
def alone(rhmc: Rhmc, small: None, shelf: Path, monkeypatch: pytest.MonkeyPatch) -> Said:
    """What a command says that plays all, one at a time, into the folder `one`: played once, then copied."""
    if (shelf / "said").exists():
        shutil.copytree(shelf / "one", "one")
        return Said(*json.loads((shelf / "said").read_text()))
    with monkeypatch.context() as patch:
        seen = jobs_of("pipelines.export.yardsticks", patch)
        said = rhmc("yardsticks", "all", "--out", "one", "--jobs", "1")
    assert seen == [1]
    shutil.copytree("one", shelf / "one")
    (shelf / "said").write_text(json.dumps(said))
    return said


def test_all_yardsticks_are_the_same_whatever_is_played_at_a_time(
    rhmc: Rhmc, alone: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = jobs_of("pipelines.export.yardsticks", monkeypatch)
    several = rhmc("yardsticks", "all", "--out", "two")
    assert seen == [2]
    assert alone.code == several.code == 0
    assert alone.out == several.out
    assert several.err == alone.err.replace("one/", "two/")
    for name in ("yardsticks.parquet", "yardsticks.runs.parquet"):
        assert Path("one", name).read_bytes() == Path("two", name).read_bytes()


def test_all_yardsticks_are_those_that_an_evaluation_at_a_time_gives(rhmc: Rhmc, alone: Said) -> None:
    lines = [line.split() for line in alone.out.splitlines() if line.strip() and "─" not in line]
    assert lines[0] == ["task", "policy", "coverage", "or", "return", "sem"]
    tasks = {tuple(line[:-3]) for line in lines[1:]}
    assert {" ".join(task) for task in tasks} == {"coverage flat, 2 x 5", "coverage flat, 4 x 3", "navigation mpe1, 3"}
    assert len(lines[1:]) == 2 * 10 + 4
    for words in (["coverage", "--agents", "2"], ["navigation", "--reward", "mpe1"]):
        scores = json.loads(rhmc("yardsticks", *words, "--episodes", "4", "--json", "--out", "p").out)
        score = next(iter(scores["nearest"].values())), scores["nearest"]["sem"]
        shown = next(x for x in lines if x[0] == words[0] and x[-3] == "nearest")
        assert shown[-2:] == [f"{x:.2f}" for x in score]
    both = [pd.read_parquet(f"{folder}/yardsticks.parquet") for folder in ("one", "p")]
    merged = both[1].merge(both[0], on=["run", "metric"], suffixes=("", "_of_all"))
    assert len(merged) == len(both[1]) > 40
    assert (merged["value"] == merged["value_of_all"]).all()


def test_all_yardsticks_bring_a_folder_up_to_date(rhmc: Rhmc, alone: Said) -> None:
    before = [Path("one", name).read_bytes() for name in ("yardsticks.parquet", "yardsticks.runs.parquet")]
    rhmc("yardsticks", "navigation", "--reward", "mpe1", "--episodes", "20", "--out", "one", "--policies", "nearest")
    assert Path("one/yardsticks.parquet").read_bytes() != before[0]
    rhmc("yardsticks", "all", "--out", "one", "--jobs", "1")
    assert [Path("one", name).read_bytes() for name in ("yardsticks.parquet", "yardsticks.runs.parquet")] == before


def by_hand(profile: str) -> list[list[str]]:
    """The command lines that `dvc.yaml` had, in pieces."""
    most, slow = {"paper": ("1000", "300"), "quick": ("300", "60")}[profile]
    coverage = [
        [],
        *(["--agents", n] for n in "2356"),
        *(["--targets", m] for m in "3467"),
        ["--preset", "coordinator"],
    ]
    found = [["coverage", *changed, "--episodes", most] for changed in coverage]
    found += [["coverage", *changed, "--policies", "planner", "--episodes", slow] for changed in coverage]
    return found + [["navigation", *changed, "--episodes", most] for changed in ([], ["--reward", "mpe1"])]


@pytest.mark.parametrize("profile", ["paper", "quick"])
def test_all_yardsticks_are_all(profile: str, rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch) -> None:
    played: list[tuple[Any, ...]] = []

    def play(env: Any, policies: list[str] | None, episodes: int, seed: int) -> dict[str, Any]:
        chosen = [name for name in names(env.kind) if name != "planner"] if policies is None else policies
        played.append((env, tuple(chosen), episodes, seed))
        return {}

    monkeypatch.setattr("rhmc.yardsticks.scores.play_yardsticks", play)
    for words in by_hand(profile):
        assert rhmc("yardsticks", *words).code == 0
    found = yardsticks.evaluations(profile)
    assert sorted(map(repr, played)) == sorted(repr(tuple(evaluation)) for evaluation in found)
    assert [
        (evaluation.env.preset, "planner" in evaluation.policies)
        for evaluation in found[:3]
        if evaluation.env.kind == "coverage"
    ] == [
        ("coordinator", True),
        ("coordinator", False),
        ("flat", True),
    ]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--out", "o"], "o/yardsticks.parquet: a table, but not one of yardsticks; move it away"),
        (["--out", "studies/x.yaml"], "--out: studies/x.yaml is not a folder"),
        (["--out", "p", "--profile", "fast"], "--profile: 'fast' is not allowed; allowed: quick, paper"),
    ],
)
def test_all_yardsticks_are_not_played_for_nothing(
    words: list[str], said: str, rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipelines.export.yardsticks.evaluate_all", None)
    Path("o").mkdir()
    pd.DataFrame({"a": [1]}).to_parquet("o/yardsticks.parquet")
    assert rhmc("yardsticks", "all", *words) == (2, "", said + "\n")


def test_a_worker_that_is_killed_writes_nothing(rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.export.yardsticks._play", die)  # the effect of a lack of memory on a worker
    said = rhmc("yardsticks", "all", "--out", "o")
    assert (said.code, said.out, said.err) == (2, "", KILLED + "\n")
    assert not Path("o").exists()


# The rest


def test_versions_are_said(rhmc: Rhmc) -> None:
    code, out, err = rhmc("--version")
    assert (code, err) == (0, "")
    assert out.startswith(f"rhmc {version('rhmc')}, Python 3.")


def test_methods_and_tasks_show_one_by_its_kind(rhmc: Rhmc) -> None:
    _, text, _ = rhmc("methods", "coma")
    assert text.startswith("COMA: Foerster et al. 2018; actor-critic, credit by a counterfactual baseline\n")
    assert "whole number at least 1" in text
    assert "weight of the policy's entropy" in text
    _, text, _ = rhmc("tasks")
    assert [line.split()[-6:] for line in text.splitlines() if " navigation " in line] == [
        ["3", "3", "25", "one", "of", "5"]
    ]
    _, text, _ = rhmc("tasks", "coverage")
    assert text.startswith("coverage: Multi-sensor multi-target coverage")
    assert "flat, executor, coordinator" in text


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["methods", "comma"], "'comma' is no method; allowed: rhmc, qmix, vdn, iql, maddpg, coma"),
        (["conformance"], "nothing to check: name a module, or --method, or --task"),
        (["conformance", "--method", "iqll"], "--method: 'iqll' is not allowed; allowed: rhmc, qmix"),
        (["conformance", "--method", "iql", "--set", "gamm=1"], "--set: iql: gamm: Extra inputs are not permitted"),
        (["conformance", "--method", "iql", "--set", "gamma"], "--set gamma: must be KEY=VALUE, as in gamma=0.8"),
        (["tasks", "coverag"], "'coverag' is no task; allowed: coverage, navigation; did you mean 'coverage'?"),
        (["methods", "coma", "--out", "o"], "--out: belongs to the table of all methods; leave the method out"),
    ],
)
def test_a_kind_that_there_is_not_is_one_line(rhmc: Rhmc, words: list[str], said: str) -> None:
    code, out, err = rhmc(*words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(said)


def test_a_new_package_needs_a_folder(rhmc: Rhmc, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    assert rhmc("new", "task", "mine", "--out", str(file)) == (2, "", f"--out: {file} is not a folder\n")


def test_fingerprint_is_printed_or_written_where_it_differs(rhmc: Rhmc) -> None:
    text = fingerprint() + "\n"
    assert rhmc("fingerprint") == (0, text, "")
    assert rhmc("fingerprint", "f") == (0, "", "")
    assert Path("f").read_text() == text
    os.utime("f", (0, 0))
    rhmc("fingerprint", "f")
    assert Path("f").stat().st_mtime == 0


def test_ui_without_a_store(rhmc: Rhmc, tmp_path: Path) -> None:
    said = rhmc("ui")
    assert (said.code, said.out) == (2, "")
    assert said.err == f"{tmp_path}/work/mlflow.db: nothing is logged yet; `rhmc study run FILE` does it\n"


def test_ui_of_a_server_elsewhere_is_its_address(rhmc: Rhmc, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://example.org/")
    assert rhmc("ui") == (0, "http://example.org/#/experiments?workflowType=machine_learning\n", "")


class Server:
    """Stands for the server's process: interrupted while it is waited for, then it ends."""

    given: tuple[list[str], dict[str, str]]
    pid = 4711

    def __init__(
        self, command: list[str], env: dict[str, str], *, cwd: Path, start_new_session: bool, stdout: int, stderr: int
    ) -> None:
        assert start_new_session
        assert cwd.name == "work"
        self.stdout = io.BytesIO(b"talk of http://me:secret@host\n\xff\n")
        Server.given = command, env

    def poll(self) -> None:
        """It runs."""

    def wait(self, timeout: float | None = None) -> int:
        if timeout is None:
            raise KeyboardInterrupt
        return -2


@pytest.fixture
def store(tmp_path: Path) -> Path:
    (tmp_path / "work").mkdir()
    file = tmp_path / "work" / "mlflow.db"
    file.touch()
    return file


def test_ui_serves_the_store_on_this_machine_only_until_ctrl_c(
    rhmc: Rhmc, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    killed: list[tuple[int, int]] = []
    monkeypatch.setattr(ui, "subprocess", SimpleNamespace(Popen=Server, STDOUT=-2, PIPE=-1))
    monkeypatch.setattr(ui.os, "killpg", lambda *given: killed.append(given))
    monkeypatch.setattr(ui.signal, "signal", lambda *given: None)
    asked = iter([OSError("not yet"), io.BytesIO()])

    def answer(address: str, timeout: float) -> io.BytesIO:
        assert address == f"http://127.0.0.1:{port}/health"
        now = next(asked)
        if isinstance(now, OSError):
            raise now
        return now

    monkeypatch.setattr("urllib.request.urlopen", answer)
    monkeypatch.setattr(
        "pipelines.tracking.mlflow_tracker.addresses",
        lambda *given: [("a", "One", "x"), ("a", "Two", "y"), ("bcd", "One", "z")],
    )
    said = rhmc("ui", "--port", str(port))
    assert list(asked) == []  # it waited for the server
    assert said.out.endswith(" ends it)\na    x\nbcd  z\n")  # a line for each study
    assert said.err == "starting MLflow; its address follows\n"
    assert killed == [(Server.pid, signal.SIGTERM)]
    command, env = Server.given
    assert said.code == 0
    assert said.out.startswith(f"http://127.0.0.1:{port}/#/experiments?workflowType=machine_learning ")
    options = dict(zip(command[4::2], command[5::2], strict=True))
    assert "--backend-store-uri" not in options  # everybody sees the arguments of a process
    assert env["MLFLOW_BACKEND_STORE_URI"] == "sqlite:///mlflow.db"  # in the work folder, where the server runs
    assert options["--artifacts-destination"] == (store.parent / "artifacts").as_uri()
    log = store.parent / "ui.log"
    wait_for(lambda: log.read_text() == "talk of http://me:***@host\n\ufffd\n", "ui.log")
    assert (options["--host"], options["--port"], options["--workers"]) == ("127.0.0.1", str(port), "1")
    assert env["MLFLOW_SERVER_ENABLE_JOB_EXECUTION"] == "false"
    assert (env["MLFLOW_DISABLE_TELEMETRY"], env["MLFLOW_ENABLE_AI_GATEWAY"]) == ("true", "false")


def test_ui_tells_no_address_of_a_server_that_ended_at_once(
    rhmc: Rhmc, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = SimpleNamespace(poll=lambda: 3, wait=lambda: 3, stdout=io.BytesIO())
    popen = SimpleNamespace(Popen=lambda command, **options: ended, STDOUT=-2, PIPE=-1)
    monkeypatch.setattr(ui, "subprocess", popen)
    monkeypatch.setattr(ui, "_free", lambda port: None)
    monkeypatch.setattr(ui.signal, "signal", lambda *given: None)
    why = f"rhmc: MLflow's server ended with exit code 3; {store.parent}/ui.log says why\n"
    assert rhmc("ui") == (1, "", f"starting MLflow; its address follows\n{why}")


def test_sigterm_ends_the_server_and_its_workers(tmp_path: Path) -> None:
    file = tmp_path / "pid"
    code = (
        "import sys, subprocess; from pathlib import Path; from pipelines.cli import ui\n"
        "real = subprocess.Popen\n"
        f"server = ['sh', '-c', 'sleep 600 & echo $! > {file}.part; mv {file}.part {file}; wait']\n"
        "ui.subprocess.Popen = lambda command, **options: real(server, **options)\n"
        f"ui._serve('sqlite:///x', Path('{tmp_path}/artifacts'), 1, [])\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.DEVNULL)
    while not file.exists():
        assert process.poll() is None
        time.sleep(0.02)
    worker = int(file.read_text())
    process.terminate()
    assert process.wait(60) == 0
    state = Path(f"/proc/{worker}/stat")
    assert not state.exists() or state.read_text().split()[2] == "Z"


def test_ui_on_a_port_that_is_taken(rhmc: Rhmc, store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ui, "subprocess", None)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        said = rhmc("ui", "--port", str(port))
    assert said == (2, "", f"--port: {port} cannot be used (Address already in use); choose another\n")


def test_ui_of_a_file_that_is_no_store(rhmc: Rhmc, store: Path) -> None:
    store.write_text("something else entirely, and long enough to be looked at" * 20)
    said = rhmc("ui")
    assert (said.code, said.out) == (2, "")
    assert said.err.startswith(f"{store}: not an MLflow database")
    assert said.err.count("\n") == 1
