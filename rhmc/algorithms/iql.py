"""Independent Q-learning: every agent its own action value, parameters shared.

Source: Tan 1993; defaults after EPyMARL's benchmark (Papoudakis et al. 2021) and the RHMC text, section 5.1.
Departures: feed-forward network instead of a recurrent one; double Q; a slow target by polyak averaging instead of a
hard copy; truncation bootstraps.
"""

from typing import Literal

import torch
from pydantic import Field
from torch import Generator, Tensor
from torch.nn import functional

from rhmc.algorithms.base import Carry
from rhmc.learner import Learner, Replay, pack, unpack
from rhmc.nets import ENCODERS, EncoderName, Sizes
from rhmc.schedules import linear
from rhmc.types import Batch, Frozen, Obs, Spec, State, Transition


class Config(Frozen):
    """Settings; lr and gamma are the paper's."""

    kind: Literal["iql"] = "iql"
    encoder: EncoderName = "mlp"
    hidden: int = Field(64, ge=1)
    lr: float = Field(5e-4, gt=0)
    gamma: float = Field(0.99, ge=0, le=1)
    polyak: float = Field(0.995, ge=0, le=1)
    buffer: int = Field(50_000, ge=1, description="rows kept: environment steps")
    batch: int = Field(256, ge=1)
    warmup: int = Field(2_000, ge=0, description="environment steps before the first update")
    steps_per_update: int = Field(64, ge=1, description="environment steps collected for each update")
    epsilon_end: float = Field(0.05, ge=0, le=1)
    epsilon_steps: int = Field(50_000, ge=1)


class IQL:
    """See the module. Discrete actions only."""

    continuous = False

    def __init__(self, cfg: Config, spec: Spec, num_envs: int, rng: Generator) -> None:
        self.cfg, self.spec, self.num_envs, self.rng = cfg, spec, num_envs, rng
        net = ENCODERS[cfg.encoder].local(Sizes.of(spec), cfg.hidden, spec.actions).to(rng.device)
        self.q = Learner(net, lr=cfg.lr, polyak=cfg.polyak)
        self.replay = Replay(cfg.buffer, rng)
        self.steps = self.updates = 0

    # Acting

    def carry(self, batch: int) -> Carry:
        """Nothing is remembered."""
        return {}

    def act(self, obs: Obs, carry: Carry, rng: Generator, *, explore: bool) -> tuple[Tensor, Carry, Batch]:
        """Greedy action (B, N), or epsilon-greedy when exploring."""
        action = self.q.net(obs).argmax(-1)
        if explore:
            epsilon = linear(1.0, self.cfg.epsilon_end, self.cfg.epsilon_steps, self.steps)
            random = torch.randint(self.spec.actions, action.shape, generator=rng, device=rng.device)
            flip = torch.rand(action.shape, generator=rng, device=rng.device) < epsilon
            action = torch.where(flip, random, action)
        return action, carry, {}

    # Learning

    def observe(self, transition: Transition) -> None:
        """Store one row per environment."""
        t = transition
        rows = {"action": t.action, "reward": t.reward, "terminal": t.terminal}
        self.replay.add(rows | pack(t.obs) | pack(t.next_obs, "next_"))
        self.steps += len(t.reward)

    def update(self) -> Batch:
        """One update for every `steps_per_update` steps since the warm-up."""
        logs: Batch = {}
        while self.updates < (self.steps - self.cfg.warmup) // self.cfg.steps_per_update:
            loss, logs = self._loss(self.replay.sample(self.cfg.batch))
            logs["grad_norm"] = self.q.update(loss)
            self.updates += 1
        return logs

    def _loss(self, rows: Batch) -> tuple[Tensor, Batch]:
        chosen = self.q.net(unpack(rows)).gather(-1, rows["action"].unsqueeze(-1)).squeeze(-1)
        with torch.no_grad():
            after = unpack(rows, "next_")
            best = self.q.net(after).argmax(-1, keepdim=True)
            value = self.q.slow(after).gather(-1, best).squeeze(-1)
            live = (~rows["terminal"]).float().unsqueeze(-1)
            target = rows["reward"].unsqueeze(-1) + self.cfg.gamma * live * value
        loss = functional.mse_loss(chosen, target)
        return loss, {"td_loss": loss, "q": chosen.mean()}

    # Checkpoints

    def state_dict(self) -> State:
        """Network, replay, generator and counters."""
        return {
            "q": self.q.state_dict(),
            "replay": self.replay.state_dict(),
            "rng": self.rng.get_state(),
            "steps": self.steps,
            "updates": self.updates,
        }

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        self.q.load_state_dict(state["q"])
        self.replay.load_state_dict(state["replay"])
        self.rng.set_state(state["rng"].cpu())
        self.steps, self.updates = state["steps"], state["updates"]
