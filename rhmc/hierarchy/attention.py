"""The coordinator of HiT-MAC (Xu et al. 2020, section 3): a policy and a critic that attend to all pairs.

Both networks start from an encoder's pair embeddings and one attention layer over all N M of them. `Assigner` gives
every pair a logit. `Contributions` values a state as the sum of what each pair adds to those before it in some order,
after the Shapley value: one pass over the pairs for any order, by running sums.
"""

import torch
from pydantic import Field
from torch import Generator, Tensor, nn
from torch.nn.functional import logsigmoid, mse_loss, scaled_dot_product_attention, softplus

from rhmc.learning import checkpoint
from rhmc.learning.experience import flat, minibatches, values
from rhmc.learning.learner import Learner, Learners, unpack
from rhmc.learning.normalisation import Scale, Standardiser
from rhmc.learning.returns import gae, normalised
from rhmc.learning.settings import Networks
from rhmc.networks.linear import Linear
from rhmc.networks.nets import ENCODERS, EncoderName, Sizes, mlp
from rhmc.networks.sampling import bernoulli
from rhmc.types import Batch, Frozen, Obs, Spec, State


class Settings(Frozen):
    """The block `coordinator`; gamma, gae_lambda, ent_coef and n_steps are the source's."""

    lr: float | None = Field(None, gt=0, description="Adam's step size at this level instead of the method's")
    gamma: float = Field(0.9, ge=0, le=1, description="per assignment period")
    gae_lambda: float = Field(1.0, ge=0, le=1, description="lambda of the advantages")
    standardise: Scale = Field("return", description="as `standardise` of other methods")
    ent_coef: float = Field(0.01, ge=0, description="weight of the policy's entropy")
    n_steps: int = Field(20, ge=1, description="assignments in each environment between updates")
    epochs: int = Field(6, ge=1, description="passes over a rollout")
    minibatches: int = Field(4, ge=1, description="updates of a pass, each on its share of the rows")
    clip_range: float = Field(0.2, gt=0, description="clip a pair's ratio of probabilities at this distance from 1")


class Config(Networks):
    """Settings of a method with this coordinator; period and lr are the source's."""

    assignment_period: int = Field(10, ge=1, description="steps for which an assignment is held")
    coordinator: Settings = Settings()


class Attended(nn.Module):
    """Embeddings of all pairs, each with what it takes from the others by attention -> (B, N M, hidden)."""

    def __init__(self, encoder: EncoderName, sizes: Sizes, hidden: int) -> None:
        super().__init__()
        self.embed = ENCODERS[encoder].pairs(sizes, hidden, hidden)
        self.project = Linear(hidden, 3 * hidden)

    def forward(self, obs: Obs) -> Tensor:
        own = self.embed(obs).flatten(1, 2).relu()
        query, key, value = self.project(own).chunk(3, -1)
        return (own + scaled_dot_product_attention(query, key, value)).relu()


class Assigner(nn.Module):
    """The logit of assigning each pair -> (B, N, M)."""

    def __init__(self, encoder: EncoderName, sizes: Sizes, hidden: int) -> None:
        super().__init__()
        self.body, self.head = Attended(encoder, sizes, hidden), Linear(hidden, 1)

    def forward(self, obs: Obs) -> Tensor:
        return self.head(self.body(obs)).view(obs.pairs.shape[:3])


class Contributions(nn.Module):
    """The value of a state, a sum of what each pair adds to those before it in an order (B, N M) -> (B,)."""

    def __init__(self, encoder: EncoderName, sizes: Sizes, hidden: int) -> None:
        super().__init__()
        self.body, self.head = Attended(encoder, sizes, hidden), mlp(2 * hidden, hidden, 1)

    def forward(self, obs: Obs, order: Tensor) -> Tensor:
        return self.each(self.body(obs), order).sum(1)

    def each(self, pairs: Tensor, order: Tensor) -> Tensor:
        """The contribution of each pair, from itself and the mean of those before it (zeros for the first).

        Args:
            pairs: (B, P, H) embeddings.
            order: (B, P) int64, the pairs in their order.

        Returns:
            (B, P), in that order.
        """
        queue = pairs.gather(1, order.unsqueeze(-1).expand_as(pairs))
        before = torch.arange(queue.shape[1], device=queue.device).clamp(min=1).view(1, -1, 1)
        coalition = (queue.cumsum(1) - queue) / before
        return self.head(torch.cat((coalition, queue), -1)).squeeze(-1)


class Coordinator:
    """Policy and critic, learned from rollouts of decisions. Assignments are (B, N, M) float, 0 or 1."""

    def __init__(self, cfg: Config, spec: Spec, rng: Generator) -> None:
        self.cfg, self.period, self.rng = cfg.coordinator, cfg.assignment_period, rng
        sizes = Sizes.of(spec)
        actor, critic = (net(cfg.encoder, sizes, cfg.hidden_dim).to(rng.device) for net in (Assigner, Contributions))
        lr = self.cfg.lr or cfg.lr
        self.actor = Learner(actor, lr=lr, tau=0.0, max_grad_norm=cfg.max_grad_norm)
        self.critic = Learner(critic, lr=lr, tau=0.0, max_grad_norm=cfg.max_grad_norm)
        self.standardiser = Standardiser(self.cfg.standardise, rng.device)

    def assign(self, obs: Obs, rng: Generator, *, explore: bool) -> tuple[Tensor, Tensor]:
        """Assignment, drawn from the policy or its threshold at 1/2, and the log-likelihood of each pair in it."""
        logits = self.actor.net(obs).detach()
        drawn = bernoulli(logits.sigmoid(), rng) if explore else (logits > 0).float()
        return drawn, likelihood(logits, drawn)

    def learn(self, rollout: Batch) -> Batch:
        """All epochs on a rollout: rows (T, B, ...) as `rhmc.hierarchy.decisions` keeps them."""
        logs: Batch = {}
        for rows in minibatches(self.judge(rollout), self.cfg.epochs, self.cfg.minibatches, self.rng):
            logs = self.improve(rows)
        return logs

    @torch.no_grad()
    def judge(self, rows: Batch) -> Batch:
        """The decisions of a rollout (K, ...), each with its normalised advantage and the critic's target.

        The value after a period that an episode's end shortened is discounted by the period's share of a whole one.
        """
        value, next_values = values(lambda obs: self.standardiser.value(self._output(obs)), rows)
        if self.cfg.gamma:  # `gae` multiplies by gamma once more; without a discount it leaves nothing
            next_values = next_values * self.cfg.gamma ** (rows["length"] / self.period - 1)
        flags = rows["terminated"], rows["done"]
        advantage = gae(rows["reward"], value, next_values, *flags, self.cfg.gamma, self.cfg.gae_lambda)
        data = flat(rows | {"advantage": advantage, "target": value + advantage})
        data = {key: value[data["filled"]] for key, value in data.items()}
        self.standardiser.update_returns(data["target"])
        return data | {"advantage": normalised(data["advantage"]), "target": self.standardiser.target(data["target"])}

    def improve(self, rows: Batch) -> Batch:
        """One step of the critic and one of the actor; no gain from a pair's ratio further than `clip_range` from 1."""
        obs, advantage = unpack(rows), rows["advantage"].view(-1, 1, 1)
        error = mse_loss(self._output(obs), rows["target"])
        logits = self.actor.net(obs)
        ratio = (likelihood(logits, rows["assignment"]) - rows["chance"]).exp()
        clipped = ratio.clamp(1 - self.cfg.clip_range, 1 + self.cfg.clip_range)
        gain = torch.minimum(ratio * advantage, clipped * advantage).mean()
        entropy = (softplus(logits) - logits * logits.sigmoid()).mean()
        self.critic.update(error)
        norm = self.actor.update(-gain - self.cfg.ent_coef * entropy)
        logs = {"value_loss": error, "policy_gain": gain, "entropy": entropy, "grad_norm": norm}
        return logs | {"assigned": rows["assignment"].sum((1, 2)).mean()}

    def _output(self, obs: Obs) -> Tensor:
        b, n, m, _ = obs.pairs.shape
        return self.critic.net(obs, orders(b, n * m, self.rng))

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


def orders(batch: int, pairs: int, rng: Generator) -> Tensor:
    """A random order of the pairs for each state: (B, P) int64."""
    return torch.rand(batch, pairs, generator=rng, device=rng.device).argsort(-1)


def likelihood(logits: Tensor, assignment: Tensor) -> Tensor:
    """Logarithm of the probability of what was drawn for each pair: (B, N, M)."""
    return logsigmoid(torch.where(assignment > 0, logits, -logits))
