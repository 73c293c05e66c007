"""The former names of settings: an old key in a file is a fault that says the new one. No old key is read."""

from collections.abc import Collection
from typing import Any, NamedTuple


class Renamed(NamedTuple):
    """The names that a setting has now, by method; the first that a method has is told, with a note on its value."""

    names: tuple[str, ...]
    note: str = ""


RENAMED: dict[str, Renamed] = {
    "polyak": Renamed(("tau",), "share moved per update: 1 - polyak"),
    "anneal": Renamed(("final_lr_fraction",)),
    "time_limit": Renamed(("bootstrap_on_truncation",), "bootstrap: true, terminal: false"),
    "warmup": Renamed(("learning_starts",)),
    "steps_per_update": Renamed(("train_freq",)),
    "buffer": Renamed(("buffer_size",)),
    "batch": Renamed(("batch_size", "executor.batch_size")),
    "rollout": Renamed(("n_steps", "coordinator.n_steps")),
    "lam": Renamed(("gae_lambda", "td_lambda", "coordinator.gae_lambda")),
    "clip": Renamed(("clip_range", "coordinator.clip_range")),
    "grad_clip": Renamed(("max_grad_norm",)),
    "entropy": Renamed(("ent_coef", "coordinator.ent_coef")),
    "hidden": Renamed(("hidden_dim",)),
    "embed": Renamed(("mixing_embed_dim",)),
    "double": Renamed(("double_q",)),
    "worth": Renamed(("advantage_estimator",)),
    "gamma_h": Renamed(("coordinator.gamma",)),
    "standardise_h": Renamed(("coordinator.standardise",)),
    "batch_h": Renamed(("coordinator.batch_size",)),
    "high_reward": Renamed(("coordinator.reward",)),
    "coordinator_every": Renamed(("coordinator.update_every",)),
    "flip": Renamed(("coordinator.assignment_epsilon",)),
    "gamma_l": Renamed(("executor.gamma",)),
    "standardise_l": Renamed(("executor.standardise",)),
    "low_reward": Renamed(("executor.reward",)),
    "epsilon": Renamed(("executor.epsilon",)),
    "logit_penalty": Renamed(("executor.logit_penalty",)),
    # Of HiT-MAC's coordinator.
    "gamma": Renamed(("coordinator.gamma",)),
    "standardise": Renamed(("coordinator.standardise",)),
    "epochs": Renamed(("coordinator.epochs",)),
    "minibatches": Renamed(("coordinator.minibatches",)),
}
BLOCKS = {"coordinator": "gradient", "executor": "method"}  # were words; the field that has the word now
WORDS = {"mixed": "qmix"}


def hint(key: str, fields: Collection[str], *, dotted: bool = False) -> str:
    """The new name of a key, empty if it has none here.

    Args:
        key: as written.
        fields: dotted names that are allowed in its place.
        dotted: blocks are written as dotted names there.
    """
    entry = RENAMED.get(key)
    new = next((name for name in entry.names if name in fields), "") if entry else ""
    if entry is None or not new:
        return ""
    block, _, field = ("", "", new) if dotted else new.rpartition(".")
    place = f"'{field}' in the block '{block}': {block}: {{{field}: ...}}" if block else f"'{new}'"
    return f"'{key}' is now {place}" + (f" ({entry.note})" if entry.note else "")


def block_hint(key: str, value: Any, fields: Collection[str]) -> str:
    """The block that a word has become, empty if the key is no such block here; arguments as in `hint`."""
    field = BLOCKS.get(key, "")
    if not field or f"{key}.{field}" not in fields or not isinstance(value, str):
        return ""
    return f"'{key}' is now a block: {key}: {{{field}: {WORDS.get(value, value)}}}"
