"""`rhmc conformance`: what every method and every task has to do, tried on those of a package, or on this project's."""

import os
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.cli.common import Json, say, say_json
from pipelines.workspace.errors import InputError
from pipelines.workspace.exit_codes import Exit

if TYPE_CHECKING:
    from pipelines.conformance.checks import Outcome

STEPS = 12_000


def conformance(
    module: Annotated[
        str | None, typer.Argument(metavar="MODULE", help="Checks all that this module registers, as `mine.methods`.")
    ] = None,
    method: Annotated[
        list[str] | None, typer.Option(metavar="KIND", help="Check this method. Can be repeated.")
    ] = None,
    task: Annotated[list[str] | None, typer.Option(metavar="KIND", help="Check this task. Can be repeated.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="A setting of the method's run that is to learn, or of the task: gamma=0.8",
        ),
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="Environment steps of the run that is to learn.")] = STEPS,
    as_json: Json = False,
) -> None:
    """Check methods, tasks and coordinators: exact resume, one seed one run, no trace of evaluation, learning, more.

    Exit code 4 where a check does not hold.
    """
    from pipelines.specs.plugins import COORDINATOR, TABLES, VARIABLE, discover, page
    from pipelines.workspace.own_packages import top_of

    if module is not None:
        os.environ[VARIABLE] = ",".join(filter(None, (os.environ.get(VARIABLE, ""), module)))
    discover()
    wanted: dict[str, list[str]] = {"algo": list(method or ()), "env": list(task or ()), COORDINATOR: []}
    if module is not None:
        for section, kinds in wanted.items():
            own = {kind for kind, one in TABLES[section].items() if top_of(page(one)) == top_of(module)}
            kinds += sorted(own - set(kinds))
    if not any(wanted.values()):
        raise InputError("nothing to check: name a module, or --method, or --task")
    found = list(_outcomes(wanted, _changes(settings or ()), steps, quiet=as_json))
    if as_json:
        say_json([one._asdict() for one in found])
    else:
        wrong = sum(1 for one in found if one.fault)
        left = sum(1 for one in found if one.left_out)
        say(f"{len(found) - wrong - left} checks hold, {wrong} do not, {left} left out")
    raise typer.Exit(Exit.NO if any(one.fault for one in found) else Exit.DONE)


def _outcomes(wanted: dict[str, list[str]], changes: dict[str, Any], steps: int, *, quiet: bool) -> Iterator["Outcome"]:
    from pydantic import ValidationError

    from pipelines.specs.plugins import TABLES

    for section, kinds in wanted.items():
        for kind in kinds:
            if kind not in TABLES[section]:
                _unknown(section, kind)
            try:
                for one in _checks(section, kind, changes, steps):
                    if not quiet:
                        _tell(one)
                    yield one
            except ValidationError as error:
                first = error.errors()[0]
                raise InputError(f"--set: {kind}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from error


def _checks(section: str, kind: str, changes: dict[str, Any], steps: int) -> Iterator["Outcome"]:
    """Of a coordinator: those of RHMC with it."""
    from pipelines.conformance.methods import check_method
    from pipelines.conformance.tasks import check_task

    if section == "env":
        return check_task(kind, changes)
    return check_method(kind, changes, steps) if section == "algo" else check_method("rhmc", changes, steps, kind)


def _unknown(section: str, kind: str) -> None:
    from pipelines.specs.plugins import unknown

    raise InputError(f"{'--method' if section == 'algo' else '--task'}: {unknown(section, kind)}")


def _tell(one: "Outcome") -> None:
    mark = "FAULT" if one.fault else "left out" if one.left_out else "holds"
    why = one.fault or one.left_out
    say(f"{mark:8}  {one.subject}: {one.check}{f': {why}' if why else ''}")


def _changes(texts: Iterable[str]) -> dict[str, Any]:
    """Settings by dotted name."""
    from pipelines.specs.document import override, plain

    found: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        node, faults = override(f"--set {text}", key, value)
        if faults or node is None or not equals or not key:
            raise InputError(*(map(str, faults) if faults else [f"--set {text}: must be KEY=VALUE, as in gamma=0.8"]))
        found[key] = plain(node)
    return found
