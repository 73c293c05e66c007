"""Figures 1 to 3: the networks that RHMC builds for the paper's task, as a graph of layers traced in a real pass.

Nothing is written down by hand: layers are found by running each network once, and the lines between them by following
the gradient's graph from a layer's input back to the outputs and inputs that it was made of.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Generator, Tensor, nn

from rhmc.algorithms.rhmc import RHMC, Config
from rhmc.envs import coverage, make_env
from rhmc.hierarchy import executor
from rhmc.hierarchy.coordinator import Coordinator, assignment_value
from rhmc.types import Obs

TASK = {"agents": 4, "targets": 5}  # section 5.2
BUILDS = {"mlp": "paper", "pairwise": "extended"}  # encoder -> the observation that it is studied with
OPERATIONS = {  # what the gradient's graph calls it -> what it does
    "MaskedFillBackward": "filter",
    "_MeanMaxBackward": "mean, max",
    "MeanBackward": "mean",
    "SumBackward": "sum",
    "AddBackward": "sum",
    "ReluBackward": "ReLU",
}

Record = dict[str, Any]
Visit = Callable[[Any], bool]


class Call(NamedTuple):
    """One layer at work. `made` and `makes` are its input's and its output's place in the gradient's graph."""

    name: str
    layer: nn.Module
    input: Tensor
    output: Tensor
    made: Any  # kept at the time of the call: a later operation in place moves the tensor on
    makes: Any


def describe_modules() -> list[Record]:
    """RHMC on each encoder: `encoder`, `observation`, `task`, the `settings` that shape it, and its four `networks`.

    A network is a record of `role` (`coordinator actor`, ...), `kind` (its class), `parameters`, `inputs` and `output`
    with shapes without the batch, `layers` (name, kind, shape in and out, parameters) and `edges` (source, target,
    what happens on the way). An edge's source is an input or a layer; the target `output` is the network's output.
    """
    return [_build(encoder, observation) for encoder, observation in BUILDS.items()]


def _build(encoder: str, observation: str) -> Record:
    env = coverage.Config.model_validate(TASK | {"observation": observation})
    cfg = Config.model_validate({"encoder": encoder})
    task = make_env(env, 1, Generator().manual_seed(0))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        method = RHMC(cfg, task.spec, 1, Generator())
    networks = list(_networks(method, task.reset()))
    shaping = ("filter", "regulator", "horizon", "alpha", "assignment_period", "hidden_dim", "share")
    settings = {name: getattr(cfg, name) for name in shaping}
    spec = task.spec._asdict()
    shown = env.model_dump(mode="json", exclude={"boxes"})
    return {"encoder": encoder, "task": shown, "spec": spec, "settings": settings, "networks": networks}


def _networks(method: RHMC, obs: Obs) -> Iterator[Record]:
    """The four networks, each called as learning calls it."""
    low, high, spec = method.executor, method.coordinator, method.spec
    assert isinstance(low, executor.Executor)
    assert isinstance(high, Coordinator)
    shape = (1, spec.agents, spec.targets)
    assignment, joint = torch.ones(shape), torch.zeros(1, spec.agents, spec.actions)
    seen = {"own features": obs.agents, "pairs": obs.pairs, "peers": obs.peers}
    given = seen | {"assignment": assignment}
    taken = given | {"others' actions": joint}

    def view(x: dict[str, Tensor]) -> Obs:
        return Obs(x["own features"], x["pairs"], x["peers"], obs.first)

    yield trace("coordinator actor", high.actor.net, seen, lambda x: high.actor.net(view(x)))
    yield trace(
        "coordinator critic",
        high.critic.net,
        given,
        lambda x: assignment_value(high.critic.net, view(x), x["assignment"]),
    )
    yield trace(
        "executor actor",
        low.actor.net,
        given,
        lambda x: low.actor.net(low.actor_obs(view(x), x["assignment"])),
    )
    yield trace(
        "executor critic",
        low.critic.net,
        taken,
        lambda x: low.critic.net(low.critic_obs(view(x), x["assignment"]), joint=x["others' actions"]),
    )


def trace(role: str, net: nn.Module, inputs: dict[str, Tensor], run: Callable[[dict[str, Tensor]], Tensor]) -> Record:
    """Run a network once and describe what happened, see `describe_modules`. Inputs without features are left out."""
    given = {name: x.detach().clone().requires_grad_() for name, x in inputs.items()}
    calls: list[Call] = []
    names = {module: name for name, module in net.named_modules()}

    def note(module: nn.Module, args: tuple[Tensor, ...], output: Tensor) -> None:
        calls.append(Call(names[module], module, args[0], output, args[0].grad_fn, output.grad_fn))

    hooks = [m.register_forward_hook(note) for m in net.modules() if not list(m.children())]
    try:
        output = run(given)
    finally:
        for hook in hooks:
            hook.remove()
    return {
        "role": role,
        "kind": type(net).__name__,
        "parameters": sum(p.numel() for p in net.parameters()),
        "inputs": [{"name": name, "shape": list(x.shape[1:])} for name, x in given.items() if x.numel()],
        "output": list(output.shape[1:]),
        "layers": [_layer(call) for call in calls],
        "edges": _edges(calls, {name: x for name, x in given.items() if x.numel()}, output),
    }


def _layer(call: Call) -> Record:
    return {
        "name": call.name,
        "kind": type(call.layer).__name__,
        "in": call.input.shape[-1],
        "out": call.output.shape[-1],
        "parameters": sum(p.numel() for p in call.layer.parameters()),
    }


def _edges(calls: list[Call], inputs: dict[str, Tensor], output: Tensor) -> list[Record]:
    """Lines from inputs and layers to layers and to `output`. A layer that is called twice is one box."""
    made = {call.makes: call.name for call in calls}
    found: dict[tuple[str, str], set[str]] = {}
    ends = [(call.name, call.made, call.input) for call in calls] + [("output", output.grad_fn, output)]
    for target, start, tensor in ends:
        direct = [name for name, x in inputs.items() if x is tensor]
        for source, way in [(name, frozenset[str]()) for name in direct] + _sources(start, made, inputs):
            found.setdefault((source, target), set()).update(way)
    return [{"from": a, "to": b, "through": sorted(way)} for (a, b), way in found.items() if a != b]


def _sources(start: Any, made: dict[Any, str], inputs: dict[str, Tensor]) -> list[tuple[str, frozenset[str]]]:
    """The origin of a tensor: layers' outputs and inputs, with the operations on the way. `start`: its grad_fn."""
    leaves = {id(x): name for name, x in inputs.items()}
    todo: list[tuple[Any, frozenset[str]]] = [(start, frozenset())] if start is not None else []
    seen: set[tuple[Any, frozenset[str]]] = set()
    found: dict[str, frozenset[str]] = {}
    while todo:
        node, way = todo.pop()
        if (node, way) in seen:
            continue
        seen.add((node, way))
        name = made.get(node) or leaves.get(id(getattr(node, "variable", None)))
        if name:
            found[name] = found.get(name, frozenset()) | way
            continue
        word = OPERATIONS.get(type(node).__name__.rstrip("0123456789"))
        todo += [(after, way | {word} if word else way) for after, _ in node.next_functions if after is not None]
    return sorted(found.items())
