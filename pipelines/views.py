"""Saved views of MLflow's run page, written as code: what a study shows as it opens.

MLflow keeps a view as a tag of its experiment and opens it by an address. The form of both is its web interface's own
and documented nowhere: it belongs to the MLflow that is pinned, and a new pin needs a look at this module.
"""

import base64
import json
import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple

from pipelines.names import HEADLINES

TAG = "mlflow.sharedViewState."
RUNS = "tags.role = 'run'"  # the parent run has no curves
BY_ARM = {"aggregateFunction": "average", "groupByKeys": [{"mode": "tag", "groupByData": "variant"}]}
FINALS = ("final/return", "final/coverage", "final/landmarks_covered", "final/collisions")
CURVES, ENDS = "The headlines", "final"
FOLDED = ("eval", "train", "time", "Model metrics", "System metrics")  # sections of what no chart of ours shows

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
        """What opens it, after `#/experiments/<id>/runs?`."""
        return f"workflowType=machine_learning&viewStateShareKey={self.key}&compareRunsMode={self.mode}"

    def written(self, created: int) -> str:
        """The tag's value. created: milliseconds since 1970."""
        packed = base64.b64encode(zlib.compress(json.dumps(self.state).encode())).decode()
        envelope = {"name": self.name, "createdAt": created, "updatedAt": created, "state": f"deflate;{packed}"}
        return json.dumps(envelope)


def views(params: Sequence[str]) -> list[View]:
    """The views of a study whose runs differ in `params`."""
    return [
        View("rhmc-curves", "Curves by arm", "CHART", _base(params) | {"groupBy": BY_ARM} | _curves()),
        View("rhmc-finals", "Finals by arm", "TABLE", _base(params) | {"groupBy": BY_ARM}),
        View("rhmc-parallel", "Every run", "CHART", _base(params) | _parallel(params)),
    ]


def _base(params: Sequence[str]) -> State:
    """All runs of the study, the best first."""
    return {
        "searchFilter": RUNS,
        "orderByKey": _column("metrics", "final/return"),
        "orderByAsc": False,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "selectedColumns": _columns(params),
        "runsHiddenMode": "SHOW_ALL",
        "useGroupedValuesInCharts": True,
        "hideEmptyCharts": True,
        "isAccordionReordered": True,  # sections stay in the order that is written here
        "groupBy": None,
    }


def _column(kind: str, name: str) -> str:
    return f"{kind}.`{name}`"


def _columns(params: Sequence[str]) -> list[str]:
    metrics = [_column("metrics", name) for name in (*FINALS, *HEADLINES)]
    varying = [_column("params", name) for name in params if name != "seed"]
    return [*metrics, _column("params", "seed"), *varying, _column("attributes", "Models")]


def _curves() -> State:
    lines = [_chart("LINE", CURVES, name, displayPoints=False) for name in HEADLINES]
    bars = [_chart("BAR", ENDS, name) for name in FINALS]
    return {"compareRunSections": _sections(CURVES, ENDS), "compareRunCharts": lines + bars}


def _parallel(params: Sequence[str]) -> State:
    axes = {"selectedParams": list(params), "selectedMetrics": ["final/return"], "showAllRuns": True}
    chart = _chart("PARALLEL", ENDS, "every run") | axes
    return {"compareRunSections": _sections(ENDS, CURVES), "compareRunCharts": [chart, *_curves()["compareRunCharts"]]}


def _chart(kind: str, section: str, metric: str, **more: Any) -> State:
    """A card. Metrics without one get one from MLflow, in the section of their group."""
    fixed = {"type": kind, "uuid": f"rhmc-{kind}-{metric}", "metricSectionId": _section_id(section)}
    return fixed | {"metricKey": metric, "runsCountToCompare": 100, "deleted": False, "isGenerated": False} | more


def _sections(*shown: str) -> list[State]:
    return [
        {"uuid": _section_id(name), "name": name, "display": name in shown, "isReordered": False, "deleted": False}
        for name in (*shown, *FOLDED)
    ]


def _section_id(name: str) -> str:
    return f"rhmc-{name}"
