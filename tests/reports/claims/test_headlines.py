"""The quantity that decides a claim: its numbers follow from the planted runs, and agree with the verdict."""

import json
import math
from pathlib import Path

import pandas as pd
import pytest

from reports.claims.headlines import PERCENT, POINTS, STEPS, Headline, about, ahead, at_most, at_odds, behind
from reports.claims.verdicts import Claim, judge, table
from reports.data.frame import load
from reports.data.paper import read
from reports.data.stats import Interval
from tests.reports.factory import NAVIGATION, noisy, study, theorem, write, yardsticks

ROOT = Path(__file__).parents[3]
PAPER = 5_000_000
OTHERS = {"HiT-MAC": 60.0, "QMIX": 61.0, "IQL": 58.0, "COMA": 50.0, "MAPPO": 55.0, "MADDPG": 45.0}

pytestmark = pytest.mark.usefixtures("quick_resampling")


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Claim]:
    coverage = {"RHMC": noisy(70.5, 5)} | {arm: noisy(x, 5) for arm, x in OTHERS.items()}
    ablation = {"full": noisy(70.0, 5), "no regulation": noisy(60.0, 5), "no filter": noisy(72.0, 5)}
    tables = (
        study("coverage", coverage, steps=PAPER),
        study("navigation", {arm: [x - 90 for x in finals] for arm, finals in coverage.items()}, env=NAVIGATION),
        study("ablation", ablation, steps=PAPER, rise={"full": 0.1, "no regulation": 0.5, "no filter": 0.9}),
        yardsticks(),
        theorem(),
    )
    folder = write(tmp_path_factory.mktemp("runs"), *tables)
    return {claim.id: claim for claim in judge(load(folder, "quick"), read())}


def headline(claim: Claim) -> Headline:
    assert claim.headline is not None
    return claim.headline


def test_numbers_of_the_runs_and_of_the_paper(found: dict[str, Claim]) -> None:
    shown = {name: headline(claim) for name, claim in found.items() if claim.headline}
    expected = {
        "C1": ("RHMC − QMIX", POINTS, 9.5, math.nan),  # of six gaps the smallest
        "C2a": ("QMIX − IQL", POINTS, 3.0, math.nan),
        "C3b": ("RHMC", POINTS, 70.5, 70.5),
        "C4a": ("HiT-MAC", POINTS, 60.0, 60.0),
        "C5b": ("MAPPO − HiT-MAC", POINTS, -5.0, math.nan),  # of six gaps the largest
        "C8a": ("full − no regulation", POINTS, 10.0, 34.9),
        "C8b": ("change without it", PERCENT, -100 / 7, 100 * (35.6 / 70.5 - 1)),
        "C9a": ("full − no filter", POINTS, -2.0, 15.4),
        "C11": ("RHMC", POINTS, -19.5, 70.5),
        "C12": ("bound with free headings", POINTS, 86.4, 92.1),
        "C13": ("4 x 5 x 8: % lost", PERCENT, 8.0, 0.0),
    }
    for name, (what, unit, ours, paper) in expected.items():
        one = shown[name]
        assert (one.what, one.unit) == (what, unit), name
        assert one.ours.value == pytest.approx(ours), name
        assert one.paper == pytest.approx(paper, nan_ok=True), name
    assert {shown[name].unit for name in ("C5a", "C6a", "C10a", "C10b", "C10c")} == {STEPS}
    assert shown["C10a"].paper == 1e6
    assert shown["C10c"].paper == -2e6
    assert headline(found["C8a"]).ours == found["C8a"].ours["full − no regulation"]


def test_where_a_claim_holds_its_quantity_lies_where_it_would(found: dict[str, Claim]) -> None:
    for claim in found.values():
        if claim.headline and claim.verdict == "reproduced":
            assert claim.headline.low <= claim.headline.ours.value <= claim.headline.high, claim.id
    assert [found[name].verdict for name in ("C8a", "C9a", "C8b")] == ["reproduced", *["not reproduced"] * 2]
    for name in ("C9a", "C8b"):
        one = headline(found[name])
        assert not one.low <= one.ours.value <= one.high
        assert one.place(one.ours.value) < 0


def test_an_untestable_claim_has_none(tmp_path: Path) -> None:
    folder = write(tmp_path, study("coverage", {"RHMC": noisy(70), "IQL": noisy(60)}, steps=PAPER))
    claims = {claim.id: claim for claim in judge(load(folder, "quick"), read())}
    assert claims["C8a"].headline is None
    assert claims["C3a"].headline is not None  # ahead of what there is, and most are not there


def test_the_table_has_a_column_for_each_number(found: dict[str, Claim]) -> None:
    rows = table(list(found.values())).numbers.set_index("id")
    one = headline(found["C3b"])
    row = rows.loc["C3b"]
    assert row[["value", "value_low", "value_high"]].tolist() == list(one.ours[:3])
    assert row[["paper_value", "holds_from", "holds_to", "origin", "pace", "level"]].tolist() == [
        *(70.5, 65.5, 75.5, 70.5, 5.0, 0.95)
    ]
    assert (row["quantity"], row["unit"]) == ("RHMC", POINTS)
    assert pd.isna(rows.loc["C7a", "value"])


def test_published_claims_have_a_label_and_a_quantity() -> None:
    claims = json.loads((ROOT / "results" / "paper" / "claims.json").read_text())
    assert all(0 < len(claim["label"]) <= 28 for claim in claims)
    judged = [claim for claim in claims if claim["verdict"] != "untestable"]
    assert all(claim["headline"] for claim in judged)


def test_each_form_of_a_claim() -> None:
    gaps = {"a": Interval(-3.0, -4.0, -2.0, 5), "b": Interval(6.0, 5.0, 7.0, 5)}
    first, last = ahead(gaps, 5.0, least=-5.0), behind(gaps, 5.0)
    assert (first.what, first.low, first.high, first.place(-5.0)) == ("a", -5.0, math.inf, -1.0)
    assert (last.what, last.low, last.high, last.place(5.0)) == ("b", -math.inf, 0.0, -1.0)
    near = about(gaps, 1.0, 2.0, sign=-1)
    assert (near.what, near.low, near.high, near.place(3.0)) == ("b", -1.0, 3.0, -1.0)
    most = at_most("x", gaps["b"], 4.0, 2.0, unit=STEPS)
    assert (most.high, most.paper, most.place(6.0)) == (4.0, 4.0, -1.0)
    odd, room = at_odds("x", gaps["b"], 9.0, 1.0), at_odds("x", gaps["b"], 9.0, 1.0, least=9.0)
    assert math.isnan(odd.low)
    assert math.isnan(odd.high)
    assert (room.low, room.high) == (9.0, math.inf)
