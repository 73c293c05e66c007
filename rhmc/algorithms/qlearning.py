"""Action values that every agent acts on alone, learned through a mixer: the common part of IQL, VDN and QMIX.

The mixer turns the values of the chosen actions, (B, N), into (B, K) values that are learned towards the team's reward:
itself (IQL, K = N), their sum (VDN, K = 1), a monotone function of them (QMIX, K = 1). Double Q: the network chooses
the next action, the target network values it. With memory: `rhmc.algorithms.recurrent_qlearning`.
"""

from typing import Self

import torch
from pydantic import Field, model_validator
from torch import Generator, Tensor, nn
from torch.nn.functional import mse_loss

from rhmc.learning import checkpoint
from rhmc.learning.experience import Experience
from rhmc.learning.learner import Learner, Learners, pack_step, taken, unpack
from rhmc.learning.memory import Recurrent
from rhmc.learning.normalisation import Standardiser
from rhmc.learning.schedules import linear
from rhmc.learning.settings import OffPolicy, Standardised, TargetNetworks
from rhmc.networks.nets import Sizes, team
from rhmc.networks.recurrent import encoder
from rhmc.types import Batch, Carry, Obs, Spec, State, Transition


class Config(Recurrent, TargetNetworks, Standardised, OffPolicy):
    """Settings; lr and gamma are the paper's."""

    double_q: bool = Field(True, description="double Q; false: the target network chooses too")
    epsilon_end: float = Field(0.05, ge=0, le=1, description="share of random actions in the end, from 1 at the start")
    epsilon_steps: int = Field(50_000, ge=1, description="environment steps until that share is reached (linear)")

    @model_validator(mode="after")
    def _whole_segments(self) -> Self:
        self.need_segments("batch_size")
        if self.remembers and self.buffer_size < self.segment_length:
            raise ValueError(f"buffer_size: must be at least segment_length, {self.segment_length}")
        return self


class Values(nn.Module):
    """Action values of every agent, (B, N, actions), and what mixes them."""

    def __init__(self, agents: nn.Module, mixer: nn.Module) -> None:
        super().__init__()
        self.agents, self.mixer = agents, mixer

    def forward(self, obs: Obs) -> Tensor:
        return self.agents(obs)

    def mixed(self, obs: Obs, action: Tensor) -> Tensor:
        """Mixed values of a joint action (B, N): (B, K)."""
        return self.mixer(obs, taken(self(obs), action))


class QLearning:
    """See the module. Discrete actions only. `mixer` maps an observation and (B, N) values to (B, K)."""

    def __init__(self, cfg: Config, spec: Spec, rng: Generator, mixer: nn.Module) -> None:
        self.cfg, self.spec, self.rng = cfg, spec, rng
        sizes, shapes = Sizes.of(spec), encoder(cfg.encoder)
        agents = team(lambda: shapes.local(sizes, cfg.hidden_dim, spec.actions), spec.agents, share=cfg.share)
        self.q = Learner(Values(agents, mixer).to(rng.device), lr=cfg.lr, tau=cfg.tau, max_grad_norm=cfg.max_grad_norm)
        self.standardiser = Standardiser(cfg.standardise, rng.device)
        self.experience = Experience(cfg, cfg.batch_size, rng)

    # Acting

    def carry(self, batch: int) -> Carry:
        """Nothing is remembered."""
        return {}

    def act(self, obs: Obs, carry: Carry, rng: Generator, *, explore: bool) -> tuple[Tensor, Carry, Batch]:
        """Greedy action (B, N), or epsilon-greedy when exploring."""
        action = self.q.net(obs).argmax(-1)
        return self._explored(action, rng) if explore else action, carry, {}

    def _explored(self, action: Tensor, rng: Generator) -> Tensor:
        epsilon = linear(1.0, self.cfg.epsilon_end, self.cfg.epsilon_steps, self.experience.steps)
        random = torch.randint(self.spec.actions, action.shape, generator=rng, device=rng.device)
        flip = torch.rand(action.shape, generator=rng, device=rng.device) < epsilon
        return torch.where(flip, random, action)

    # Learning

    def observe(self, transition: Transition) -> None:
        """Store one row per environment."""
        t = transition
        self.standardiser.update_rewards(t.reward)
        self.experience.add(pack_step(t), len(t.reward))

    def update(self) -> Batch:
        """The updates that are due."""
        logs: Batch = {}
        for rows in self.experience.due():
            loss, logs = self._loss(rows)
            logs["grad_norm"] = self.q.update(loss)
        return logs

    def _loss(self, rows: Batch) -> tuple[Tensor, Batch]:
        chosen, following = self._values(rows)
        with torch.no_grad():
            value = self.standardiser.value(following)
            live = (~rows["terminated"]).float().unsqueeze(-1)
            td_target = self.standardiser.reward(rows["reward"]).unsqueeze(-1) + self.cfg.gamma * live * value
            self.standardiser.update_returns(td_target)
        loss = mse_loss(chosen, self.standardiser.target(td_target).expand_as(chosen))
        return loss, {"td_loss": loss, "q": chosen.mean()}

    def _values(self, rows: Batch) -> tuple[Tensor, Tensor]:
        """Mixed values of the actions taken, and the target network's of the best ones afterwards: (B, K) both."""
        chosen = self.q.net.mixed(unpack(rows), rows["action"])
        with torch.no_grad():
            after = unpack(rows, "next_")
            best = (self.q.net if self.cfg.double_q else self.q.target_net)(after).argmax(-1)
            return chosen, self.q.target_net.mixed(after, best)

    def learners(self) -> Learners:
        """The values."""
        return [self.q]

    # Checkpoints

    def _parts(self) -> checkpoint.Parts:
        return {"q": self.q, "experience": self.experience, "standardiser": self.standardiser}

    def state_dict(self) -> State:
        """Network, replay, statistics and generator."""
        return checkpoint.save(self.rng, self._parts())

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        checkpoint.load(state, self.rng, self._parts())
