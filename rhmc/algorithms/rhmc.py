"""RHMC: a coordinator assigns targets, executors act on them; a regulated reward and a filter steady the learning.

Source: the RHMC paper, Eq. 6 to 13 and Algorithms 1 and 2; the levels are `rhmc.hierarchy.coordinator` and
`rhmc.hierarchy.executor`.
Departures, each a field of `Config`: `coordinator.gradient: counterfactual` and `executor.method: expected` beside the
paper's gradients; `executor.method: qmix` instead of actors (`rhmc.hierarchy.mixing_executor`); `regulator: exact`
beside Algorithm 1, with a `horizon`; an assignment may be held (`assignment_period`); Eq. 6 may charge for targets that
nobody is assigned to (`unassigned`); both levels may learn from the team's reward (`reward` of either block), each on a
scale of its own (`standardise`); `coordinator.method` puts another coordinator in the learned one's place.
Eq. 7, 11 and 13 are read with standard signs; truncation bootstraps.
"""

from typing import Literal, Self

import torch
from pydantic import Field, model_validator
from torch import Generator, Tensor

from rhmc.algorithms.base import About, Method, register_method
from rhmc.hierarchy import coordinator, executor
from rhmc.hierarchy.coordinator import COORDINATORS
from rhmc.hierarchy.mixing_executor import QMIXExecutor
from rhmc.hierarchy.regulation import REGULATORS, Charges, executed
from rhmc.learning import checkpoint
from rhmc.learning.experience import Experience
from rhmc.learning.learner import Learners, Replay, choose, pack
from rhmc.learning.settings import Replayed
from rhmc.types import Batch, Carry, Obs, Spec, State, Transition

ABOUT = About(
    name="RHMC",
    source="the paper, Eq. 6 to 13",
    family="hierarchical",
    training="centralised",
    execution="central assignment, decentralised action",
    critic="central: of the assignment; of own actions given the others' actions and assignments",
    coordination="assignment of targets, regulated reward, target-conditioned filter",
)


class Config(coordinator.Config, executor.Config, Replayed):
    """Settings; those that the text gives (lr, gammas, Algorithms 1 and 2 as printed) are the defaults."""

    kind: Literal["rhmc"] = "rhmc"
    regulator: Literal["none", "paper", "exact"] = Field(
        "paper",
        description="least reward of an assignment: what agents could complete within `horizon` steps, by Algorithm 1 "
        "or its optimum; or none",
    )
    horizon: int = Field(1, ge=1, description="steps that the regulator lets an agent act")
    alpha: float = Field(0.1, ge=0, le=1, description="alpha_1 of Eq. 6")
    unassigned: Literal["free", "charged"] = Field(
        "free", description="whether Eq. 6 charges alpha for a target that is assigned to nobody"
    )
    assignment_period: int = Field(1, ge=1, description="steps for which an assignment is held")

    @model_validator(mode="after")
    def _regulates(self) -> Self:
        if self.coordinator.reward == "team" and self.regulator != "none":
            text = f"'{self.regulator}' bounds Eq. 6; with coordinator.reward 'team' allowed: 'none'"
            raise ValueError(f"regulator: {text}")
        return self


class RHMC:
    """See the module. Discrete actions only. Assignments are (B, N, M) float, 0 or 1."""

    def __init__(self, cfg: Config, spec: Spec, num_envs: int, rng: Generator) -> None:
        self.cfg, self.spec, self.rng = cfg, spec, rng
        self.regulate, self.reward_fn = REGULATORS[cfg.regulator], REWARDS[cfg.coordinator.reward]
        self.charges = Charges(cfg.alpha, cfg.unassigned)
        entry = COORDINATORS[cfg.coordinator.method]
        if fault := entry.misfit(spec):
            raise ValueError(fault)
        self.coordinator = entry.build(cfg, spec, rng)
        self.executor = EXECUTORS[cfg.executor.method](cfg, spec, rng)
        self.low = Experience(cfg, cfg.executor.batch_size, rng)
        self.high = Replay(cfg.buffer_size, rng)
        self.pending: Batch = {}  # the half-done assignment period of each environment

    # Acting

    def carry(self, batch: int) -> Carry:
        """The assignment held, and for how many steps it has been."""
        dev = self.rng.device
        held = torch.zeros(batch, self.spec.agents, self.spec.targets, device=dev)
        return {"assignment": held, "age": torch.zeros(batch, dtype=torch.int64, device=dev)}

    def act(self, obs: Obs, carry: Carry, rng: Generator, *, explore: bool) -> tuple[Tensor, Carry, Batch]:
        """Assign where an episode or a period starts, then act on the filtered observation."""
        new = obs.first | (carry["age"] % self.cfg.assignment_period == 0)
        assignment = carry["assignment"]
        if bool(new.any()):
            drawn = self.coordinator.assign(obs, rng, explore=explore)
            assignment = torch.where(new.view(-1, 1, 1), drawn, assignment)
        action = self.executor.act(obs, assignment, rng, explore=explore)
        age = torch.where(new, 0, carry["age"]) + 1
        return action, {"assignment": assignment, "age": age}, {"assignment": assignment, "new": new}

    # Learning

    def observe(self, transition: Transition) -> None:
        """Store the low-level rows of this step, and the high-level rows of the periods that end with it (Alg. 2)."""
        t, g, cfg = transition, transition.extra["assignment"], self.cfg
        self.low.add(self.executor.rows(t, g), len(t.reward))
        if bool(t.extra["new"].any()):
            none = torch.zeros_like(t.reward)
            start = pack(t.obs) | {"assignment": g, "earned": none, "length": none}
            start["bound"] = self.regulate(t.options(cfg.horizon), g, self.charges)
            self.pending = choose(t.extra["new"], start, self.pending or start)
        p = self.pending = dict(self.pending)
        p["earned"] = p["earned"] + self.reward_fn(t, g, self.charges)
        p["length"] = p["length"] + 1
        over = t.terminated | t.truncated | (p["length"] >= cfg.assignment_period)
        rows = {key: value[over] for key, value in self._period(t).items()}
        self.coordinator.observe(rows)
        self.high.add(rows)

    def _period(self, t: Transition) -> Batch:
        """Rows of B_h: state, assignment, regulated reward (Alg. 1 against what was earned) and next state.

        And the `share` of a whole period that it took: an episode's end may have come first.
        """
        p = self.pending
        rows = {key: p[key] for key in ("agents", "pairs", "peers", "assignment")} | pack(t.next_obs, "next_")
        earned, share = p["earned"] / p["length"], p["length"] / self.cfg.assignment_period
        rows |= {"reward": torch.maximum(earned, p["bound"]), "earned": earned, "share": share}
        return rows | {"terminated": t.terminated}

    def update(self) -> Batch:
        """One update of the executors for every `train_freq` steps since `learning_starts`, once a period has ended.

        The coordinator has one update for every `coordinator.update_every` of these.
        """
        logs: Batch = {}
        for rows in self.low.due() if self.high.size else ():
            logs |= self.executor.update(rows)
            if self.low.updates % self.cfg.coordinator.update_every == 0:
                logs |= self.coordinator.update(self.high.sample(self.cfg.coordinator.batch_size))
        return logs

    def learners(self) -> Learners:
        """The learners of both levels."""
        return [*self.coordinator.learners(), *self.executor.learners()]

    # Checkpoints

    def _parts(self) -> checkpoint.Parts:
        levels: checkpoint.Parts = {"coordinator": self.coordinator, "executor": self.executor}
        return levels | {"low": self.low, "high": self.high}

    def state_dict(self) -> State:
        """Both levels, replays, half-done periods and generator."""
        return checkpoint.save(self.rng, self._parts()) | {"pending": self.pending}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        checkpoint.load(state, self.rng, self._parts())
        self.pending = {key: value.to(self.rng.device) for key, value in state["pending"].items()}


def _assigned(t: Transition, assignment: Tensor, charges: Charges) -> Tensor:
    return executed(t.completed, assignment, charges)


def _team(t: Transition, assignment: Tensor, charges: Charges) -> Tensor:
    return t.reward


EXECUTORS: dict[str, type[executor.Executor | QMIXExecutor]] = {
    "gumbel": executor.Executor,
    "expected": executor.Executor,
    "qmix": QMIXExecutor,
}
REWARDS = {"assigned": _assigned, "team": _team}


register_method("rhmc", Method(Config, RHMC, ABOUT))
