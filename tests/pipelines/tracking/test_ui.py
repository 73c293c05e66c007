"""The view of MLflow: names, saved views, and the parent run of a study."""

import base64
import csv
import io
import json
import re
import zlib
from pathlib import Path
from typing import Any

import mlflow
import pytest
from PIL import Image

from pipelines.conformance.blocks import fitted, nested
from pipelines.specs.safe_names import HEADLINES, full, shown
from pipelines.specs.study import Setting
from pipelines.tracking import arm_colours, mlflow_tracker, overview, saved_views
from pipelines.tracking.mlflow_tracker import MlflowTracker, addresses
from pipelines.tracking.overview import Overview, Run, figure, so_far, table
from pipelines.tracking.plan import study_card
from pipelines.tracking.tracker import Card, StudyCard, points_of
from pipelines.workspace.work_folder import Home
from rhmc.algorithms import ALGORITHMS
from tests.memory_tracker import MemoryRun, MemoryTracker
from tests.pipelines.support import plan, setting, tiny

PARAMS = {"iql": ["algo.lr", "seed"], "rhmc": ["algo.lr", "algo.alpha", "seed"]}
STUDY = StudyCard("demo", "quick", "Why?\n\n- **slow**: the base", PARAMS, ["slow", "fast"])
CARD = Card("full", 3, "5pec", "c0de", "iql", "coverage", "abc", {"method": "iql", "algo.lr": "0.1", "seed": "3"})
POINT = {
    "step": 0.0,
    "eval/return": 1.0,
    "eval/coverage": 2.0,
    "eval/return_sem": 0.1,
    "train/loss": 3.0,
    "final/return": 4.0,
    "time/steps_per_second": 50.0,
    "time/seconds": 1.0,
}


# Names


def test_headlines_stand_alone_and_the_rest_in_groups(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    log = tracker.start(CARD)
    log.log([POINT])
    names = set(tracker.client.get_run(log.ref).data.metrics)
    assert {name for name in names if "/" not in name} == {"return", "coverage", "steps_per_second"}
    assert names >= {"eval/return_sem", "train/loss", "final/return", "time/seconds"}
    assert points_of(tracker.rows([log.ref])) == [POINT]
    assert points_of(tracker._rows_client([log.ref])) == [POINT]


def test_a_log_with_the_former_names_is_read_and_continued_without_doubles(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    log = tracker.start(CARD)
    tracker.client.log_metric(log.ref, "eval/return", 1.0, step=0)
    again = MlflowTracker(STUDY, Home(home)).start(CARD)
    again.log([{"step": 0.0, "eval/return": 1.0}, {"step": 8.0, "eval/return": 2.0}])
    assert [(row.step, row.metric, row.value) for row in tracker.rows([log.ref])] == [
        (0, "eval/return", 1.0),
        (8, "eval/return", 2.0),
    ]
    assert tracker.client.get_run(log.ref).data.metrics == {"eval/return": 1.0, "return": 2.0}
    assert tracker.rows([log.ref], {"eval/return"}) == tracker.rows([log.ref])


@pytest.mark.parametrize("metric", [*HEADLINES.values(), "train/loss", "final/return"])
def test_a_name_comes_back(metric: str) -> None:
    assert full(shown(metric)) == metric
    assert full(metric) == metric


# Saved views


def unpacked(tag: str) -> dict[str, Any]:
    """The state in the value of a tag, as the web interface reads it."""
    envelope = json.loads(tag)
    kind, packed = envelope["state"].split(";", 1)
    assert kind == "deflate"
    assert isinstance(envelope["name"], str)
    assert isinstance(envelope["createdAt"], int)
    state: dict[str, Any] = json.loads(zlib.decompress(base64.b64decode(packed)))
    return state


def test_a_view_is_a_tag_that_unpacks_to_its_state() -> None:
    for view in saved_views.views(PARAMS, STUDY.arms):
        assert unpacked(view.written(5)) == view.state
        assert len(view.written(5)) < 20_000  # what MLflow takes
        assert view.written(5) == view.written(5)


def test_charts_are_grouped_by_arm_and_show_the_headlines_first() -> None:
    curves, finals, every = saved_views.views(PARAMS, STUDY.arms)
    for view in (curves, finals):
        assert view.state["groupBy"]["groupByKeys"] == [{"mode": "tag", "groupByData": "legend"}]
    assert every.state["groupBy"] is None
    for view in (curves, finals, every):  # the best run first
        assert (view.state["orderByKey"], view.state["orderByAsc"]) == ("metrics.`final/return`", False)
    charts = [chart for chart in curves.state["compareRunCharts"] if chart["type"] == "LINE"]
    assert all((chart["lineSmoothness"], chart["useGlobalLineSmoothing"]) == (0, False) for chart in charts)
    assert [chart["metricKey"] for chart in charts] == [
        "return",
        "coverage",
        "landmarks_covered",
        "collisions",
        "steps_per_second",
    ]
    assert curves.state["groupsExpanded"] == {"tag.legend.slow": False, "tag.legend.fast": False}
    columns = finals.state["columnOrder"]
    assert columns[:3] == ["attributes.`Run Name`", "runDateAndNestInfo", "metrics.`final/return`"]
    assert columns.index("params.`algo.alpha`") < columns.index("metrics.`steps_per_second`")
    assert set(columns) - set(finals.state["selectedColumns"]) == {*columns[:2], "duration"}


def parallel(params: dict[str, list[str]]) -> dict[str, list[str]]:
    """The axes of each chart of parallel coordinates, by its section."""
    state = saved_views.views(params)[-1].state
    names = {section["uuid"]: section["name"] for section in state["compareRunSections"]}
    charts = [chart for chart in state["compareRunCharts"] if chart["type"] == "PARALLEL"]
    assert all(chart["selectedMetrics"] == ["final/return"] for chart in charts)
    return {names[chart["metricSectionId"]]: chart["selectedParams"] for chart in charts}


def test_no_run_is_left_out_of_the_parallel_coordinates_for_a_setting_that_it_has_not() -> None:
    assert parallel(PARAMS) == {
        "Every run": ["method", "algo.lr", "seed"],
        "Every run of rhmc": ["algo.lr", "algo.alpha", "seed"],
    }
    assert parallel({"A": ["algo.alpha"], "B": ["algo.lr"]}) == {
        "Every run": ["method"],
        "Every run of A": ["algo.alpha"],
        "Every run of B": ["algo.lr"],
    }
    assert parallel({"rhmc": ["algo.alpha", "seed"]}) == {"Every run": ["method", "algo.alpha", "seed"]}


def test_a_view_of_a_thousand_arms_still_fits_into_a_tag() -> None:
    arms = [f"RHMC, alpha={k}, agents={k}, horizon={k}" for k in range(1000)]
    assert all(len(view.written(5)) < 20_000 for view in saved_views.views(PARAMS, arms))


def test_what_varies_is_told_by_method() -> None:
    arms = {"slow": setting(lr=1e-4), "fast": setting(lr=1e-2), "other": of_kind("rhmc", lr=1e-2)}
    assert study_card(tiny(arms=arms)).params == {"iql": ["algo.lr"], "rhmc": ["algo.lr"]}
    arms["held"] = of_kind("rhmc", lr=1e-2, assignment_period=3)
    assert study_card(tiny(arms=arms)).params == {"iql": ["algo.lr"], "rhmc": ["algo.lr", "algo.assignment_period"]}
    assert list(study_card(tiny(arms=arms)).arms) == ["slow", "fast", "other", "held"]


def of_kind(kind: str, **algo: Any) -> Setting:
    """The tiny task with another method."""
    config = ALGORITHMS[kind].config
    few = fitted(config, {"learning_starts": 64, "batch_size": 32})
    return setting().model_copy(update={"algo": config.model_validate({"kind": kind, **nested(few), **algo})})


def seen(text: str) -> str:
    """A text without what is not seen of it."""
    return "".join(letter for letter in text if letter not in arm_colours.MARKS)


@pytest.mark.parametrize(("name", "colour"), [("tag.variant.IQL", "#facb66"), ("tag.variant.no regulation", "#facb66")])
def test_the_hash_is_that_of_mlflow(name: str, colour: str) -> None:
    assert arm_colours.PALETTE[arm_colours._hash(name) % len(arm_colours.PALETTE)] == colour  # as its page showed them


def names(state: Any) -> set[str]:
    """The keys of a view's state that are MLflow's own."""
    if isinstance(state, list):
        return set().union(*map(names, state))
    inner = set(state) | names(list(state.values())) if isinstance(state, dict) else set()
    return {name for name in inner if name.isidentifier()}


def test_the_pinned_interface_knows_the_form_of_views_and_colours() -> None:
    """It is documented nowhere: where this fails after a new pin, both modules need a look."""
    built = Path(mlflow.__file__).parent / "server/js/build/static/js"
    code = "".join(file.read_text(encoding="utf-8") for file in built.rglob("*.js"))
    states = [view.state for view in saved_views.views(PARAMS, STUDY.arms)]
    wanted = {saved_views.TAG, "viewStateShareKey", "compareRunsMode", arm_colours.COLOUR, *names(states)}
    assert len(wanted) > 30
    assert {word for word in wanted if word not in code} == set()
    assert json.dumps(arm_colours.PALETTE, separators=(",", ":")) in code
    assert re.search(r"%255,(\w)=\(\1\+(\w)\)%255;return [\w.]+\[\(\2\|\1<<8\)%[\w.]+\.length\]", code)


def test_every_arm_has_a_colour_of_its_own_and_reads_as_before() -> None:
    arms = [f"RHMC, alpha={k}" for k in range(29)]
    legends = [arm_colours.legend(arm, place) for place, arm in enumerate(arms)]
    assert list(map(seen, legends)) == arms
    hashed = [arm_colours.PALETTE[arm_colours._hash(arm_colours.group(name)) % 29] for name in legends]
    assert hashed == [arm_colours.colour(place) for place in range(29)]
    assert len(set(hashed)) == 29
    assert arm_colours.colour(29) == arm_colours.colour(0)


def looks(tracker: MlflowTracker) -> dict[str, tuple[str, str]]:
    """Legend and colour of the runs, by arm."""
    tags = [run.data.tags for run in tracker._search("tags.role = 'run'")]
    return {one["arm"]: (one["legend"], one.get("mlflow.runColor", "")) for one in tags}


def test_an_arm_keeps_its_colour_when_the_study_is_extended(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    for arm in ("slow", "fast", "unplanned"):
        tracker.start(CARD._replace(arm=arm, spec_id=arm))
    first = looks(tracker)
    assert first == {
        "slow": (arm_colours.legend("slow", 0), arm_colours.colour(0)),
        "fast": (arm_colours.legend("fast", 1), arm_colours.colour(1)),
        "unplanned": ("unplanned", ""),
    }
    tracker = MlflowTracker(STUDY._replace(arms=["new", "fast", "slow"]), Home(home))
    tracker.start(CARD._replace(arm="new", spec_id="new"))
    assert looks(tracker) == first | {"new": (arm_colours.legend("new", 2), arm_colours.colour(2))}


@pytest.mark.parametrize("view", saved_views.views({"iql": ["seed"]}), ids=lambda view: view.key)
def test_every_chart_is_in_a_section_and_has_a_name_of_its_own(view: saved_views.View) -> None:
    sections = [section["uuid"] for section in view.state.get("compareRunSections", [])]
    charts = view.state.get("compareRunCharts", [])
    assert {chart["metricSectionId"] for chart in charts} <= set(sections)
    assert len({chart["uuid"] for chart in charts}) == len(charts)
    assert len(set(sections)) == len(sections)


def test_a_study_has_its_views_as_it_opens(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    tags = tracker.client.get_experiment(tracker.experiment).tags
    for view in saved_views.views(STUDY.params, [arm_colours.legend("slow", 0), arm_colours.legend("fast", 1)]):
        assert unpacked(tags[view.tag]) == view.state
    assert list(map(seen, unpacked(tags["mlflow.sharedViewState.rhmc-finals"])["groupsExpanded"])) == [
        "tag.legend.slow",
        "tag.legend.fast",
    ]
    found = addresses(tracker.uri, "http://127.0.0.1:5000")
    assert [(name, view) for name, view, _ in found] == [
        ("demo (quick)", "Curves by arm"),
        ("demo (quick)", "Finals by arm"),
        ("demo (quick)", "Every run"),
    ]
    start = f"http://127.0.0.1:5000/#/experiments/{tracker.experiment}/runs?workflowType=machine_learning"
    assert found[0][2] == f"{start}&viewStateShareKey=rhmc-curves&compareRunsMode=CHART"
    assert found[1][2] == f"{start}&viewStateShareKey=rhmc-finals&compareRunsMode=TABLE"


def test_a_study_that_was_logged_without_views_gets_them_when_it_is_shown(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    tracker.start(CARD)
    for view in saved_views.views({}):
        tracker.client.delete_experiment_tag(tracker.experiment, view.tag)
    assert len(addresses(tracker.uri, "")) == 3
    tags = tracker.client.get_experiment(tracker.experiment).tags
    state = unpacked(tags["mlflow.sharedViewState.rhmc-parallel"])
    assert sorted(state["compareRunCharts"][0]["selectedParams"]) == ["algo.lr", "method", "seed"]
    finals = unpacked(tags["mlflow.sharedViewState.rhmc-finals"])
    assert finals["groupBy"]["groupByKeys"] == [{"mode": "tag", "groupByData": "arm"}]


def test_views_pass_over_stale_runs_and_the_parent(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    refs = [tracker.start(CARD._replace(spec_id=spec_id)).ref for spec_id in ("1", "2")]

    def shown() -> set[str]:
        query = saved_views.views({})[0].state["searchFilter"]
        return {run.info.run_id for run in tracker.client.search_runs([str(tracker.experiment)], query)}

    assert shown() == set(refs)
    tracker.mark(refs[0], stale=True)
    assert shown() == {refs[1]}


def test_an_experiment_of_somebody_else_is_left_alone(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    theirs = tracker.client.create_experiment("theirs")
    assert {name for name, _, _ in addresses(tracker.uri, "")} == {"demo (quick)"}
    assert not any(tag.startswith(saved_views.TAG) for tag in tracker.client.get_experiment(theirs).tags)


def test_an_empty_file_is_not_made_a_store(tmp_path: Path) -> None:
    (tmp_path / "empty.db").touch()
    assert addresses(f"sqlite:///{tmp_path}/empty.db", "") == []
    assert (tmp_path / "empty.db").stat().st_size == 0


# The parent run

RUNS = [
    Run("full", 0, "finished", [(0, 1.0), (8, 3.0)], {"final/return": 60.0, "final/coverage": 61.0}),
    Run("full", 1, "finished", [(0, 2.0), (8, 5.0)], {"final/return": 64.0, "final/coverage": 65.0}),
    Run("full", 2, "running", [(0, 9.0)], {}),
    Run("no filter", 0, "finished", [(0, 0.0), (8, 1.0)], {"final/return": 50.0, "final/coverage": 51.0}),
    Run("no filter", 1, "failed", [], {}),
    Run("no filter", 2, None, [], {}),
]


def test_the_description_says_what_is_there_and_what_is_not() -> None:
    lines = so_far(RUNS).splitlines()
    assert "3 of 6 runs are finished; the highest mean final return is that of **full**." in so_far(RUNS)
    assert lines[-4] == "| arm | finished seeds | others | final return | final coverage |"
    assert lines[-3] == "|---|---|---|---|---|"
    assert lines[-2] == "| full | 0, 1 | running: 2 | 62.00 (60.00 to 64.00) | 63.00 (61.00 to 65.00) |"
    assert lines[-1] == "| no filter | 0 | failed: 1; missing: 2 | 50.00 | 51.00 |"


def test_nobody_is_ahead_before_two_arms_have_a_result() -> None:
    assert "0 of 1 runs are finished." in so_far(RUNS[-1:])
    assert "highest" not in so_far(RUNS[:3])


def test_a_bar_in_a_name_does_not_break_the_table() -> None:
    assert "| a\\|b | none | missing: 0 |" in so_far([Run("a|b", 0, None, [], {})])


def test_the_table_has_every_planned_run() -> None:
    rows = list(csv.reader(io.StringIO(table(RUNS))))
    assert rows[0] == ["arm", "seed", "status", "final/return", "final/coverage"]
    assert rows[1] == ["full", "0", "finished", "60.0", "61.0"]
    assert rows[-1] == ["no filter", "2", "missing", "", ""]
    assert len(rows) == 1 + len(RUNS)


def test_a_curve_is_of_the_finished_seeds_at_the_steps_that_all_have() -> None:
    assert overview._common(RUNS[:3]) == (2, [0, 8], [[1.0, 2.0], [3.0, 5.0]])
    begun = [run._replace(status="running") for run in RUNS[:3]]
    assert overview._common(begun) == (3, [0], [[1.0, 2.0, 9.0]])
    assert overview._common(RUNS[4:]) is None


def test_the_figure_is_a_picture_and_the_same_every_time() -> None:
    picture = figure(STUDY, RUNS)
    assert Image.open(io.BytesIO(picture)).size == (880, 495)
    assert figure(STUDY, RUNS) == picture


def test_the_overview_follows_a_launch_and_finds_what_an_earlier_one_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(overview, "PAUSE", 0.0)
    shelf: list[MemoryRun] = []
    runs = plan()
    slow, fast = runs
    tracker = MemoryTracker(STUDY, shelf)
    log = tracker.start(slow.card)
    log.log([{"step": 0.0, "eval/return": 1.0}, {"step": 8.0, "eval/return": 2.0, "final/return": 2.5}])
    log.finish("finished")

    tracker = MemoryTracker(STUDY, shelf)
    follows = Overview(STUDY, runs, tracker, tracker.recorded())
    follows.describe()
    assert tracker.files == {}
    assert tracker.note.startswith("Why?\n\n### So far\n\n1 of 2 runs are finished.")
    assert tracker.note.endswith("\n\n- **slow**: the base")
    assert "| slow | 0 |  | 2.50 |" in tracker.note
    assert "| fast | none | missing: 0 | – |" in tracker.note
    follows.points("fast", fast.key, [{"step": 0.0, "eval/return": 3.0}])
    follows.points("fast", fast.key, [{"step": 8.0, "eval/return": 4.0, "final/return": 4.5}])
    follows.ended("fast", fast.key, "finished")
    assert "| fast | 0 |  | 4.50 |" in tracker.note
    assert "**fast**" in tracker.note
    assert sorted(tracker.files) == ["curves.png", "finals.csv"]
    assert tracker.files["finals.csv"].decode().splitlines()[2] == "fast,0,finished,4.5"


def test_refreshes_keep_a_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    now, told = [100.0], []
    monkeypatch.setattr(overview.time, "monotonic", lambda: now[0])
    tracker = MemoryTracker(STUDY, [])
    monkeypatch.setattr(tracker, "publish", lambda note, files: told.append(now[0]))
    slow, fast = plan()
    follows = Overview(STUDY, [slow, fast], tracker, tracker.recorded())
    for now[0] in (100.0, 110.0, 129.0, 131.0):
        follows.ended("slow", slow.key, "failed")
    assert told == [100.0, 131.0]


def test_what_is_published_is_on_the_parent_run_and_replaces_the_former(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    tracker.publish("first", {"finals.csv": b"a\n"})
    tracker.publish("**second**\n\nmore", {"finals.csv": b"b\n"})
    note = tracker.client.get_run(tracker.parent).data.tags[mlflow_tracker.NOTE]
    where = f"#/experiments/{tracker.experiment}/runs?workflowType=machine_learning&viewStateShareKey=rhmc-curves"
    assert note.startswith(f"[Curves by arm]({where}&compareRunsMode=CHART) · [Finals by arm](")
    assert note.endswith(") · **second**\n\nmore")  # the views first: MLflow cuts the line at the window's width
    assert tracker.client.get_experiment(tracker.experiment).tags[mlflow_tracker.NOTE] == note
    kept = tracker.file(tracker.parent, "finals.csv", home)
    assert kept is not None
    assert kept.read_bytes() == b"b\n"
