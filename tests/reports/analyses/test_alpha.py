"""Effects by alpha and the curves of the mechanism, against numbers that were planted."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from pipelines.specs.study import Study
from reports.analyses import alpha
from reports.data.frame import Results, load
from reports.data.paper import read as paper
from reports.pages.build import build
from reports.pages.gallery import gallery
from tests.reports.factory import COVERAGE, Tables, noisy, study, write

pytestmark = pytest.mark.usefixtures("quick_resampling")
ROOT = Path(__file__).parents[3]
NAME = alpha.STUDY
ARMS: dict[str, dict[str, Any]] = {
    "full, horizon 1": {"regulator": "exact", "horizon": 1, "filter": "on"},
    "full, horizon 18": {"regulator": "exact", "horizon": 18, "filter": "on"},
    "no regulation": {"regulator": "none", "horizon": 1, "filter": "on"},
    "no filter, horizon 18": {"regulator": "exact", "horizon": 18, "filter": "off"},
    "neither": {"regulator": "none", "horizon": 1, "filter": "off"},
    "Algorithm 1": {"regulator": "paper", "horizon": 1, "filter": "on"},
}
LEVELS = {
    "full, horizon 1": 64.0,
    "full, horizon 18": 66.0,
    "no regulation": 60.0,
    "no filter, horizon 18": 65.0,
    "neither": 58.0,
    "Algorithm 1": 61.0,
}
ALPHAS = (0.02, 0.5)  # at the second, all that is without regulation ends 20 points lower


def final(arm: str, at: float) -> float:
    return LEVELS[arm] - (20.0 if at == ALPHAS[1] and ARMS[arm]["regulator"] == "none" else 0.0)


def planted(arms: Mapping[str, Mapping[str, Any]] = ARMS, form: str = "{}, alpha={:g}") -> Tables:
    """The study with five seeds, and what its coordinators logged at two points."""
    cells = {form.format(arm, at): (arm, at) for at in ALPHAS for arm in arms}
    points, runs = study(NAME, {name: noisy(final(*cell), 5) for name, cell in cells.items()}, points=2)
    algo = {name: {"kind": "rhmc", "alpha": at} | dict(arms[arm]) for name, (arm, at) in cells.items()}
    both = zip(runs["arm"], runs["config"], strict=True)
    runs = runs.assign(config=[json.dumps(json.loads(text) | {"algo": algo[arm]}) for arm, text in both])
    logged = [
        (row.study, row.arm, row.seed, row.run, step, f"train/{quantity}", value + row.seed)
        for row in runs.itertuples()
        for step in (75_000, 150_000)
        for quantity, value in (("assigned", step / 15_000), ("earned", -1.0), ("regulated", 2.0))
    ]
    return pd.concat([points, pd.DataFrame(logged, columns=list(points))], ignore_index=True), runs


def read(folder: Path, tables: Tables) -> Results:
    return load(write(folder, tables), "quick")


def missing(tables: Tables, pattern: str, seeds: int = 0) -> Tables:
    """Without the runs of arms that fit, but for the first seeds."""
    points, runs = tables
    gone = runs["arm"].str.contains(pattern) & (runs["seed"] >= seeds)
    kept = points[~points["run"].isin(runs["run"][gone])]
    return kept, runs.assign(status=np.where(gone, "missing", runs["status"]))


def words(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(Text) if isinstance(text, Text))


@pytest.mark.parametrize("form", ["{}, alpha={:g}", "{} ({})"])
def test_effects_are_those_that_were_planted_whatever_arms_are_called(tmp_path: Path, form: str) -> None:
    table = alpha.table_effects(read(tmp_path, planted(form=form)), NAME)
    assert table is not None
    value = table.numbers.set_index(["effect", "line", "alpha"])["value"]
    wanted = {
        ("regulation", "horizon 1"): (4, 24),
        ("regulation", "horizon 18"): (6, 26),
        ("regulation", "Algorithm 1"): (1, 21),
        ("filter", "with regulation, horizon 18"): (1, 1),
        ("filter", "without regulation"): (2, 2),
    }
    assert list(dict.fromkeys(key[:2] for key in value.index)) == list(wanted)
    assert value.to_dict() == pytest.approx(
        {(*key, at): x[n] for key, x in wanted.items() for n, at in enumerate(ALPHAS)}
    )


def test_a_row_has_interval_means_and_seeds_of_both_arms(tmp_path: Path) -> None:
    table = alpha.table_effects(read(tmp_path, missing(planted(), "^no regulation, alpha=0.5", seeds=3)), NAME)
    assert table is not None
    row = table.numbers.set_index(["line", "alpha"]).loc[("horizon 18", 0.5)]
    assert (row["mean"], row["mean_without"], row["value"]) == pytest.approx((66, 39.5, 26.5))  # the lowest three
    assert row["low"] < 26.5 < row["high"]
    assert (row["seeds"], row["seeds_without"]) == (5, 3)
    assert (row["arm"], row["without"]) == ("full, horizon 18, alpha=0.5", "no regulation, alpha=0.5")
    shown = table.shown.set_index(["In", "alpha"]).loc[("horizon 18", "0.5")]
    assert shown["Effect [95 %] or (range)"].startswith("26.5 (")
    assert shown["Seeds: with, without"] == "5; 3 of 5"


def test_arms_that_differ_in_more_are_not_compared(tmp_path: Path) -> None:
    arms = ARMS | {"no regulation": ARMS["no regulation"] | {"lr": 0.1}}
    found = alpha.effects(read(tmp_path, planted(arms)), NAME)
    assert {(one.part, one.line) for one in found} == {("filter", "with regulation, horizon 18")}


def test_what_has_no_run_is_left_out_of_the_figure_and_a_dash_in_the_table(tmp_path: Path) -> None:
    results = read(tmp_path, missing(missing(planted(), "alpha=0.5$", seeds=2), "^(?:neither|Algorithm)"))
    drawing, table = alpha.fig_effects(results, NAME), alpha.table_effects(results, NAME)
    assert drawing is not None
    assert table is not None
    assert set(drawing.numbers["line"]) == {"horizon 1", "horizon 18", "with regulation, horizon 18"}
    faces = [line.get_markerfacecolor() for line in drawing.figure.axes[0].lines if line.get_marker() == "o"]
    assert [face == "white" for face in faces] == [False, True, False, True]  # not all seeds at the second alpha
    assert [x.get_text() for x in drawing.figure.axes[0].get_xticklabels()] == ["0.02", "0.5"]
    shown = table.shown.set_index(["In", "alpha"])
    assert shown.loc[("Algorithm 1", "0.5"), "Effect [95 %] or (range)"] == "–"
    assert shown.loc[("Algorithm 1", "0.5"), "Seeds: with, without"] == "0 of 5; 2 of 5"
    assert "Algorithm" not in alpha.described(results, NAME)


def test_one_alpha_and_two_arms_are_drawn(tmp_path: Path) -> None:
    """All that the quick profile has."""
    points, runs = planted({name: ARMS[name] for name in ("full, horizon 1", "no regulation")})
    keep = runs["arm"].str.endswith("alpha=0.02") & (runs["seed"] == 0)
    tables = points[points["run"].isin(runs["run"][keep])], runs[keep]
    results = read(tmp_path, tables)
    drawing, seen = alpha.fig_effects(results, NAME), alpha.fig_mechanism(results, NAME)
    assert drawing is not None
    assert drawing.numbers["value"].tolist() == [4]
    assert np.isnan(drawing.numbers["low"]).all()
    assert "no two such arms are finished" in words(drawing.figure)
    assert seen is not None
    assert set(seen.numbers["arm"]) == {"full, horizon 1", "no regulation"}
    assert "full, horizon 1 (1 seed)" in words(seen.figure)


def test_without_data_nothing_is_drawn(tmp_path: Path) -> None:
    results = read(tmp_path, missing(planted(), ""))
    assert alpha.fig_effects(results, NAME) is None
    assert alpha.fig_mechanism(results, NAME) is None
    assert alpha.table_effects(results, NAME) is None
    assert alpha.table_mechanism(results, NAME) is None
    other = read(tmp_path / "other", study("reach", {"one": noisy(60)}))
    assert alpha.effects(other, "reach") == []


@pytest.mark.parametrize(
    "change", [{"alpha": "x"}, {"alpha": None}, {"regulator": 3}, {"horizon": [1]}, {"filter": {}}]
)
def test_settings_of_another_kind_are_no_arms(tmp_path: Path, change: dict[str, Any]) -> None:
    results = read(tmp_path, planted({name: settings | change for name, settings in ARMS.items()}))
    assert alpha.fig_effects(results, NAME) is None


def test_the_mechanism_has_the_longest_horizon_and_every_alpha_that_has_points(tmp_path: Path) -> None:
    drawing = alpha.fig_mechanism(read(tmp_path, missing(planted(), "^no regulation, alpha=0.5")), NAME)
    assert drawing is not None
    rows = drawing.numbers.set_index(["alpha", "arm", "quantity", "step"])["mean"]
    for at in ALPHAS:
        mine = [rows[at, "full, horizon 18", name, 75_000] for name, _ in alpha.QUANTITIES]
        assert mine == pytest.approx([5 + 2, -1 + 2, 2 + 2])  # seeds 0 to 4 are a point apart
    assert set(drawing.numbers[drawing.numbers["arm"] == "no regulation"]["alpha"]) == {0.02}
    assert "full, horizon 18 (5 seeds)" in words(drawing.figure)


def test_the_table_of_the_mechanism_has_the_end_of_the_training(tmp_path: Path) -> None:
    table = alpha.table_mechanism(read(tmp_path, missing(planted(), "^no regulation, alpha=0.5")), NAME)
    assert table is not None
    rows = table.numbers.set_index(["alpha", "arm", "quantity"])
    assert len(rows) == 3 * 3
    assert rows.loc[(0.5, "full, horizon 18", "assigned"), "value"] == pytest.approx(10 + 2)  # the last of two points
    assert rows.loc[(0.02, "no regulation", "earned"), "value"] == pytest.approx(-1 + 2)
    assert table.shown["After regulation"][0].startswith("4.00 [")
    assert table.shown["Seeds"].tolist() == ["5"] * 3


def test_values_that_are_none_are_passed_over(tmp_path: Path) -> None:
    points, runs = planted()
    first = (points["metric"] == "train/earned") & (points["step"] == 75_000)
    drawing = alpha.fig_mechanism(
        read(tmp_path, (points.assign(value=points["value"].mask(first, np.inf)), runs)), NAME
    )
    assert drawing is not None
    assert set(drawing.numbers[drawing.numbers["quantity"] == "earned"]["step"]) == {150_000}


@pytest.mark.usefixtures("unpainted")
def test_both_figures_and_tables_stand_under_the_study(tmp_path: Path) -> None:
    results = read(tmp_path, planted())
    pictures = {one.name: one for one in gallery(results, paper())}
    for name in (f"effects_{NAME}", f"mechanism_{NAME}"):
        assert pictures[name].study == NAME
        assert pictures[name].drawing is not None
        assert pictures[name].caption.endswith(".")
        assert pictures[name].alt.endswith(".")
    assert "Regulation, horizon 1 4.0 at 0.02, 24.0 at 0.5" in pictures[f"effects_{NAME}"].alt
    built = build(tmp_path, tmp_path / "out", "quick", NAME)
    assert built.undrawn == []
    assert {f"{name}_{NAME}.{kind}" for name in ("effects", "mechanism") for kind in ("png", "md")} <= {
        path.name for path in built.files
    }


def test_the_shipped_study_has_these_arms() -> None:
    """Its configurations, as they are exported, give every comparison at every alpha."""
    plan = Study.load(ROOT / f"studies/{NAME}.yaml", "paper").runs()
    rows = [
        (
            NAME,
            run.arm,
            run.spec.seed,
            run.spec.id,
            "missing",
            "rhmc",
            "coverage",
            "paper",
            run.spec.canonical(),
            "",
            "",
        )
        for run in plan
    ]
    columns = ["study", "arm", "seed", "run", "status", "algorithm", "task", "profile", "config", "fingerprint"]
    points, _ = planted()
    results = Results(points.iloc[:0], pd.DataFrame(rows, columns=[*columns, "question"]), "paper")
    found = alpha.effects(results, NAME)
    lines = [(one.part, one.line) for one in found if one.alpha == 0.3]
    assert lines == [
        ("regulation", "horizon 1"),
        ("regulation", "horizon 10"),
        ("regulation", "horizon 18"),
        ("regulation", "Algorithm 1"),
        ("filter", "with regulation, horizon 18"),
        ("filter", "without regulation"),
    ]
    assert len(found) == 6 * 5
    assert results.env(NAME)["kind"] == COVERAGE["kind"]
