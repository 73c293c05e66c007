"""The cost of one update of a network, by method: batch, optimiser, target network, torch.compile. Prints Markdown.

The network is the executors' critic with the pairwise encoder on the coverage task's extended observation, the largest
part of RHMC's training time. Milliseconds of processor time, one torch thread; forward and backward pass where an
update is meant, the forward pass alone where the network only answers.
"""

import time
from collections.abc import Callable

import env_speed
import torch
from torch import Tensor, nn

from rhmc.envs import coverage
from rhmc.networks.nets import ENCODERS, Sizes
from rhmc.types import Obs

BATCHES = (64, 128, 256, 512, 1024)
SIZES = Sizes.of(coverage.spec(coverage.Config(observation="extended")), pair=1)
ACTIONS = 3


def critic() -> nn.Module:
    """The executors' critic as `rhmc.hierarchy.executor` builds it."""
    return ENCODERS["pairwise"].central(SIZES, 64, ACTIONS, joint=ACTIONS)


def inputs(batch: int) -> tuple[Obs, Tensor]:
    """Random observations and the others' actions."""
    n, m = SIZES.agents, SIZES.targets
    pairs, none = torch.randn(batch, n, m, SIZES.pair), torch.zeros(batch, n, 0)
    return Obs(none, pairs, torch.zeros(batch, n, n, 0), torch.zeros(batch).bool()), torch.randn(batch, n, ACTIONS)


def milliseconds(work: Callable[[], object], repeats: int = 100) -> float:
    """Processor time of one call, after ten to warm up."""
    for _ in range(10):
        work()
    start = time.process_time()
    for _ in range(repeats):
        work()
    return (time.process_time() - start) / repeats * 1e3


def passes(net: Callable[..., Tensor], batch: int) -> tuple[float, float]:
    """Forward and backward; forward alone."""
    obs, joint = inputs(batch)
    both = milliseconds(lambda: net(obs, joint=joint).square().mean().backward())
    with torch.no_grad():
        return both, milliseconds(lambda: net(obs, joint=joint))


def step(**options: bool) -> float:
    """A step of Adam."""
    net = critic()
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-3, **options)  # type: ignore[arg-type]
    obs, joint = inputs(8)
    net(obs, joint=joint).square().mean().backward()
    return milliseconds(optimiser.step)


def follow(*, foreach: bool) -> float:
    """A step of a target network towards its network."""
    slow: list[Tensor] = list(critic().parameters())
    fast: list[Tensor] = list(critic().parameters())

    def one_by_one() -> None:
        for a, b in zip(slow, fast, strict=True):
            a.lerp_(b, 0.01)

    with torch.no_grad():
        return milliseconds((lambda: torch._foreach_lerp_(slow, fast, 0.01)) if foreach else one_by_one)


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    print(f"{env_speed.machine()} Milliseconds of processor time.\n")
    print("| what | milliseconds | microseconds per row |\n|---|---:|---:|")
    for batch in BATCHES:
        both, forward = passes(critic(), batch)
        print(f"| forward and backward, batch {batch} | {both:.2f} | {both / batch * 1e3:.1f} |")
        print(f"| forward alone, batch {batch} | {forward:.2f} | {forward / batch * 1e3:.1f} |", flush=True)
    both, forward = passes(torch.compile(critic(), dynamic=False), 128)
    print(f"| forward and backward, batch 128, torch.compile | {both:.2f} | {both / 0.128:.1f} |")
    print(f"| forward alone, batch 128, torch.compile | {forward:.2f} | {forward / 0.128:.1f} |")
    for name, options in (("fused", {"fused": True}), ("foreach", {"foreach": True}), ("a loop", {"foreach": False})):
        print(f"| step of Adam, {name} | {step(**options):.3f} | |")
    for foreach in (True, False):
        print(f"| target network, {'foreach' if foreach else 'a loop'} | {follow(foreach=foreach):.3f} | |", flush=True)


if __name__ == "__main__":
    main()
