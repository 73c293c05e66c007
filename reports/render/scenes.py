"""Figures 4, 5 and 8: an instance of the regulator as a graph, and states of both tasks as they were played; Theorem
1's smallest counterexamples, drawn as Figure 4 is."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Wedge

from reports.data.drawn import Counterexample, Coverage, Instance, Joint, Navigation, Regulation
from reports.render.canvas import BLUE, FAINT, GREEN, INK, ORANGE, QUIET, Drawing, blank, foot, head, styled
from reports.render.tables import joined, number

AGENTS = (BLUE, ORANGE, GREEN, "#AA4499", "#B07C00", "#56A0D3")


def regulation(found: Regulation) -> Drawing:
    """Figure 4: a column per agent, a node per option, the way of Algorithm 1 and a best one."""
    with styled():
        figure = blank(9.5, 2.2 + 0.95 * max(map(len, found.options)))
        head(figure, "Regulation: Algorithm 1 and the optimum", _regulation_words(found))
        _graph(figure.add_axes((0.03, 0.08, 0.94, 0.8)), found)
        share = "; ".join(f"{m.lost} of {m.states:,} at horizon {m.horizon}" for m in found.met)
        foot(
            figure,
            f"Algorithm 1 below the optimum in states met by a scripted policy, pairs assigned by a coin: {share}.",
        )
    return Drawing(figure, _regulation_numbers(found))


MISSED = {"reward": "largest reward missed", "count": "not even the most targets"}


def counterexamples(found: Sequence[Counterexample]) -> Drawing:
    """Side by side, each with a title that says what Algorithm 1 misses there."""
    widths = [len(case.options) + 0.15 for case in found]
    most = max(len(agent) for case in found for agent in case.options)
    with styled():
        figure = blank(9.5, 2.3 + 0.95 * most)
        words = f"α = {found[0].alpha:g}; no instance with fewer agents x options x targets does it"
        head(figure, "Theorem 1's smallest counterexamples", words)
        left = 0.03
        for case, width in zip(found, widths, strict=True):
            share = 0.94 * width / sum(widths)
            axes = figure.add_axes((left, 0.03, share - 0.02, 0.75))
            _graph(axes, case)
            size = f"{len(case.options)} agents, {len(case.assignment[0])} targets"
            axes.set_title(f"{size}: {MISSED[case.by]}", fontsize=10, loc="left")
            left += share
    tables = [_regulation_numbers(case).assign(missed=case.by) for case in found]
    return Drawing(figure, pd.concat(tables, ignore_index=True))


def navigation(found: Navigation) -> Drawing:
    """Figure 5: where an episode begins, and where it ends."""
    last = len(found.positions) - 1
    with styled():
        figure = blank(9.0, 5.2)
        words = f"{len(found.landmarks)} agents, as many landmarks; scripted policy: {found.policy}"
        head(figure, "Cooperative navigation", words)
        for n, step in enumerate((0, last)):
            axes = figure.add_axes((0.05 + 0.48 * n, 0.1, 0.44, 0.74))
            _navigation_panel(axes, found, step)
            axes.set_title(f"step {step}", fontsize=10, loc="left")
        foot(
            figure,
            "Circles: agents at their size, with their way so far; crosses: landmarks with the disc that covers them.",
        )
    places = [("agent", i, t, *p) for t, at in enumerate(found.positions) for i, p in enumerate(at)]
    places += [("landmark", j, 0, *p) for j, p in enumerate(found.landmarks)]
    return Drawing(figure, pd.DataFrame(places, columns=["kind", "index", "step", "x", "y"]))


def coverage(found: Sequence[Coverage]) -> Drawing:
    """Figure 8: one state for each number of sensors."""
    columns = min(3, len(found))
    rows = -(-len(found) // columns)
    with styled():
        figure = blank(9.6, 1.0 + 3.45 * rows)
        first = found[0]
        policy = first.policy.replace("_", " ")
        words = f"{len(first.targets)} targets; step {first.step} of an episode, scripted policy: {policy}"
        head(figure, "Sensor coverage with different numbers of sensors", words)
        inches = 1.0 + 3.45 * rows
        for n, state in enumerate(found):
            bottom = (inches - 0.75 - 3.45 * (n // columns + 1) + 0.12) / inches
            axes = figure.add_axes((0.03 + 0.325 * (n % columns), bottom, 0.29, 3.0 / inches))
            _coverage_panel(axes, state)
        foot(
            figure,
            "Sectors: what a sensor sees (90°, range to scale); filled dots: targets in sight; rings: targets unseen.",
        )
    return Drawing(figure, pd.concat([_coverage_numbers(state) for state in found], ignore_index=True))


def covered(state: Coverage) -> int:
    """Targets that some sensor sees."""
    return int(np.asarray(state.seen).any(0).sum())


def _graph(axes: Axes, found: Instance) -> None:
    """A column per agent, both ways through it, and below what each of them completes."""
    n, most = len(found.options), max(map(len, found.options))
    axes.set_axis_off()
    axes.set_xlim(-0.45, n - 0.3)
    axes.set_ylim(-most - 0.25, 1.0)
    _options(axes, found)
    paths = (("Algorithm 1", found.paths.algorithm_1, ORANGE, 0.05), ("optimum", found.paths.optimum, BLUE, -0.05))
    for name, path, colour, shift in paths:
        _way(axes, path, colour, shift)
        row = -most + (0.3 if name == "optimum" else 0.0)
        axes.text(-0.4, row, _path_words(name, path), color=colour, fontsize=9.5, fontweight="bold", va="center")


def _options(axes: Axes, found: Instance) -> None:
    """All nodes and all edges."""
    for i, agent in enumerate(found.options):
        held = [str(j + 1) for j, given in enumerate(found.assignment[i]) if given]
        axes.text(i, 0.75, f"agent {i + 1}", ha="center", fontweight="bold")
        axes.text(i, 0.5, f"assigned {', '.join(held) or 'nothing'}", ha="center", fontsize=8, color=QUIET)
        for d, mask in enumerate(agent):
            targets = [str(j + 1) for j, done in enumerate(mask) if done]
            box = {"boxstyle": "round,pad=0.35", "facecolor": "white", "edgecolor": FAINT}
            text = f"completes {', '.join(targets)}" if targets else "completes none"
            axes.text(i, -d, text, ha="center", va="center", fontsize=8.5, bbox=box, zorder=5)
            for e in range(len(found.options[i + 1]) if i + 1 < len(found.options) else 0):
                axes.plot([i, i + 1], [-d, -e], color=FAINT, linewidth=0.8, zorder=1)


def _way(axes: Axes, path: Joint, colour: str, shift: float) -> None:
    heights = [shift - choice for choice in path.choices]
    axes.plot(range(len(heights)), heights, color=colour, linewidth=3, alpha=0.85, zorder=3, solid_capstyle="round")


def _path_words(name: str, path: Joint) -> str:
    done = [str(j + 1) for j, completed in enumerate(path.completed) if completed]
    return f"{name}: completes {joined(done) or 'none'}, reward {number(path.reward, 2)}"


def _regulation_words(found: Regulation) -> str:
    return f"met in coverage: horizon {found.horizon} steps, α = {found.alpha:g}; options that differ, once each"


def _regulation_numbers(found: Instance) -> pd.DataFrame:
    both = {"algorithm_1": found.paths.algorithm_1, "optimum": found.paths.optimum}
    rows = [
        {"agent": i + 1, "option": d + 1, "completes": " ".join(str(j + 1) for j, x in enumerate(mask) if x)}
        | {name: int(path.choices[i] == d) for name, path in both.items()}
        | {f"{name}_reward": path.reward for name, path in both.items()}
        for i, agent in enumerate(found.options)
        for d, mask in enumerate(agent)
    ]
    return pd.DataFrame(rows)


def _navigation_panel(axes: Axes, found: Navigation, step: int) -> None:
    for x, y in found.landmarks:
        axes.add_patch(Circle((x, y), found.near, facecolor="#EEEEEE", edgecolor=FAINT, zorder=2))
        axes.plot([x], [y], marker="x", color=INK, markersize=6, zorder=3)
    ways = np.asarray(found.positions)[: step + 1]
    for i in range(ways.shape[1]):
        colour = AGENTS[i % len(AGENTS)]
        axes.plot(ways[:, i, 0], ways[:, i, 1], color=colour, linewidth=1.2, alpha=0.6, zorder=3)
        axes.add_patch(Circle(ways[step, i], found.radius, facecolor=colour, alpha=0.75, zorder=4))
        axes.text(
            ways[step, i, 0],
            ways[step, i, 1],
            str(i + 1),
            color="white",
            fontsize=8,
            ha="center",
            va="center",
            zorder=5,
        )
    reach = max(1.15, float(np.abs(np.asarray(found.positions)).max()) + 0.2)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_aspect("equal")


def _coverage_panel(axes: Axes, state: Coverage) -> None:
    for i, ((x, y), heading) in enumerate(zip(state.sensors, state.heading, strict=True)):
        colour = AGENTS[i % len(AGENTS)]
        ends = (heading - state.half_view, heading + state.half_view)
        axes.add_patch(Wedge((x, y), state.range, *ends, facecolor=colour, alpha=0.16, edgecolor=colour, zorder=2))
        axes.plot([x], [y], marker="s", color=colour, markersize=6, zorder=4)
    seen = [any(of_target) for of_target in zip(*state.seen, strict=True)]
    for (x, y), in_sight in zip(state.targets, seen, strict=True):
        axes.plot([x], [y], marker="o", color=INK, fillstyle="full" if in_sight else "none", markersize=6, zorder=5)
    edge = state.half_area * 1.04
    axes.set_xlim(-edge, edge)
    axes.set_ylim(-edge, edge)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_visible(True)
    title = f"{state.agents} sensors: {covered(state)} of {len(state.targets)} targets seen"
    axes.set_title(title, fontsize=9.5, loc="left")


def _coverage_numbers(state: Coverage) -> pd.DataFrame:
    seen = np.asarray(state.seen)
    rows = [
        (state.agents, "sensor", i, *place, heading, int(seen[i].sum()))
        for i, (place, heading) in enumerate(zip(state.sensors, state.heading, strict=True))
    ]
    rows += [
        (state.agents, "target", j, *place, np.nan, int(seen[:, j].sum())) for j, place in enumerate(state.targets)
    ]
    return pd.DataFrame(rows, columns=["sensors", "kind", "index", "x", "y", "heading", "sightings"])
