"""`rhmc verify`: results here, or runs trained anew, against the published ones."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.cli.common import Profile, say, table
from pipelines.workspace.errors import InputError
from pipelines.workspace.exit_codes import Exit

if TYPE_CHECKING:
    import pandas as pd

    from reports.analyses.equivalence import Compared


def verify(
    profile: Profile = "quick",
    retrain: Annotated[
        int, typer.Option(min=0, metavar="K", help="Train K published runs anew instead, drawn at random.")
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random draw.")] = 0,
    runs: Annotated[Path | None, typer.Option(help="Exported tables; what the log holds if not given.")] = None,
    published: Annotated[Path | None, typer.Option(help="Published tables; the repository's if not given.")] = None,
    margin: Annotated[float, typer.Option(min=0.01, help="Points of return within which arms are equivalent.")] = 1.0,
    jobs: Annotated[int, typer.Option(min=1, help="Trainings at a time.")] = 2,
    publish: Annotated[bool, typer.Option("--publish", help="Replace the published results with those here.")] = False,
) -> None:
    """Compare results with the published ones: the same bytes, or per arm the difference and a test of equivalence.

    Exit code 4 where an arm is missing, has other settings, or is not shown to be equivalent.
    """
    from pipelines.export.published import folder, trained
    from pipelines.export.published import retrain as train
    from reports.analyses.equivalence import compare, read
    from reports.data.frame import TableError

    try:
        if publish:
            say(f"wrote {_publish(*_here(runs, profile, None), profile)}")
            return
        wanted, theirs = read(published or folder(profile))
        _same_profile(theirs, profile, published or folder(profile))
        if runs is None:
            wanted, theirs = trained(wanted, theirs)
        if retrain:
            compared = _again(list(train(theirs, retrain, seed, jobs)), wanted, margin)
        else:
            values, mine = _here(runs, profile, sorted(set(theirs["study"])))
            _same_profile(mine, profile, runs or Path("the log"))
            compared = compare(values, wanted, margin)
    except TableError as error:
        raise InputError(str(error)) from error
    _tell(compared, profile)
    raise typer.Exit(Exit.DONE if all(one.holds for one in compared) else Exit.NO)


def _here(runs: Path | None, profile: str, studies: Sequence[str] | None) -> "tuple[pd.DataFrame, pd.DataFrame]":
    """Values and runs in a folder, or in the log of these studies."""
    from pipelines.export.published import export_log
    from pipelines.workspace.work_folder import StoreError, work_folder
    from reports.analyses.equivalence import read

    if runs is not None:
        return read(runs)
    if studies is None:
        raise InputError("--publish: give the exported tables with --runs")
    with TemporaryDirectory() as name:
        try:
            export_log(studies, profile, work_folder(), Path(name))
        except StoreError as error:
            raise InputError(str(error)) from error
        return read(Path(name))


def _publish(values: "pd.DataFrame", runs: "pd.DataFrame", profile: str) -> Path:
    from pipelines.export.published import publish, trained

    return publish(*trained(values, runs), profile)


def _same_profile(runs: "pd.DataFrame", profile: str, where: Path) -> None:
    found = sorted(set(runs["profile"].astype(str)) - {profile})
    if found:
        raise InputError(f"{where}: results of profile {', '.join(found)}, and --profile is {profile}")


def _again(trained: "Sequence[Any]", published: "pd.DataFrame", margin: float) -> "list[Compared]":
    """Runs trained anew, each compared with its own published values."""
    import pandas as pd

    from reports.analyses.equivalence import compare_runs

    rows = [(one.study, one.arm, one.seed, one.run, *value) for one in trained for value in one.points]
    here = pd.DataFrame(rows, columns=["study", "arm", "seed", "run", "step", "metric", "value"])
    return compare_runs(here, published, margin)


def _tell(compared: "Sequence[Compared]", profile: str) -> None:
    from reports.analyses.equivalence import COLUMNS, summary
    from reports.analyses.equivalence import table as rows

    if any(one.outcome != "byte-equal" for one in compared):
        table(COLUMNS, rows(compared), numbers=["seeds", "p"])
    say(summary(compared, profile))
