"""Made-up tables in the exported form, with everything a test may want to plant."""

import json
import sys
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from reports.data.frame import METHOD, METHODS, OWN, PLACE, POINTS, RUNS
from reports.data.schema import RUNS as RUNS_OF_NOW

COVERAGE = {"kind": "coverage", "preset": "flat", "agents": 4, "targets": 5, "observation": "extended"}
NAVIGATION = {"kind": "navigation", "agents": 3, "reward": "paper"}
YARDSTICK_RETURNS = {
    "random": 30.4,
    "nearest": 60.6,
    "best_window": 65.3,
    "set_point": 63.9,
    "planner": 73.9,
    "free_heading_bound": 86.4,
}
KINDS = {"full": "rhmc", "no regulation": "rhmc", "no filter": "rhmc", "RHMC": "rhmc"}

Tables = tuple[pd.DataFrame, pd.DataFrame]  # points, and runs with how they were made


def study(
    name: str,
    arms: Mapping[str, Sequence[float]],
    *,
    env: Mapping[str, Any] = COVERAGE,
    steps: int = 150_000,
    points: int = 20,
    rise: Mapping[str, float] | None = None,
    profile: str = "quick",
    start: float = 30.0,
) -> Tables:
    """A finished study.

    Args:
        arms: final return of each seed, per arm.
        rise: per arm, the share of the budget after which the curve is at its final value; 0.5 unless given.
    """
    rows, plan = [], []
    grid = np.linspace(0, steps, points + 1).round().astype(int)
    for arm, finals in arms.items():
        for seed, final in enumerate(finals):
            config = {"algo": {"kind": KINDS.get(arm, arm.lower()), "arm": arm}, "env": dict(env), "seed": seed}
            config |= {"trainer": {"steps": steps, "evaluations": points}}
            run = sha256(json.dumps([name, config], sort_keys=True).encode()).hexdigest()[:12]
            key = {"study": name, "arm": arm, "seed": seed, "run": run}
            share = np.minimum(1, grid / steps / (rise or {}).get(arm, 0.5))
            wobble = np.random.default_rng(seed).normal(size=len(grid)) * (share < 1)
            for step, value in zip(grid, start + (final - start) * share + wobble, strict=True):
                rows.append(key | {"step": int(step), "metric": "eval/return", "value": float(value)})
            rows.append(key | {"step": steps, "metric": "final/return", "value": float(final)})
            rows.append(key | {"step": steps, "metric": "final/coverage", "value": float(final) + 0.1})
            about = {
                "algorithm": KINDS.get(arm, arm.lower()),
                "task": env["kind"],
                "config": json.dumps(config, sort_keys=True),
            }
            about |= {"fingerprint": "0123456789ab", "commit": "c0ffee", "question": "Which?", "seconds": 1.5}
            plan.append(key | {"status": "finished", "profile": profile} | about)
    return pd.DataFrame(rows, columns=list(POINTS)), pd.DataFrame(plan, columns=[*RUNS, "commit", "seconds"])


def yardsticks(
    values: Mapping[str, float] = YARDSTICK_RETURNS, env: Mapping[str, Any] = COVERAGE, profile: str = "quick"
) -> Tables:
    """Yardsticks, standard error 0.3."""
    points, runs = study("yardsticks", {name: [value] for name, value in values.items()}, env=env, profile=profile)
    points = points[points["metric"].str.startswith("final/")].assign(step=0)
    errors = points.assign(metric=points["metric"] + "_sem", value=0.3)
    task = {k: v for k, v in env.items() if k != "observation"} | {"observation": "paper"}
    ids = {run: f"y{n:03d}{env['kind'][:4]}" for n, run in enumerate(runs["run"])}
    points = pd.concat([points, errors], ignore_index=True)
    points["run"] = points["run"].map(ids)
    return points, runs.assign(config=json.dumps({"env": task}), run=runs["run"].map(ids))


def theorem(lost: int = 40) -> Tables:
    """Algorithm 1 against the optimum on two families of instances."""
    rows = [
        ("theorem", arm, 0, f"t{n}", 0, f"theorem/{metric}", value)
        for n, arm in enumerate(("4 x 3 x 5", "4 x 5 x 8"))
        for metric, value in (("instances", 1000.0), ("lost", float(lost * (n + 1))), ("max_gap", 1.1 if lost else 0.0))
    ]
    return pd.DataFrame(rows, columns=list(POINTS)), pd.DataFrame(columns=list(RUNS))


def methods(folder: Path, names: Sequence[str] = ("RHMC", "IQL")) -> Path:
    """Output of `rhmc methods --out`: sizes 1000 k + 10 for the k-th method, 5 more for each next encoder or task."""
    records = []
    for k, name in enumerate(names, 1):
        texts = {key: f"{key} of {name}" for key in METHOD} | {"kind": name.lower(), "name": name}
        places = [(env, encoder) for env in (COVERAGE, NAVIGATION) for encoder in ("mlp", "pairwise")]
        sizes = [
            {"task": env, "encoder": encoder, "acting": 1000 * k + 10 + 5 * n, "all": 3000 * k + n}
            for n, (env, encoder) in enumerate(places)
        ]
        records.append(texts | {"actions": ["discrete", "continuous"][:k], "parameters": sizes})
    folder.mkdir(parents=True, exist_ok=True)
    (folder / METHODS).write_text(json.dumps(records))
    return folder


def half_done(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    """A seed missing, a seed half-way, all others as they were."""
    gone, cut = runs["run"].iloc[0], runs["run"].iloc[1]
    keep = (points["run"] != gone) & ~((points["run"] == cut) & (points["step"] > 75_000))
    keep &= ~((points["run"] == cut) & points["metric"].str.startswith("final/"))
    status = np.select([runs["run"] == gone, runs["run"] == cut], ["missing", "partial"], "finished")
    return points[keep], runs.assign(status=status)


def write(folder: Path, *tables: Tables) -> Path:
    """Write tables as an export does, three files per study."""
    folder.mkdir(parents=True, exist_ok=True)
    for points, runs in tables:
        name = [*runs["study"], *points["study"]][0]
        points.to_parquet(folder / f"{name}.parquet", index=False)
        if len(runs):
            own = [column for column in OWN if column in runs]
            made = runs[[*PLACE, *own]].reindex(columns=[*PLACE, *OWN], fill_value="")
            made.to_parquet(folder / f"{name}.made.parquet", index=False)
            table = pa.Table.from_pandas(runs.drop(columns=own), preserve_index=False)
            pq.write_table(table.replace_schema_metadata(RUNS_OF_NOW.metadata), folder / f"{name}.runs.parquet")
    return folder


def reporting(runs: Path, out: Path, study: str | None = None) -> list[str]:
    """A command that builds a report in a process of its own."""
    call = f"write_report(Path({str(runs)!r}), Path({str(out)!r}), study={study!r})"
    code = (
        f"from pathlib import Path; from reports.pages.build import write_report; raise SystemExit({call} != 'whole')"
    )
    return [sys.executable, "-c", code]


def noisy(mean: float, n: int = 3, spread: float = 1.0) -> list[float]:
    """n values of that mean, evenly spread over mean - spread .. mean + spread."""
    return [float(x) for x in np.linspace(mean - spread, mean + spread, n)]


def drawings(folder: Path) -> Path:
    """The output of `rhmc drawings --out`, small: a chain and a branched network per role, two states, one instance."""
    folder.mkdir(parents=True, exist_ok=True)
    builds = [
        {
            "encoder": encoder,
            "task": COVERAGE,
            "settings": {"filter": "on", "regulator": "paper", "horizon": 1, "alpha": 0.1, "assignment_period": 1},
            "networks": [_network(f"{level} {part}") for level in ("coordinator", "executor") for part in PARTS],
        }
        for encoder in ("mlp", "pairwise")
    ]
    (folder / "modules.json").write_text(json.dumps(builds))
    (folder / "scenes.json").write_text(json.dumps(SCENES))
    return folder


PARTS = ("actor", "critic")
SCENES: dict[str, Any] = {
    "navigation": {
        "policy": "matching",
        "positions": [[[0, 0], [0.5, 0.5]], [[0.1, 0], [0.5, 0.2]]],
        "landmarks": [[0.2, 0], [0.5, 0]],
        "radius": 0.15,
        "near": 0.1,
    },
    "coverage": [
        {
            "agents": n,
            "policy": "best_window",
            "step": 20,
            "sensors": [[100 * i, 0] for i in range(n)],
            "heading": [90.0] * n,
            "targets": [[0, 300], [0, -300]],
            "seen": [[True, False]] * n,
            "range": 800.0,
            "half_view": 45.0,
            "half_area": 1250.0,
        }
        for n in (2, 3)
    ],
    "regulation": {
        "alpha": 0.1,
        "horizon": 6,
        "assignment": [[1, 1], [1, 0]],
        "options": [[[1, 0], [0, 1]], [[1, 0]]],
        "paths": {
            "algorithm_1": {"choices": [0, 0], "completed": [True, False], "reward": 0.4},
            "optimum": {"choices": [1, 0], "completed": [True, True], "reward": 1.5},
        },
        "met": [{"horizon": 6, "states": 1000, "lost": 7, "max_gap": 1.1}],
    },
    "counterexamples": [
        {
            "by": "reward",
            "alpha": 0.1,
            "assignment": [[1, 1], [0, 1]],
            "options": [[[0, 1], [1, 0]], [[0, 0], [0, 0]]],
            "paths": {
                "algorithm_1": {"choices": [0, 0], "completed": [False, True], "reward": 0.4},
                "optimum": {"choices": [1, 0], "completed": [True, False], "reward": 0.9},
            },
        },
    ],
}


def _network(role: str) -> dict[str, Any]:
    layers = [("a", 3, 4), ("b", 4, 2), ("c", 4, 2), ("d", 2, 1)]
    edges = [("x", "a"), ("a", "a.relu"), ("a.relu", "b"), ("a.relu", "c"), ("b", "d"), ("c", "d"), ("d", "output")]
    every = [{"name": name, "kind": "Linear", "in": i, "out": o, "parameters": i * o + o} for name, i, o in layers]
    relu = {"name": "a.relu", "kind": "ReLU", "in": 4, "out": 4, "parameters": 0}
    return {
        "role": role,
        "kind": "Toy",
        "parameters": sum(layer["parameters"] for layer in every),
        "inputs": [{"name": "x", "shape": [2, 3]}],
        "output": [2, 1],
        "layers": [every[0], relu, *every[1:]],
        "edges": [{"from": a, "to": b, "through": ["sum"] if b == "d" else []} for a, b in edges],
    }


def episode(folder: Path) -> Path:
    """The output of `rhmc render`, the smallest: a GIF of two by one pixels."""
    gif = bytes.fromhex("47494638396102000100800000ffffff00000021f90400000000002c00000000020001000002020c0a003b")
    (folder / "episode_coverage.gif").write_bytes(gif)
    return folder


def assignments(points: pd.DataFrame, arm: str, pairs: Sequence[float], lost: Sequence[float]) -> pd.DataFrame:
    """The output of `rhmc assignments` of an arm's first run: a point at every 1000 steps."""
    place = points[points["arm"] == arm].iloc[0][["study", "arm", "seed", "run"]].to_dict()
    rows = [
        place | {"step": 1000 * (n + 1), "metric": f"assign/{name}", "value": value}
        for n, (p, x) in enumerate(zip(pairs, lost, strict=True))
        for name, value in (
            *(("pairs", p), ("conflicts", p / 4), ("free", 0.5), ("idle", 0.25), ("states", 100.0 * (n + 1))),
            *(("lost_h1", 0.0), ("gap_h1", 0.0), ("lost_h6", x), ("gap_h6", 0.4 + n)),
        )
    ]
    return pd.DataFrame(rows, columns=list(POINTS))


def transfer(points: pd.DataFrame, levels: Mapping[tuple[int, int], float], arm: str = "RHMC") -> pd.DataFrame:
    """The output of `rhmc transfer`: every seed of an arm a point apart at each size."""
    runs = points[points["arm"] == arm].drop_duplicates("run")
    rows = [
        (r.study, r.arm, r.seed, r.run, "coverage flat", n, m, 4, 5, 200, level + float(str(r.seed)), 0.5)
        for r in runs.itertuples()
        for (n, m), level in levels.items()
    ]
    columns = ["study", "arm", "seed", "run", "task", "agents", "targets", "trained_agents", "trained_targets"]
    return pd.DataFrame(rows, columns=[*columns, "episodes", "value", "sem"])
