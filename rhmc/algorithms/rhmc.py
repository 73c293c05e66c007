"""RHMC: a coordinator assigns targets, executors act on them; a regulated reward and a filter steady the learning.

Source: the RHMC paper, Eq. 6 to 13 and Algorithms 1 and 2. Departures and choices, each a field of `Config`:
`coordinator: counterfactual` beside the paper's gradient (Eq. 9 follows the critic's slope at binary assignments, which
need not point to the better neighbour; the finite difference per pair does); the executor's bootstrap keeps the
assignment it acts under; standard signs in Eq. 7, 11 and 13.
"""

from typing import Literal

import torch
from pydantic import Field
from torch import Generator, Tensor
from torch.nn import functional

from rhmc.algorithms.base import Carry
from rhmc.filters import FILTERS
from rhmc.learner import Learner, Replay, pack, unpack
from rhmc.nets import ENCODERS, EncoderName, Sizes, append
from rhmc.regulation import REGULATORS, executed
from rhmc.types import Batch, Frozen, Obs, Spec, State, Transition, assigned_reward


class Config(Frozen):
    """Settings; those that the text gives (lr, gammas, literal Algorithm 1 and 2) are the defaults."""

    kind: Literal["rhmc"] = "rhmc"
    encoder: EncoderName = "mlp"
    hidden: int = Field(64, ge=1)
    regulator: Literal["none", "paper", "exact"] = "paper"
    horizon: int = Field(1, ge=1, description="steps that the regulator lets an agent act")
    alpha: float = Field(0.1, ge=0, le=1, description="alpha_1 of Eq. 6")
    filter: Literal["on", "off"] = "on"
    coordinator: Literal["ddpg", "counterfactual"] = "ddpg"
    assignment_period: int = Field(1, ge=1, description="steps for which an assignment is held")
    flips: int = Field(4, ge=1, description="pairs per state whose counterfactual an update looks at")
    executor: Literal["gumbel", "expected"] = "gumbel"
    lr: float = Field(5e-4, gt=0)
    gamma_h: float = Field(0.99, ge=0, le=1)
    gamma_l: float = Field(0.99, ge=0, le=1)
    polyak: float = Field(0.995, ge=0, le=1)
    flip: float = Field(0.05, ge=0, le=1, description="share of assigned pairs drawn at random while exploring")
    epsilon: float = Field(0.05, ge=0, le=1, description="share of actions drawn at random while exploring")
    entropy: float = Field(0.2, ge=0, description="weight of the assignment's entropy (counterfactual only)")
    buffer: int = Field(50_000, ge=1, description="rows kept at each level")
    batch: int = Field(256, ge=1)
    batch_h: int = Field(256, ge=1, description="rows of a coordinator update")
    warmup: int = Field(2_000, ge=0, description="environment steps before the first update")
    steps_per_update: int = Field(64, ge=1, description="environment steps collected for each update of all networks")


class RHMC:
    """See the module. Assignments are (B, N, M) float, 0 or 1."""

    def __init__(self, cfg: Config, spec: Spec, num_envs: int, rng: Generator) -> None:
        self.cfg, self.spec, self.rng = cfg, spec, rng
        self.regulate, self.filter = REGULATORS[cfg.regulator], FILTERS[cfg.filter]
        self.assignment_loss = {"ddpg": self._ddpg, "counterfactual": self._counterfactual}[cfg.coordinator]
        encoder, seen, told, dev = ENCODERS[cfg.encoder], Sizes.of(spec), Sizes.of(spec, pair=1), rng.device
        nets = {
            "coordinator": encoder.pairs(seen, cfg.hidden, 1),
            "value": encoder.pairs(told, cfg.hidden, 1),
            "executor": encoder.local(told, cfg.hidden, spec.actions),
            "critic": encoder.central(told, cfg.hidden, spec.actions, joint=spec.actions),
        }
        self.learners = {k: Learner(net.to(dev), lr=cfg.lr, polyak=cfg.polyak) for k, net in nets.items()}
        self.coordinator, self.value, self.executor, self.critic = self.learners.values()
        self.low, self.high = Replay(cfg.buffer, rng), Replay(cfg.buffer, rng)
        self.pending: Batch = {}  # the half-done assignment period of each environment
        self.steps = self.updates = 0

    # Acting

    def carry(self, batch: int) -> Carry:
        """The assignment held, and for how many steps it has been."""
        dev = self.rng.device
        held = torch.zeros(batch, self.spec.agents, self.spec.targets, device=dev)
        return {"assignment": held, "age": torch.zeros(batch, dtype=torch.int64, device=dev)}

    def act(self, obs: Obs, carry: Carry, rng: Generator, *, explore: bool) -> tuple[Tensor, Carry, Batch]:
        """Assign where an episode or a period starts, then act on the (filtered) observation. Greedy: thresholds."""
        cfg, dev = self.cfg, rng.device
        new = obs.first | (carry["age"] % cfg.assignment_period == 0)
        logits = self.coordinator.net(obs).squeeze(-1)
        drawn = logits > 0
        if explore:
            chance = torch.lerp(logits.sigmoid(), torch.tensor(0.5, device=dev), cfg.flip)
            drawn = torch.rand(chance.shape, generator=rng, device=dev) < chance
        assignment = torch.where(new.view(-1, 1, 1), drawn.float(), carry["assignment"])
        scores = self.executor.net(self._told(obs, assignment, filtered=True))
        if explore:
            chance = torch.lerp(scores.softmax(-1), torch.tensor(1 / self.spec.actions, device=dev), cfg.epsilon)
            scores = chance.log() + gumbel(scores.shape, rng)
        age = torch.where(new, 0, carry["age"]) + 1
        extra = {"assignment": assignment, "new": new}
        return scores.argmax(-1), {"assignment": assignment, "age": age}, extra

    def _told(self, obs: Obs, assignment: Tensor, *, filtered: bool) -> Obs:
        pairs = self.filter(obs.pairs, assignment) if filtered else obs.pairs
        return append(obs._replace(pairs=pairs), pair=assignment.unsqueeze(-1))

    # Learning

    def observe(self, transition: Transition) -> None:
        """Store the low-level rows of this step, and the high-level rows of the periods that it ends."""
        t, g = transition, transition.extra["assignment"]
        rows = pack(t.obs) | pack(t.next_obs, "next_") | {"assignment": g, "terminal": t.terminal}
        self.low.add(rows | {"action": t.action, "reward": assigned_reward(t.local, g)})
        self.steps += len(t.reward)
        earned = executed(t.completed, g, self.cfg.alpha)
        start = pack(t.obs) | {"assignment": g, "earned": torch.zeros_like(earned), "length": torch.zeros_like(earned)}
        start["regulated"] = self.regulate(t.options(self.cfg.horizon), g, self.cfg.alpha)
        new = t.extra["new"]
        self.pending = _where(new, start, self.pending) if self.pending else start
        self.pending["earned"] = self.pending["earned"] + earned
        self.pending["length"] = self.pending["length"] + 1
        ended = t.terminal | t.truncated | (self.pending["length"] >= self.cfg.assignment_period)
        self._store_periods(ended, t)

    def _store_periods(self, ended: Tensor, t: Transition) -> None:
        p = self.pending
        reward = torch.maximum(p["earned"] / p["length"], p["regulated"])
        rows = {k: p[k] for k in ("agents", "pairs", "peers", "assignment")}
        rows |= pack(t.next_obs, "next_") | {"reward": reward, "earned": p["earned"] / p["length"], "terminal": t.terminal}
        self.high.add({key: value[ended] for key, value in rows.items()})

    def update(self) -> Batch:
        """One update of all four networks for every `steps_per_update` steps since the warm-up."""
        logs: Batch = {}
        while self.updates < (self.steps - self.cfg.warmup) // self.cfg.steps_per_update:
            rows, rows_h = self.low.sample(self.cfg.batch), self.high.sample(self.cfg.batch_h)
            for learner, loss in (
                (self.critic, self._critic),
                (self.executor, self._executor),
            ):
                value, log = loss(rows)
                learner.update(value)
                logs |= log
            for learner, loss in (
                (self.value, self._value),
                (self.coordinator, self.assignment_loss),
            ):
                value, log = loss(rows_h)
                learner.update(value)
                logs |= log
            self.updates += 1
        return logs

    def _critic(self, rows: Batch) -> tuple[Tensor, Batch]:
        """Eq. 11, with one output per own action."""
        g, action = rows["assignment"], rows["action"].unsqueeze(-1)
        obs, after = unpack(rows), unpack(rows, "next_")
        with torch.no_grad():
            best = self.executor.slow(self._told(after, g, filtered=True)).argmax(-1)
            value = self.critic.slow(self._told(after, g, filtered=False), joint=self._one_hot(best))
            value = value.gather(-1, best.unsqueeze(-1)).squeeze(-1)
            live = (~rows["terminal"]).float().unsqueeze(-1)
            target = rows["reward"] + self.cfg.gamma_l * live * value
        q = self.critic.net(self._told(obs, g, filtered=False), joint=self._one_hot(rows["action"]))
        q = q.gather(-1, action).squeeze(-1)
        loss = functional.mse_loss(q, target)
        return loss, {"low_td": loss, "low_q": q.mean(), "low_reward": rows["reward"].mean()}

    def _executor(self, rows: Batch) -> tuple[Tensor, Batch]:
        """Eq. 13 through a straight-through Gumbel-softmax; the others' actions are the stored ones."""
        g, obs = rows["assignment"], unpack(rows)
        logits = self.executor.net(self._told(obs, g, filtered=True))
        soft = (logits + gumbel(logits.shape, self.rng)).softmax(-1)
        own = self._one_hot(soft.argmax(-1)) + soft - soft.detach()
        if self.cfg.executor == "expected":
            own = logits.softmax(-1)
        with torch.no_grad():
            q = self.critic.net(self._told(obs, g, filtered=False), joint=self._one_hot(rows["action"]))
        loss = -(q * own).sum(-1).mean() + 1e-3 * logits.square().mean()
        return loss, {"low_logit": logits.abs().mean()}

    def _one_hot(self, action: Tensor) -> Tensor:
        return functional.one_hot(action, self.spec.actions).float()

    def _value(self, rows: Batch) -> tuple[Tensor, Batch]:
        """Eq. 7, the value of an assignment as a sum over pairs."""
        obs, after = unpack(rows), unpack(rows, "next_")
        with torch.no_grad():
            best = (self.coordinator.slow(after).squeeze(-1) > 0).float()
            value = _worth(self.value.slow, after, best)
            target = rows["reward"] + self.cfg.gamma_h * (~rows["terminal"]).float() * value
        q = _worth(self.value.net, obs, rows["assignment"])
        loss = functional.mse_loss(q, target)
        logs = {"high_td": loss, "high_q": q.mean(), "assigned": rows["assignment"].sum((1, 2)).mean()}
        return loss, logs | {"regulated": rows["reward"].mean(), "earned": rows["earned"].mean()}

    def _ddpg(self, rows: Batch) -> tuple[Tensor, Batch]:
        """Eq. 9 through a straight-through relaxed Bernoulli."""
        obs = unpack(rows)
        logits = self.coordinator.net(obs).squeeze(-1)
        u = torch.rand(logits.shape, generator=self.rng, device=self.rng.device).clamp(1e-6, 1 - 1e-6)
        soft = (logits + u.logit()).sigmoid()
        g = (soft > 0.5).float() + soft - soft.detach()
        return -_worth(self.value.net, obs, g).mean(), {"high_logit": logits.abs().mean()}

    def _counterfactual(self, rows: Batch) -> tuple[Tensor, Batch]:
        """Gradient of the expected value in each pair's Bernoulli logit: Q with the pair minus Q without it."""
        obs = unpack(rows)
        logits = self.coordinator.net(obs).squeeze(-1)
        chance = logits.sigmoid()
        with torch.no_grad():
            g = (torch.rand(chance.shape, generator=self.rng, device=self.rng.device) < chance).float()
            which, advantage = counterfactual(self.value.net, obs, g, self.cfg.flips, self.rng)
            advantage = advantage / advantage.std()
        entropy = functional.softplus(logits) - logits * chance
        loss = -(chance.flatten(1).gather(1, which) * advantage).mean() - self.cfg.entropy * entropy.mean()
        return loss, {"high_logit": logits.abs().mean(), "high_entropy": entropy.mean()}

    # Checkpoints

    def state_dict(self) -> State:
        """Networks, replays, half-done periods, generator and counters."""
        state: State = {name: learner.state_dict() for name, learner in self.learners.items()}
        state |= {"low_replay": self.low.state_dict(), "high_replay": self.high.state_dict(), "pending": self.pending}
        return state | {"rng": self.rng.get_state(), "steps": self.steps, "updates": self.updates}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        for name, learner in self.learners.items():
            learner.load_state_dict(state[name])
        self.low.load_state_dict(state["low_replay"])
        self.high.load_state_dict(state["high_replay"])
        self.pending = {key: value.to(self.rng.device) for key, value in state["pending"].items()}
        self.rng.set_state(state["rng"].cpu())
        self.steps, self.updates = state["steps"], state["updates"]


def counterfactual(
    value: torch.nn.Module, obs: Obs, assignment: Tensor, flips: int, rng: Generator
) -> tuple[Tensor, Tensor]:
    """Q(s, g with g_ij = 1) - Q(s, g with g_ij = 0) of `flips` pairs per state, drawn without replacement.

    Returns:
        Index of the pairs in (N M) and the differences: (B, flips) each.
    """
    b, n, m = assignment.shape
    which = torch.rand(b, n * m, generator=rng, device=rng.device).argsort(-1)[:, :flips]
    flat = assignment.flatten(1)
    flipped = flat.unsqueeze(1).repeat(1, which.shape[1], 1)
    flipped.scatter_(2, which.unsqueeze(-1), 1 - flat.gather(1, which).unsqueeze(-1))
    many = Obs(*(x.repeat_interleave(which.shape[1], 0) for x in obs))
    change = _worth(value, many, flipped.view(-1, n, m)).view(b, -1) - _worth(value, obs, assignment).unsqueeze(1)
    return which, change * (1 - 2 * flat.gather(1, which))


def gumbel(shape: torch.Size, rng: Generator) -> Tensor:
    """Standard Gumbel noise."""
    u = torch.rand(shape, generator=rng, device=rng.device).clamp(1e-10, 1 - 1e-7)
    return -(-u.log()).log()


def _worth(value: torch.nn.Module, obs: Obs, assignment: Tensor) -> Tensor:
    """The high-level critic: (B, N, M) -> (B,)."""
    return value(append(obs, pair=assignment.unsqueeze(-1))).sum((1, 2, 3))


def _where(mask: Tensor, new: Batch, old: Batch) -> Batch:
    return {k: torch.where(mask.view(-1, *[1] * (v.dim() - 1)), v, old[k]) for k, v in new.items()}
