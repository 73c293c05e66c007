"""Executors that act greedily on their own action values, learned together through QMIX's monotone mixture.

The low level of `rhmc.hierarchy.executor` beside its actors (Eq. 10 to 13): what an executor may see, and what it is
paid, stay.
An executor's value is of its filtered row and its assignment; the mixture's weights come from what everybody sees and
all assignments, as in Rashid et al. 2018. The mixture is one value, hence of the mean of the executors' rewards.
"""

import torch
from torch import Generator, Tensor, nn
from torch.nn.functional import mse_loss

from rhmc.hierarchy.executor import PAID, Config, seen, told
from rhmc.learning import checkpoint
from rhmc.learning.learner import Learner, Learners, pack_step, taken, unpack
from rhmc.learning.normalisation import Standard
from rhmc.networks.nets import ENCODERS, Sizes, team
from rhmc.types import Batch, Obs, Spec, State, Transition

EMBED = 32  # units of the mixture's hidden layer, as in `rhmc.algorithms.qmix`


class Values(nn.Module):
    """Every executor's values of its own actions and the mixture of the chosen ones."""

    def __init__(self, cfg: Config, spec: Spec) -> None:
        super().__init__()
        self.filter, encoder, sizes = cfg.filter, ENCODERS[cfg.encoder], Sizes.of(spec, pair=1)
        self.own = team(lambda: encoder.local(sizes, cfg.hidden, spec.actions), spec.agents, share=cfg.share)
        self.mixer = encoder.mixer(sizes, cfg.hidden, EMBED)

    def forward(self, obs: Obs, assignment: Tensor) -> Tensor:
        """Values (B, N, actions)."""
        return self.own(seen(self.filter, obs, assignment))

    def mixed(self, obs: Obs, assignment: Tensor, action: Tensor) -> Tensor:
        """Value (B,) of a joint action (B, N)."""
        return self.mixer(told(obs, assignment), taken(self(obs, assignment), action)).squeeze(-1)


class MixedExecutor:
    """See the module; the interface of `rhmc.hierarchy.executor.Executor`. Assignments are (B, N, M) float, 0 or 1."""

    def __init__(self, cfg: Config, spec: Spec, rng: Generator) -> None:
        self.cfg, self.actions, self.paid = cfg, spec.actions, PAID[cfg.low_reward]
        self.q = Learner(Values(cfg, spec).to(rng.device), lr=cfg.lr, polyak=cfg.polyak, clip=cfg.grad_clip)
        self.standard = Standard(cfg.standardise_l, rng.device)

    def act(self, obs: Obs, assignment: Tensor, rng: Generator, *, explore: bool) -> Tensor:
        """Actions (B, N) int64: the greatest value, or epsilon-greedy."""
        action = self.q.net(obs, assignment).argmax(-1)
        if explore:
            random = torch.randint(self.actions, action.shape, generator=rng, device=rng.device)
            flip = torch.rand(action.shape, generator=rng, device=rng.device) < self.cfg.epsilon
            action = torch.where(flip, random, action)
        return action

    def rows(self, t: Transition, assignment: Tensor) -> Batch:
        """One row per environment of Alg. 2's B_l."""
        reward = self.paid(t, assignment)
        self.standard.see_rewards(reward)
        return pack_step(t) | {"assignment": assignment, "reward": reward}

    def update(self, rows: Batch) -> Batch:
        """One step down the temporal difference of the mixture (double Q)."""
        g, reward = rows["assignment"], self.standard.reward(rows["reward"]).mean(-1)
        q = self.q.net.mixed(unpack(rows), g, rows["action"])
        with torch.no_grad():
            after = unpack(rows, "next_")
            value = self.standard.value(self.q.slow.mixed(after, g, self.q.net(after, g).argmax(-1)))
            target = reward + self.cfg.gamma_l * (~rows["terminal"]).float() * value
            self.standard.see_returns(target)
        td = mse_loss(q, self.standard.target(target))
        self.q.update(td)
        return {"low_td": td, "low_q": q.mean(), "low_reward": rows["reward"].mean()}

    def learners(self) -> Learners:
        """The values."""
        return [self.q]

    def _parts(self) -> checkpoint.Parts:
        return {"q": self.q, "standard": self.standard}

    def state_dict(self) -> State:
        """Networks and statistics; the generator belongs to its owner."""
        return checkpoint.save_parts(self._parts())

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        checkpoint.load_parts(state, self._parts())
