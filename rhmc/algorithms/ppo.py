"""Policies improved by several epochs on what they have just done: the common part of MAPPO and IPPO.

A rollout of all environments gives generalised advantages, normalised over the batch, and lambda-returns as the
critic's targets (Schulman et al. 2016 and 2017). `objective` says what keeps the new policy near the one that acted:
`clip`, the ratio of their probabilities (2017, eq. 7); `kl_adaptive`, a penalty on the divergence between them whose
weight doubles or halves when the divergence misses its target (2017, section 4). With memory:
`rhmc.algorithms.recurrent_ppo`.
"""

from collections.abc import Callable, Iterable
from typing import Literal, Protocol, Self

import torch
from pydantic import Field, model_validator
from torch import Generator, Tensor, nn
from torch.nn.functional import huber_loss

from rhmc.learning import checkpoint
from rhmc.learning.experience import Rollout, flat, minibatches, values
from rhmc.learning.learner import Learner, Learners, taken, unpack
from rhmc.learning.memory import Recurrent
from rhmc.learning.normalisation import Standardiser
from rhmc.learning.returns import gae, normalised
from rhmc.learning.settings import OnPolicy, Standardised
from rhmc.networks.nets import Sizes, team
from rhmc.networks.recurrent import encoder
from rhmc.networks.sampling import gumbel
from rhmc.types import Batch, Carry, Obs, Spec, State, Transition

POLICY_GAIN = 0.01  # of the policy's last layer at the start: nearly uniform


class Config(Recurrent, Standardised, OnPolicy):
    """Settings; gamma is the paper's, the rest the MAPPO authors' (Yu et al. 2022) but for more and larger steps.

    With 1 minibatch and their lr of 7e-4, navigation takes several times as many environment steps to learn.
    """

    lr: float = Field(2e-3, gt=0, description="Adam's step size")
    standardise: Literal["none", "reward", "return"] = Field(
        "return",
        description="learn from rewards, or predict returns, of mean 0 and deviation 1 (`rhmc.learning.normalisation`)",
    )
    gae_lambda: float = Field(0.95, ge=0, le=1, description="lambda of the advantages")
    epochs: int = Field(10, ge=1, description="passes over a rollout")
    minibatches: int = Field(4, ge=1, description="updates of a pass, each on its share of the rows")
    objective: Literal["clip", "kl_adaptive"] = Field(
        "clip",
        description="what keeps the new policy near the old one: a clipped ratio of probabilities, or a penalty on "
        "their divergence",
    )
    clip_range: float = Field(
        0.2, gt=0, description="clip: distance from 1 at which the ratio of probabilities is clipped"
    )
    kl_target: float = Field(0.01, gt=0, description="kl_adaptive: divergence of a rollout's updates, in nats")
    huber: float = Field(10.0, gt=0, description="error of the value beyond which its loss is linear")
    segment_length: int = Field(
        25, ge=1, description="with a GRU: steps in a row that are learned from at once, through which gradients flow"
    )

    @model_validator(mode="after")
    def _whole_segments(self) -> Self:
        self.need_segments("n_steps")
        return self


class Objective(Protocol):
    """The objective of an update: a loss, and an adaptation to the divergence after the epochs."""

    def __call__(self, new: Tensor, old: Tensor, action: Tensor, advantage: Tensor) -> Tensor:
        """Loss (B, N) of log-policies (B, N, actions), for actions and their advantages (B, N)."""
        ...

    def adapt(self, divergence: Tensor) -> None: ...
    def state_dict(self) -> State: ...
    def load_state_dict(self, state: State) -> None: ...


class Clip:
    """No gain from a ratio further than `clip_range` from 1 (Schulman et al. 2017, eq. 7)."""

    def __init__(self, cfg: Config, device: torch.device) -> None:
        self.low, self.high = 1 - cfg.clip_range, 1 + cfg.clip_range

    def __call__(self, new: Tensor, old: Tensor, action: Tensor, advantage: Tensor) -> Tensor:
        change = ratio(new, old, action)
        return -torch.minimum(change * advantage, change.clamp(self.low, self.high) * advantage)

    def adapt(self, divergence: Tensor) -> None:
        """Nothing is adapted."""

    def state_dict(self) -> State:
        """Nothing is kept."""
        return {}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""


class Penalty:
    """A price `beta` on the divergence from the old policy, after Schulman et al. 2017, section 4 and eq. 8."""

    def __init__(self, cfg: Config, device: torch.device) -> None:
        self.target, self.beta = cfg.kl_target, torch.ones((), device=device)

    def __call__(self, new: Tensor, old: Tensor, action: Tensor, advantage: Tensor) -> Tensor:
        return self.beta * kl(old, new) - ratio(new, old, action) * advantage

    def adapt(self, divergence: Tensor) -> None:
        """Dearer when the policy has moved too far, cheaper when not far enough; right within a factor of 1.5."""
        too_far, too_near = divergence > 1.5 * self.target, divergence < self.target / 1.5
        self.beta = torch.where(too_far, 2 * self.beta, torch.where(too_near, self.beta / 2, self.beta))

    def state_dict(self) -> State:
        """The price."""
        return {"beta": self.beta}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        self.beta = state["beta"].to(self.beta.device)


OBJECTIVES: dict[str, type[Clip] | type[Penalty]] = {"clip": Clip, "kl_adaptive": Penalty}


class PPO:
    """See the module. Discrete actions only. `sees` is the shape of the critic: the own row, or everything."""

    def __init__(self, cfg: Config, spec: Spec, rng: Generator, sees: Literal["local", "central"]) -> None:
        self.cfg, self.spec, self.rng = cfg, spec, rng
        sizes, shapes = Sizes.of(spec), encoder(cfg.encoder)

        def learner(make: Callable[..., nn.Module], out: int, gain: float) -> Learner[nn.Module]:
            net = team(lambda: orthogonal(make(sizes, cfg.hidden_dim, out), gain), spec.agents, share=cfg.share)
            return Learner(net.to(rng.device), lr=cfg.lr, tau=0.0, max_grad_norm=cfg.max_grad_norm)

        self.actor = learner(shapes.local, spec.actions, POLICY_GAIN)
        self.critic = learner(shapes.central if sees == "central" else shapes.local, 1, 1.0)
        self.objective: Objective = OBJECTIVES[cfg.objective](cfg, rng.device)
        self.standardiser = Standardiser(cfg.standardise, rng.device)
        self.rollout = Rollout(cfg.n_steps, rng.device)

    # Acting

    def carry(self, batch: int) -> Carry:
        """Nothing is remembered."""
        return {}

    def act(self, obs: Obs, carry: Carry, rng: Generator, *, explore: bool) -> tuple[Tensor, Carry, Batch]:
        """The likeliest action (B, N), or one drawn from the policy when exploring; and that policy."""
        policy = self._policy(obs).detach()
        return self._drawn(policy, rng, explore=explore), carry, {"policy": policy}

    def _drawn(self, policy: Tensor, rng: Generator, *, explore: bool) -> Tensor:
        return (policy + gumbel(policy.shape, rng) if explore else policy).argmax(-1)

    # Learning

    def observe(self, transition: Transition) -> None:
        """Store one row per environment, with the policy that acted."""
        self.standardiser.update_rewards(transition.reward)
        self.rollout.add(transition, policy=transition.extra["policy"])

    def update(self) -> Batch:
        """All epochs, once a rollout is full."""
        rollout = self.rollout.take()
        if rollout is None:
            return {}
        rows, logs = self._judged(rollout)
        for part in self._minibatches(rows):
            logs |= self._improve(part) | self._learn_value(part)
        with torch.no_grad():
            logs["kl"] = kl(rows["policy"], self._policies(rows)).mean()
        self.objective.adapt(logs["kl"])
        return logs

    @torch.no_grad()
    def _judged(self, rows: Batch) -> tuple[Batch, Batch]:
        """Rows (T B, ...) with normalised advantages and the critic's targets, (T B, N) both."""
        value, next_values = values(lambda obs: self.standardiser.value(self._value(obs)), rows)
        kept, logs = self._aims(rows, value, next_values)
        return flat(kept), logs

    def _aims(self, rows: Batch, value: Tensor, next_values: Tensor) -> tuple[Batch, Batch]:
        """The same (T, B, ...) from values of every step and of what follows it, (T, B, N) both."""
        reward = self.standardiser.reward(rows["reward"]).unsqueeze(-1)  # the team's, to every agent
        terminated, done = rows["terminated"].unsqueeze(-1), rows["done"].unsqueeze(-1)
        advantage = gae(reward, value, next_values, terminated, done, self.cfg.gamma, self.cfg.gae_lambda)
        target = value + advantage
        self.standardiser.update_returns(target)
        kept = {key: rows[key] for key in ("agents", "pairs", "peers", "action", "policy")}
        kept |= {"advantage": normalised(advantage), "target": self.standardiser.target(target)}
        return kept, {"value": value.mean(), "explained": 1 - advantage.var() / target.var()}

    def _minibatches(self, rows: Batch) -> Iterable[Batch]:
        """Every row once per epoch; without a draw where a pass is one update."""
        if self.cfg.minibatches == 1:
            return [rows] * self.cfg.epochs
        return minibatches(rows, self.cfg.epochs, self.cfg.minibatches, self.rng)

    def _improve(self, rows: Batch) -> Batch:
        policy = self._policies(rows)
        loss = self.objective(policy, rows["policy"], rows["action"], rows["advantage"]).mean()
        entropy = -(policy.exp() * policy).sum(-1).mean()
        norm = self.actor.update(loss - self.cfg.ent_coef * entropy)
        return {"policy_loss": loss, "entropy": entropy, "grad_norm": norm}

    def _learn_value(self, rows: Batch) -> Batch:
        loss = huber_loss(self._predicted(rows), rows["target"], delta=self.cfg.huber)
        return {"value_loss": loss, "critic_grad_norm": self.critic.update(loss)}

    def _policies(self, rows: Batch) -> Tensor:
        return self._policy(unpack(rows))

    def _predicted(self, rows: Batch) -> Tensor:
        return self._value(unpack(rows))

    def _policy(self, obs: Obs) -> Tensor:
        """Logarithm of the probability of each action: (B, N, actions)."""
        return self.actor.net(obs).log_softmax(-1)

    def _value(self, obs: Obs) -> Tensor:
        """Output of the critic for each agent, on the scale of its targets: (B, N)."""
        return self.critic.net(obs).squeeze(-1)

    def learners(self) -> Learners:
        """Actor and critic."""
        return [self.actor, self.critic]

    # Checkpoints

    def _parts(self) -> checkpoint.Parts:
        learners = {"actor": self.actor, "critic": self.critic}
        return learners | {"rollout": self.rollout, "standardiser": self.standardiser, "objective": self.objective}

    def state_dict(self) -> State:
        """Networks, rollout, statistics, price and generator."""
        return checkpoint.save(self.rng, self._parts())

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        checkpoint.load(state, self.rng, self._parts())


def orthogonal(net: nn.Module, gain: float) -> nn.Module:
    """The network with orthogonal weights and no biases: for ReLU inside, of size `gain` in the last layer."""
    layers = [layer for layer in net.modules() if isinstance(layer, nn.Linear)]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else 2**0.5)
        if layer.bias is not None:
            nn.init.zeros_(layer.bias)
    return net


def ratio(new: Tensor, old: Tensor, action: Tensor) -> Tensor:
    """Ratio of the new to the old probability of an action (B, N), from log-policies (B, N, actions): (B, N)."""
    return (taken(new, action) - taken(old, action)).exp()


def kl(old: Tensor, new: Tensor) -> Tensor:
    """Divergence of `new` from `old`, both log-policies (B, N, actions), in nats: (B, N)."""
    return (old.exp() * (old - new)).sum(-1)
