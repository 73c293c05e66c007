"""The low level: shared actor and central critic that act under an assignment (section 4.3, Eq. 10 to 13).

The actor sees its own (filtered) row and its assignment; the critic sees everything, the other agents' actions and, by
`critic_sees`, every assignment, and has one output per own action. The bootstrap keeps the assignment that was acted
under, so that the executors' task does not change with the coordinator.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal

import torch
from pydantic import Field
from torch import Generator, Tensor
from torch.nn.functional import mse_loss, one_hot

from rhmc.hierarchy.filters import FILTERS
from rhmc.learning import checkpoint
from rhmc.learning.learner import Learner, Learners, pack_step, taken, unpack
from rhmc.learning.normalisation import Scale, Standardiser
from rhmc.learning.settings import TargetNetworks
from rhmc.networks.nets import ENCODERS, Sizes, append, team
from rhmc.networks.sampling import gumbel, mix, straight_through
from rhmc.types import Batch, Frozen, Obs, Spec, State, Transition, assigned_reward


class Settings(Frozen):
    """The block `executor`; gamma is the paper's."""

    method: Literal["gumbel", "expected", "qmix"] = Field(
        "gumbel",
        description="an actor with a straight-through Gumbel-softmax, or with the expectation over own actions; or no "
        "actor: greedy on own action values, learned by value mixing (`rhmc.hierarchy.mixing_executor`)",
    )
    reward: Literal["local", "team"] = Field(
        "local", description="reward of the executors: their scores on assigned targets, or the team's reward"
    )
    told: Literal["always", "filtered"] = Field(
        "always", description="an executor is told its assignment: always, or where the filter is on, and else nothing"
    )
    critic_sees: Literal["all", "none"] = Field(
        "all", description="assignments that the critic is told, or QMIX's mixture: all of them; or none, as in Q(x, a)"
    )
    lr: float | None = Field(None, gt=0, description="Adam's step size at this level instead of the method's")
    gamma: float = Field(0.99, ge=0, le=1, description="discount per environment step")
    standardise: Scale = Field("none", description="as `standardise` of other methods")
    epsilon: float = Field(0.05, ge=0, le=1, description="share of actions drawn at random while exploring")
    logit_penalty: float = Field(1e-3, ge=0, description="weight of the squared logits (as in MADDPG)")
    batch_size: int = Field(256, ge=1, description="rows of an update")


class Config(TargetNetworks):
    """Settings of a method with executors; lr is the paper's."""

    filter: Literal["on", "off"] = Field("on", description="hide unassigned targets from the executors (Eq. 10)")
    executor: Settings = Settings()


class Executor:
    """All executors: one actor and one critic, shared parameters. Assignments are (B, N, M) float, 0 or 1."""

    def __init__(self, cfg: Config, spec: Spec, rng: Generator) -> None:
        self.cfg, self.actions = cfg.executor, spec.actions
        self.reward_fn = REWARDS[self.cfg.reward]
        self.actor_obs, self.critic_obs = partial(actor_obs, cfg), partial(critic_obs, cfg)
        policies = {"gumbel": partial(straight_through, rng=rng), "expected": partial(torch.softmax, dim=-1)}
        self.policy: Callable[[Tensor], Tensor] = policies[self.cfg.method]
        encoder, sizes = ENCODERS[cfg.encoder], Sizes.of(spec, pair=1)
        local = partial(encoder.local, sizes, cfg.hidden_dim, spec.actions)
        central = partial(encoder.central, sizes, cfg.hidden_dim, spec.actions, joint=spec.actions)
        actor, critic = (team(make, spec.agents, share=cfg.share).to(rng.device) for make in (local, central))
        lr = self.cfg.lr or cfg.lr
        self.actor = Learner(actor, lr=lr, tau=cfg.tau, max_grad_norm=cfg.max_grad_norm)
        self.critic = Learner(critic, lr=lr, tau=cfg.tau, max_grad_norm=cfg.max_grad_norm)
        self.standardiser = Standardiser(self.cfg.standardise, rng.device)

    def act(self, obs: Obs, assignment: Tensor, rng: Generator, *, explore: bool) -> Tensor:
        """Actions (B, N) int64: sampled from the softened policy, or its greatest logit."""
        logits = self.actor.net(self.actor_obs(obs, assignment))
        if explore:
            logits = mix(logits.softmax(-1), 1 / self.actions, self.cfg.epsilon).log() + gumbel(logits.shape, rng)
        return logits.argmax(-1)

    def rows(self, t: Transition, assignment: Tensor) -> Batch:
        """One row per environment of Alg. 2's B_l."""
        reward = self.reward_fn(t, assignment)
        self.standardiser.update_rewards(reward)
        return pack_step(t) | {"assignment": assignment, "reward": reward}

    def update(self, rows: Batch) -> Batch:
        """One step of the critic (Eq. 11) and one of the actor (Eq. 13, ascent)."""
        g, obs, joint = rows["assignment"], unpack(rows), self._one_hot(rows["action"])
        q = self.critic.net(self.critic_obs(obs, g), joint=joint)
        chosen = taken(q, rows["action"])
        td_target = self._target(rows)
        self.standardiser.update_returns(td_target)
        td = mse_loss(chosen, self.standardiser.target(td_target))
        logits = self.actor.net(self.actor_obs(obs, g))
        gain = (q.detach() * self.policy(logits)).sum(-1).mean()
        self.critic.update(td)
        self.actor.update(self.cfg.logit_penalty * logits.square().mean() - gain)
        logs = {"low_td": td, "low_q": chosen.mean(), "low_reward": rows["reward"].mean()}
        return logs | {"low_logit": logits.abs().mean()}

    @torch.no_grad()
    def _target(self, rows: Batch) -> Tensor:
        g, after = rows["assignment"], unpack(rows, "next_")
        best = self.actor.target_net(self.actor_obs(after, g)).argmax(-1)
        q = self.critic.target_net(self.critic_obs(after, g), joint=self._one_hot(best))
        value = self.standardiser.value(taken(q, best))
        return self.standardiser.reward(rows["reward"]) + self.cfg.gamma * (~rows["terminated"]).unsqueeze(-1) * value

    def _one_hot(self, action: Tensor) -> Tensor:
        return one_hot(action, self.actions).float()

    def learners(self) -> Learners:
        """Actor and critic."""
        return [self.actor, self.critic]

    def _parts(self) -> checkpoint.Parts:
        return {"actor": self.actor, "critic": self.critic, "standardiser": self.standardiser}

    def state_dict(self) -> State:
        """Networks and statistics; the generator belongs to its owner."""
        return checkpoint.save_parts(self._parts())

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        checkpoint.load_parts(state, self._parts())


def with_assignment(obs: Obs, assignment: Tensor, *, told: bool = True) -> Obs:
    """The observation with the assignment as the last feature of every pair, or 0 there if it is not `told`."""
    return append(obs, pair=(assignment if told else torch.zeros_like(assignment)).unsqueeze(-1))


def actor_obs(cfg: Config, obs: Obs, assignment: Tensor) -> Obs:
    """The observation of an executor: filtered (Eq. 10), with the assignment or, untold without the filter, zeros."""
    seen = obs._replace(pairs=FILTERS[cfg.filter](obs.pairs, assignment))
    return with_assignment(seen, assignment, told=cfg.filter == "on" or cfg.executor.told == "always")


def critic_obs(cfg: Config, obs: Obs, assignment: Tensor) -> Obs:
    """The observation of a critic: everything, with every assignment or none (Eq. 11 has Q(x, a))."""
    return with_assignment(obs, assignment, told=cfg.executor.critic_sees == "all")


def _local(t: Transition, assignment: Tensor) -> Tensor:
    return assigned_reward(t.local, assignment)


def _team(t: Transition, assignment: Tensor) -> Tensor:
    return t.reward.unsqueeze(-1).expand(assignment.shape[:2])


REWARDS = {"local": _local, "team": _team}
