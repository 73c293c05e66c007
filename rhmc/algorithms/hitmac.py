"""HiT-MAC: executors learn alone under any assignment and are frozen; then a coordinator learns to assign them.

Source: Xu et al. 2020, section 3: executors rewarded for their assigned targets; a coordinator with attention over
all pairs, whose critic adds up the pairs' approximate marginal contributions, holds an assignment for 10 steps and
learns from the team's reward.
Departures: the executors are those of `rhmc.hierarchy.executor` (off-policy, a central critic) instead of A3C, under
assignments drawn at random (`practice`), within the run's budget (`pretrain`). Synchronous instead of A3C: rollouts of
all environments, several epochs on each with every pair's ratio of probabilities clipped (`epochs: 1, minibatches: 1`
is the plain actor-critic), normalised advantages, predicted returns standardised. A period that an episode shortens
counts for the steps it had. A pair's contribution is judged from the mean of those before it, not by attention over
them; its order is drawn, not fixed. Truncation bootstraps.
"""

from typing import Literal

import torch
from pydantic import Field
from torch import Generator, Tensor

from rhmc.algorithms.base import About, Method, register_method
from rhmc.hierarchy import attention, executor
from rhmc.hierarchy.decisions import Decisions
from rhmc.learning import checkpoint
from rhmc.learning.experience import Experience
from rhmc.learning.learner import Learners, Replay, choose, pack
from rhmc.learning.schedules import linear
from rhmc.learning.settings import Replayed
from rhmc.types import Batch, Carry, Obs, Spec, State, Transition

ABOUT = About(
    name="HiT-MAC",
    source="Xu et al. 2020",
    family="hierarchical",
    training="centralised",
    execution="central assignment, decentralised action",
    critic="central: of the state, a sum of the pairs' marginal contributions; of own actions for the executors",
    coordination="assignment of targets to executors trained before",
)
PRACTISED = 10  # steps that a random assignment lasts on average


class Executor(executor.Settings):
    """The block `executor`: actors only."""

    method: Literal["gumbel", "expected"] = Field("expected", description="as in `rhmc.hierarchy.executor`")
    final_lr_fraction: float | None = Field(
        None,
        ge=0,
        le=1,
        description="share of their step size that is left at the end of `pretrain` (linear) instead "
        "of the trainer's schedule, which they leave early",
    )


class Config(attention.Config, executor.Config, Replayed):
    """Settings; those of the coordinator are the source's."""

    kind: Literal["hitmac"] = "hitmac"
    executor: Executor = Executor()
    pretrain: int = Field(500_000, ge=0, description="environment steps in which the executors learn")


class HiTMAC:
    """See the module. Discrete actions only. Assignments are (B, N, M) float, 0 or 1."""

    def __init__(self, cfg: Config, spec: Spec, num_envs: int, rng: Generator) -> None:
        self.cfg, self.spec, self.rng = cfg, spec, rng
        self.executor = executor.Executor(cfg, spec, rng)
        self.coordinator = attention.Coordinator(cfg, spec, rng)
        self.practised = Experience(cfg, cfg.executor.batch_size, rng)
        self.decisions = Decisions(cfg.coordinator.n_steps, rng.device)
        self.pending: Batch = {}  # the half-done assignment period of each environment

    @property
    def practising(self) -> bool:
        """True while the executors learn."""
        return self.practised.steps < self.cfg.pretrain

    # Acting

    def carry(self, batch: int) -> Carry:
        """The assignment held, and for how many steps by the coordinator's word."""
        dev = self.rng.device
        held = torch.zeros(batch, self.spec.agents, self.spec.targets, device=dev)
        return {"assignment": held, "age": torch.zeros(batch, dtype=torch.int64, device=dev)}

    def act(self, obs: Obs, carry: Carry, rng: Generator, *, explore: bool) -> tuple[Tensor, Carry, Batch]:
        """Assign where an episode or a period starts, then act on the filtered observation."""
        held, age = carry["assignment"], carry["age"]
        if explore and self.practising:
            extra = {"assignment": practice(obs.first, held, rng)}
            action = self.executor.act(obs, extra["assignment"], rng, explore=True)
            return action, extra | {"age": torch.zeros_like(age)}, extra
        new = obs.first | (age % self.cfg.assignment_period == 0)
        chance = torch.zeros_like(held)
        if bool(new.any()):
            drawn, chance = self.coordinator.assign(obs, rng, explore=explore)
            held = torch.where(new.view(-1, 1, 1), drawn, held)
        after = {"assignment": held, "age": torch.where(new, 0, age) + 1}
        action = self.executor.act(obs, held, rng, explore=False)
        return action, after, {"assignment": held, "new": new, "chance": chance}

    # Learning

    def observe(self, transition: Transition) -> None:
        """Store a row for the executors; after their time, the coordinator's rows of the periods that end now."""
        t, extra = transition, transition.extra
        if self.practising:
            return self.practised.add(self.executor.rows(t, extra["assignment"]), len(t.reward))
        self.coordinator.standardiser.update_rewards(t.reward)
        none = torch.zeros_like(t.reward)
        start = pack(t.obs) | {key: extra[key] for key in ("assignment", "chance")} | {"reward": none, "length": none}
        self.pending = p = choose(extra["new"], start, self.pending or start)
        p["reward"] = p["reward"] + self.coordinator.standardiser.reward(t.reward) / self.cfg.assignment_period
        p["length"] = p["length"] + 1
        done = t.terminated | t.truncated
        rows = p | pack(t.next_obs, "next_") | {"terminated": t.terminated, "done": done}
        return self.decisions.add(rows, done | (p["length"] >= self.cfg.assignment_period))

    def update(self) -> Batch:
        """The executors' updates that are due; when they are frozen, all epochs of the coordinator's full rollout."""
        logs: Batch = {}
        for rows in self.practised.due():
            self._anneal()
            logs = self.executor.update(rows)
        if not self.practising:
            self.practised.replay = Replay(self.cfg.buffer_size, self.rng)  # of no more use
            rollout = self.decisions.take()
            logs |= self.coordinator.learn(rollout) if rollout else {}
        return logs

    def _anneal(self) -> None:
        final = self.cfg.executor.final_lr_fraction
        if final is None:
            return  # as the trainer says
        for learner in self.executor.learners():
            learner.anneal(linear(1.0, final, self.cfg.pretrain, self.practised.steps))

    def learners(self) -> Learners:
        """The learners of both levels."""
        return [*self.coordinator.learners(), *self.executor.learners()]

    # Checkpoints

    def _parts(self) -> checkpoint.Parts:
        levels: checkpoint.Parts = {"coordinator": self.coordinator, "executor": self.executor}
        return levels | {"practised": self.practised, "decisions": self.decisions}

    def state_dict(self) -> State:
        """Both levels, the executors' replay while they learn, the rollout, half-done periods and generator."""
        return checkpoint.save(self.rng, self._parts()) | {"pending": self.pending}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        checkpoint.load(state, self.rng, self._parts())
        self.pending = {key: value.to(self.rng.device) for key, value in state["pending"].items()}


def practice(first: Tensor, held: Tensor, rng: Generator) -> Tensor:
    """Random assignments, drawn anew at the `first` step of an episode and every `PRACTISED` steps on average.

    Every number of targets is as likely for an agent as any other: what a coordinator may want is not known yet.
    """
    draw = torch.rand(*held.shape[:2], held.shape[2] + 1, generator=rng, device=rng.device)
    drawn = (draw[..., 1:] < draw[..., :1]).float()
    new = first | (torch.rand(len(first), generator=rng, device=rng.device) < 1 / PRACTISED)
    return torch.where(new.view(-1, 1, 1), drawn, held)


register_method("hitmac", Method(Config, HiTMAC, ABOUT))
