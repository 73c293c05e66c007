"""The limit of policies without memory, as the accuracy with which networks copy the 30-step planner. Prints Markdown.

Coverage `flat`, 4 x 5, `extended` observation, pairwise encoder. The planner names the action in every state that the
network's own play visits (DAgger, Ross et al. 2011; the planner acts in a falling share of the first 50 k steps), the
network learns the named actions. `local` sees an agent's own row, `central` everything.
"""

import argparse
from typing import NamedTuple

import env_speed
import torch
from torch import Generator, Tensor
from torch.nn.functional import cross_entropy

from rhmc.envs import coverage, make_env
from rhmc.learning.learner import Learner, pack, unpack
from rhmc.learning.schedules import linear
from rhmc.networks.nets import ENCODERS, Sizes
from rhmc.types import Batch, Obs
from rhmc.yardsticks.coverage import planner

CFG = coverage.Config(observation="extended")
COPIES, KEPT, ROWS = 128, 1500, 2  # environments, steps kept, steps of an update
GUIDED = 50_000  # steps over which the share of the planner's own actions falls to 0
LR, LEFT = 1e-3, 0.05


class Copied(NamedTuple):
    """Greedy return of the network and how often it names the planner's action."""

    value: float
    agreement: float


def imitate(view: str, hidden: int, steps: int) -> Copied:
    """Train a network of `view` on `steps` environment steps and evaluate it on 500 episodes."""
    torch.manual_seed(0)
    rng = torch.Generator().manual_seed(0)
    env = make_env(CFG, COPIES, rng)
    encoder = ENCODERS["pairwise"]
    net = {"local": encoder.local, "central": encoder.central}[view](Sizes.of(env.spec), hidden, env.spec.actions)
    learner = Learner(net, lr=LR, tau=0.0)
    kept: list[tuple[Batch, Tensor]] = []
    obs, agreement = env.reset(), 0.0
    for step in range(0, steps, COPIES):
        named = planner(CFG, env.state, rng)
        with torch.no_grad():
            own = net(obs).argmax(-1)
        agreement = 0.99 * agreement + 0.01 * (own == named).float().mean().item()
        guided = torch.rand(COPIES, 1, generator=rng) < linear(1.0, 0.0, GUIDED, step)
        kept = [*kept[1 - KEPT :], (pack(obs), named)]
        obs = env.step(torch.where(guided, named, own), None).obs
        learner.anneal(linear(1.0, LEFT, steps, step))
        for _ in range(2):
            learner.update(_loss(net, kept, rng))
    return Copied(_evaluate(net, 500), agreement)


def _loss(net: torch.nn.Module, kept: list[tuple[Batch, Tensor]], rng: Generator) -> Tensor:
    some = [kept[int(i)] for i in torch.randint(len(kept), (ROWS,), generator=rng)]
    rows = {key: torch.cat([batch[key] for batch, _ in some]) for key in some[0][0]}
    named = torch.cat([action for _, action in some])
    return cross_entropy(net(unpack(rows)).flatten(0, 1), named.flatten())


@torch.no_grad()
def _evaluate(net: torch.nn.Module, episodes: int) -> float:
    """100 x mean reward per step of the greedy network, on episodes that training did not see."""
    env = make_env(CFG, episodes, torch.Generator().manual_seed(10_000_000))
    obs: Obs = env.reset()
    rewards = []
    for _ in range(env.spec.episode):
        step = env.step(net(obs).argmax(-1), None)
        obs = step.obs
        rewards.append(step.reward.mean())
    return 100 * torch.stack(rewards).mean().item()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=300_000, help="environment steps for each network")
    parser.add_argument("--views", nargs="+", default=["local", "central"], choices=["local", "central"])
    parser.add_argument("--hidden", type=int, nargs="+", default=[64])
    args = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{env_speed.machine()} {args.steps:,} environment steps each.\n")
    print("| sees | hidden units | return | same action as the planner |\n|---|---:|---:|---:|")
    for view in args.views:
        for hidden in args.hidden:
            found = imitate(view, hidden, args.steps)
            print(f"| {view} | {hidden} | {found.value:.1f} | {found.agreement:.0%} |", flush=True)


if __name__ == "__main__":
    main()
