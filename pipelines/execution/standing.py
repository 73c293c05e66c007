"""Progress of a study, for people and for scripts. Imports nothing heavy."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from pipelines.execution.progress import print_table
from pipelines.tracking.kept_plan import Options, Place, kept, stale
from pipelines.workspace.errors import visible
from pipelines.workspace.exit_codes import Exit
from pipelines.workspace.terminal import terminal
from pipelines.workspace.work_folder import Home

STATES = ("finished", "running", "interrupted", "failed", "missing")


class Standing(NamedTuple):
    """The progress of a study."""

    finished: bool  # all of it
    arms: dict[str, dict[str, int]]  # runs by state
    errors: dict[str, str]  # of each failed run, by its name
    stale: list[str]  # why runs are no part of the plan, a line for each arm and reason
    remarks: list[str]  # of the log


def by_arm(plan: Iterable[Place]) -> dict[str, list[Place]]:
    """The planned runs of each arm; what is planned twice once."""
    arms: dict[str, dict[Place, None]] = {}
    for place in plan:
        arms.setdefault(place.arm, {})[place] = None
    return {arm: list(places) for arm, places in arms.items()}


def counted(plan: Iterable[Place], state: Mapping[Place, str], others: Mapping[str, int]) -> dict[str, dict[str, int]]:
    """Runs by arm and state.

    Args:
        plan: all runs.
        state: of those in the log.
        others: stale runs of each arm.
    """
    arms = {}
    for arm, places in by_arm(plan).items():
        mine = Counter(state.get(place, "missing") for place in places)
        arms[arm] = {"planned": len(places)} | {kind: mine[kind] for kind in STATES} | {"stale": others.get(arm, 0)}
    return arms


def quickly(home: Home, options: Options) -> tuple[str, Standing, list[str]] | None:
    """A study's name, its progress and the remarks on its file, from the plan that its last launch kept.

    None where that plan is no longer right, or stale runs have to be explained: the long way has to be gone.
    """
    found = kept(home, options)
    if found is None or stale(found[0].runs.values(), found[1]):
        return None
    plan, seen = found
    # Runs of a driver that was killed are logged as running; this log knows no other driver than one here.
    driven = home.driven(plan.study, options.profile)
    state = {one.place: "interrupted" if one.status == "running" and not driven else one.status for one in seen}
    failed = {one.place: one.error for one in seen if one.status == "failed"}
    errors = {name: failed[place] for name, place in plan.runs.items() if place in failed}
    done = all(state.get(place) == "finished" for place in plan.runs.values())
    return plan.study, Standing(done, counted(plan.runs.values(), state, {}), errors, [], []), plan.remarks


def show(name: str, profile: str, found: Standing, remarks: Sequence[str], *, as_json: bool = False) -> int:
    """Print it. remarks: on the study's file. The exit code: 0 all finished, 3 not."""
    if as_json:
        print(json.dumps({"study": name, "profile": profile} | found._asdict()))
    else:
        columns = ["planned", *STATES, "stale"]
        rows = [[arm, *(str(one[c]) for c in columns)] for arm, one in found.arms.items()]
        print_table(terminal(), ["arm", *columns], rows)
        lines = [f"failed: {name}: {error}" for name, error in found.errors.items()]
        lines += [*found.stale, *(f"note: {remark}" for remark in (*remarks, *found.remarks))]
        terminal().print("\n".join(map(visible, lines)), soft_wrap=True, end="\n" if lines else "")
    return Exit.DONE if found.finished else Exit.UNFINISHED


def show_quickly(
    file: Path, profile: str, variant: str | None, overrides: Sequence[str], home: Path, *, as_json: bool
) -> int | None:
    """`show` of what `quickly` finds; None, and nothing is printed, where it finds nothing."""
    found = quickly(Home(home), Options(str(file), profile, variant or "", tuple(overrides)))
    return None if found is None else show(found[0], profile, found[1], found[2], as_json=as_json)
