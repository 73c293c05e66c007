"""Results in the form that marl-eval (Gorsane et al. 2022) reads, and rliable through it.

`{task: {study: {arm: {seed_0: {step_0: {step_count, metric: [value]}, ..., absolute_metrics: {metric: [value]}}}}}}`.
Points are those of the evaluation curve, `absolute_metrics` the final episodes. marl-eval allows no comma in the
name of an arm, so a semicolon takes its place.
"""

import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

from pipelines.export.tables import read_parquet
from pipelines.workspace.errors import InputError, visible
from pipelines.workspace.work_folder import whole
from reports.data.schema import METRICS, RUNS

EVAL, FINAL = "eval/", "final/"
Tree = dict[str, Any]


def export_marl_eval(study: str, runs: Path, out: Path) -> int:
    """Write `<study>.marl_eval.json` from a study's exported tables.

    marl-eval wants every run of a length, so runs that are not finished stay out, and one line says how many.

    Args:
        study: its name.
        runs: folder of the tables.
        out: folder, made when missing.

    Returns:
        0 every planned run is in it, 1 some are not.

    Raises:
        InputError: there are no tables of this study, or no finished run, or two arms differ in a comma alone.
        StoreError: they cannot be read, or the folder cannot be written to.
    """
    planned = read_parquet(runs / f"{study}.runs.parquet", RUNS, "a study's runs")
    rows = read_parquet(runs / f"{study}.parquet", METRICS, "a study's results")
    finished = {(run["arm"], run["seed"]): run["task"] for run in planned if run["status"] == "finished"}
    if not finished:
        why = "no finished run" if planned else "no tables of this study; `rhmc export` writes them"
        raise InputError(f"{runs / study}.parquet: {why}")
    arms = {arm for arm, _ in finished}
    if clash := [arm for arm in arms if "," in arm and arm.replace(",", ";") in arms]:
        raise InputError(
            f"{study}: arm '{clash[0]}' and the one with ';' for ',' would be one for marl-eval; rename one"
        )
    with whole(out / f"{study}.marl_eval.json") as part:
        part.write_text(json.dumps(_tree(study, rows, finished), indent=1, ensure_ascii=False), encoding="utf-8")
    if left := len(planned) - len(finished):
        print(visible(f"{study}: {left} of {len(planned)} runs are not finished and left out"), file=sys.stderr)
    return 1 if left else 0


def _tree(study: str, rows: list[dict[str, Any]], finished: dict[tuple[str, int], str]) -> Tree:
    points: dict[tuple[str, int], dict[int, Tree]] = defaultdict(lambda: defaultdict(dict))
    finals: dict[tuple[str, int], Tree] = defaultdict(dict)
    for row in rows:
        run, metric = (row["arm"], row["seed"]), row["metric"]
        if metric.startswith(EVAL):
            points[run][row["step"]][metric.removeprefix(EVAL)] = [row["value"]]
        elif metric.startswith(FINAL):
            finals[run][metric.removeprefix(FINAL)] = [row["value"]]
    tree: Tree = {}
    for (arm, seed), task in sorted(finished.items()):
        curve = enumerate(sorted(points[arm, seed].items()))
        steps = {f"step_{i}": {"step_count": step} | values for i, (step, values) in curve}
        runs = tree.setdefault(task, {}).setdefault(study, {}).setdefault(arm.replace(",", ";"), {})
        runs[f"seed_{seed}"] = steps | {"absolute_metrics": finals[arm, seed]}
    return tree
