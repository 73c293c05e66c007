"""COMA, counterfactual multi-agent policy gradients: an agent learns from what its action adds to the team's value.

A central critic gives the value of each own action beside what everybody sees and what the others do. An action's
advantage is its value minus the mean of all own actions' values under the policy: the others' part cancels out.

Source: Foerster et al. 2018, eq. 4 and algorithm 1.
Departures: the advantage of an action is that of its lambda-return, as the critic alone tells actions apart too badly
(`advantage_estimator: critic` is the source's rule); returns bootstrap with the mean of an agent's own action values,
not the sampled one's; where a rollout or an episode ends, the others' next actions are drawn from the policy;
advantages and returns are standardised; an entropy bonus beside the floor of the chances, which is constant;
minibatches; feed-forward networks; a target critic that moves by a share (`tau`), which also gives the baseline;
truncation bootstraps (`trainer.bootstrap_on_truncation`).
"""

from typing import Literal

import torch
from pydantic import Field
from torch import Generator, Tensor
from torch.nn.functional import mse_loss, one_hot

from rhmc.algorithms.base import About, Method, register_method
from rhmc.learning import checkpoint
from rhmc.learning.experience import Rollout, ends, flat, minibatches
from rhmc.learning.learner import Learner, Learners, taken, unpack
from rhmc.learning.normalisation import Standardiser
from rhmc.learning.returns import td_lambda
from rhmc.learning.settings import OnPolicy, Standardised, TargetNetworks
from rhmc.networks.nets import ENCODERS, Sizes, team
from rhmc.networks.sampling import mix
from rhmc.types import Batch, Carry, Obs, Spec, State, Transition

ABOUT = About(
    name="COMA",
    source="Foerster et al. 2018",
    family="actor-critic",
    training="centralised",
    execution="decentralised",
    critic="central: an agent's action values given the others' actions",
    coordination="credit by a counterfactual baseline",
)


class Config(TargetNetworks, Standardised, OnPolicy):
    """Settings, found on navigation and coverage; the paper's lr is 5e-4, its gamma 0.99, the source's lambda 0.8."""

    kind: Literal["coma"] = "coma"
    lr: float = Field(1e-3, gt=0, description="Adam's step size")
    tau: float = Field(0.02, ge=0, le=1, description="share of the way that the target critic moves per update")
    gamma: float = Field(0.95, ge=0, le=1, description="discount per environment step")
    standardise: Literal["none", "reward", "return"] = Field(
        "return",
        description="learn from rewards, or predict returns, of mean 0 and deviation 1 (`rhmc.learning.normalisation`)",
    )
    n_steps: int = Field(10, ge=1, description="steps of each environment between updates")
    ent_coef: float = Field(0.03, ge=0, description="weight of the policy's entropy")
    td_lambda: float = Field(0.9, ge=0, le=1, description="lambda of the returns")
    advantage_estimator: Literal["critic", "return"] = Field(
        "return", description="value of an action, less the baseline: the critic's value of it, or its lambda-return"
    )
    scale: bool = Field(True, description="give a rollout's advantages mean 0 and deviation 1")
    epochs: int = Field(2, ge=1, description="how often the critic sees a rollout; the actor sees it once")
    minibatches: int = Field(8, ge=1, description="the critic's updates of an epoch")
    actor_minibatches: int = Field(4, ge=1, description="the actor's updates of a rollout")
    epsilon: float = Field(0.02, ge=0, le=1, description="share of the uniform policy in the one that explores")


class COMA:
    """See the module. Discrete actions only."""

    def __init__(self, cfg: Config, spec: Spec, num_envs: int, rng: Generator) -> None:
        self.cfg, self.actions, self.rng = cfg, spec.actions, rng
        sizes, encoder = Sizes.of(spec), ENCODERS[cfg.encoder]
        actor = team(lambda: encoder.local(sizes, cfg.hidden_dim, spec.actions), spec.agents, share=cfg.share)
        critic = team(
            lambda: encoder.central(sizes, cfg.hidden_dim, spec.actions, joint=spec.actions),
            spec.agents,
            share=cfg.share,
        )
        self.actor = Learner(actor.to(rng.device), lr=cfg.lr, tau=0.0, max_grad_norm=cfg.max_grad_norm)
        self.critic = Learner(critic.to(rng.device), lr=cfg.lr, tau=cfg.tau, max_grad_norm=cfg.max_grad_norm)
        self.standardiser = Standardiser(cfg.standardise, rng.device)
        self.rollout = Rollout(cfg.n_steps, rng.device)

    # Acting

    def carry(self, batch: int) -> Carry:
        """Nothing is remembered."""
        return {}

    def act(self, obs: Obs, carry: Carry, rng: Generator, *, explore: bool) -> tuple[Tensor, Carry, Batch]:
        """The likeliest action (B, N); when exploring one drawn from the policy, and the chances (B, N, actions)."""
        logits = self.actor.net(obs)
        if not explore:
            return logits.argmax(-1), carry, {}
        chance = self._chance(logits).detach()
        return draw(chance, rng), carry, {"chance": chance}

    def _chance(self, logits: Tensor) -> Tensor:
        return mix(logits.softmax(-1), 1 / self.actions, self.cfg.epsilon)

    # Learning

    def observe(self, transition: Transition) -> None:
        """Keep the step until the rollout is whole."""
        self.standardiser.update_rewards(transition.reward)
        self.rollout.add(transition, chance=transition.extra["chance"])

    def update(self) -> Batch:
        """The critic's updates, then the actor's, once the rollout is whole."""
        rollout = self.rollout.take()
        if rollout is None:
            return {}
        target, advantage = self._judged(rollout)
        self.standardiser.update_returns(target)
        rows = flat(rollout | {"target": self.standardiser.target(target), "advantage": advantage})
        rows = {key: value for key, value in rows.items() if not key.startswith("next_")}
        logs: Batch = {}
        for part in minibatches(rows, self.cfg.epochs, self.cfg.minibatches, self.rng):
            loss, logs = self._critic_loss(part)
            logs["critic_norm"] = self.critic.update(loss)
        for part in minibatches(rows, 1, self.cfg.actor_minibatches, self.rng):
            loss, more = self._actor_loss(part)
            logs |= more | {"grad_norm": self.actor.update(loss)}
        return logs

    @torch.no_grad()
    def _judged(self, rollout: Batch) -> tuple[Tensor, Tensor]:
        """The lambda-return of every agent and the advantage of its action by the target critic, (T, B, N) both."""
        rows, shape = flat(rollout), rollout["reward"].shape
        q = self._values(unpack(rows), rows["action"])
        value = expected(q, rows["chance"]).unflatten(0, shape)
        last, after = ends(rollout)
        chance = self._chance(self.actor.net(after))
        next_values = torch.cat((value[1:], value[-1:]))
        next_values[last] = expected(self._values(after, draw(chance, self.rng)), chance)
        reward = self.standardiser.reward(rollout["reward"])
        reward, terminated, done = (x.unsqueeze(-1) for x in (reward, rollout["terminated"], rollout["done"]))
        target = td_lambda(reward, next_values, terminated, done, self.cfg.gamma, self.cfg.td_lambda)
        estimates = {"critic": taken(q, rows["action"]).unflatten(0, shape), "return": target}
        advantage = estimates[self.cfg.advantage_estimator] - value
        if self.cfg.scale:
            advantage = (advantage - advantage.mean()) / advantage.std(correction=0).clamp(min=1e-6)
        return target, advantage

    def _values(self, obs: Obs, action: Tensor) -> Tensor:
        """The target critic's values of every own action, given the others' actions: (B, N, actions)."""
        return self.standardiser.value(self.critic.target_net(obs, joint=self._joint(action)))

    def _joint(self, action: Tensor) -> Tensor:
        return one_hot(action, self.actions).float()

    def _critic_loss(self, rows: Batch) -> tuple[Tensor, Batch]:
        q = taken(self.critic.net(unpack(rows), joint=self._joint(rows["action"])), rows["action"])
        loss = mse_loss(q, rows["target"])
        return loss, {"critic_loss": loss, "q": q.mean()}

    def _actor_loss(self, rows: Batch) -> tuple[Tensor, Batch]:
        chance = self._chance(self.actor.net(unpack(rows)))
        surprise = -chance.clamp(min=1e-10).log()
        entropy = (chance * surprise).sum(-1).mean()
        gain = (rows["advantage"] * -taken(surprise, rows["action"])).mean()
        return -gain - self.cfg.ent_coef * entropy, {"entropy": entropy, "gain": gain}

    def learners(self) -> Learners:
        """Actor and critic."""
        return [self.actor, self.critic]

    # Checkpoints

    def _parts(self) -> checkpoint.Parts:
        return {"actor": self.actor, "critic": self.critic, "rollout": self.rollout, "standardiser": self.standardiser}

    def state_dict(self) -> State:
        """Networks, rollout, statistics and generator."""
        return checkpoint.save(self.rng, self._parts())

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        checkpoint.load(state, self.rng, self._parts())


def draw(chance: Tensor, rng: Generator) -> Tensor:
    """Actions (B, N) from their chances (B, N, actions)."""
    return torch.multinomial(chance.flatten(0, 1), 1, generator=rng).view(chance.shape[:2])


def expected(q: Tensor, chance: Tensor) -> Tensor:
    """The mean (B, N) of action values under their chances, (B, N, actions) both: the baseline of eq. 4."""
    return (q * chance).sum(-1)


register_method("coma", Method(Config, COMA, ABOUT))
