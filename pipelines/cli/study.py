"""`rhmc study`: check, run, follow and move studies; `rhmc export` for the report."""

import shlex
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli.common import (
    Arms,
    File,
    Files,
    Folder,
    Json,
    Profile,
    Sets,
    Variant,
    listing,
    load_studies,
    load_study,
    say,
    table,
    tell,
)
from pipelines.workspace.errors import InputError
from pipelines.workspace.exit_codes import Exit
from pipelines.workspace.files import regular

if TYPE_CHECKING:
    from pipelines.specs.readings import Plan
    from pipelines.specs.study import Study

app = typer.Typer(help="Check, run, follow and move studies.", no_args_is_help=True)


@app.command("check")
def check(file: File, profile: Profile = "quick", variant: Variant = None, overrides: Sets = None) -> None:
    """Say what a study would run, or everything that is wrong with it. Starts nothing."""
    from pipelines.specs.study import changes
    from pipelines.tracking.source_file import another
    from pipelines.workspace.work_folder import Home, work_folder

    study = load_study(file, profile, overrides, variant)
    say(f"{study.name} ({study.profile}): {study.question}")
    if remark := another(Home(work_folder()), study.name, study.profile, study.file):
        say(remark)
    shown = [cell.reading for cell in study.cells.values()][:1]  # the arms differ alike in all of them
    rows = []
    for arm, setting in study.arms.items():
        if study.cells and study.cells[arm].reading not in shown:
            continue
        differs = ", ".join(f"{key}={value}" for key, value in changes(study.base, setting).items()) or "the base"
        rows.append([arm, differs, str(study.seeds), f"{study.steps:,}", str(setting.trainer.num_envs)])
    table(["arm", "differs in", "seeds", "steps", "copies"], rows, numbers=("seeds", "steps", "copies"))
    if study.readings:
        _show_readings(study, study.readings)
    _show_budget(study)
    for remark in study.remarks:
        say(f"note: {remark}")


def _show_readings(study: "Study", plan: "Plan") -> None:
    """Factors, readings, and effects that cannot be told apart."""
    readings = {cell.reading: cell.levels for cell in study.cells.values()}
    say(f"{len(readings)} readings: {plan.kind}; each arm is trained under each")
    rows = []
    for factor, levels in plan.factors.items():
        each = [
            f"{i} {name} ({sum(one[factor] == name for one in readings.values())})" for i, name in enumerate(levels, 1)
        ]
        rows.append([factor, ", ".join(each), plan.generators.get(factor, "")])
    table(["factor", "levels (readings)", "generator"], rows)
    say(f"named by the level of {', '.join(plan.factors)}:")
    say("  " + " ".join(name.partition("=")[2] for name in readings))
    mains = [effects for effects in plan.confounded if effects[0] in plan.factors]
    say(f"main effects confounded with interactions of two factors: {len(mains) or 'none'}")
    if len(plan.confounded) > len(mains):
        say(f"sets of confounded interactions of two factors: {len(plan.confounded) - len(mains)}")
    for effects in plan.confounded:
        say(f"  {' = '.join(effects)}")


def _show_budget(study: "Study") -> None:
    from pipelines.export.pace import estimated

    runs = study.runs()
    different = len({run.spec.id for run in runs})
    shared = f", {different} of them different" if different < len(runs) else ""
    total = f"{different * study.steps:,} environment steps in all"
    say(f"{len(runs)} runs{shared}, {total}, {study.resources.concurrent} runs at a time")
    if hours := estimated(study, Path("results") / study.profile / "runs"):
        say(hours)


@app.command("run")
def run(
    files: Files, profile: Profile = "quick", variant: Variant = None, arm: Arms = None, overrides: Sets = None
) -> None:
    """Run what studies still lack. Finished runs are skipped, interrupted ones continue.

    Several files are one queue: what they share is trained once. With --arm the other arms wait for another launch.
    """
    studies = load_studies(files, profile, overrides, variant)
    from pipelines.execution.run import run_studies
    from pipelines.workspace.work_folder import work_folder

    raise typer.Exit(run_studies(studies, work_folder(), arm or ()))


@app.command("status")
def status(
    file: File, profile: Profile = "quick", variant: Variant = None, as_json: Json = False, overrides: Sets = None
) -> None:
    """Say how many runs are finished, under way, missing or stale (made by other code). Exit code 3 if any is left."""
    from pipelines.execution.standing import show_quickly
    from pipelines.workspace.work_folder import work_folder

    code = show_quickly(file, profile, variant, overrides or (), work_folder(), as_json=as_json)
    if code is None:
        study = load_study(file, profile, overrides, variant)
        from pipelines.execution.run import show_status

        code = show_status(study, work_folder(), as_json=as_json)
    raise typer.Exit(code)


@app.command("list")
def list_(folder: Folder = None, as_json: Json = False) -> None:
    """List the studies of a folder with their questions and variants. `rhmc search list` has the searches."""
    listing(folder, "study", as_json)


@app.command("copy")
def copy_shipped(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Of a study of this package, such as coverage.")],
    out: Annotated[Path, typer.Option(help="Folder; made if it is not there.")] = Path("studies"),
) -> None:
    """Write a study of this package into a folder, with what it includes: where there is no checkout."""
    from pipelines.specs.include import copy
    from pipelines.workspace.work_folder import StoreError

    try:
        for path in copy(name, out):
            say(str(path))
    except StoreError as error:
        raise InputError(str(error)) from error


@app.command("export")
def export_runs(
    file: File,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="A new folder, or a new archive if it ends with .zip.")],
    profile: Profile = "quick",
    variant: Variant = None,
    overrides: Sets = None,
    values_only: Annotated[
        bool, typer.Option("--values-only", help="Leave policies and checkpoints behind: small enough for git.")
    ] = False,
) -> None:
    """Pack a study's finished runs, and the checkpoints of those under way, for another machine."""
    study = load_study(file, profile, overrides, variant)
    from pipelines.bundles.bundle import pack
    from pipelines.workspace.work_folder import StoreError, work_folder

    try:
        packed = pack(study, out, work_folder(), values_only=values_only)
    except StoreError as error:
        raise InputError(str(error)) from error
    say(f"{out}: {packed.finished} of {packed.planned} runs finished, {packed.begun} under way")
    for line in packed.astray:
        print(f"left out, a value is not finite: {line}", file=sys.stderr)
    say(f"there:  rhmc study import {out.name}")


@app.command("import")
def import_runs(
    bundle: Annotated[Path, typer.Argument(metavar="BUNDLE", help="What `rhmc study export` wrote.")],
) -> None:
    """Take in runs from another machine: `rhmc study run` then goes on from there."""
    if not bundle.is_dir():
        regular(bundle)
    from pipelines.bundles.bundle import unpack
    from pipelines.workspace.work_folder import StoreError, work_folder

    try:
        taken = unpack(bundle, work_folder())
    except StoreError as error:
        raise InputError(str(error)) from error
    say(
        f"{taken.study} ({taken.profile}): {taken.new} finished runs taken in, {taken.known} were here before, "
        f"{taken.begun} to be continued"
    )
    if taken.foreign:
        say(f"{taken.foreign} of them were made by other code: `rhmc study run` would train them again")
        say("`rhmc study adopt FILE` lets them count where trainings of today repeat them bit for bit")


@app.command("adopt")
def adopt_runs(
    files: Files,
    profile: Profile = "quick",
    variant: Variant = None,
    verify: Annotated[int, typer.Option(min=1, metavar="K", help="Runs of each arm that are trained again.")] = 1,
    until: Annotated[
        int | None, typer.Option(min=1, metavar="STEP", help="To this step; whole runs without it.")
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Trainings at a time.")] = 2,
    overrides: Sets = None,
) -> None:
    """Let finished runs of other code count for the code here, where trainings of today repeat them bit for bit.

    Exit code 4 if an arm is refused: the first value that differs is named, and its runs stay as they are.
    """
    from pipelines.execution.adoption import adopt
    from pipelines.workspace.work_folder import work_folder

    refused = False
    for study in load_studies(files, profile, overrides, variant):
        say(f"{study.name} ({study.profile})")
        proofs = adopt(study, work_folder(), verify, until, jobs, say)
        refused = refused or any(proof.difference for proof in proofs)
    raise typer.Exit(Exit.NO if refused else Exit.DONE)


class Form(StrEnum):
    """Of exported results."""

    TABLES = "tables"
    MARL_EVAL = "marl-eval"


def export(
    files: Files,
    profile: Profile = "quick",
    variant: Variant = None,
    out: Annotated[Path | None, typer.Option(help="Folder; results/<profile>/runs if not given.")] = None,
    overrides: Sets = None,
    form: Annotated[
        Form, typer.Option("--format", help="tables, for the report; or marl-eval: JSON for marl-eval and rliable.")
    ] = Form.TABLES,
    runs: Annotated[
        Path | None, typer.Option(help="For marl-eval: tables that are there already; else they are exported anew.")
    ] = None,
) -> None:
    """Write each study's results as one tidy table, with tables of its runs and how they were made, for the report."""
    studies = load_studies(files, profile, overrides, variant)
    from pipelines.export.marl_eval import export_marl_eval
    from pipelines.export.tables import export_study
    from pipelines.tracking.plan import given_twice

    if faults := given_twice(studies):
        raise InputError(*faults)

    marl_eval = form is Form.MARL_EVAL
    if runs is not None and not marl_eval:
        raise InputError("--runs: belongs to --format marl-eval")
    results = Path("results") / profile
    tables = runs or (results / "runs" if marl_eval or not out else out)
    code: int = Exit.DONE
    for study in studies:
        code = max(code, Exit.DONE if runs else export_study(study, tables))
        if code == Exit.BAD:
            raise typer.Exit(Exit.BAD)
        if marl_eval:
            code = max(code, export_marl_eval(study.name, tables, out or results / "marl_eval"))
    if marl_eval:
        raise typer.Exit(code)
    words = ["rhmc", "report", *(["--study", str(files[0])] if len(files) == 1 else [])]
    words += ["--profile", profile] if profile != "quick" else []
    words += ["--variant", variant] if variant and len(files) == 1 else []
    words += ["--runs", str(out)] if out else []
    tell(f"next:  {shlex.join(words)}")
    raise typer.Exit(code)
