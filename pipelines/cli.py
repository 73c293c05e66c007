"""The command `rhmc`. The verbs are in `pipelines.commands`, a module for each noun.

Everything heavy is imported by the verb that needs it, so that help answers at once.

Exit codes: 0 done, 1 some run failed, 2 bad input (nothing was started), 130 interrupted, 143 terminated.
"""

import os
import sys

import typer

from pipelines.commands import doctor, evaluate, render, science, search, study, ui, verify, yardsticks
from pipelines.commands.common import BAD, DONE, INTERRUPTED
from pipelines.errors import InputError

EXIT_CODES = (
    "Exit codes: 0 done; 1 a run failed or is not finished, or something is wrong; 2 bad input, nothing was started; "
    "130 interrupted; 143 terminated. Results are kept in $RHMC_HOME, or in the folder work."
)

app = typer.Typer(
    help="Reproduce a multi-agent coordination paper: run studies, score yardsticks, build the report.",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
RESULTS, CODE = "Results", "This installation"
app.add_typer(study.app, name="study")
app.add_typer(search.app, name="search")
app.add_typer(yardsticks.app, name="yardsticks")
app.command("evaluate", rich_help_panel=RESULTS)(evaluate.evaluate)
app.command("transfer", rich_help_panel=RESULTS)(evaluate.transfer)
app.command("assignments", rich_help_panel=RESULTS)(evaluate.assignments)
app.command("render", rich_help_panel=RESULTS)(render.render)
app.command("export", rich_help_panel=RESULTS)(study.export)
app.command("verify", rich_help_panel=RESULTS)(verify.verify)
app.command("report", rich_help_panel=RESULTS)(science.report)
app.command("ui", rich_help_panel=RESULTS)(ui.ui)
app.command("theorem", rich_help_panel=RESULTS)(science.theorem)
app.command("methods", rich_help_panel=CODE)(science.methods)
app.command("drawings", rich_help_panel=CODE)(science.drawings)
app.command("fingerprint", rich_help_panel=CODE)(science.fingerprint)
app.command("doctor", rich_help_panel=CODE)(doctor.doctor)


def main() -> None:
    """Entry point: what a user can mend is one message on stderr and exit code 2."""
    try:
        app(prog_name="rhmc")
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(BAD)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except BrokenPipeError:  # the reader of our output has gone, as in `rhmc study list | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(DONE)


if __name__ == "__main__":
    main()
