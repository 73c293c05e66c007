"""One episode of a policy as a small animation, beside policies without learning and a bound if wanted."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Generator, Tensor

from pipelines.policies.animation import Panel, Scene, gif
from pipelines.policies.evaluation import EvaluationEpisodes, Policy, acting, task
from pipelines.specs.document import choices
from pipelines.tracking import policy
from pipelines.tracking.policy_address import saved_at
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import Home, whole
from rhmc.envs import ENVS, EnvConfig, coverage
from rhmc.yardsticks import POLICIES, offered
from rhmc.yardsticks.coverage import windows
from rhmc.yardsticks.joint import best_choice

FRAMES, MILLISECONDS = 40, 110

OWN = EvaluationEpisodes()  # those of the run itself
FREE = "free_heading_bound"  # a bound that can be shown: sensors that take any heading at once
Act = Callable[[Any], tuple[Tensor, Tensor | None]]  # state -> action (1, N[, A]) and assignment (1, N, M) if any


def trained(actor: policy.Actor) -> Act:
    """The action of a trained policy in a state."""
    observe = ENVS[actor.env.kind].physics.observe

    def act(state: Any) -> tuple[Tensor, Tensor | None]:
        action, extra = actor.act(observe(actor.env, state))
        return action, extra.get("assignment")

    return act


def yardstick(env: EnvConfig, name: str, episode: int) -> Act:
    """The action of a policy without learning; its own draws have a generator of their own.

    Raises:
        InputError: the task has no such policy.
    """
    table = POLICIES.get(env.kind, {})
    if name not in table:
        known = [*table, *PLACED.get(env.kind, {})]
        allowed = choices(name, known) if known else f"the task '{env.kind}' offers no policy without learning"
        raise InputError(f"--beside: '{name}' is not allowed; {allowed}")
    own = Generator().manual_seed(episode)
    return lambda state: (table[name](env, state, own), None)


def panel(env: EnvConfig, name: str, episode: int) -> list[Scene]:
    """The scenes of a policy without learning, or of sensors that take any heading at once.

    Raises:
        InputError: the task has neither.
    """
    if place := PLACED.get(env.kind, {}).get(name):
        return play(env, yardstick(env, "hold", episode), episode, place)
    return play(env, yardstick(env, name, episode), episode)


def freely(state: coverage.State) -> coverage.State:
    """The same state with headings under which as many targets are seen as under any."""
    bearing, distance = coverage.relation(state)
    seen, turn = windows(bearing, distance <= coverage.RANGE)
    window = best_choice(seen, torch.zeros_like(turn))
    turned = state.heading + turn.gather(-1, window.unsqueeze(-1)).squeeze(-1)
    return state._replace(heading=coverage.wrap(turned))


PLACED: dict[str, dict[str, Callable[[Any], Any]]] = {"coverage": {FREE: freely}}  # bounds that can be shown


@torch.no_grad()
def play(env: EnvConfig, act: Act, episode: int, place: Callable[[Any], Any] | None = None) -> list[Scene]:
    """The scenes of one episode, start included. Start and target motion depend on `episode` alone.

    place: what is done to every state after the step into it.
    """
    physics = ENVS[env.kind].physics
    world = Generator().manual_seed(episode)
    state = physics.initial(env, 1, world)
    scenes, rewards, infos = [Scene(state, None, "step 0")], [], []
    for step in range(1, physics.spec(env).episode + 1):
        action, assignment = act(state)
        state = physics.transition(env, state, action, world)
        state = place(state) if place else state
        out = physics.outcome(env, state, action, assignment)
        rewards.append(out.reward)
        infos.append(out.info)
        so_far = {key: torch.stack([info[key] for info in infos]) for key in infos[0]}
        score = physics.summary(env, torch.stack(rewards), so_far)
        text = f"step {step}: " + ", ".join(
            _words(name, float(score[name])) for name in offered(env.kind).measures if name in score
        )
        scenes.append(Scene(state, None if assignment is None else assignment[0], text))
    return scenes


def _words(name: str, value: float) -> str:
    if name == "landmarks_covered":
        return f"{100 * value:.0f} % covered"
    if name == "coverage":
        return f"coverage so far {value:.1f} %"
    if name == "collisions":
        return f"{value:.0f} bumps"
    return f"return {value:.1f}" if name == "return" else f"{name.replace('_', ' ')} {value:.2f}"


def episode_gif(
    saved: policy.Saved,
    episode: int = 0,
    beside: str | None = None,
    frames: int = FRAMES,
    wanted: EvaluationEpisodes = OWN,
    note: str = "",
) -> bytes:
    """An episode of a trained policy as a GIF.

    Args:
        saved: whose.
        episode: names the start and the target motion.
        beside: also policies without learning, or `FREE`, in the same episode: names with commas between.
        frames: at most so many.
        wanted: other numbers of agents and targets; how many episodes it says does not matter here.
        note: kept in the file.

    Raises:
        InputError: no such policy or task, or a state that this code cannot load.
    """
    env = task(saved.spec.env, wanted)
    names = [name.strip() for name in beside.split(",")] if beside else []
    others = [Panel(f"{name.replace('_', ' ')}, episode {episode}", panel(env, name, episode)) for name in names]
    actor = acting(Policy(saved.spec.algo.kind, saved), env)
    own = f"{saved.spec.algo.kind}, seed {saved.spec.seed}, episode {episode}"
    return gif(env, [Panel(own, play(env, trained(actor), episode)), *others], frames, MILLISECONDS, note)


def render(
    what: str | policy.Saved,
    out: Path,
    home: Home,
    episode: int = 0,
    beside: str | None = None,
    frames: int = FRAMES,
    wanted: EvaluationEpisodes = OWN,
) -> Path:
    """Write the animation of a policy, or of one by its address (`pipelines.tracking.policy_address`).

    Raises:
        InputError: what is given cannot be used; nothing is written.
        StoreError: the file cannot be written.
    """
    if out.is_dir() or not out.parent.is_dir():
        raise InputError(f"--out: {out} is a folder" if out.is_dir() else f"--out: {out.parent} is no folder")
    saved = what if isinstance(what, policy.Saved) else saved_at(what, home)
    torch.set_num_threads(saved.spec.trainer.threads)  # the actions of larger layers depend on it
    note = json.dumps({"run": saved.spec.id, "episode": episode})  # the report's page says whose episode it shows
    write(out, episode_gif(saved, episode, beside, frames, wanted, note))
    return out


def write(path: Path, content: bytes) -> None:
    """Write a file whole or not at all.

    Raises:
        StoreError: the folder cannot be written to, or the disk is full.
    """
    with whole(path) as part:
        part.write_bytes(content)
