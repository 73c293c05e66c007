"""More than a hundred malformed inputs, see `malformed`: no traceback, no hang, nothing left, the place is named."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.robustness.malformed import WRONG, Case, Outcome, Runner, cases, judge, look, make_base, prepared

SEED = 1
CASES = cases(SEED)
KINDS = ("names", "search files", "included files", "paths that are no files", "paper.yaml", "by chance")


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory, template: Path) -> Path:
    return make_base(tmp_path_factory.mktemp("malformed"), template)


@pytest.fixture(scope="module")
def runner() -> Iterator[Runner]:
    with Runner(SEED) as one:
        yield one


@pytest.mark.parametrize("kind", KINDS)
def test_malformed_inputs(kind: str, base: Path, runner: Runner, tmp_path: Path) -> None:
    wrong, folder = {}, tmp_path / "case"
    for number, case in enumerate(CASES):
        if case.kind == kind:
            with prepared(case, folder, base) as before:
                outcome = runner.run(number, folder)
                if found := judge(case, outcome, before, look(folder)):
                    wrong[case.name] = found
    assert not wrong


def test_there_are_more_than_a_hundred_and_their_names_are_their_own() -> None:
    assert len(CASES) > 100
    assert len({(case.kind, case.name) for case in CASES}) == len(CASES)
    assert [case.name for case in cases(SEED)] == [case.name for case in CASES]
    assert {case.kind for case in CASES} >= set(KINDS)


CASE = Case("a", "b", ("study", "check"), ("s.yaml", ("one", "other")))


@pytest.mark.parametrize(
    ("outcome", "after", "wrong"),
    [
        (Outcome(2, "s.yaml: one\n"), {"s.yaml": b"1"}, None),
        (Outcome(2, "S.YAML: the other\n"), {"s.yaml": b"1"}, None),
        (Outcome(1, "s.yaml: one", "Traceback\nValueError: x"), {"s.yaml": b"1"}, "tracebacks"),
        (Outcome(None, ""), {"s.yaml": b"1"}, "hangs"),
        (Outcome(1, "s.yaml: one"), {"s.yaml": b"1"}, "other exit codes"),
        (Outcome(2, "s.yaml: one"), {"s.yaml": b"2"}, "files left"),
        (Outcome(2, "s.yaml: one"), {}, "files left"),
        (Outcome(2, "s.yaml: one"), {"s.yaml": b"1", "w/x": b""}, "files left"),
        (Outcome(2, "s.yaml: neither"), {"s.yaml": b"1"}, "places not named"),
        (Outcome(2, ""), {"s.yaml": b"1"}, "places not named"),
        (Outcome(2, "s.yaml: one \x1b[31m"), {"s.yaml": b"1"}, "control characters"),
    ],
)
def test_what_counts_as_wrong(outcome: Outcome, after: dict[str, bytes], wrong: str | None) -> None:
    found = judge(CASE, outcome, {"s.yaml": b"1"}, after)
    assert list(found) == ([wrong] if wrong else [])
    assert set(found) <= set(WRONG)
