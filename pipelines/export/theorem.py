"""The shortfall of Algorithm 1, as a table of the form that runs are exported in."""

from collections.abc import Sequence
from pathlib import Path

from pipelines.export.tables import write_parquet
from reports.data.schema import METRICS
from rhmc.hierarchy.theorem import Shortfall

STUDY = "theorem"


def export_theorem(table: Sequence[Shortfall], seed: int, out: Path) -> Path:
    """Write `theorem.parquet` in a folder: an arm per size and density, its counts as `theorem/` metrics.

    Raises:
        StoreError: the folder cannot be written to.
    """
    rows: list[tuple[object, ...]] = []
    for row in table:
        size = " x ".join(map(str, row.size))
        arm = f"{size}, completed {row.coverage:g}, assigned {row.assignment:g}"
        values = {"instances": row.instances, "lost": row.lost, "mean_gap": row.mean_gap, "max_gap": row.max_gap}
        rows += [(STUDY, arm, seed, arm, 0, f"theorem/{name}", float(value)) for name, value in values.items()]
    file = out / f"{STUDY}.parquet"
    write_parquet(file, METRICS, sorted(rows, key=lambda row: row[:6]))
    return file
