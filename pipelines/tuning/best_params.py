"""The winner of a search as a file that a study includes: `algo: {include: best_params/search_rhmc.rhmc.paper.yaml}`.

The same search gives the same bytes: no clock, no path of this machine.
"""

from contextlib import suppress
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from pipelines.specs.safe_names import slug
from pipelines.specs.search import Search
from pipelines.tuning.trials import OBJECTIVE, Best
from pipelines.workspace.work_folder import whole


def file_name(search: Search, arm: str) -> str:
    """`<search>.<arm>.<profile>.yaml`: a quick search leaves the winner of a long one alone."""
    return f"{search.name}.{stem(arm)}.{search.profile}.yaml"


def stem(arm: str) -> str:
    """An arm's name as part of a file name. Lower case: a search has no two arms that differ in case alone."""
    return slug(arm).lower()


def winner_yaml(search: Search, arm: str, best: Best, counts: dict[str, int]) -> str:
    """The whole `algo` of the best trial, every default written out, and where it comes from."""
    algo = search.arms[arm].at(best.params).algo
    document = {
        "algo": {"kind": algo.kind} | algo.model_dump(mode="json"),
        "provenance": _provenance(search, arm, best, counts),
    }
    out = StringIO()
    yaml = YAML()
    yaml.width = 1000
    yaml.dump(document, out)
    head = f"# Written by `rhmc search run`. In a study: algo: {{include: best_params/{file_name(search, arm)}}}\n"
    return head + out.getvalue()


def _provenance(search: Search, arm: str, best: Best, counts: dict[str, int]) -> dict[str, Any]:
    env = search.arms[arm].setting.env
    return {
        "search": Path(search.file).name,
        "sha256": search.sha256,
        "changes": list(search.overrides),
        "profile": search.profile,
        "arm": arm,
        "question": search.question,
        "fingerprint": search.code(arm),
        "trials": {"budget": search.trials} | {name: counts[name] for name in ("complete", "pruned", "failed")},
        "steps": search.steps,
        "sampler": search.sampler.model_dump(mode="json"),
        "pruner": search.pruner.model_dump(mode="json"),
        "task": {"kind": env.kind} | env.model_dump(mode="json", exclude_defaults=True),
        "trainer": search.arms[arm].setting.trainer.model_dump(mode="json"),
        "best": {
            "trial": best.trial_index,
            "params": dict(best.params),
            "objective": f"mean of {OBJECTIVE} over the seeds",
            "value": best.value,
            "seeds": dict(zip(search.seed_list(), best.returns, strict=True)),
        },
    }


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all, and not if it is the same.

    Raises:
        StoreError: it cannot be written.
    """
    with suppress(OSError):  # what cannot be read is written anew
        if path.read_bytes() == text.encode():
            return
    with whole(path) as part:
        part.write_text(text, encoding="utf-8")
