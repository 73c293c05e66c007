"""Options of every verb: the code behind a verb is asked for what the command line says."""

import json
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from pydantic import BaseModel
from typer.main import get_command

from pipelines.bundles.bundle import Packed
from pipelines.cli import main as cli
from pipelines.export import yardsticks  # noqa: F401  # before a test replaces what it takes from the science
from pipelines.policies.evaluation import Score
from pipelines.specs.search import Search
from pipelines.specs.study import Study
from pipelines.workspace.work_folder import Home

TESTS = Path(__file__).parents[2]
STUDY = """\
question: Which?
base: {env: {kind: coverage}, algo: {kind: iql}}
arms: {full: {}, none: {algo: {lr: 1e-4}}}
variants: {large: {algo: {hidden_dim: 128}}}
seeds: 2
steps: 1000
"""
SEARCH = """\
question: Which?
base: {env: {kind: coverage}, algo: {kind: iql}}
arms: {IQL: {space: {lr: {low: 1e-4, high: 1e-2}}}}
trials: 5
seeds: 2
steps: 1000
"""
PAPER = "--profile paper --set seeds=3"
OTHER = f"{PAPER} --variant large"
ONE = Score("full", 1, "finished", 8, {"return": 1.25, "return_sem": 0.5}, 9, {"kind": "coverage"}, {})


class Case(NamedTuple):
    """A command line, the functions that are replaced with what each gives back, and the calls that they get."""

    words: str
    answers: Mapping[str, Any]
    calls: tuple[str, ...]


CASES = [
    Case(
        f"evaluate studies/x.yaml {OTHER} --arm full --arm none --seed 1 --seed 2 "
        "--agents 6 --targets 7 --episodes 8 --eval-seed 9 --json",
        {"pipelines.policies.evaluation.of_study": ["policy"], "pipelines.policies.evaluation.score": ONE},
        (
            "of_study(x@large paper 3, work, [full, none], [1, 2])",
            "score(policy, EvaluationEpisodes(episodes=8, seed=9, agents=6, targets=7))",
        ),
    ),
    Case(
        "evaluate p.pt --config c.yaml",
        {"pipelines.policies.evaluation.of_file": "policy", "pipelines.policies.evaluation.score": ONE},
        (
            "of_file(p.pt, c.yaml)",
            "score(policy, EvaluationEpisodes(episodes=None, seed=None, agents=None, targets=None))",
        ),
    ),
    Case(
        "transfer studies/x.yaml --profile paper --arm full --seed 1 --agents 2,3 --targets 6 "
        "--episodes 8 --jobs 3 --out o",
        {
            "pipelines.policies.evaluation.of_study": ["policy"],
            "pipelines.policies.transfer.transfer": [],
            "pipelines.policies.transfer.export_transfer": "",
        },
        (
            "of_study(x paper 2, work, [full], [1])",
            "transfer(x, [policy], [2, 3], [6], 8, 3)",
            "export_transfer([], o)",
        ),
    ),
    Case(
        f"assignments studies/x.yaml {OTHER} --arm full --seed 1 --jobs 3 --out o",
        {"pipelines.policies.assignments.watched": []},
        ("watched(x@large paper 3, [full], [1], 3)",),
    ),
    Case(
        f"render studies/x.yaml {OTHER} --arm full --seed 1 --agents 6 --targets 7 --episode 2 --beside nearest "
        "--frames 3 --out o.gif",
        {
            "pipelines.policies.evaluation.of_study": [SimpleNamespace(saved="saved")],
            "pipelines.policies.render.render": "",
        },
        (
            "of_study(x@large paper 3, work, [full], [1])",
            "render(saved, o.gif, work, 2, nearest, 3, EvaluationEpisodes(episodes=None, seed=None, agents=6, "
            "targets=7))",
        ),
    ),
    Case(
        "render p.pt --config c.yaml --out o.gif",
        {
            "pipelines.policies.evaluation.of_file": SimpleNamespace(saved="saved"),
            "pipelines.policies.render.render": "",
        },
        (
            "of_file(p.pt, c.yaml)",
            "render(saved, o.gif, work, 0, None, 40, EvaluationEpisodes(episodes=None, seed=None, agents=None, "
            "targets=None))",
        ),
    ),
    Case(
        f"export studies/x.yaml {OTHER} --out o",
        {"pipelines.export.tables.export_study": 0},
        ("export_study(x@large paper 3, o)",),
    ),
    Case(
        f"export studies/x.yaml {OTHER} --format marl-eval --runs r --out o",
        {"pipelines.export.marl_eval.export_marl_eval": 0},
        ("export_marl_eval(x@large, r, o)",),
    ),
    Case(
        "new method mine --out o",
        {"pipelines.conformance.scaffold.create": (Path("o/mine/mine/method.py"),)},
        ("create(method, mine, o)",),
    ),
    Case(
        "new task mine --out o",
        {"pipelines.conformance.scaffold.create": (Path("o/mine/mine/task.py"),)},
        ("create(task, mine, o)",),
    ),
    Case(
        "conformance --method iql --set gamma=0.5 --steps 7 --json",
        {"pipelines.conformance.methods.check_method": []},
        ("check_method(iql, {'gamma': 0.5}, 7)",),
    ),
    Case(
        "conformance --task coverage --set agents=6",
        {"pipelines.conformance.tasks.check_task": []},
        ("check_task(coverage, {'agents': 6})",),
    ),
    Case(
        "theorem --instances 7 --seed 3 --alpha 0.5 --out o",
        {
            "rhmc.hierarchy.theorem.shortfall_table": "found",
            "rhmc.hierarchy.theorem.summary": "",
            "pipelines.export.theorem.export_theorem": "",
        },
        ("shortfall_table(7, 3, alpha=0.5)", "summary(found, 0.5)", "export_theorem(found, 3, o)"),
    ),
    Case(
        "report --profile paper --study studies/x.yaml --variant large --runs r --out o",
        {"reports.pages.build.write_report": "whole"},
        ("write_report(r, o, paper, x@large, visible_lines)",),
    ),
    Case("methods --out o", {"pipelines.export.methods.export_methods": ""}, ("export_methods(o)",)),
    Case("drawings --out o", {"pipelines.export.drawings.export_drawings": []}, ("export_drawings(o)",)),
    Case(
        f"study run studies/x.yaml {OTHER} --arm full --arm none",
        {"pipelines.execution.run.run_studies": 0},
        ("run_studies([x@large paper 3], work, [full, none])",),
    ),
    Case(
        f"study status studies/x.yaml {OTHER} --json",
        {"pipelines.execution.run.show_status": 0},
        ("show_status(x@large paper 3, work, as_json=True)",),
    ),
    Case("study copy alpha --out o", {"pipelines.specs.include.copy": []}, ("copy(alpha, o)",)),
    Case(
        f"study export studies/x.yaml o {OTHER} --values-only",
        {"pipelines.bundles.bundle.pack": Packed(1, 1, 0)},
        ("pack(x@large paper 3, o, work, values_only=True)",),
    ),
    Case(
        f"study export studies/x.yaml o {OTHER}",
        {"pipelines.bundles.bundle.pack": Packed(1, 1, 0)},
        ("pack(x@large paper 3, o, work, values_only=False)",),
    ),
    Case(
        f"study adopt studies/x.yaml {OTHER} --verify 4 --until 500 --jobs 3",
        {"pipelines.execution.adoption.adopt": []},
        ("adopt(x@large paper 3, work, 4, 500, 3, say)",),
    ),
    Case(
        f"search run studies/search_x.yaml {PAPER} --out o",
        {"pipelines.tuning.search_run.run_search": 0},
        ("run_search(search_x paper 3, work, o)",),
    ),
    Case(
        f"search status studies/search_x.yaml {PAPER}",
        {"pipelines.tuning.search_run.show_search": 0},
        ("show_search(search_x paper 3, work)",),
    ),
    Case(
        f"search export studies/search_x.yaml {PAPER} --out o",
        {"pipelines.tuning.search_export.export_search": 0},
        ("export_search(search_x paper 3, o, work)",),
    ),
    Case(
        "yardsticks coverage --preset executor --agents 2 --targets 3 --policies random --episodes 8 --seed 9 "
        "--profile paper --json --out o",
        {"rhmc.yardsticks.scores.play_yardsticks": {"random": {}}, "pipelines.export.yardsticks.export_yardsticks": ""},
        (
            "play_yardsticks({'agents': 2, 'preset': 'executor', 'targets': 3}, [random], episodes=8, seed=9)",
            "export_yardsticks([scored], paper, o)",
        ),
    ),
    Case(
        "yardsticks navigation --agents 2 --reward mpe1 --order mpe1 --policies random --episodes 8 --seed 9 "
        "--profile paper --json --out o",
        {"rhmc.yardsticks.scores.play_yardsticks": {"random": {}}, "pipelines.export.yardsticks.export_yardsticks": ""},
        (
            "play_yardsticks({'agents': 2, 'reward': 'mpe1', 'order': 'mpe1'}, [random], episodes=8, seed=9)",
            "export_yardsticks([scored], paper, o)",
        ),
    ),
    Case(
        f"yardsticks study studies/x.yaml {OTHER} --episodes 8 --seed 9 --out o",
        {"pipelines.export.yardsticks.evaluate_all": [], "pipelines.export.yardsticks.export_yardsticks": ""},
        (
            "evaluate_all([Evaluation(env={}, policies=[random, hold, nearest, mean_all, best_window, joint_one_step, "
            "set_point, free_heading_bound, range_bound], episodes=8, seed=9)], 1)",
        ),
    ),
    Case(
        "yardsticks all --profile paper --jobs 3 --out o",
        {
            "pipelines.export.yardsticks.evaluations": [],
            "pipelines.export.yardsticks.evaluate_all": [],
            "pipelines.export.yardsticks.export_yardsticks": "",
        },
        ("evaluations(paper)", "evaluate_all([], 3)", "export_yardsticks([], paper, o)"),
    ),
]
CHECKS = [
    (f"study check studies/x.yaml {OTHER}", "x@large (paper): Which?", "6 runs, 6,000 environment steps"),
    (f"search check studies/search_x.yaml {PAPER}", "search_x (paper): Which?", "5 trials x 3 seeds"),
]
ELSEWHERE = {  # verbs whose options have tests of their own
    "verify": "pipelines/export/test_published.py",
    "ui": "pipelines/cli/test_cli.py",
    "doctor": "pipelines/cli/test_cli.py",
    "study list": "pipelines/cli/test_cli.py",
    "search list": "pipelines/cli/test_cli.py",
    "status": "pipelines/cli/test_cli.py",
    "verdicts": "pipelines/cli/test_cli.py",
}


def shown(value: Any) -> str:
    """An argument as the cases write it."""
    match value:
        case Study() | Search():
            return f"{value.name} {value.profile} {value.seeds}"
        case BaseModel():
            return str(value.model_dump(exclude_defaults=True))
        case Path():
            return value.name
        case Home():
            return value.root.name
        case tuple() if hasattr(value, "_asdict"):
            if type(value).__name__ == "Scored":
                return "scored"
            return f"{type(value).__name__}({', '.join(f'{k}={shown(v)}' for k, v in value._asdict().items())})"
        case list() | tuple() | Iterator():
            return f"[{', '.join(map(shown, value))}]"
        case _:
            return getattr(value, "__name__", str(value))


@pytest.fixture
def called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Case], list[str]]:
    """Runs a case in a folder with a study and a search; the calls."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RHMC_HOME", str(tmp_path / "work"))
    (tmp_path / "studies").mkdir()
    (tmp_path / "studies/x.yaml").write_text(STUDY)
    (tmp_path / "studies/search_x.yaml").write_text(SEARCH)

    def run(case: Case) -> list[str]:
        calls: list[str] = []

        def recorder(name: str, answer: Any) -> Callable[..., Any]:
            def function(*given: Any, **named: Any) -> Any:
                words = [*map(shown, given), *(f"{key}={shown(value)}" for key, value in named.items())]
                calls.append(f"{name}({', '.join(words)})")
                return iter(answer) if isinstance(answer, list) else answer

            return function

        for place, answer in case.answers.items():
            monkeypatch.setattr(place, recorder(place.rpartition(".")[2], answer))
        monkeypatch.setattr(sys, "argv", ["rhmc", *case.words.split()])
        with pytest.raises(SystemExit) as left:
            cli.main()
        assert not left.value.code
        return calls

    return run


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.words.partition(" -")[0])
def test_what_is_said_is_what_is_asked_for(case: Case, called: Callable[[Case], list[str]]) -> None:
    assert called(case) == list(case.calls)


@pytest.mark.parametrize(("words", "first", "second"), CHECKS)
def test_checks_are_of_what_is_said(
    words: str, first: str, second: str, called: Callable[[Case], list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    called(Case(words, {}, ()))
    out = capsys.readouterr().out
    assert (first in out, second in out) == (True, True), out


def test_scores_as_json(called: Callable[[Case], list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    called(CASES[0])
    assert json.loads(capsys.readouterr().out) == [ONE._asdict()]
    called(CASES[1])
    assert "1.25 ± 0.50" in capsys.readouterr().out


def verbs() -> Iterator[tuple[str, set[str]]]:
    """Every verb with its options."""
    for name, one in get_command(cli.app).commands.items():  # type: ignore[attr-defined]
        for verb, command in getattr(one, "commands", {"": one}).items():
            options = {[*p.opts, *p.secondary_opts][-1] for p in command.params if p.param_type_name == "option"}
            yield f"{name} {verb}".strip(), options - {"--help"}


def test_every_option_is_in_a_test() -> None:
    for verb, options in verbs():
        lines = [*(case.words for case in CASES), *(words for words, *_ in CHECKS)]
        words = {word for line in lines if f"{line} ".startswith(f"{verb} ") for word in line.split()}
        text = (TESTS / ELSEWHERE[verb]).read_text() if verb in ELSEWHERE else ""
        assert {option for option in options - words if f'"{option}"' not in text} == set(), verb
