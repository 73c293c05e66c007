"""The reason why a run is stale: which of its settings, or which modules of its code, are other than the plan's."""

from collections import Counter
from collections.abc import Iterable, Sequence

from pipelines.specs.study import RunSpec
from pipelines.tracking.plan import Item, flatten
from pipelines.tracking.policy import CONFIG, settings
from pipelines.tracking.tracker import Recorded, Tracker
from pipelines.workspace.errors import InputError
from pipelines.workspace.leftovers import scratch

NAMED = 4  # settings or modules that a line names


def reasons(plan: Sequence[Item], recorded: Iterable[Recorded], tracker: Tracker) -> list[str]:
    """A line for each arm and reason for which recorded runs are not those of the plan."""
    planned = {(item.card.arm, item.key) for item in plan}
    stale = [run for run in recorded if (run.arm, run.key) not in planned]
    counts = Counter((run.arm, _reason(run, plan, tracker)) for run in stale)
    return [f"stale: arm '{arm}', {n} run{'s' * (n > 1)}: {why}" for (arm, why), n in counts.items()]


def _reason(run: Recorded, plan: Sequence[Item], tracker: Tracker) -> str:
    arm = [item for item in plan if item.card.arm == run.arm]
    if not arm:
        return "the study has no such arm now"
    same = next((item for item in arm if item.card.spec_id == run.key.partition("-")[0]), None)
    if same is not None:
        return _code(run, same)
    spec = kept_settings(run, tracker)
    if spec is None:
        return "made with settings that the code here does not know"
    again = next((item for item in arm if item.spec.id == spec.id), None)  # named otherwise when it was made
    if again is not None:
        return _code(run, again)
    return _settings(spec, arm[0].spec) or f"the study has no seed {spec.seed} now"


def _code(run: Recorded, item: Item) -> str:
    """Which modules changed since."""
    if not run.modules:
        return f"made by other code ({run.key.rpartition('-')[2]}), which kept no list of its modules"
    now = item.card.modules
    changed = [name for name in sorted({*now, *run.modules}) if now.get(name) != run.modules.get(name)]
    return f"changed since: {_some(changed)}" if changed else "made with another version of torch"


def _settings(before: RunSpec, now: RunSpec) -> str:
    """Which settings are other now; nothing where only the seed is."""
    old, new = (flatten(spec.model_dump(mode="json", exclude={"seed"})) for spec in (before, now))
    names = [name for name in sorted({*old, *new}) if old.get(name) != new.get(name)]
    said = [f"{name} was {old.get(name)}, now {new.get(name)}" for name in names]
    return f"other settings: {_some(said)}" if said else ""


def _some(words: Sequence[str]) -> str:
    more = f" and {len(words) - NAMED} more" if len(words) > NAMED else ""
    return ", ".join(words[:NAMED]) + more


def kept_settings(run: Recorded, tracker: Tracker) -> RunSpec | None:
    """The settings that a run kept, None where they cannot be read."""
    with scratch() as folder:
        file = tracker.file(run.ref, CONFIG, folder)
        try:
            return settings(file)[0] if file else None
        except InputError:
            return None
