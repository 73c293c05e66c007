"""The export of Theorem 1's test, read back."""

from pathlib import Path

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from pipelines.cli.main import app
from pipelines.workspace.errors import InputError
from rhmc.hierarchy.theorem import shortfall_table


def test_export_holds_the_counts_of_every_row(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["theorem", "--instances", "60", "--seed", "3", "--out", str(tmp_path / "runs")])
    assert done.exit_code == 0
    table = pq.read_table(tmp_path / "runs" / "theorem.parquet").to_pylist()
    lost = {row["arm"]: row["value"] for row in table if row["metric"] == "theorem/lost"}
    expected = {
        f"{' x '.join(map(str, r.size))}, completed {r.coverage:g}, assigned {r.assignment:g}": r.lost
        for r in shortfall_table(60, 3)
    }
    assert lost == expected
    assert sum(expected.values()) > 0
    assert all(row["value"] == 60 for row in table if row["metric"] == "theorem/instances")


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    file = tmp_path / "x"
    file.touch()
    done = CliRunner().invoke(app, ["theorem", "--instances", "1", "--out", str(file)])
    assert isinstance(done.exception, InputError)
    with pytest.raises(InputError, match=r"--out: .* is not a folder"):
        raise done.exception
