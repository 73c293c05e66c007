"""The command `rhmc`. The verbs are the other modules of this room, one for each noun.

Everything heavy is imported by the verb that needs it, so that help answers at once.

`pipelines.workspace.exit_codes` has the exit codes.
"""

import errno
import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from pipelines.cli import (
    conformance,
    doctor,
    evaluate,
    new,
    render,
    science,
    search,
    status,
    study,
    ui,
    verify,
    yardsticks,
)
from pipelines.workspace import streams
from pipelines.workspace.addresses import reach_loopback, scrubbed
from pipelines.workspace.errors import InputError, visible
from pipelines.workspace.exit_codes import Exit

EXIT_CODES = (
    "Exit codes: 0 done; 1 a fault of the program; 2 bad input, nothing was started; 3 half done: a run failed or is "
    "not finished; 4 done, and the answer is no; 130 interrupted; 143 terminated. Results are kept in $RHMC_HOME, "
    "or in the folder work."
)

NO_PATH = (errno.ENAMETOOLONG, errno.EACCES, errno.ELOOP)  # what looking at a path says of the path alone


class Verbs(TyperGroup):
    """Shows words that it refuses as messages show them."""

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        """The root's own options."""
        with _visible():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: Any) -> Any:
        """All else."""
        with _visible():
            return super().invoke(ctx)


@contextmanager
def _visible() -> Iterator[None]:
    try:
        yield
    except typer.TyperException as error:
        error.message = visible(error.message)
        raise


app = typer.Typer(
    cls=Verbs,
    epilog=EXIT_CODES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
RESULTS, CODE = "Results", "This installation"


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"rhmc {version('rhmc')}, Python {sys.version.split()[0]}, torch {version('torch')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which versions these are.")
    ] = False,
) -> None:
    """Reproduce a multi-agent coordination paper: run studies, score yardsticks, build the report."""


app.add_typer(study.app, name="study")
app.add_typer(search.app, name="search")
app.add_typer(yardsticks.app, name="yardsticks")
app.command("status", rich_help_panel=RESULTS)(status.status)
app.add_typer(new.app, name="new")
app.command("evaluate", rich_help_panel=RESULTS)(evaluate.evaluate)
app.command("transfer", rich_help_panel=RESULTS)(evaluate.transfer)
app.command("assignments", rich_help_panel=RESULTS)(evaluate.assignments)
app.command("render", rich_help_panel=RESULTS)(render.render)
app.command("export", rich_help_panel=RESULTS)(study.export)
app.command("verify", rich_help_panel=RESULTS)(verify.verify)
app.command("report", rich_help_panel=RESULTS)(science.report)
app.command("verdicts", rich_help_panel=RESULTS)(science.verdicts)
app.command("ui", rich_help_panel=RESULTS)(ui.ui)
app.command("theorem", rich_help_panel=RESULTS)(science.theorem)
app.command("methods", rich_help_panel=CODE)(science.methods)
app.command("tasks", rich_help_panel=CODE)(science.tasks)
app.command("conformance", rich_help_panel=CODE)(conformance.conformance)
app.command("drawings", rich_help_panel=CODE)(science.drawings)
app.command("profile", rich_help_panel=CODE)(science.profile)
app.command("fingerprint", rich_help_panel=CODE)(science.fingerprint)
app.command("doctor", rich_help_panel=CODE)(doctor.doctor)


def main() -> None:
    """Entry point: what a user can mend is one message on stderr and exit code 2."""
    streams.settle()
    reach_loopback()
    try:
        app(prog_name="rhmc")
    except InputError as error:
        print(scrubbed(str(error)), file=sys.stderr)
        sys.exit(Exit.BAD)
    except KeyboardInterrupt:
        sys.exit(Exit.INTERRUPTED)
    except Exception as error:
        if isinstance(error, OSError) and (found := _of_the_system(error)):
            print(scrubbed(str(found)), file=sys.stderr)
            sys.exit(Exit.BAD)
        print(scrubbed(traceback.format_exc()), file=sys.stderr, end="")  # a fault of ours: the whole of it
        sys.exit(Exit.BROKEN)
    finally:
        if why := streams.lost():
            print(f"rhmc: standard output: {why}; what was printed is not all there", file=sys.stderr)
            sys.exit(Exit.BROKEN)


def _of_the_system(error: OSError) -> InputError | None:
    """Errors of the system in any verb: a path that none can be, or one more open file."""
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return InputError(f"rhmc: {error}")
    if error.errno not in NO_PATH or error.filename is None:
        return None
    limit = "; at most 255 bytes a name, 4,095 a path" if error.errno == errno.ENAMETOOLONG else ""
    return InputError(f"{os.fsdecode(error.filename)}: {error.strerror}{limit}")


if __name__ == "__main__":
    main()
