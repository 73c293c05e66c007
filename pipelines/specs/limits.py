"""Limits of every study, search and option, whatever the method: bounds on every number, devices, and what cannot go
together. The configurations of the science package say what is right; this says what is absurd.
"""

import re
from collections.abc import Iterable
from typing import Any

MOST = 10**9  # of a number that has no bound of its own
SEED = 10**12  # what is added to a seed must not leave 64 bits
EPISODES = 1_000_000
JOBS = 1024  # processes or threads
BOUNDS: dict[str, int] = {  # by name of a field or an option
    "agents": 100,
    "targets": 100,
    "episode": 100_000,
    "horizon": 1000,
    "assignment_period": 100_000,
    "hidden_dim": 8192,
    "mixing_embed_dim": 8192,
    "buffer_size": 100_000_000,
    "batch_size": 1_000_000,
    "n_steps": 100_000,
    "segment_length": 100_000,
    "epochs": 10_000,
    "minibatches": 10_000,
    "actor_minibatches": 10_000,
    "num_envs": 100_000,
    "steps": 10**12,
    "epsilon_steps": 10**12,
    "pretrain": 10**12,
    "learning_starts": 10**12,
    "warmup": 10**12,
    "evaluations": 100_000,
    "eval_episodes": EPISODES,
    "final_episodes": EPISODES,
    "eval_seed": SEED,
    "threads": JOBS,
    "concurrent": JOBS,
    "cpus": JOBS,
    "checkpoint_every": 1_000_000,
    "seeds": 1000,
    "trials": 100_000,
    "startup": 100_000,
    "seed": SEED,
}
DEVICES = ("cpu", "cuda", "cuda:N with N from 0 to 99")
DEVICE = re.compile(r"cpu|cuda(:\d{1,2})?")


def beyond(name: str, value: Any) -> str:
    """The values that are allowed instead of a field's value, nothing if the value is.

    Args:
        name: of the field, such as `num_envs`.
        value: a number, a word, or a list of them.
    """
    if name == "device" and isinstance(value, str) and not DEVICE.fullmatch(value):
        return f"allowed: {', '.join(DEVICES)}"
    most = BOUNDS.get(name, MOST)
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) > most:
        return f"must be at most {most:,}" if value > 0 else f"must be at least {-most:,}"
    return ""


def misfit(env: Any, algo: Any) -> str:
    """The reason why a method cannot act or learn in a task, as `field: text` with a field of the task, or nothing."""
    from rhmc.envs import ENVS  # brings torch along, which a fault in a file can do without
    from rhmc.hierarchy.coordinator import COORDINATORS
    from rhmc.hierarchy.regulation import MOST_TARGETS
    from rhmc.training import trainer

    if text := trainer.misfit(env, algo):
        return text
    field = "targets" if "targets" in type(env).model_fields else "agents"  # navigation has as many of both
    count = getattr(env, field)
    if getattr(algo, "regulator", "") == "exact" and count > MOST_TARGETS:
        return f"{field}: {count} is not allowed; the exact regulator takes at most {MOST_TARGETS} targets: use 'paper'"
    chosen = COORDINATORS.get(getattr(getattr(algo, "coordinator", None), "method", ""))
    return chosen.misfit(ENVS[env.kind].physics.spec(env)) if chosen else ""


def absent(devices: Iterable[str]) -> list[str]:
    """Devices that this machine has not, each with what it has."""
    import torch

    count = torch.cuda.device_count()
    here = ["cpu", *(["cuda"] if count else []), *(f"cuda:{i}" for i in range(count))]
    return [f"'{one}' is not there; this machine has: {', '.join(here)}" for one in devices if one not in here]
