"""The plot of all claims: its rows are the numbers of claims.json, in places that follow from these alone."""

import json
import math
import re
from html import unescape
from pathlib import Path
from typing import Any

import pytest

from reports.claims.headlines import Headline
from reports.claims.verdicts import Claim
from reports.data.stats import Interval, Range
from reports.pages import forest

ROOT = Path(__file__).parents[3]
NAN, INF = math.nan, math.inf


def spot(value: float, found: dict[str, Any]) -> float:
    """The place of a value, worked out again from a claim's JSON."""
    away = max(-20.0, min(20.0, (value - found["origin"]) / found["pace"]))
    return 50 + 50 * math.asinh(away) / math.asinh(20)


def drawn(page: str) -> dict[str, str]:
    """The rows of the page by claim."""
    rows = re.findall(r'<li><a href="#(C\d+[a-c]?)".*?</a></li>', page, flags=re.DOTALL)
    texts = re.findall(r'<li><a href="#C\d+[a-c]?".*?</a></li>', page, flags=re.DOTALL)
    return dict(zip(rows, texts, strict=True))


def number(pattern: str, row: str) -> list[float]:
    found = re.search(pattern, row)
    return [float(x) for x in found.groups()] if found else []


@pytest.mark.parametrize("published", [False, True])
def test_rows_are_the_numbers_of_the_claims(made: Path, published: bool) -> None:
    folder = ROOT / "results" / "paper" if published else made
    claims = json.loads((folder / "claims.json").read_text())
    rows = drawn((folder / "index.html").read_text())
    assert list(rows) == [claim["id"] for claim in claims]
    shown = 0
    for claim in claims:
        row, found = rows[claim["id"]], claim["headline"]
        kind = claim["verdict"].split()[0]
        assert claim["label"] in unescape(row)
        assert f'<span class="{kind}">' in row
        dot = number(rf'#mark-{kind}" x="([\d.]+)%"', row)
        if found is None:
            assert dot == []
            continue
        shown += 1
        assert dot == [pytest.approx(spot(found["ours"]["value"], found), abs=0.01)]
        theirs = number(r'#mark-paper" x="([\d.]+)%"', row)
        assert theirs == ([] if found["paper"] is None else [pytest.approx(spot(found["paper"], found), abs=0.01)])
        ends = [found["ours"]["low"], found["ours"]["high"]]
        bar = number(r'class="bar" x1="([\d.]+)%" x2="([\d.]+)%"', row)
        places = [] if ends[0] is None else sorted(spot(x, found) for x in ends)
        assert bar == pytest.approx(places, abs=0.02)
        assert ('class="band"' in row) is found["holds"]
    assert shown > 3


def claim(found: Headline | None, verdict: str = "not reproduced") -> Claim:
    about = ("C1", "text", "highest of all", "Figure 6", verdict, "reason", {}, ("3 seeds",), (), "rule", ())
    return Claim(*about, found, "Navigation: best")  # type: ignore[arg-type]


def test_a_row_is_a_sentence_for_those_who_do_not_see_it() -> None:
    (row,) = forest.rows([claim(Headline("A − B", "points of return", Range(-3.3, -3.7, -2.9, 3), NAN, 0, INF, 0, 5))])
    assert row.sentence == (
        "C1, Navigation: best: not reproduced (provisional). Paper: highest of all. "
        "Ours: A − B, −3.3 (−3.7 to −2.9) points of return."
    )
    assert (row.paper, row.what) == ("> 0", "A − B")
    (row,) = forest.rows([claim(Headline("loss", "%", Interval(0.4, NAN, NAN, 1), -49.5, -59.5, -39.5, -49.5, -10))])
    assert row.sentence.endswith("Ours: loss, 0.4 %.")
    assert row.paper == "−49.5 %"
    (row,) = forest.rows([claim(None, "untestable")])
    assert row.sentence == "C1, Navigation: best: untestable. Paper: highest of all. Nothing of ours to show."
    assert (row.dot, row.bar, row.band, row.stated) == (None, None, None, None)


@pytest.mark.parametrize(
    ("value", "low", "high", "pace", "right"),
    [
        (-3.0, 0.0, INF, 5.0, False),  # should be above
        (4.0, -INF, 0.0, -5.0, False),  # should be below
        (-4.0, -INF, 0.0, -5.0, True),
        (0.4, -59.5, -39.5, -10.0, False),  # nothing of a loss that should be large
    ],
)
def test_what_falls_short_is_left_of_the_line(value: float, low: float, high: float, pace: float, right: bool) -> None:
    origin = -49.5 if pace == -10.0 else 0.0
    found = Headline("x", "u", Interval(value, value - 1, value + 1, 5), NAN, low, high, origin, pace)
    (row,) = forest.rows([claim(found)])
    assert row.dot is not None
    assert (row.dot > forest.place(0)) is right
    assert row.bar is not None
    assert row.bar[0] < row.dot < sum(row.bar)
    assert row.band is not None
    inside = row.band[0] <= row.dot <= sum(row.band)
    assert inside is right


def test_nothing_leaves_the_axis() -> None:
    assert (forest.place(-INF), forest.place(0), forest.place(INF)) == (0, 50, 100)
    places = [place for place, _ in forest.ticks()]
    assert places == sorted(places)
    assert [word for _, word in forest.ticks()][:4] == ["−10", "−3", "−1", "0"]


def test_the_caption_says_what_one_step_is() -> None:
    ours = Interval(1.0, 0.0, 2.0, 5)
    found = [("points of return", 5.0), ("steps", -50_000.0), ("steps", 500_000.0), ("%", -10.0)]
    claims = [claim(Headline("x", unit, ours, NAN, 0, INF, 0, pace)) for unit, pace in found]
    assert forest.scale(claims) == "5 points of return, 50 k or 500 k steps or 10 %"
    assert forest.scale([claim(None)]) == ""
