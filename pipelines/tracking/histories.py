"""Metric histories through MLflow's client, of many runs at once where a server answers.

The client asks for one metric of one run at a time: 20 runs with 25 metrics are 500 requests. The page that MLflow's
own charts read gives a metric of up to a hundred runs. It is undocumented, so without it all goes the client's way.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import NamedTuple

from mlflow import MlflowClient
from mlflow.entities import Run
from mlflow.utils.credentials import get_default_host_creds
from mlflow.utils.rest_utils import http_request, verify_rest_response

PAGE = "/ajax-api/2.0/mlflow/metrics/get-history-bulk"
RUNS = 100  # that a request may name
VALUES = 25_000  # that an answer may hold; more are cut off


class Value(NamedTuple):
    """One logged value."""

    ref: str
    metric: str  # MLflow's name
    step: int
    value: float


class Histories:
    """Reads histories; of a run and metric, values come in the order in which they were logged.

    Args:
        client: of the store.
        uri: its address.
    """

    def __init__(self, client: MlflowClient, uri: str) -> None:
        self.client, self.uri = client, uri
        self.together = uri.startswith(("http://", "https://"))

    def of(self, runs: Iterable[Run], metrics: Collection[str] | None = None) -> Iterator[Value]:
        """Every value of these metrics of the runs, of all metrics if None."""
        having: dict[str, list[str]] = defaultdict(list)
        for run in runs:
            for metric in run.data.metrics:
                if metrics is None or metric in metrics:
                    having[metric].append(run.info.run_id)
        for metric, refs in having.items():
            for start in range(0, len(refs), RUNS):
                yield from self._some(metric, refs[start : start + RUNS])

    def _some(self, metric: str, refs: Sequence[str]) -> Iterator[Value]:
        found = self._page(metric, refs) if self.together else None
        if found is not None and len(found) < VALUES:
            yield from found
        elif found is not None and len(refs) > 1:
            yield from self._some(metric, refs[: len(refs) // 2])
            yield from self._some(metric, refs[len(refs) // 2 :])
        else:
            for ref in refs:
                yield from (Value(ref, metric, v.step, v.value) for v in self.client.get_metric_history(ref, metric))

    def _page(self, metric: str, refs: Sequence[str]) -> list[Value] | None:
        asked = {"run_id": list(refs), "metric_key": metric, "max_results": VALUES}
        answer = http_request(get_default_host_creds(self.uri), PAGE, "GET", params=asked)
        if answer.status_code == 404:
            self.together = False
            return None
        values = verify_rest_response(answer, PAGE).json()["metrics"]
        return [Value(v["run_id"], metric, int(v["step"]), float(v["value"])) for v in values]
