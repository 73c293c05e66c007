"""MADDPG: decentralised actors, each led by the slope of a critic that sees everything, in its own action.

Source: Lowe et al. 2017, eq. 5 and 6 and algorithm 1; the discrete form and its penalty after EPyMARL's benchmark
(Papoudakis et al. 2021).
Departures: parameters shared by all agents, told apart by a one-hot id (`share: false` gives each its own);
feed-forward; a replay of steps; the critics learn from the team's reward; the target's action is the target actor's
best one, not a draw; a share of random actions, or Gaussian noise, when exploring; truncation bootstraps. The discrete
critic has an output for each own action, hence is linear in it: a critic that takes it as input is trained at one-hot
actions only, and its slope there need not point to the better choice.
"""

from functools import partial
from typing import Literal

import torch
from pydantic import Field
from torch import Generator, Tensor
from torch.nn.functional import mse_loss

from rhmc.algorithms.base import About, Method, register_method
from rhmc.learning import checkpoint
from rhmc.learning.experience import Experience
from rhmc.learning.learner import Learner, Learners, pack_step, unpack
from rhmc.learning.normalisation import Standardiser
from rhmc.learning.settings import OffPolicy, Standardised, TargetNetworks
from rhmc.networks.heads import Continuous, Discrete, Head
from rhmc.networks.nets import ENCODERS, Sizes, team
from rhmc.types import Batch, Carry, Obs, Spec, State, Transition

ABOUT = About(
    name="MADDPG",
    source="Lowe et al. 2017",
    family="actor-critic",
    training="centralised",
    execution="decentralised",
    critic="central: all observations and all actions",
    coordination="each actor climbs a central critic of the joint action",
    actions=("discrete", "continuous"),
)


class Config(TargetNetworks, Standardised, OffPolicy):
    """Settings; the penalty is EPyMARL's."""

    kind: Literal["maddpg"] = "maddpg"
    epsilon: float = Field(0.05, ge=0, le=1, description="discrete: share of actions drawn at random while exploring")
    noise: float = Field(0.2, ge=0, description="continuous: deviation of what is added to actions while exploring")
    penalty: float = Field(1e-3, ge=0, description="weight of the square of the actor's outputs")


class MADDPG:
    """See the module."""

    def __init__(self, cfg: Config, spec: Spec, num_envs: int, rng: Generator) -> None:
        self.cfg, self.rng = cfg, rng
        self.head: Head = (
            Continuous(spec.actions, cfg.noise) if spec.continuous else Discrete(spec.actions, cfg.epsilon)
        )
        encoder, sizes = ENCODERS[cfg.encoder], Sizes.of(spec)
        local = partial(encoder.local, sizes, cfg.hidden_dim, spec.actions)
        central = partial(self.head.critic, partial(encoder.central, sizes, cfg.hidden_dim, joint=spec.actions))
        actor, critic = (team(make, spec.agents, share=cfg.share).to(rng.device) for make in (local, central))
        self.actor = Learner(actor, lr=cfg.lr, tau=cfg.tau, max_grad_norm=cfg.max_grad_norm)
        self.critic = Learner(critic, lr=cfg.lr, tau=cfg.tau, max_grad_norm=cfg.max_grad_norm)
        self.standardiser = Standardiser(cfg.standardise, rng.device)
        self.experience = Experience(cfg, cfg.batch_size, rng)

    # Acting

    def carry(self, batch: int) -> Carry:
        """Nothing is remembered."""
        return {}

    def act(self, obs: Obs, carry: Carry, rng: Generator, *, explore: bool) -> tuple[Tensor, Carry, Batch]:
        """Best action (B, N) or (B, N, A); a draw around it when exploring."""
        output = self.actor.net(obs).detach()
        return self.head.explore(output, rng) if explore else self.head.greedy(output), carry, {}

    # Learning

    def observe(self, transition: Transition) -> None:
        """Store one row per environment."""
        t = transition
        self.standardiser.update_rewards(t.reward)
        self.experience.add(pack_step(t), len(t.reward))

    def update(self) -> Batch:
        """The updates that are due: one step of the critic, then one of the actor."""
        logs: Batch = {}
        for rows in self.experience.due():
            td, logs = self._critic_loss(rows)
            logs["grad_norm"] = self.critic.update(td)
            loss, more = self._actor_loss(rows)
            logs |= more | {"actor_grad_norm": self.actor.update(loss)}
        return logs

    def _critic_loss(self, rows: Batch) -> tuple[Tensor, Batch]:
        td_target, taken = self._target(rows), self.head.encode(rows["action"])
        q = self.critic.net(unpack(rows), own=taken, joint=taken).squeeze(-1)
        self.standardiser.update_returns(td_target)
        loss = mse_loss(q, self.standardiser.target(td_target).expand_as(q))
        return loss, {"td_loss": loss, "q": q.mean()}

    @torch.no_grad()
    def _target(self, rows: Batch) -> Tensor:
        after = unpack(rows, "next_")
        best = self.head.encode(self.head.greedy(self.actor.target_net(after)))
        value = self.standardiser.value(self.critic.target_net(after, own=best, joint=best).squeeze(-1))
        live = (~rows["terminated"]).float().unsqueeze(-1)
        return self.standardiser.reward(rows["reward"]).unsqueeze(-1) + self.cfg.gamma * live * value

    def _actor_loss(self, rows: Batch) -> tuple[Tensor, Batch]:
        """Each agent's own action from its actor, the others' as they were taken."""
        obs, taken = unpack(rows), self.head.encode(rows["action"])
        output = self.actor.net(obs)
        gain = self.critic.net(obs, own=self.head.policy(output, self.rng), joint=taken).mean()
        return self.cfg.penalty * output.square().mean() - gain, {"output": output.abs().mean()}

    def learners(self) -> Learners:
        """Actor and critic."""
        return [self.actor, self.critic]

    # Checkpoints

    def _parts(self) -> checkpoint.Parts:
        parts = {"actor": self.actor, "critic": self.critic}
        return parts | {"experience": self.experience, "standardiser": self.standardiser}

    def state_dict(self) -> State:
        """Networks, replay, statistics and generator."""
        return checkpoint.save(self.rng, self._parts())

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        checkpoint.load(state, self.rng, self._parts())


register_method("maddpg", Method(Config, MADDPG, ABOUT))
