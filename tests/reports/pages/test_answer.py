"""The answer in one sentence, for each mix of verdicts, and the questions after it."""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd
import pytest

from reports.claims.verdicts import VERDICTS, Claim
from reports.data.frame import load
from reports.data.paper import Source, read
from reports.pages.answer import SAID, sentence
from reports.pages.build import build
from reports.pages.report import single
from tests.reports.factory import half_done, noisy, study, write, yardsticks

NONE, HELD, FAILED, SHORT = "untestable", "reproduced", "not reproduced", "too short to judge"
READING, ODD = "depends on the reading", "contradicted by the paper itself"


def claims(counts: Mapping[str, int], provisional: int = 0) -> list[Claim]:
    every = [verdict for verdict, count in counts.items() for _ in range(count)]
    return [
        Claim(f"C{n}", "t", "p", "s", verdict, "r", {}, ("3 seeds",) * (n < provisional), (), "rule")  # type: ignore[arg-type]
        for n, verdict in enumerate(every)
    ]


@pytest.mark.parametrize(
    ("counts", "provisional", "said"),
    [
        (
            {HELD: 3, FAILED: 14, ODD: 2, NONE: 4},
            17,
            "Of 23 claims 3 hold, 14 do not, 2 are contradicted by the paper itself, 4 cannot be tested; "
            "17 of these verdicts are provisional.",
        ),
        ({HELD: 1, FAILED: 1}, 1, "Of 2 claims 1 holds, 1 does not; 1 of these verdicts is provisional."),
        ({HELD: 5}, 0, "Of 5 claims all hold."),
        ({FAILED: 5}, 0, "Of 5 claims none holds, 5 do not."),
        ({READING: 1, HELD: 2}, 0, "Of 3 claims 2 hold, 1 depends on how the text is read."),
        ({READING: 2, ODD: 1}, 0, "Of 3 claims none holds, 2 depend on how the text is read, 1 is contradicted by the "
         "paper itself."),
        ({NONE: 1, SHORT: 1}, 0, "Of 2 claims none is judged: 1 has runs too short to judge it, 1 cannot be tested."),
        ({NONE: 21, ODD: 2, SHORT: 2}, 0, "Of 25 claims none is judged: 2 are contradicted by the paper itself, 2 have "
         "runs too short to judge them, 21 cannot be tested."),
    ],
)  # fmt: skip
def test_the_sentence_of_each_mix_of_verdicts(counts: Mapping[str, int], provisional: int, said: str) -> None:
    assert sentence(claims(counts, provisional)) == said


def test_every_verdict_has_its_words() -> None:
    assert {*SAID, HELD} == set(VERDICTS)


def header(folder: Path) -> str:
    text = (folder / "index.html").read_text()
    return text[text.index("<main") : text.index("</header>")]


@pytest.mark.usefixtures("unpainted", "quick_resampling")
def test_a_study_of_ones_own_changes_nothing_of_the_answer(tmp_path: Path) -> None:
    paper = study("coverage", {"RHMC": noisy(67), "IQL": noisy(63)}, points=4), yardsticks()
    own = half_done(*study("mine", {"RHMC": noisy(90), "other": noisy(10)}, points=4, steps=1_000))
    build(write(tmp_path / "with", *paper, own), tmp_path / "a", "quick")
    build(write(tmp_path / "without", *paper), tmp_path / "b", "quick")
    assert header(tmp_path / "a") == header(tmp_path / "b")
    assert (tmp_path / "a" / "claims.json").read_bytes() == (tmp_path / "b" / "claims.json").read_bytes()
    text = (tmp_path / "a" / "index.html").read_text()
    assert '<section class="study" id="study-mine"' in text
    assert "Smoke test" not in text
    assert "Study mine, arm RHMC: 1 of 3 seeds not run (seed 0)." in text


@pytest.mark.usefixtures("unpainted", "quick_resampling")
def test_a_report_of_ones_own_study_alone_still_warns_of_short_runs(tmp_path: Path) -> None:
    build(write(tmp_path / "runs", study("mine", {"one": noisy(9)}, points=4, steps=1_000)), tmp_path / "a", "quick")
    assert "Smoke test. Every run here has" in header(tmp_path / "a")


@pytest.mark.parametrize(("name", "warned"), [("coverage", True), ("mine", False)])
def test_a_study_alone_is_short_where_the_paper_has_it(name: str, warned: bool, tmp_path: Path) -> None:
    found = load(write(tmp_path, study(name, {"RHMC": noisy(67)}, points=4, steps=1_000)), "quick")
    assert bool(single(found, read(), name).smoke) is warned


@pytest.mark.parametrize(
    ("about", "words"),
    [
        ({}, ""),
        ({"authors": ("A. One", "B. Two")}, "A. One, B. Two"),
        ({"venue": "Journal", "year": 2024}, "Journal, 2024"),
        ({"authors": ("A. One",), "venue": "Journal"}, "A. One. Journal"),
    ],
)
def test_what_is_known_of_the_paper_is_said(about: dict[str, object], words: str) -> None:
    assert Source.model_validate({"title": "T"} | about).about == words


def test_the_questions_are_answered_from_the_runs(made: Path) -> None:
    text = header(made)
    for question in ("Which method is best?", "What does the regulator do?", "How sure is this?", "How do I run it?"):
        assert f"<dt>{question}</dt>" in text
    assert "full − no regulation 10.0 (8.0 to 12.0); paper: 34.9." in text
    assert "rhmc report --profile quick" in text
    finals = pd.read_csv(made / "tables" / "final_ablation.csv").set_index("arm")["mean"]
    assert f"full ends at {finals['full']:.1f} (1 of 3 arms by the mean), ahead of no filter at" in text
