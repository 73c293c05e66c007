"""The reason why a run is stale: which of its settings, or which modules of its code, are other than the plan's."""

from collections import Counter
from collections.abc import Collection, Iterable, Sequence

from pipelines.specs.study import RunSpec
from pipelines.tracking.plan import Item, flat_settings
from pipelines.tracking.policy import CONFIG, settings
from pipelines.tracking.tracker import Recorded, Tracker
from pipelines.workspace.errors import InputError
from pipelines.workspace.leftovers import scratch

NAMED = 4  # settings or modules that a line names

Copied = Collection[tuple[str, str, str]]  # arm, settings id and former code of runs that were adopted


def stale_runs(plan: Sequence[Item], recorded: Sequence[Recorded], tracker: Tracker) -> list[tuple[str, str]]:
    """Arm and reason of each run that is not of the plan, but for those of which the log has adopted copies."""
    planned = {(item.card.arm, item.key) for item in plan}
    copied = {(run.arm, run.spec_id, run.copied_from) for run in recorded if run.adopted}
    others = [run for run in recorded if (run.arm, run.key) not in planned]
    reasons = [(run.arm, _reason(run, plan, tracker, copied)) for run in others]
    return [(arm, why) for arm, why in reasons if why]


def stale_lines(found: Iterable[tuple[str, str]]) -> list[str]:
    """A line for each arm and reason."""
    counts = Counter(found)
    return [f"stale: arm '{arm}', {n} run{'s' * (n > 1)}: {why}" for (arm, why), n in counts.items()]


def _reason(run: Recorded, plan: Sequence[Item], tracker: Tracker, copied: Copied) -> str:
    """The reason why a run is stale; nothing where an adopted copy of it stands for it."""
    arm = [item for item in plan if item.card.arm == run.arm]
    if not arm:
        return "the study has no such arm now"
    same = next((item for item in arm if item.card.spec_id == run.spec_id), None)
    if same is not None:
        return _code(run, same, copied)
    spec = kept_settings(run, tracker)
    if spec is None:
        return "made with settings that the code here does not know"
    again = next((item for item in arm if item.spec.id == spec.id), None)  # named otherwise when it was made
    if again is not None:
        return _code(run, again, copied)
    return _settings(spec, arm[0].spec) or f"the study has no seed {spec.seed} now"


def _code(run: Recorded, item: Item, copied: Copied) -> str:
    """The modules that changed since; nothing where the log has a copy of the run under later code."""
    if (run.arm, item.card.spec_id, run.code) in copied:
        return ""
    if not run.modules:
        return f"made by other code ({run.code}), which kept no list of its modules"
    now = item.card.modules
    changed = [name for name in sorted({*now, *run.modules}) if now.get(name) != run.modules.get(name)]
    return f"changed since: {_some(changed)}" if changed else "made with another version of torch"


def _settings(before: RunSpec, now: RunSpec) -> str:
    """The settings that differ now; nothing where only the seed is."""
    old, new = flat_settings(before), flat_settings(now)
    names = [name for name in sorted({*old, *new} - {"seed"}) if old.get(name) != new.get(name)]
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
