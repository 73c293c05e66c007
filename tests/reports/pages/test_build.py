"""The report as files: what is in them, the same bytes twice, nothing half-written."""

import json
import os
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.text import Text

from reports.claims.evidence import VERDICTS
from reports.data.frame import TableError, load
from reports.data.paper import read
from reports.pages import build as report
from reports.pages.build import build, write_report
from reports.render import figures, tables
from tests.reports.factory import (
    NAVIGATION,
    YARDSTICK_RETURNS,
    methods,
    noisy,
    reporting,
    study,
    theorem,
    write,
    yardsticks,
)

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    ablation = {"full": [69.0, 70.0, 74.0], "no regulation": noisy(60), "no filter": noisy(64), "IQL": noisy(62)}
    return write(
        methods(tmp_path_factory.mktemp("tables")),
        study("ablation", ablation),
        study("coverage", {"RHMC": noisy(67.2), "IQL": noisy(63)}),
        study("navigation", {"RHMC": noisy(-25), "IQL": noisy(-30)}, env=NAVIGATION, start=-60),
        yardsticks(),
        theorem(),
    )


@pytest.fixture(scope="module")
def made(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("report")
    build(runs, out, "quick")
    return out


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tables that are quickly reported on."""
    return write(tmp_path_factory.mktemp("few"), study("coverage", {"RHMC": noisy(67), "IQL": noisy(63)}, points=4))


@pytest.fixture(scope="module")
def little(few: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Their report. Not to be changed."""
    out = tmp_path_factory.mktemp("little")
    build(few, out, "quick")
    return out


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_every_file_is_there(made: Path) -> None:
    found = set(content(made))
    assert {f"figures/fig_{n}.{kind}" for n in (6, 7, 10) for kind in ("png", "pdf", "csv")} < found
    names = ("table_1", "table_2", "final_ablation", "final_coverage", "final_navigation", "yardsticks", "runs")
    assert {f"tables/{name}.{kind}" for name in names for kind in ("md", "csv", "tex")} < found
    assert {"claims.md", "claims.csv", "claims.json", "index.md"} < found
    studies = ("ablation", "coverage", "navigation")
    for kind in ("steadiness", "pairs"):
        assert {f"tables/{kind}_{study}.md" for study in studies} < found
    assert {"tables/efficiency_ablation.md", "tables/efficiency_coverage.md", "tables/theorem.md"} < found
    assert {"figures/better_ablation.png"} | {f"figures/profile_{study}.png" for study in studies} < found
    assert "index.html" in found


def test_the_same_bytes_in_another_process_with_other_settings(runs: Path, made: Path, tmp_path: Path) -> None:
    (tmp_path / "matplotlibrc").write_text("font.size: 20\nsavefig.dpi: 50\npdf.compression: 1\n")
    out = tmp_path / "report"
    env = os.environ | {"PYTHONHASHSEED": "7", "MATPLOTLIBRC": str(tmp_path), "TZ": "Asia/Tokyo"}
    call = reporting(runs, out)
    said = subprocess.run(call, cwd=ROOT, env=env, check=True, capture_output=True, text=True).stdout
    assert said == f"{len(content(out))} files; start with {out / 'index.html'}\n"
    first, second = content(made), content(out)
    assert [name for name in first if first[name] != second.get(name)] == []


def test_index(made: Path) -> None:
    text = (made / "index.md").read_text()
    parts = [
        "## Figures",
        "## The paper's claims",
        "## Table 1",
        "## Table 2",
        "## Yardsticks",
        "## Definitions",
        "## What is",
    ]
    assert [text.index(part) for part in parts] == sorted(text.index(part) for part in parts)
    assert "no such arm yet: HiT-MAC, QMIX, COMA, MAPPO, MADDPG" in text
    assert "code `0123456789ab`, commit `c0ffee`" in text
    assert "mean over seeds of final/return" in text
    linked = [part.split(")")[0] for part in text.split("](")[1:]]
    assert [link for link in linked if not link.startswith("#") and not (made / link).exists()] == []


def test_the_few_numbers_that_reports_are_compared_by(made: Path, runs: Path) -> None:
    found, claims = (json.loads((made / name).read_text()) for name in ("metrics.json", "claims.json"))
    counts = Counter(claim["verdict"] for claim in claims)
    assert found["verdicts"] == {verdict: counts[verdict] for verdict in VERDICTS}
    assert sum(found["verdicts"].values()) == len(claims) == 23
    results = load(runs, "quick")
    finished = results.runs[results.runs["study"].isin(results.studies)]["status"].eq("finished").sum()
    assert found["runs"]["finished"] == finished <= found["runs"]["planned"]
    assert list(found["finals"]) == ["navigation", "coverage", "ablation"]
    assert found["finals"]["ablation"]["full"] == pytest.approx(results.finals("ablation", "full").mean(), abs=1e-4)
    for name, finals in found["finals"].items():
        assert list(finals) == [arm for arm in results.arms(name) if len(results.finals(name, arm))]


def test_claims_as_json(made: Path) -> None:
    found = {claim["id"]: claim for claim in json.loads((made / "claims.json").read_text())}
    assert len(found) == 23
    assert found["C8a"]["verdict"] == "reproduced"
    assert found["C8a"]["provisional"] is True
    assert found["C8a"]["ours"]["full"]["value"] == pytest.approx(71.0)
    assert found["C8b"]["verdict"] == "not reproduced"
    assert found["C8a"]["commands"] == [
        "rhmc study run studies/ablation.yaml --profile quick && rhmc export studies/ablation.yaml --profile quick && "
        "rhmc report --profile quick"
    ]
    lost = found["C13"]["ours"]["4 x 3 x 5: % lost"]
    assert lost == {"value": 4.0, "low": None, "high": None, "n": 1, "range": False}
    assert found["C8a"]["ours"]["full"]["range"] is True


def test_table_1(runs: Path, made: Path) -> None:
    table = tables.table_1(load(runs, "quick"))
    rows = table.numbers.set_index("name")
    assert list(rows.index) == ["RHMC", "IQL"]
    assert rows.loc["IQL", "actions"] == "discrete, continuous"
    assert rows.loc["IQL", ["critic", "execution"]].tolist() == ["critic of IQL", "execution of IQL"]
    counted = ["coverage_mlp_acting", "coverage_mlp_all", "navigation_pairwise_acting", "navigation_pairwise_all"]
    assert rows.loc["RHMC", counted].tolist() == [1010, 3000, 1025, 3003]
    shown = table.shown.set_index("Method")
    assert shown.loc["IQL", "Parameters, coverage (all)"] == "mlp 2,010 (6,000); pairwise 2,015 (6,001)"
    assert shown.loc["RHMC", "Parameters, navigation (all)"] == "mlp 1,020 (3,002); pairwise 1,025 (3,003)"
    assert shown.loc["RHMC", ["Source", "Actions"]].tolist() == ["source of RHMC", "discrete"]
    assert "coverage flat, 4 sensors x 5 targets and navigation, 3 agents" in table.note
    text = (made / "index.md").read_text()
    assert f"## Table 1: the methods\n\n{table.note}\n\n{table.markdown()}\n" in text


def test_a_report_without_animations_says_so(little: Path) -> None:
    assert "- Animations: none; `rhmc render --out` writes them." in (little / "index.md").read_text()


def test_a_report_without_methods_says_so(little: Path) -> None:
    text = (little / "index.md").read_text()
    assert "- Table 1: no methods; `rhmc methods --out` writes them.\n" in text
    assert "## Table 1" not in text
    assert not (little / "tables" / "table_1.md").exists()


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"a": 1}', '[{"kind": "x"}]'])
def test_faulty_methods_are_named(tmp_path: Path, text: str) -> None:
    write(tmp_path, study("coverage", {"RHMC": noisy(67)}, points=4))
    (tmp_path / "methods.json").write_text(text)
    with pytest.raises(TableError, match=r"^methods\.json: not the methods as `rhmc methods --out` writes them"):
        load(tmp_path, "quick")


def test_table_2(runs: Path) -> None:
    table = tables.table_2(load(runs, "quick"), read())
    rows = table.numbers.set_index("arm")
    assert list(rows.index) == ["full", "no regulation", "no filter", "IQL"]
    assert rows["mean"].tolist() == pytest.approx([71, 60, 64, 62])
    assert (rows["mean_low"]["full"], rows["mean_high"]["full"]) == (69, 74)
    assert rows["change"].tolist()[1:] == pytest.approx([100 * (x / 71 - 1) for x in (60, 64, 62)])
    assert rows["paper_change_recomputed"].tolist()[1:3] == pytest.approx([-49.504, -21.844], abs=1e-3)
    assert rows["paper_change_stated"].tolist()[1:3] == [-50.9, -21.4]
    assert rows["probability_full_better"].tolist()[1:] == [1, 1, 1]
    shown = table.shown.set_index("Method")
    assert shown.loc["Full RHMC", f"Ours: final {tables.SPAN}"] == "71.0 (69.0 to 74.0)"
    assert shown.loc["IQL", "Paper: final"] == tables.NONE


def test_table_2_shows_a_missing_arm_as_missing(tmp_path: Path) -> None:
    points, runs = study("ablation", {"full": noisy(70), "no filter": noisy(60, spread=0)})
    points = points[(points["arm"] == "full") | (points["seed"] == 0)]
    runs = runs.assign(status=["finished"] * 4 + ["missing"] * 2)
    folder = write(tmp_path, (points, runs))
    table = tables.table_2(load(folder, "quick"), read())
    rows, shown = table.numbers.set_index("arm"), table.shown.set_index("Method")
    assert np.isnan(rows.loc["no regulation", ["mean", "change", "iqm"]].astype(float)).all()
    assert shown[f"Ours: final {tables.SPAN}"]["Without regulation mechanism"] == "–"
    assert shown["Seeds"]["Without regulation mechanism"] == "missing"
    assert shown.loc["Without target-conditioned filter", "Seeds"] == "1 of 3"
    assert shown.loc["Without target-conditioned filter", f"Ours: final {tables.SPAN}"] == "60.0"  # a seed, no interval


def test_final_table_is_in_order_of_the_mean(runs: Path) -> None:
    table = tables.finals(load(runs, "quick"), "ablation")
    assert table.shown["Arm"].tolist() == ["full", "no filter", "IQL", "no regulation"]
    assert "\\begin{tabular}" in table.latex()
    assert "95 \\%" in table.latex()


def test_yardsticks_table(runs: Path) -> None:
    table = tables.yardsticks(load(runs, "quick"))
    assert dict(zip(table.numbers["policy"], table.numbers["final/return"], strict=True)) == YARDSTICK_RETURNS
    assert table.shown["Policy"].tolist()[-1] == "free heading (bound)"
    assert table.shown["Return"].tolist()[-1] == "86.4 (0.30)"


def test_numbers_of_a_figure(made: Path) -> None:
    rows = pd.read_csv(made / "figures" / "fig_10.csv")
    full = rows[(rows["kind"] == "curve") & (rows["name"] == "full")]
    assert len(full) == 21
    assert full["value"].iloc[-1] == pytest.approx(71)
    assert full["seeds"].tolist() == [3] * 21
    assert rows[rows["kind"] == "paper"].set_index("name")["value"].to_dict() == {
        "full": 70.5,
        "no regulation": 35.6,
        "no filter": 55.1,
    }
    lines = rows[rows["kind"] == "yardstick"].set_index("name")["value"].to_dict()
    assert lines == YARDSTICK_RETURNS


def test_a_figure_says_what_made_it(runs: Path) -> None:
    results, spec = load(runs, "quick"), read().figures["fig_10"]
    drawing = figures.learning_curves(results, spec)
    assert drawing is not None
    texts = [text.get_text() for text in texts_of(drawing)]
    footer = next(text for text in texts if text.startswith("profile"))
    assert footer.startswith("profile: quick, 150 k steps, 3 seeds  ·  code 0123456789ab")
    assert "fewer than 5 seeds" in footer
    for words in ("full (3 seeds)", "full 71.0", "best window 65.3", "free heading (bound) 86.4", "paper, full: 70.5"):
        assert words in texts


def test_an_unfinished_arm_in_a_figure(tmp_path: Path) -> None:
    points, runs = study("ablation", {"full": noisy(70), "no filter": noisy(60)})
    late = (points["arm"] == "no filter") & (points["step"] > 75_000)
    status = ["finished"] * 3 + ["partial"] * 3
    results = load(write(tmp_path, (points[~late], runs.assign(status=status))), "quick")
    drawing = figures.learning_curves(results, read().figures["fig_10"])
    assert drawing is not None
    texts = [text.get_text() for text in texts_of(drawing)]
    assert "no filter (0 of 3 seeds)" in texts
    assert "no filter, unfinished" in texts
    rows = drawing.numbers
    assert rows[rows["name"] == "no filter"]["step"].max() == 75_000


def texts_of(drawing: figures.Drawing) -> list[Text]:
    """Every piece of text in a figure."""
    return [found for found in drawing.figure.findobj(Text) if isinstance(found, Text)]


def overlaps(drawing: figures.Drawing) -> list[tuple[str, str]]:
    """Pairs of words that lie on each other."""
    ticks = [  # some lie outside the axes and are not drawn
        tick for axes in drawing.figure.axes for tick in (*axes.get_xticklabels(), *axes.get_yticklabels())
    ]
    found = [text for text in texts_of(drawing) if text.get_visible() and text.get_text() and text not in ticks]
    boxes = [(text.get_text(), text.get_window_extent()) for text in found]
    return [(a, b) for n, (a, box) in enumerate(boxes) for b, other in boxes[:n] if box.overlaps(other)]


def test_no_words_lie_on_each_other(tmp_path: Path) -> None:
    levels = ("HiT-MAC", "QMIX", "VDN", "IQL", "COMA", "MAPPO", "IPPO", "MADDPG")
    arms = {"RHMC": noisy(61), **{arm: noisy(60 - n / 10) for n, arm in enumerate(levels)}}
    results = load(write(tmp_path, study("coverage", arms), yardsticks()), "quick")
    drawing = figures.learning_curves(results, read().figures["fig_7"])
    assert drawing is not None
    drawing.figure.canvas.draw()
    assert overlaps(drawing) == []


@settings(deadline=None)
@given(st.lists(st.floats(-0.5, 1.5), max_size=20))
def test_spread(heights: list[float]) -> None:
    placed = figures.spread(heights, 0.04, 0.0, 1.0)
    assert np.argsort(placed, kind="stable").tolist() == np.argsort(heights, kind="stable").tolist()
    assert all(b - a >= 0.04 - 1e-9 for a, b in zip(sorted(placed), sorted(placed)[1:], strict=False))
    assert all(-1e-9 <= y <= 1 + 1e-9 for y in placed)


def test_spread_leaves_alone_what_is_apart() -> None:
    assert figures.spread([0.5, 0.1, 0.9], 0.04, 0, 1) == pytest.approx([0.5, 0.1, 0.9])
    assert figures.spread([0.5, 0.5], 0.04, 0, 1) == pytest.approx([0.48, 0.52])


@pytest.mark.usefixtures("unpainted")
def test_a_study_that_is_not_there(tmp_path: Path) -> None:
    out = tmp_path / "out"
    build(write(tmp_path / "runs", study("coverage", {"RHMC": noisy(67), "IQL": noisy(63)})), out, "quick")
    assert sorted(path.name for path in (out / "figures").glob("*.png")) == ["fig_7.png", "profile_coverage.png"]
    text = (out / "index.md").read_text()
    assert "Study `ablation`: no results." in text
    assert "## Table 2" not in text


def test_faulty_tables_leave_the_old_report(few: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert len(build(few, out, "quick").files) == len(content(out))
    before = content(out)
    assert write_report(few, out, "paper") == "refused"
    lines = capsys.readouterr().err.splitlines()
    assert "made with profile 'quick', and this report is of 'paper'" in lines[0]
    assert write_report(tmp_path / "no", out) == "refused"
    assert content(out) == before


def test_a_failure_half_way_leaves_the_old_report(
    few: Path, little: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = Path(shutil.copytree(little, tmp_path / "out"))
    before = content(out)
    monkeypatch.setattr(report.index, "page", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        build(few, out, "quick")
    assert content(out) == before


@pytest.mark.usefixtures("unpainted")
def test_a_rebuild_removes_what_is_no_more(little: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(little, tmp_path / "out"))
    (out / "runs").mkdir()
    keep = out / "runs" / "a.txt"
    keep.write_text("mine")
    assert (out / "figures" / "fig_7.png").exists()
    build(write(tmp_path / "other", study("other", {"RHMC": noisy(67)})), out, "quick")
    assert not (out / "figures" / "fig_7.png").exists()
    assert keep.read_text() == "mine"


def test_an_unreadable_table_is_an_error_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "x.parquet").write_bytes(b"")
    with pytest.raises(TableError):
        build(tmp_path, tmp_path / "out", "quick")
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("unpainted")
def test_a_study_that_the_paper_does_not_have_gets_its_curves(runs: Path, tmp_path: Path) -> None:
    for part in ("", ".runs"):
        table = pd.read_parquet(runs / f"coverage{part}.parquet").assign(study="reach")
        table.to_parquet(tmp_path / f"reach{part}.parquet")
    build(tmp_path, tmp_path / "out", "quick")
    assert (tmp_path / "out" / "figures" / "curves_reach.png").exists()
    assert "![Study reach: learning curves](figures/curves_reach.png)" in (tmp_path / "out" / "index.md").read_text()


@pytest.mark.usefixtures("unpainted")
def test_tables_of_an_older_version_are_set_aside_and_the_page_says_so(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    folder = tmp_path / "runs"
    shutil.copytree(runs, folder)
    said = "made by an older version and set aside, until `rhmc study run` and `rhmc export` make them anew"
    assert write_report(folder, tmp_path / "out") == "whole"
    assert said not in capsys.readouterr().err + (tmp_path / "out" / "index.md").read_text()
    pd.read_parquet(folder / "coverage.runs.parquet").to_parquet(folder / "coverage.runs.parquet")
    assert write_report(folder, tmp_path / "out") == "whole"
    assert capsys.readouterr().err == f"note: Tables of coverage: {said}.\n"
    assert f"**Tables of coverage: {said}.**" in (tmp_path / "out" / "index.md").read_text()
    assert f"Tables of coverage: {said.replace('`', '')}." in (tmp_path / "out" / "index.html").read_text()


def test_steadiness_is_best_and_last_of_the_mean_curve(runs: Path) -> None:
    results = load(runs, "quick")
    row = tables.steadiness(results, "coverage").numbers.iloc[0]
    points = results.curve("coverage", row["arm"])
    means = points.groupby("step")["value"].mean()
    assert row["best"] == pytest.approx(means.max())
    assert row["best_step"] == means.idxmax()
    assert row["last"] == pytest.approx(means.iloc[-1])
    assert row["fall"] == pytest.approx(means.max() - means.iloc[-1])
    assert row["quarter_step"] == min(step for step in means.index if 4 * step >= means.index[-1])
    falls = [seed["value"].max() - seed["value"].iloc[-1] for _, seed in points.groupby("seed")]
    assert row["largest_fall_of_a_seed"] == pytest.approx(max(falls))
