"""Saved views of MLflow's run page, written as code: what a study shows as it opens.

MLflow keeps a view as a tag of its experiment and opens it by an address. The form of both is its web interface's own
and documented nowhere: a test looks for it in the interface of the MLflow that is installed, and fails after a new pin
that has another.
"""

import base64
import json
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from pipelines.specs.plugins import finals
from pipelines.specs.safe_names import HEADLINES
from pipelines.tracking import arm_colours

TAG = "mlflow.sharedViewState."
STALE = "stale"  # the tag of runs that the latest plan of the study is without: other steps, other code
RUNS = f"tags.role = 'run' and tags.{STALE} IS NULL"  # the parent run has no curves
CURVES, ENDS, EVERY = "Curves", "Final values", "Every run"
FOLDED = (
    "eval",
    "final",
    "train",
    "time",
    "Model metrics",
    "System metrics",
)  # MLflow's own: what no chart of ours shows
NAME, BEGUN, DURATION, MODELS = (
    "attributes.`Run Name`",
    "runDateAndNestInfo",
    "duration",
    "attributes.`Models`",
)  # columns
LINE_HEIGHT, PARALLEL_HEIGHT = 360, 420  # pixels of a chart
NARROW, WIDE, LETTER, ROOM = 130, 400, 8, 40  # pixels: of a column, and of its text
SHOWN = 100  # runs, and so arms, of a page

Params = Mapping[str, Sequence[str]]  # what varies, by kind of run: by method, or by arm of a search
State = dict[str, Any]


class View(NamedTuple):
    """A view as MLflow keeps it."""

    key: str  # in the tag and the address
    name: str  # in the menu
    mode: str  # CHART or TABLE
    state: State

    @property
    def tag(self) -> str:
        """Of the experiment."""
        return TAG + self.key

    @property
    def query(self) -> str:
        """The query that opens it, after `#/experiments/<id>/runs?`."""
        return f"workflowType=machine_learning&viewStateShareKey={self.key}&compareRunsMode={self.mode}"

    def written(self, created: int) -> str:
        """The tag's value. created: milliseconds since 1970."""
        packed = base64.b64encode(zlib.compress(json.dumps(self.state).encode())).decode()
        envelope = {"name": self.name, "createdAt": created, "updatedAt": created, "state": f"deflate;{packed}"}
        return json.dumps(envelope)


def views(params: Params, legends: Sequence[str] = ()) -> list[View]:
    """The views of a study.

    Args:
        params: what varies between its runs.
        legends: of its arms, which the table shows as a line each. Without them runs are grouped by their arms' names.
    """
    legends = legends[:SHOWN]
    base, tag = _base(params, legends), arm_colours.TAG if legends else "arm"
    grouped = base | {
        "groupBy": {"aggregateFunction": "average", "groupByKeys": [{"mode": "tag", "groupByData": tag}]},
        "groupsExpanded": {arm_colours.group(name): False for name in legends},
    }
    return [
        View("rhmc-curves", "Curves by arm", "CHART", grouped | _curves()),
        View("rhmc-finals", "Finals by arm", "TABLE", grouped),
        View("rhmc-parallel", "Every run", "CHART", base | _parallel(params)),
    ]


def links(experiment: str) -> str:
    """The views of an experiment as Markdown for its description, whatever the server's address is."""
    return " · ".join(f"[{view.name}](#/experiments/{experiment}/runs?{view.query})" for view in views({}))


def _base(params: Params, legends: Sequence[str]) -> State:
    """All runs of the study, the best first, in columns that show what they are of."""
    names = [f"Group: {name} 10" for name in legends]
    columns = _columns(_names(params))
    return {
        "searchFilter": RUNS,
        "orderByKey": _column("metrics", "final/return"),
        "orderByAsc": False,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "selectedColumns": columns,
        "columnOrder": [NAME, BEGUN, *columns[:-1], DURATION, MODELS],
        "columnWidths": {NAME: _width(*names), BEGUN: NARROW} | {name: _width(name[9:]) for name in columns[:-1]},
        "runsHiddenMode": "SHOW_ALL",
        "useGroupedValuesInCharts": True,
        "hideEmptyCharts": True,
        "isAccordionReordered": True,  # sections stay in the order that is written here
        "groupBy": None,
    }


def _names(params: Params) -> list[str]:
    """The columns that vary in any kind of run."""
    return list(dict.fromkeys(name for names in params.values() for name in names))


def _column(kind: str, name: str) -> str:
    return f"{kind}.`{name}`"


def _columns(names: Sequence[str]) -> list[str]:
    """Final values, what varies, the speed; the models last."""
    ends = [_column("metrics", name) for name in finals()]
    varying = [_column("params", name) for name in ("method", *names) if name != "seed"]  # which a run's name says
    return [*ends, *varying, _column("metrics", "steps_per_second"), MODELS]


def _width(*texts: str) -> int:
    """Pixels for the longest of the texts."""
    return min(WIDE, max([NARROW, *(ROOM + LETTER * len(text) for text in texts)]))


def _curves() -> State:
    as_measured = {"lineSmoothness": 0, "useGlobalLineSmoothing": False, "displayPoints": False}
    lines = [_chart("LINE", CURVES, name) | as_measured for name in HEADLINES]
    bars = [_chart("BAR", ENDS, name) for name in finals()]
    shown = [_section(name, columns=2, cardHeight=LINE_HEIGHT) for name in (CURVES, ENDS)]
    return {"compareRunSections": [*shown, *_folded()], "compareRunCharts": lines + bars}


def _parallel(params: Params) -> State:
    """A chart of what all runs have, and one for each kind with more: MLflow leaves out runs that lack an axis."""
    common = [name for name in _names(params) if all(name in own for own in params.values())]
    axes = {EVERY: ["method", *common]}
    axes |= {f"{EVERY} of {kind}": list(own) for kind, own in params.items() if not set(own) <= {*common}}
    charts = [_chart("PARALLEL", name, name) | _axes(chosen) for name, chosen in axes.items()]
    wide = [_section(name, columns=1, cardHeight=PARALLEL_HEIGHT) for name in axes]
    rest = _curves()
    return {
        "compareRunSections": [*wide, *rest["compareRunSections"]],
        "compareRunCharts": [*charts, *rest["compareRunCharts"]],
    }


def _axes(params: Sequence[str]) -> State:
    return {"selectedParams": list(params), "selectedMetrics": ["final/return"], "showAllRuns": True}


def _chart(kind: str, section: str, metric: str) -> State:
    """A card. Metrics without one get one from MLflow, in the section of their group."""
    fixed = {"type": kind, "uuid": f"rhmc-{kind}-{metric}", "metricSectionId": _section_id(section)}
    return fixed | {"metricKey": metric, "runsCountToCompare": SHOWN, "deleted": False, "isGenerated": False}


def _section(name: str, **more: int) -> State:
    fixed = {"uuid": _section_id(name), "name": name, "display": name not in FOLDED}
    return fixed | {"isReordered": False, "deleted": False} | more


def _folded() -> list[State]:
    return [_section(name) for name in FOLDED]


def _section_id(name: str) -> str:
    return f"rhmc-{name}"
