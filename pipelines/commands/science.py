"""Verbs that describe the code: Theorem 1, the methods, the fingerprint; and the report from what was exported."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from pipelines.commands.common import Profile, folder_option, table
from pipelines.errors import InputError


def theorem(
    instances: Annotated[int, typer.Option(min=1, help="Random instances per size and density.")] = 20_000,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    alpha: Annotated[float, typer.Option(min=0, max=1, help="The penalty of Eq. 6.")] = 0.1,
    out: Annotated[Path | None, typer.Option(help="Also write theorem.parquet in this folder.")] = None,
) -> None:
    """Put Theorem 1 to the test: Algorithm 1 against the optimum, and the smallest instances where it fails."""
    from pipelines.theorem import export_theorem
    from rhmc.theorem import shortfall_table, summary

    with folder_option(out):
        found = shortfall_table(instances, seed, alpha=alpha)
        print(summary(found, alpha))
        if out is not None:
            print(f"wrote {export_theorem(found, seed, out)}", file=sys.stderr)


def methods(out: Annotated[Path | None, typer.Option(help="Also write methods.json in this folder.")] = None) -> None:
    """Say what every method is (Table 1), with the parameters of the networks that it builds."""
    from pipelines.methods import describe, export_methods

    with folder_option(out):
        found = describe()
        rows = [
            [m["name"], m["source"], m["family"], m["training"], m["execution"], ", ".join(m["actions"])]
            + [f"{size['acting']:,} of {size['all']:,}" for size in m["parameters"]]
            for m in found
        ]
        counted = [f"{size['task']['kind']}, {size['encoder']}" for size in found[0]["parameters"]]
        table(["method", "source", "family", "training", "execution", "actions", *counted], rows, numbers=counted)
        if out is not None:
            print(f"wrote {export_methods(out)}", file=sys.stderr)


def fingerprint(file: Annotated[Path | None, typer.Argument(help="Write it there, if it differs.")] = None) -> None:
    """Name the code that decides results: the same after editing a comment, another after editing behaviour."""
    from pipelines.identity import fingerprint as of_code

    text = of_code() + "\n"
    if file is None:
        print(text, end="")
        return
    try:
        if not file.exists() or file.read_text() != text:
            file.write_text(text)
    except OSError as error:
        raise InputError(f"{file}: cannot be written ({error.strerror})") from error


def drawings(
    out: Annotated[Path, typer.Option(help="Folder; made if it is not there.")] = Path("reports/quick/runs"),
) -> None:
    """Write what Figures 1 to 5 and 8 show: RHMC's networks as they run, and states of both tasks."""
    from pipelines.drawings import export_drawings

    with folder_option(out):
        for file in export_drawings(out):
            print(f"wrote {file}", file=sys.stderr)


def report(
    profile: Profile = "quick",
    study: Annotated[Path | None, typer.Option(metavar="FILE", help="Report on this study alone.")] = None,
    variant: Annotated[str | None, typer.Option(help="Of that study.")] = None,
    runs: Annotated[Path | None, typer.Option(help="Exported tables; reports/<profile>/runs if not given.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder; reports/<profile>, with study/<name> after it for one study, if not given."),
    ] = None,
) -> None:
    """Build figures, tables, claims and their page from the exported tables; or curves and comparison of one study."""
    if study is not None and not study.is_file():
        raise InputError(f"--study: {study} is not a file; a study such as studies/ablation.yaml")
    if variant is not None and study is None:
        raise InputError("--variant: belongs to a study; give --study as well")
    from reports.build import main as build

    arguments = ["--profile", profile]
    arguments += ["--study", f"{study.stem}@{variant}" if variant else study.stem] if study else []
    arguments += ["--runs", str(runs)] if runs else []
    arguments += ["--out", str(out)] if out else []
    raise typer.Exit(build(arguments))
