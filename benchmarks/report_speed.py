"""Time and memory to build the whole report from synthetic exported runs. Prints a Markdown table.

The runs are made up, the report is not: every table, figure, claim and the page are written as from real ones. Memory
is the largest resident set of the process, the libraries included.
"""

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd

from pipelines.export.tables import write_parquet
from reports.data.frame import OWN, PLACE, POINTS, RUNS
from reports.data.schema import RUNS as EXPORTED
from reports.pages.build import build

STUDIES = ("ablation", "coverage", "reach", "scaling")
METHODS = ("RHMC", "HiT-MAC", "QMIX", "VDN", "IQL", "COMA", "MAPPO", "IPPO", "MADDPG", "RHMC, other")
ABLATION = ("full", "no regulation", "no filter", "IQL", "a", "b", "c", "d", "e", "f")
LOGGED = ("eval/return", "eval/coverage", "eval/return_sem", "train/assigned", "train/earned", "train/q", "train/r")
STEPS = 1_000_000


def tables(study: str, seeds: int, points: int, rng: np.random.Generator) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Points and plan of a study with ten arms, in the form of an export."""
    rows, plan = [], []
    at = np.linspace(0, STEPS, points + 1).round().astype(int)
    for n, arm in enumerate(ABLATION if study == "ablation" else METHODS):
        agents = 2 + n % 5 if study == "scaling" else 4
        name = f"{METHODS[n // 5]}, agents={agents}" if study == "scaling" else arm
        for seed in range(seeds):
            place = (study, name, seed, f"{study[:3]}{n:02d}{seed:02d}")
            level = 60 + n + rng.normal()
            curve = 30 + (level - 30) * (1 - np.exp(-at / 2e5)) + rng.normal(size=len(at))
            rows += [(*place, int(x), metric, float(y)) for metric in LOGGED for x, y in zip(at, curve, strict=True)]
            rows.append((*place, STEPS, "final/return", float(level)))
            env = {"kind": "coverage", "preset": "flat", "agents": agents, "targets": 5}
            config = json.dumps({"env": env, "trainer": {"steps": STEPS}, "seed": seed, "arm": name})
            made = ("finished", "rhmc", "coverage", "paper", config, "0123456789ab", "How fast?", "c0ffee", 600.0)
            plan.append((*place, *made, "", "", ""))
    return pd.DataFrame(rows, columns=list(POINTS)), pd.DataFrame(plan, columns=[*RUNS, *OWN])


def write(folder: Path, seeds: int, points: int) -> tuple[int, int]:
    """Write the studies to a folder; returns how many runs and how many rows."""
    rng, runs, rows = np.random.default_rng(0), 0, 0
    for study in STUDIES:
        values, plan = tables(study, seeds, points, rng)
        values.to_parquet(folder / f"{study}.parquet", index=False)
        write_parquet(folder / f"{study}.runs.parquet", EXPORTED, list(plan[EXPORTED.names].itertuples(index=False)))
        plan[[*PLACE, *OWN]].to_parquet(folder / f"{study}.made.parquet", index=False)
        runs, rows = runs + len(plan), rows + len(values)
    return runs, rows


def main() -> None:
    """Build once and print what it took."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="per arm; four studies of ten arms (default: 5, 200 runs)")
    parser.add_argument("--points", type=int, default=50, help="of each curve (default: 50)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        runs, rows = write(Path(folder), args.seeds, args.points)
        before, start = time.process_time(), time.perf_counter()
        files = build(Path(folder), Path(folder) / "report", "paper").files
        spent, wall = time.process_time() - before, time.perf_counter() - start
        size = sum(file.stat().st_size for file in files) / 2**20
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    print("| runs | rows | files | MiB written | CPU s | wall s | peak memory, MiB |\n|---|---|---|---|---|---|---|")
    print(f"| {runs} | {rows:,} | {len(files)} | {size:.1f} | {spent:.1f} | {wall:.1f} | {memory:.0f} |")


if __name__ == "__main__":
    main()
