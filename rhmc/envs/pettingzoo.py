"""The tasks for other libraries: PettingZoo's parallel interface, or its turn-based one.

One copy of a task, on the CPU; needs `pip install "rhmc[pettingzoo]"`. A team gets one reward, so each agent gets all
of it. Nothing in `rhmc` imports this page: it is not part of what names a run.
"""

from typing import Any

import torch
from gymnasium.spaces import Box, Discrete, Space
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import parallel_to_aec
from torch import Tensor

from rhmc.envs.base import ENVS, EnvConfig, make_env
from rhmc.types import Obs

Agent = str
Array = Any  # numpy's, which this package does not import


class ParallelTask(ParallelEnv[Agent, Array, Any]):
    """A task in which all agents act at once. Agents are `agent_0` to `agent_{N-1}`.

    An agent observes a vector: its own features (Fa), those about each target (M x Fp), those about each other agent
    ((N - 1) x Fo). `state` is all of them in a row. An episode ends by truncation, as `spec.episode` says.

    Args:
        cfg: the task's settings, those that studies write under `env`.
    """

    def __init__(self, cfg: EnvConfig) -> None:
        self.cfg = cfg
        self.env = make_env(cfg, 1, torch.Generator())
        self.spec = self.env.spec
        self.metadata = {"name": f"{cfg.kind}_v0", "render_modes": [], "is_parallelizable": True}
        self.render_mode = None
        self.possible_agents = [f"agent_{i}" for i in range(self.spec.agents)]
        self.agents: list[Agent] = []
        s = self.spec
        width = s.agent_features + s.targets * s.pair_features + (s.agents - 1) * s.peer_features
        self.observation_spaces = {agent: Box(-torch.inf, torch.inf, (width,)) for agent in self.possible_agents}
        self.action_spaces = {agent: _actions(s.actions, continuous=s.continuous) for agent in self.possible_agents}
        self.state_space = Box(-torch.inf, torch.inf, (s.agents * width,))
        self._seen = torch.zeros(s.agents, width)
        self._first = True

    def observation_space(self, agent: Agent) -> Space[Array]:
        """A vector of unbounded float32."""
        return self.observation_spaces[agent]

    def action_space(self, agent: Agent) -> Space[Any]:
        """One of the task's directions or turns, or a force in [-1, 1] per dimension."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[Agent, Array], dict[Agent, dict[str, Any]]]:
        """Begin an episode. A seed decides this one and those after it; without a first one they are random."""
        if seed is not None:
            self.env.rng.manual_seed(seed)
        elif self.env.state is None:
            self.env.rng.seed()
        self.agents = list(self.possible_agents)
        return self._observed(self.env.reset()), {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[Agent, Any]
    ) -> tuple[
        dict[Agent, Array], dict[Agent, float], dict[Agent, bool], dict[Agent, bool], dict[Agent, dict[str, Any]]
    ]:
        """Act together.

        Args:
            actions: one action for each agent.

        Returns:
            Observations, rewards, terminations, truncations, and for each agent what the task measures in this step.

        Raises:
            ValueError: an agent has no action, or one that is not in its space.
        """
        out = self.env.step(self._joint(actions))
        ended = bool(out.truncated)
        seen = self._observed(out.final_obs)
        info = {name: float(value) for name, value in out.info.items()}
        acted, self.agents = self.agents, [] if ended else self.agents
        return (
            seen,
            dict.fromkeys(acted, float(out.reward)),
            dict.fromkeys(acted, bool(out.terminated)),
            dict.fromkeys(acted, ended),
            {agent: dict(info) for agent in acted},
        )

    def state(self) -> Array:
        """The observations of all agents in a row, as a central critic may use them."""
        return self._seen.flatten().numpy().copy()

    def observed(self) -> Obs:
        """Observation of the agents now, as methods of this project take it: a batch of one."""
        return unflattened(self.cfg, self._seen.unsqueeze(0), first=self._first)

    def split(self, action: Tensor) -> dict[Agent, Any]:
        """A joint action (1, N) or (1, N, A), as methods of this project give it, by agent."""
        return dict(zip(self.possible_agents, action[0].numpy(), strict=True))

    def render(self) -> None:
        """Draw nothing: `rhmc render` animates episodes."""

    def close(self) -> None:
        """Free nothing: the task holds no window and no file."""

    def _observed(self, obs: Obs) -> dict[Agent, Array]:
        self._seen, self._first = flattened(obs)[0], bool(obs.first)
        return dict(zip(self.possible_agents, self._seen.numpy().copy(), strict=True))

    def _joint(self, actions: dict[Agent, Any]) -> Tensor:
        for agent in self.possible_agents:
            if not self.action_spaces[agent].contains(actions.get(agent)):
                wanted = self.action_spaces[agent]
                raise ValueError(f"{agent}: action {actions.get(agent)!r} is not allowed; allowed is {wanted}")
        kind = torch.float32 if self.spec.continuous else torch.int64
        return torch.stack([torch.as_tensor(actions[agent], dtype=kind) for agent in self.possible_agents]).unsqueeze(0)


def parallel_env(kind: str, **settings: Any) -> ParallelTask:
    """A task in which all agents act at once: `parallel_env("coverage", agents=4, targets=5, preset="flat")`.

    Args:
        kind: `coverage`, `navigation`, or another registered task.
        settings: as studies write them under `env`.

    Raises:
        ValueError: there is no such task or setting, or a value is not allowed.
    """
    if kind not in ENVS:
        raise ValueError(f"task '{kind}' is not known; known are {', '.join(sorted(ENVS))}")
    return ParallelTask(ENVS[kind].config(**settings))


def env(kind: str, **settings: Any) -> AECEnv[Agent, Array, Any]:
    """The same task turn by turn: each agent chooses in the state before any of them has acted.

    Raises:
        ValueError: as `parallel_env`.
    """
    turns: AECEnv[Agent, Array, Any] = parallel_to_aec(parallel_env(kind, **settings))
    return turns


def flattened(obs: Obs) -> Tensor:
    """Observations as one vector an agent: (B, N, Fa + M Fp + (N - 1) Fo)."""
    b, n = obs.agents.shape[:2]
    peers = obs.peers[:, _others(n)].reshape(b, n, -1)
    return torch.cat([obs.agents, obs.pairs.reshape(b, n, -1), peers], -1)


def unflattened(cfg: EnvConfig, vectors: Tensor, *, first: bool) -> Obs:
    """The observations whose vectors (B, N, F) these are; `first` says whether episodes begin with them."""
    s = ENVS[cfg.kind].physics.spec(cfg)
    b, n = vectors.shape[:2]
    own, pairs, others = vectors.split(
        [s.agent_features, s.targets * s.pair_features, (n - 1) * s.peer_features], dim=-1
    )
    peers = vectors.new_zeros(b, n, n, s.peer_features)
    peers[:, _others(n)] = others.reshape(b, n * (n - 1), s.peer_features)
    return Obs(own, pairs.reshape(b, n, s.targets, s.pair_features), peers, torch.full((b,), first))


def _others(n: int) -> Tensor:
    """Mask of the pairs of two different agents: (N, N) bool."""
    return ~torch.eye(n, dtype=torch.bool)


def _actions(number: int, *, continuous: bool) -> Space[Any]:
    return Box(-1, 1, (number,)) if continuous else Discrete(number)
