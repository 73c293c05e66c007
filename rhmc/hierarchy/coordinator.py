"""The high level: one policy that assigns targets to agents (sections 4.2 and 4.4, Eq. 6 to 9).

Two gradients for the binary assignment. `ddpg` is Eq. 9 through a straight-through relaxed Bernoulli: it follows the
critic's slope at assignments of 0 and 1, where the critic was never asked between them. `counterfactual` replaces that
slope by the finite difference of the critic per pair, Q(s, g with g_ij = 1) - Q(s, g with g_ij = 0).

A table has the coordinators that `coordinator.method` chooses from: this one, `learned`, and those that packages add.
"""

from collections.abc import Callable
from difflib import get_close_matches
from typing import Any, Literal, NamedTuple, Protocol

import torch
from pydantic import Field, field_validator
from torch import Generator, Tensor, nn
from torch.nn.functional import mse_loss, softplus

from rhmc.learning import checkpoint
from rhmc.learning.learner import Learner, Learners, unpack
from rhmc.learning.normalisation import Scale, Standardiser
from rhmc.learning.settings import TargetNetworks
from rhmc.networks.nets import ENCODERS, PairNet, Sizes, append
from rhmc.networks.sampling import bernoulli, mix, relaxed_bernoulli
from rhmc.registry import register
from rhmc.types import Batch, Frozen, Obs, Spec, State


class HighLevel(Protocol):
    """The interface of a coordinator to RHMC. Assignments are (B, N, M) float, 0 or 1.

    Built as `build(cfg, spec, rng)`: the method's configuration, the sizes of the task, and the generator that samples
    while learning. Network weights are drawn from torch's global generator.
    """

    def assign(self, obs: Obs, rng: Generator, *, explore: bool) -> Tensor:
        """Assignment of each environment; draws come from this `rng`, and none are made without `explore`."""
        ...

    def observe(self, rows: Batch) -> None:
        """Take in the rows of the assignment periods that ended now (`RHMC._period`); there may be none."""
        ...

    def update(self, rows: Batch) -> Batch:
        """Learn from a batch of such rows: scalar tensors to log, or nothing."""
        ...

    def learners(self) -> Learners:
        """Every network that learns, with its optimiser; none where nothing learns."""
        ...

    def state_dict(self) -> State:
        """Everything that assigning and learning depend on, `rng` left out: it belongs to RHMC."""
        ...

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`, bit for bit."""
        ...


def _fits(spec: Spec) -> str:
    return ""


class Coordination(NamedTuple):
    """An entry of the table.

    `misfit(spec)` is the reason why it cannot assign in a task of these sizes, as `field: text` with a field of the
    task's configuration; empty if it can.
    """

    build: Callable[[Any, Spec, Generator], HighLevel]
    misfit: Callable[[Spec], str] = _fits


COORDINATORS: dict[str, Coordination] = {}  # by the name that `coordinator.method` has


def register_coordinator(name: str, entry: Coordination) -> None:
    """Make a coordinator known under the name that studies write; its page calls this once, at its end.

    Raises:
        ValueError: another coordinator has the name.
    """
    register(COORDINATORS, name, entry)


def _list(schema: dict[str, Any]) -> None:
    """The names that are there now, for a reader of the settings."""
    schema["enum"] = list(COORDINATORS)


class Settings(Frozen):
    """The block `coordinator`; gamma is the paper's. All but `method` are settings of the one that learns."""

    method: str = Field(
        "learned",
        json_schema_extra=_list,
        description="who assigns: the coordinator that learns, or one of a package (`register_coordinator`)",
    )
    gradient: Literal["ddpg", "counterfactual"] = Field("ddpg", description="gradient of the assignment policy")
    reward: Literal["assigned", "team"] = Field(
        "assigned", description="reward of the coordinator: Eq. 6, or the team's reward, which knows no regulation"
    )
    lr: float | None = Field(None, gt=0, description="Adam's step size at this level instead of the method's")
    gamma: float = Field(0.99, ge=0, le=1, description="per assignment period")
    standardise: Scale = Field("none", description="as `standardise` of other methods")
    ent_coef: float = Field(0.2, ge=0, description="weight of the assignment's entropy, for advantages of deviation 1")
    assignment_epsilon: float = Field(0.05, ge=0, le=1, description="share of pairs assigned at random while exploring")
    batch_size: int = Field(256, ge=1, description="rows of an update")
    update_every: int = Field(1, ge=1, description="updates of the executors for each one of the coordinator")

    @field_validator("method")
    @classmethod
    def _is_there(cls, name: str) -> str:
        if name not in COORDINATORS:
            near = get_close_matches(name, COORDINATORS, 1, 0.5)
            meant = f"; did you mean '{near[0]}'?" if near else ""
            raise ValueError(f"'{name}' is not allowed; allowed: {', '.join(COORDINATORS)}{meant}")
        return name


class Config(TargetNetworks):
    """Settings of a method with this coordinator; lr is the paper's, for both levels."""

    coordinator: Settings = Settings()


class Coordinator:
    """Actor over all pairs and the critic of an assignment. Assignments are (B, N, M) float, 0 or 1."""

    def __init__(self, cfg: Config, spec: Spec, rng: Generator) -> None:
        self.cfg, self.rng = cfg.coordinator, rng
        self.gain = {"ddpg": self._slope, "counterfactual": self._difference}[self.cfg.gradient]
        encoder = ENCODERS[cfg.encoder]
        actor = encoder.pairs(Sizes.of(spec), cfg.hidden_dim, 1).to(rng.device)
        critic = encoder.pairs(Sizes.of(spec, pair=1), cfg.hidden_dim, 1).to(rng.device)
        lr = self.cfg.lr or cfg.lr
        self.actor = Learner(actor, lr=lr, tau=cfg.tau, max_grad_norm=cfg.max_grad_norm)
        self.critic = Learner(critic, lr=lr, tau=cfg.tau, max_grad_norm=cfg.max_grad_norm)
        self.standardiser = Standardiser(self.cfg.standardise, rng.device)

    def assign(self, obs: Obs, rng: Generator, *, explore: bool) -> Tensor:
        """Assignment (B, N, M): drawn from the softened policy, or its threshold at 1/2."""
        logits = self.actor.net(obs).squeeze(-1)
        if explore:
            return bernoulli(mix(logits.sigmoid(), 0.5, self.cfg.assignment_epsilon), rng)
        return (logits > 0).float()

    def observe(self, rows: Batch) -> None:
        """Count in the rewards of periods that ended."""
        self.standardiser.update_rewards(rows["reward"])

    def update(self, rows: Batch) -> Batch:
        """One step of the critic (Eq. 7) and one of the actor (Eq. 9).

        The value after a period that an episode's end shortened is discounted by the period's `share` of a whole one.
        """
        obs, after = unpack(rows), unpack(rows, "next_")
        with torch.no_grad():
            best = (self.actor.target_net(after).squeeze(-1) > 0).float()
            live = (~rows["terminated"]).float()
            value = self.standardiser.value(assignment_value(self.critic.target_net, after, best))
            discount = self.cfg.gamma ** rows["share"] * live
            td_target = self.standardiser.reward(rows["reward"]) + discount * value
            self.standardiser.update_returns(td_target)
        q = assignment_value(self.critic.net, obs, rows["assignment"])
        td = mse_loss(q, self.standardiser.target(td_target))
        self.critic.update(td)
        logits = self.actor.net(obs).squeeze(-1)
        self.actor.update(-self.gain(obs, logits))
        logs = {"high_td": td, "high_q": q.mean(), "high_logit": logits.abs().mean()}
        logs |= {"assigned": rows["assignment"].sum((1, 2)).mean(), "earned": rows["earned"].mean()}
        return logs | {"regulated": rows["reward"].mean()}

    def _slope(self, obs: Obs, logits: Tensor) -> Tensor:
        return assignment_value(self.critic.net, obs, relaxed_bernoulli(logits, self.rng)).mean()

    def _difference(self, obs: Obs, logits: Tensor) -> Tensor:
        """Expected advantage of the Bernoulli chances plus entropy; advantages scaled to deviation 1."""
        chance = logits.sigmoid()
        with torch.no_grad():
            advantage = differences(self.critic.net, obs, bernoulli(chance, self.rng))
            advantage = advantage / advantage.std().clamp(min=1e-6)
        entropy = softplus(logits) - logits * chance
        return (chance * advantage + self.cfg.ent_coef * entropy).mean()

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


def assignment_value(critic: nn.Module, obs: Obs, assignment: Tensor) -> Tensor:
    """The critic's value of an assignment, a sum over pairs: (B, N, M) -> (B,)."""
    return critic(append(obs, pair=assignment.unsqueeze(-1))).sum((1, 2, 3))


def differences(critic: PairNet, obs: Obs, assignment: Tensor) -> Tensor:
    """Q(s, g with g_ij = 1) - Q(s, g with g_ij = 0) for every pair, the other pairs as in `assignment`. (B, N, M)."""
    given = append(obs, pair=assignment.unsqueeze(-1))
    change = critic.flips(given) - critic(given).sum((1, 2, 3)).view(-1, 1, 1)
    return change * (1 - 2 * assignment)


register_coordinator("learned", Coordination(Coordinator))
