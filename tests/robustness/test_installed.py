"""Installed from a wheel, outside a checkout, in a folder that has names of this project: what most users have."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pipelines.tracking.mlflow_tracker import open_existing
from pipelines.tracking.tracker import StudyCard
from pipelines.workspace.work_folder import Home
from tests.pipelines.support import HOSTILE
from tests.reports.factory import noisy, study, write

ROOT = Path(__file__).parents[2]
PARTS = ("rhmc", "pipelines", "reports", "studies", "rhmc_command.py", "pyproject.toml", "README.md", "LICENSE")
TINY = """\
question: Tiny?
base:
  env: {kind: coverage, agents: 2, targets: 3}
  algo: {kind: iql}
  trainer: {num_envs: 4, evaluations: 1, eval_episodes: 2, final_episodes: 2}
arms: {a: {}}
seeds: 1
steps: 2400
resources: {concurrent: 1}
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that the built wheel is installed in."""
    folder = tmp_path_factory.mktemp("installed")
    source, wheels, found = (folder / name for name in ("source", "wheels", "site"))
    source.mkdir()
    for part in PARTS:
        subprocess.run(["cp", "-R", "-P", ROOT / part, source], check=True)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", wheels, source], check=True)
    subprocess.run([*pip, "install", "--no-deps", "--target", found, *wheels.iterdir()], check=True)
    return found


def person(folder: Path) -> Path:
    """A person's folder, with packages of theirs."""
    for name in ("pipelines", "reports", "rhmc"):
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").write_text(f"raise RuntimeError('the {name} of a person')\n")
    return folder


@pytest.fixture
def user(tmp_path: Path) -> Path:
    return person(tmp_path)


def rhmc(site: Path, user: Path, *words: str, home: Path | None = None, stdout: int = subprocess.PIPE) -> str:
    """The output of the installed command, in the person's folder and with it on the search path; it must succeed."""
    environment = {"PYTHONPATH": f"{user}{os.pathsep}{site}", "RHMC_HOME": str(home or user / "work")}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", str(site / "bin" / "rhmc"), *words],
        cwd=user,
        env=os.environ | environment,
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert done.returncode == 0, (done.stdout, done.stderr)
    return done.stdout or ""


def test_a_study_of_the_package_is_copied_and_checked(site: Path, user: Path) -> None:
    assert rhmc(site, user, "study", "copy", "searched").splitlines()[0] == "studies/searched.yaml"
    assert "searched (quick): " in rhmc(site, user, "study", "check", "studies/searched.yaml")


def test_a_study_of_ones_own_includes_the_settings_of_the_package(site: Path, user: Path) -> None:
    settings = "env: {include: settings/navigation}, algo: {include: settings/navigation/rhmc}"
    (user / "own.yaml").write_text(
        f"question: Own?\nbase: {{{settings}}}\narms: {{a: {{}}}}\nseeds: 1\nsteps: 45_000\n"
    )
    assert "own (quick): Own?" in rhmc(site, user, "study", "check", "own.yaml")
    assert not (user / "studies").exists()


def test_a_report_has_its_template_and_the_statements_of_the_paper(site: Path, user: Path) -> None:
    write(user / "runs", study("reach", {"one": noisy(60), "two": noisy(61)}, points=3))
    rhmc(site, user, "report", "--runs", "runs", "--out", "out")
    assert "</html>" in (user / "out" / "index.html").read_text(encoding="utf-8")


# One launch, in which three things hold


@pytest.fixture(scope="module")
def launched(site: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A person's folder, and the work folder of a launch there, which has ended well: of any name, and nobody read."""
    folder = tmp_path_factory.mktemp("launched")
    user, home = person(folder / "user"), folder / "of any name" / HOSTILE.strip()
    home.parent.mkdir()
    (user / "tiny.yaml").write_text(TINY)
    told, ours = os.pipe()
    os.close(told)
    rhmc(site, user, "study", "run", "tiny.yaml", home=home, stdout=ours)
    os.close(ours)
    return user, home


@pytest.mark.ray
def test_a_study_is_trained_beside_packages_of_a_person(site: Path, launched: tuple[Path, Path]) -> None:
    user, home = launched
    rhmc(site, user, "export", "tiny.yaml", "--out", "tables", home=home)  # which fails while a run is missing
    assert (user / "tables" / "tiny.parquet").is_file()


@pytest.mark.ray
def test_a_launch_in_a_folder_of_any_name(launched: tuple[Path, Path]) -> None:
    """Keeps everything inside."""
    user, home = launched
    assert [file.name for file in home.parent.iterdir()] == [home.name]
    assert {file.name for file in user.iterdir()} <= {"pipelines", "reports", "rhmc", "tiny.yaml", "tables"}
    assert {"artifacts", "mlflow.db"} <= {file.name for file in home.iterdir()}


@pytest.mark.ray
def test_a_launch_goes_on_when_nobody_reads_any_more(launched: tuple[Path, Path]) -> None:
    tracker = open_existing(StudyCard("tiny", "quick", "", {}, []), Home(launched[1]))
    assert tracker is not None
    assert [run.status for run in tracker.recorded()] == ["finished"]
