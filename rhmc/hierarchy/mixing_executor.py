"""Executors that act greedily on their own action values, learned together through QMIX's monotone mixture.

An alternative to the actors of `rhmc.hierarchy.executor` (Eq. 10 to 13), with the same observations and rewards.
Each executor values its actions from its filtered row and its assignment. The mixture stands where the critic does: its
weights come from all observations and, by `critic_sees`, all assignments, as in Rashid et al. 2018. It is one value, so
its reward is the mean of the executors' rewards.
"""

import torch
from torch import Generator, Tensor, nn
from torch.nn.functional import mse_loss

from rhmc.hierarchy.executor import REWARDS, Config, actor_obs, critic_obs
from rhmc.learning import checkpoint
from rhmc.learning.learner import Learner, Learners, pack_step, taken, unpack
from rhmc.learning.normalisation import Standardiser
from rhmc.networks.nets import ENCODERS, Sizes, team
from rhmc.types import Batch, Obs, Spec, State, Transition

MIXING_EMBED_DIM = 32  # units of the mixture's hidden layer, as in `rhmc.algorithms.qmix`


class Values(nn.Module):
    """Every executor's values of its own actions and the mixture of the chosen ones."""

    def __init__(self, cfg: Config, spec: Spec) -> None:
        super().__init__()
        self.cfg, encoder, sizes = cfg, ENCODERS[cfg.encoder], Sizes.of(spec, pair=1)
        self.own = team(lambda: encoder.local(sizes, cfg.hidden_dim, spec.actions), spec.agents, share=cfg.share)
        self.mixer = encoder.mixer(sizes, cfg.hidden_dim, MIXING_EMBED_DIM)

    def forward(self, obs: Obs, assignment: Tensor) -> Tensor:
        """Values (B, N, actions)."""
        return self.own(actor_obs(self.cfg, obs, assignment))

    def mixed(self, obs: Obs, assignment: Tensor, action: Tensor) -> Tensor:
        """Value (B,) of a joint action (B, N)."""
        own = taken(self(obs, assignment), action)
        return self.mixer(critic_obs(self.cfg, obs, assignment), own).squeeze(-1)


class QMIXExecutor:
    """See the module; the interface of `rhmc.hierarchy.executor.Executor`. Assignments are (B, N, M) float, 0 or 1."""

    def __init__(self, cfg: Config, spec: Spec, rng: Generator) -> None:
        self.cfg, self.actions = cfg.executor, spec.actions
        self.reward_fn = REWARDS[self.cfg.reward]
        values, lr = Values(cfg, spec).to(rng.device), self.cfg.lr or cfg.lr
        self.q = Learner(values, lr=lr, tau=cfg.tau, max_grad_norm=cfg.max_grad_norm)
        self.standardiser = Standardiser(self.cfg.standardise, rng.device)

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
        reward = self.reward_fn(t, assignment)
        self.standardiser.update_rewards(reward)
        return pack_step(t) | {"assignment": assignment, "reward": reward}

    def update(self, rows: Batch) -> Batch:
        """One gradient step on the temporal difference of the mixture (double Q)."""
        g, reward = rows["assignment"], self.standardiser.reward(rows["reward"]).mean(-1)
        q = self.q.net.mixed(unpack(rows), g, rows["action"])
        with torch.no_grad():
            after = unpack(rows, "next_")
            value = self.standardiser.value(self.q.target_net.mixed(after, g, self.q.net(after, g).argmax(-1)))
            td_target = reward + self.cfg.gamma * (~rows["terminated"]).float() * value
            self.standardiser.update_returns(td_target)
        td = mse_loss(q, self.standardiser.target(td_target))
        self.q.update(td)
        return {"low_td": td, "low_q": q.mean(), "low_reward": rows["reward"].mean()}

    def learners(self) -> Learners:
        """The values."""
        return [self.q]

    def _parts(self) -> checkpoint.Parts:
        return {"q": self.q, "standardiser": self.standardiser}

    def state_dict(self) -> State:
        """Networks and statistics; the generator belongs to its owner."""
        return checkpoint.save_parts(self._parts())

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        checkpoint.load_parts(state, self._parts())
