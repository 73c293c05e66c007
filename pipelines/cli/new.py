"""`rhmc new`: a package of one's own to begin with."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli.common import folder_option, say

if TYPE_CHECKING:
    from pipelines.conformance.scaffold import What

app = typer.Typer(no_args_is_help=True, help="Begin a package with a method or a task of your own.")
Name = Annotated[str, typer.Argument(metavar="NAME", help="Of the folder, the package and the kind.")]
Out = Annotated[Path, typer.Option(help="Where the new folder is made.")]


@app.command("method")
def method(name: Name, out: Out = Path()) -> None:
    """Write a package with a method that runs at once: its page, a study, a test, a README."""
    _create("method", name, out)


@app.command("task")
def task(name: Name, out: Out = Path()) -> None:
    """Write a package with a task that runs at once: its page, a study, a test, a README."""
    _create("task", name, out)


def _create(what: "What", name: str, out: Path) -> None:
    from pipelines.conformance.scaffold import create

    with folder_option(out):
        page, *_ = create(what, name, out)
    say(f"wrote {page.parents[1]}; the {what} is {page}")
    say(f"next:  cd {page.parents[1]} && rhmc conformance {name}.{what}")
