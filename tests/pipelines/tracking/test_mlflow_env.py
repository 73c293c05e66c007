"""`mlflow.env`, by which MLflow's own command finds the work folder of a checkout."""

import re
from pathlib import Path

import mlflow

from pipelines.workspace.work_folder import Home

ROOT, PACKAGE = Path(__file__).parents[3], Path(mlflow.__file__).parent
NO_MLFLOW = {"DO_NOT_TRACK"}  # a convention that many programs follow


def settings() -> dict[str, str]:
    lines = (ROOT / "mlflow.env").read_text(encoding="utf-8").splitlines()
    return dict(re.fullmatch(r"(\w+)=(\S+)", line).groups() for line in lines if not line.startswith("#"))  # type: ignore[union-attr]


def test_it_names_the_store_and_the_files_of_the_checkout() -> None:
    home, found = Home(ROOT / "work"), settings()
    assert found["MLFLOW_BACKEND_STORE_URI"] == f"sqlite:///{home.database.relative_to(ROOT)}"
    assert found["MLFLOW_ARTIFACTS_DESTINATION"] == str(home.artifacts.relative_to(ROOT))


def test_mlflow_knows_each_of_its_names() -> None:
    files = ("cli/__init__.py", "environment_variables.py")  # importing the first one starts much else
    known = re.findall(r'"(MLFLOW_\w+)"', "".join((PACKAGE / file).read_text(encoding="utf-8") for file in files))
    assert set(settings()) - set(known) == NO_MLFLOW


def test_git_ignores_what_mlflow_makes_where_it_is_not_told() -> None:
    ignored = (ROOT / ".gitignore").read_text(encoding="utf-8").splitlines()
    assert {"/mlruns/", "/mlflow.db", "/work/"} <= set(ignored)
