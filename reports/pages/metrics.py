"""The few numbers of a report that two of them are compared by, such as in `dvc metrics diff`."""

from collections import Counter
from collections.abc import Mapping

from reports.claims.evidence import VERDICTS
from reports.pages.report import ORDER, Report

DIGITS = 4  # decimals of a final return: the spread over seeds is far wider


def metrics(report: Report) -> dict[str, Mapping[str, object]]:
    """Counts of verdicts and of runs, and the mean final return of each arm of the studies of the paper's figures.

    Every verdict has a count, so that a table of several reports has no holes. An arm without a finished run is left
    out.
    """
    results, counts = report.results, Counter[str](claim.verdict for claim in report.claims)
    runs = results.runs[results.runs["study"].isin(results.studies)]
    return {
        "verdicts": {verdict: counts[verdict] for verdict in VERDICTS},
        "runs": {"planned": len(runs), "finished": int((runs["status"] == "finished").sum())},
        "finals": {
            study: {
                arm: round(float(values.mean()), DIGITS)
                for arm in results.arms(study)
                if len(values := results.finals(study, arm))
            }
            for study in ORDER
            if study in results.studies
        },
    }
