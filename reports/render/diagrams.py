"""Figures 1 to 3: RHMC's networks with the layers, widths and parameters that they were found to have."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from reports.data.drawn import Build, Layer, Network
from reports.render.canvas import BLUE, FAINT, GREEN, INK, ORANGE, PAPER, QUIET, Drawing, blank, foot, head, styled
from reports.render.tables import describe_task, joined

INPUT, OUTPUT = "#E8F1F8", "#FBEDE3"
STEP, WIDTH = 3.9, 2.0  # from column to column, and of a box


class Box(NamedTuple):
    """A box of a diagram: words, a second line, its column, and whether it is an input, a layer or the output."""

    title: str
    detail: str
    column: int
    face: str


class Flow(NamedTuple):
    """A network with activations drawn into the layers before them."""

    boxes: dict[str, Box]
    arrows: list[tuple[str, str, str]]  # from, to, words

    @property
    def columns(self) -> int:
        """The number of columns."""
        return 1 + max(box.column for box in self.boxes.values())

    def rows(self, column: int) -> list[str]:
        """Names of the boxes in a column."""
        return [name for name, box in self.boxes.items() if box.column == column]


def flow(network: Network) -> Flow:
    """Boxes and arrows of a network, a box right of all that it is made from."""
    merged = _activations(network)
    edges = [(merged.get(e.source, e.source), merged.get(e.target, e.target), e.through) for e in network.edges]
    edges = [(a, b, through) for a, b, through in edges if a != b]
    names = [x.name for x in network.inputs] + [x.name for x in network.layers if x.name not in merged] + ["output"]
    columns = _columns(names, [(a, b) for a, b, _ in edges])
    boxes = {x.name: Box(x.name, _shape(x.shape), columns[x.name], INPUT) for x in network.inputs}
    active = set(merged.values())
    for layer in network.layers:
        if layer.name not in merged:
            boxes[layer.name] = Box(*_words(layer, layer.name in active), columns[layer.name], PAPER)
    boxes["output"] = Box("output", _shape(network.output), columns["output"], OUTPUT)
    return Flow(boxes, [(a, b, "\n".join(sorted(through))) for a, b, through in edges])


def architecture(builds: Sequence[Build]) -> Drawing:
    """Figure 1: the two levels, what each is given, and the regulator between them."""
    first = builds[0]
    with styled():
        figure = blank(10.5, 6.6)
        head(figure, "RHMC: architecture", _subtitle(builds))
        axes = _canvas(figure, (0.02, 0.08, 0.96, 0.78), (0, 21), (0, 11))
        _block(axes, (0.3, 4.0, 3.6, 3.0), "Task", _task_lines(first), GREEN)
        _block(axes, (6.2, 6.6, 8.6, 4.0), "High level: coordinator", _network_lines(builds, "coordinator"), BLUE)
        _block(axes, (6.2, 0.4, 8.6, 4.0), "Low level: executors, shared", _network_lines(builds, "executor"), BLUE)
        settings = first.settings
        regulator = [f"{settings.regulator}: horizon {settings.horizon}", f"Eq. 6 with α = {settings.alpha:g}"]
        _block(axes, (16.9, 6.9, 3.9, 2.4), "Regulator", regulator, ORANGE)
        _block(
            axes,
            (16.9, 1.3, 3.9, 2.3),
            "Filter (Eq. 10)",
            [f"{settings.filter}: hides what is", "not assigned"],
            ORANGE,
        )
        for start, end, words, at in (
            ((3.9, 6.2), (6.2, 8.4), "state", (4.2, 7.7)),
            ((14.8, 9.0), (16.9, 8.6), "assignment", (14.95, 9.15)),
            ((16.9, 7.6), (14.8, 7.4), "regulated\nreward", (15.0, 6.45)),
            ((10.5, 6.6), (10.5, 4.4), "assignment g (agents × targets)", (10.7, 5.4)),
            ((14.8, 5.9), (17.6, 3.6), "", (0, 0)),
            ((16.9, 2.5), (14.8, 2.3), "filtered\nstate", (15.1, 1.35)),
            ((6.2, 2.4), (3.2, 4.0), "joint action", (2.0, 2.8)),
        ):
            _arrow(axes, start, end)
            axes.text(at[0], at[1], words, fontsize=8, color=QUIET)
        axes.plot([10.5, 14.8], [5.9, 5.9], color=QUIET, linewidth=1.1)
        foot(
            figure,
            "Traced from networks built with the method's defaults; target networks not shown. "
            "Widths: features in → units of each layer.",
        )
    return Drawing(figure, numbers(builds, ("coordinator", "executor")))


def level(builds: Sequence[Build], role: str, title: str) -> Drawing:
    """Figures 2 and 3: actor and critic of one level, layer by layer, on each encoder."""
    parts = [(build, build.network(f"{role} {part}")) for build in builds for part in ("actor", "critic")]
    flows = [flow(network) for _, network in parts]
    heights = [max(1.35, 0.72 * max(len(f.rows(c)) for c in range(f.columns))) + 0.45 for f in flows]
    with styled():
        figure = blank(13.5, sum(heights) + 1.35)
        head(figure, title, _subtitle(builds))
        top = 1 - 0.75 / (sum(heights) + 1.35)
        wide = max(f.columns for f in flows)
        for (build, network), boxes, height in zip(parts, flows, heights, strict=True):
            share = height / (sum(heights) + 1.35)
            axes = _canvas(figure, (0.02, top - share, 0.96, share), (0, wide * STEP), (0, height / 0.72))
            _draw_flow(axes, boxes, network, build.encoder)
            top -= share
        foot(figure, "Traced from the built networks. Grey words: what happens on the way, in no order.")
    return Drawing(figure, numbers(builds, (role,)))


def numbers(builds: Sequence[Build], roles: Sequence[str]) -> pd.DataFrame:
    """Every layer: encoder, network, class, layer, kind, width in and out, parameters."""
    rows = [
        (b.encoder, n.role, n.kind, x.name, x.kind, x.width_in, x.width_out, x.parameters)
        for b in builds
        for n in b.networks
        for x in n.layers
        if n.role.startswith(tuple(roles))
    ]
    return pd.DataFrame(rows, columns=["encoder", "network", "class", "layer", "kind", "in", "out", "parameters"])


def widths(network: Network) -> str:
    """`80 → 64 → 64 → 20` of a chain; of a branched network its first and last width and the number of layers."""
    linear = [layer for layer in network.layers if layer.parameters]
    if all(a.width_out == b.width_in for a, b in pairwise(linear)):
        return " → ".join(str(x) for x in [linear[0].width_in, *(layer.width_out for layer in linear)])
    return f"{linear[0].width_in} → … → {linear[-1].width_out}, {len(linear)} layers"


def _activations(network: Network) -> dict[str, str]:
    """Layers without parameters that follow one other layer only, with that layer."""
    layers = {layer.name: layer for layer in network.layers}
    found: dict[str, str] = {}
    for edge in network.edges:
        layer = layers.get(edge.target)
        if layer and layer.kind == "ReLU" and edge.source in layers:
            found[layer.name] = found.get(edge.source, edge.source)
    return found


def _columns(names: Sequence[str], edges: Sequence[tuple[str, str]]) -> dict[str, int]:
    """The longest way to each box from an input; an input stands right before the first box that uses it."""
    columns = dict.fromkeys(names, 0)
    for _ in names:
        for a, b in edges:
            columns[b] = max(columns[b], columns[a] + 1)
    made = {b for _, b in edges}
    first = {a: min(columns[b] for x, b in edges if x == a) - 1 for a, _ in edges if a not in made}
    return columns | first


def _words(layer: Layer, active: bool) -> tuple[str, str]:
    kind = "" if layer.kind == "Linear" else f"{layer.kind} "
    return layer.name.removeprefix("body."), f"{kind}{layer.width_in} → {layer.width_out}{', ReLU' if active else ''}"


def _shape(shape: Sequence[int]) -> str:
    return " × ".join(map(str, shape)) if shape else "one value"


def _subtitle(builds: Sequence[Build]) -> str:
    seen = joined(f"{build.encoder} on observation {build.task.get('observation', '?')}" for build in builds)
    return f"{describe_task(builds[0].task)}; encoders {seen}"


def _task_lines(build: Build) -> list[str]:
    task = build.task
    return [str(task.get("kind", "")), f"{task.get('agents')} sensors, {task.get('targets')} targets", "team reward"]


def _network_lines(builds: Sequence[Build], role: str) -> list[str]:
    lines = []
    for part in ("actor", "critic"):
        for build in builds:
            network = build.network(f"{role} {part}")
            lines.append(f"{part}, {build.encoder}: {widths(network)}; {network.parameters:,} parameters")
    return lines


def _canvas(
    figure: Figure, place: tuple[float, float, float, float], x: tuple[float, float], y: tuple[float, float]
) -> Axes:
    axes = figure.add_axes(place)
    axes.set_axis_off()
    axes.set_xlim(*x)
    axes.set_ylim(*y)
    return axes


def _block(axes: Axes, place: tuple[float, float, float, float], title: str, lines: Sequence[str], colour: str) -> None:
    x, y, width, height = place
    _rounded(axes, (x, y), width, height, PAPER, colour)
    axes.text(x + 0.25, y + height - 0.65, title, fontsize=10.5, fontweight="bold", color=colour)
    for n, line in enumerate(lines):
        axes.text(x + 0.25, y + height - 1.3 - 0.66 * n, line, fontsize=8)


def _rounded(axes: Axes, corner: tuple[float, float], width: float, height: float, face: str, edge: str) -> None:
    shape: dict[str, Any] = {"boxstyle": "round,pad=0,rounding_size=0.12", "facecolor": face, "edgecolor": edge}
    axes.add_patch(FancyBboxPatch(corner, width, height, linewidth=1.1, zorder=3, **shape))


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], bend: float = 0) -> None:
    looks: dict[str, Any] = {"arrowstyle": "-|>", "mutation_scale": 10, "color": QUIET, "linewidth": 1.1}
    way = f"arc3,rad={bend}"
    axes.add_patch(FancyArrowPatch(start, end, connectionstyle=way, shrinkA=0, shrinkB=1, **looks))


def _draw_flow(axes: Axes, boxes: Flow, network: Network, encoder: str) -> None:
    height = axes.get_ylim()[1]
    title = axes.text(0.05, height - 0.3, f"{network.role}, {encoder}", fontsize=10, fontweight="bold")
    size = f"{network.kind}, {network.parameters:,} parameters"
    beside: dict[str, Any] = {"xycoords": title, "xytext": (8, 0), "textcoords": "offset points", "va": "bottom"}
    axes.annotate(size, (1, 0), fontsize=8.5, color=QUIET, **beside)
    places = _places(boxes, height - 0.6)
    for a, b, words in boxes.arrows:
        (xa, ya), (xb, yb) = places[a], places[b]
        far = xb - xa > 1.5 * STEP  # a way round the boxes between
        start, end = ((xa + WIDTH, ya - 0.2), (xb + 0.3, yb - 0.34)) if far else ((xa + WIDTH, ya), (xb, yb))
        _arrow(axes, start, end, 0.3 if far else 0)
        middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2 - (0.62 if far else 0))
        white = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
        axes.text(*middle, words, fontsize=7, color=QUIET, ha="center", va="center", bbox=white if words else None)
    for name, (x, y) in places.items():
        box = boxes.boxes[name]
        _rounded(axes, (x, y - 0.34), WIDTH, 0.68, box.face, FAINT)
        axes.text(x + WIDTH / 2, y + 0.13, box.title, fontsize=7, ha="center", va="center", color=INK, zorder=4)
        axes.text(x + WIDTH / 2, y - 0.14, box.detail, fontsize=7.5, ha="center", va="center", color=QUIET, zorder=4)


def _places(boxes: Flow, height: float) -> Mapping[str, tuple[float, float]]:
    """Left end and middle height of each box."""
    found = {}
    for column in range(boxes.columns):
        rows = boxes.rows(column)
        for n, name in enumerate(rows):
            found[name] = (0.05 + STEP * column, height * (1 - (n + 0.5) / len(rows)))
    return found
