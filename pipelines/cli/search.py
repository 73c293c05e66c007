"""`rhmc search`: check, run, follow and export searches."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli.common import (
    Folder,
    Json,
    Profile,
    files_in,
    folder_option,
    listing,
    load_each,
    load_search,
    say,
    tell,
)
from pipelines.workspace.errors import InputError
from pipelines.workspace.exit_codes import Exit

if TYPE_CHECKING:
    from pipelines.specs.search import Search


def _searches(incomplete: str) -> list[str]:
    return files_in("studies", "search_*.yaml", incomplete)


File = Annotated[
    Path,
    typer.Argument(metavar="FILE", help="A search, such as studies/search_rhmc.yaml.", autocompletion=_searches),
]
Files = Annotated[list[Path], typer.Argument(metavar="FILE...", help="Searches.", autocompletion=_searches)]
Sets = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change the search, as in a study: trials=4, base.algo.lr=1e-3."),
]
Out = Annotated[
    Path | None,
    typer.Option(help="Folder for the winners; `best_params` beside FILE if not given, the work folder with --set."),
]

app = typer.Typer(help="Search settings with the same budget for every method.", no_args_is_help=True)


@app.command("check")
def check(file: File, profile: Profile = "quick", overrides: Sets = None) -> None:
    """Say what a search would try, or everything that is wrong with it. Starts nothing."""
    from pipelines.export.pace import estimated_search

    search = _search(file, profile, overrides)
    say(f"{search.name} ({search.profile}): {search.question}")
    for name, arm in search.arms.items():
        say("\n".join([f"{name}: {arm.setting.algo.kind}", *(f"  {key}: {one}" for key, one in arm.space.items())]))
    each = search.trials * search.seeds
    say(
        f"each arm: {search.trials} trials x {search.seeds} seeds x {search.steps:,} environment steps, "
        f"{each * search.steps:,} in all; sampler {search.sampler.kind}, pruner {search.pruner.kind}, "
        f"{search.resources.concurrent} trials at a time"
    )
    if hours := estimated_search(search, Path("results") / search.profile / "runs"):
        say(hours)
    for remark in search.remarks:
        say(f"note: {remark}")


@app.command("run")
def run(file: File, profile: Profile = "quick", overrides: Sets = None, out: Out = None) -> None:
    """Try what a search still lacks. Finished trials are kept, interrupted ones continue; the winners are written."""
    search = _search(file, profile, overrides)
    from pipelines.tuning.search_run import run_search
    from pipelines.workspace.work_folder import work_folder

    with folder_option(out):
        raise typer.Exit(run_search(search, work_folder(), out))


@app.command("status")
def status(file: File, profile: Profile = "quick", overrides: Sets = None) -> None:
    """Say how many trials are done, pruned, failed or missing, and what is best. Exit code 3 if any is left."""
    search = _search(file, profile, overrides)
    from pipelines.tuning.search_run import show_search
    from pipelines.workspace.work_folder import work_folder

    raise typer.Exit(show_search(search, work_folder()))


@app.command("list")
def list_(folder: Folder = None, as_json: Json = False) -> None:
    """List the searches of a folder with their questions and arms."""
    listing(folder, "search", as_json)


@app.command("export")
def export(
    files: Files,
    profile: Profile = "quick",
    out: Annotated[Path | None, typer.Option(help="Folder; results/<profile>/runs if not given.")] = None,
    overrides: Sets = None,
) -> None:
    """Write each search's trials as one table, for the report. Exit code 3 if a budget is not spent."""
    searches = load_each(files, lambda file: _search(file, profile, overrides))
    from pipelines.tracking.plan import given_twice
    from pipelines.tuning.search_export import export_search
    from pipelines.workspace.work_folder import work_folder

    if faults := given_twice(searches):
        raise InputError(*faults)
    home = work_folder()
    code: int = Exit.DONE
    for search in searches:
        code = max(code, export_search(search, out or Path("results") / profile / "runs", home))
        if code == Exit.BAD:
            raise typer.Exit(Exit.BAD)
    words = ["rhmc", "report", *(["--study", str(files[0])] if len(files) == 1 else [])]
    words += ["--profile", profile] if profile != "quick" else []
    words += ["--runs", str(out)] if out else []
    tell(f"next:  {shlex.join(words)}")
    raise typer.Exit(code)


def _search(file: Path, profile: str, overrides: Sequence[str] | None) -> "Search":
    return load_search(file, profile, overrides)
