"""Policies and critics with memory: `ppo` on recurrent networks, learned from a rollout cut into segments.

The actor's state at the start of a segment is the one that acted then. The critic need not act: it is unrolled over
each whole rollout, from where it was at the end of the last one.
"""

from typing import Literal

import torch
from torch import Generator, Tensor, nn

from rhmc.algorithms.ppo import PPO, Config
from rhmc.learning.segments import along, cut, following, in_time
from rhmc.networks.recurrent import stepped
from rhmc.types import Batch, Carry, Obs, Spec, State, Transition


def learner(cfg: Config, spec: Spec, rng: Generator, sees: Literal["local", "central"]) -> PPO:
    """The learner that the encoder asks for."""
    return (RecurrentPPO if cfg.remembers else PPO)(cfg, spec, rng, sees)


class RecurrentPPO(PPO):
    """See the module."""

    def __init__(self, cfg: Config, spec: Spec, rng: Generator, sees: Literal["local", "central"]) -> None:
        super().__init__(cfg, spec, rng, sees)
        self.critic_carry: Carry = {}  # the critic's memory after the last rollout

    def carry(self, batch: int) -> Carry:
        """The state of every agent's memory, (B, N, H)."""
        return {"state": torch.zeros(batch, self.spec.agents, self.cfg.hidden_dim, device=self.rng.device)}

    def act(self, obs: Obs, carry: Carry, rng: Generator, *, explore: bool) -> tuple[Tensor, Carry, Batch]:
        """As without memory; beside the policy the state before it."""
        logits, state = stepped(self.actor.net, obs, carry["state"])
        policy = logits.log_softmax(-1)
        return self._drawn(policy, rng, explore=explore), {"state": state}, carry | {"policy": policy}

    def observe(self, transition: Transition) -> None:
        """Store one step of each environment, with the policy that acted and the state before it."""
        t = transition
        self.standardiser.update_rewards(t.reward)
        self.rollout.add(t, first=t.obs.first, policy=t.extra["policy"], state=t.extra["state"])

    @torch.no_grad()
    def _judged(self, rows: Batch) -> tuple[Batch, Batch]:
        """As without memory, in segments (K, T, ...) with the states at their start."""
        before = (self.critic_carry or self.carry(rows["reward"].shape[1]))["state"]
        output, states = along(self.critic.net, rows, before)
        next_output = following(self.critic.net, rows, output, states)
        self.critic_carry = {"state": states[-1]}
        value, next_values = (self.standardiser.value(one.squeeze(-1)) for one in (output, next_output))
        kept, logs = self._aims(rows, value, next_values)
        kept |= {"critic_state": torch.cat((before.unsqueeze(0), states[:-1])), "state": rows["state"]}
        return cut(kept | {"first": rows["first"]}, self.cfg.segment_length), logs

    def _policies(self, rows: Batch) -> Tensor:
        """Of segments: (K, T, N, actions)."""
        return _outputs(self.actor.net, rows, "state").log_softmax(-1)

    def _predicted(self, rows: Batch) -> Tensor:
        """Of segments: (K, T, N)."""
        return _outputs(self.critic.net, rows, "critic_state").squeeze(-1)

    def state_dict(self) -> State:
        """As without memory, and that of the critic."""
        return super().state_dict() | {"critic_carry": self.critic_carry}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        super().load_state_dict(state)
        self.critic_carry = {key: value.to(self.rng.device) for key, value in state["critic_carry"].items()}


def _outputs(net: nn.Module, segments: Batch, state: str) -> Tensor:
    """(K, T, N, out) of segments (K, T, ...) from one of their states."""
    seen = {key: segments[key] for key in ("agents", "pairs", "peers", "first")}
    return along(net, in_time(seen), segments[state])[0].transpose(0, 1)
