"""Every figure of a report with its words: title, caption that says what to see, text for those who cannot see it.

A figure that cannot be drawn leaves its place, with the reason: the numbers are in the tables.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

from reports.analyses import alpha, beyond, comparison, findings, readings, scaling, searches
from reports.analyses.scaling import Sweep
from reports.data.drawn import Counterexample, Scenes
from reports.data.escaping import stem
from reports.data.frame import FINAL, Results
from reports.data.paper import Curves, Paper
from reports.pages.embed import Embedded
from reports.render import charts, diagrams, figures, panels, scenes
from reports.render.canvas import Drawing
from reports.render.charts import Chart
from reports.render.tables import describe_task, joined, number, steps

PAPERS = "fig_"
ARMS = "_arms"  # ends the name of the figure that has each arm of another one in a frame of its own
OWN = ("RHMC", "full")  # the paper's method
HOW = "A band is how far seeds spread; names stand in the order of the final return."
EACH = 48  # arms that have a frame each
Made = tuple[str, str, Drawing]  # caption, text for those who cannot see it, figure


class Picture(NamedTuple):
    """A figure of the report; `name` is that of its files."""

    name: str
    title: str
    caption: str
    alt: str
    drawing: Drawing | None
    study: str = ""
    behind: str = ""  # the command that made its numbers, where it is not the study's own
    fault: str = ""  # why it could not be drawn
    shown: Embedded | None = None  # as the page has it, once it is drawn
    chart: Chart | None = None  # as the page has it instead, with a script

    @property
    def heading(self) -> str:
        """`Fig. 7. Title` for the paper's figures, the title alone for others."""
        own = self.name.removeprefix(PAPERS)
        return f"Fig. {own}. {self.title}" if self.name.startswith(PAPERS) and own.isdigit() else self.title


def reason(error: Exception) -> str:
    """The fault of a figure, on one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")


def picture(
    name: str,
    title: str,
    make: Callable[[], Made | None],
    study: str = "",
    behind: str = "",
    chart: Callable[[], Chart | None] = lambda: None,
) -> Iterator[Picture]:
    """The figure that `make` draws, none if that has no data for it, or its place if it or its chart fails."""
    try:
        made = make()
        live = chart() if made else None
    except Exception as error:
        yield Picture(name, title, "", "", None, study, behind, reason(error))
    else:
        if made:
            yield Picture(name, title, *made, study, behind, chart=live)


def gallery(results: Results, paper: Paper) -> list[Picture]:
    """The paper's figures in their order, then what goes beyond it. What has no data is left out."""
    drawn = [*_networks(results), *_states(results), *_scaling(results), *_counterexamples(results)]
    known = {spec.study: name for name, spec in paper.figures.items()}
    for study in results.studies:
        if results.has_readings(study):
            drawn += _readings(results, study)
            continue
        spec = paper.figures[known[study]] if study in known else paper.curves_of(study, results.task(study))
        drawn += _curves(results, spec, known.get(study, f"curves_{stem(study)}"))
    own = sorted((p for p in drawn if p.name.startswith(PAPERS)), key=lambda p: _order(p.name))
    others = [p for p in drawn if not p.name.startswith(PAPERS)]
    searched = [picture for search in results.searches for picture in search_gallery(results, search)]
    return [*own, *others, *comparisons(results), *searched]


def in_short(results: Results, paper: Paper) -> list[str]:
    """The outcome, a sentence for each of the paper's comparisons that has runs."""
    lines = []
    for spec in paper.figures.values():
        arms = comparison.compared(results, spec.study)
        own = next((arm for arm in OWN if arm in arms), None)
        if own is None or len(arms) < 2:
            continue
        first = arms[0] if arms[0] != own else arms[1]
        side = "ahead of" if arms[0] == own else "behind"
        values = [number(float(results.finals(spec.study, arm).mean())) for arm in (own, first)]
        budget = results.budget(spec.study)
        place = f"{arms.index(own) + 1} of {len(arms)} arms"
        head = f"{spec.title.partition(':')[0]}{', ablation' * (spec.study == 'ablation')}"
        head += f", {steps(budget) if budget else 'unknown'} steps"
        lines.append(f"{head}: {own} ends at {values[0]} ({place} by the mean), {side} {first} at {values[1]}.")
    return lines


def study_gallery(results: Results, paper: Paper, study: str) -> list[Picture]:
    """The figures of one study."""
    if results.has_readings(study):
        return list(_readings(results, study))
    spec = paper.curves_of(study, results.task(study))
    return [
        *_curves(results, spec, f"curves_{stem(study)}"),
        *_sweep(results, study, f"scaling_{stem(study)}"),
        *comparisons(results),
    ]


def search_gallery(results: Results, search: str) -> Iterator[Picture]:
    """The figure of a search."""
    behind = f"rhmc search run studies/{search}.yaml --profile {results.profile}"
    title = f"Best objective by number of trials, search {search}"
    yield from picture(f"trials_{stem(search)}", title, partial(_trials, results, search), search, behind)


def _trials(results: Results, search: str) -> Made | None:
    drawing = searches.fig_trials(results, search)
    if drawing is None:
        return None
    caption = (
        f"{findings.of_trials(results, search)} "
        "See where each line last rises: an arm that still gains at the right edge may gain from more trials. The "
        "height at a number of trials is what that budget would have found."
    )
    return caption, searches.described(results, search), drawing


def comparisons(results: Results) -> Iterator[Picture]:
    """Figures that the paper lacks: effects by alpha, assignments, profiles, probabilities of improvement, transfer."""
    for study in results.studies:
        if results.has_readings(study):
            continue
        if alpha.is_of(study):
            yield from _by_alpha(results, study)
        made = f"rhmc assignments studies/{study.partition('@')[0]}.yaml --profile {results.profile}"
        title = f"What is assigned while training, study {study}"
        name = stem(study)
        yield from picture(f"assignments_{name}", title, partial(_assigned, results, study), study, made)
        title = f"Performance profile, study {study}"
        yield from picture(f"profile_{name}", title, partial(_profile, results, study), study)
        title = f"Probability of improvement, study {study}"
        yield from picture(f"better_{name}", title, partial(_better, results, study), study)
    title = "Trained once, played with other numbers"
    yield from picture("transfer", title, lambda: _moved(results), "-", "rhmc transfer")


def _readings(results: Results, study: str) -> Iterator[Picture]:
    """The specification curve of each contrast."""
    for found in readings.contrasts(results, study):
        title = f"Whole method less '{found.without}', by reading, study {study}"
        name = f"readings_{stem(found.without)}_{stem(study)}"
        yield from picture(name, title, partial(_specification, results, study, found), study)


def _specification(results: Results, study: str, found: readings.Contrast) -> Made | None:
    drawing = readings.fig_curve(results, study, found)
    holds = int((found.effects > 0).sum())
    caption = (
        f"Every mark is one reading of the paper: right of the zero crossing the paper's order holds ({holds} of "
        f"{len(found.effects)}). See which levels crowd at one end: these decide."
    )
    alt = f"Effects of {len(found.effects)} readings with intervals, and the level of each factor under each."
    return (caption, alt, drawing) if drawing else None


def _by_alpha(results: Results, study: str) -> Iterator[Picture]:
    """Worth of regulation and the filter at each alpha, and the rewards behind that."""
    title = f"Effect of regulation and of the filter by alpha, study {study}"
    yield from picture(f"effects_{stem(study)}", title, partial(_effects, results, study), study)
    title = f"The mechanism, seen, study {study}"
    yield from picture(f"mechanism_{stem(study)}", title, partial(_mechanism, results, study), study)


def _effects(results: Results, study: str) -> Made | None:
    drawing = alpha.fig_effects(results, study)
    caption = (
        f"{findings.of_effects(results, study)} "
        "Above zero the part helps. See whether the lines on the left rise: then regulation is worth more, the more "
        "Eq. 6 charges; whether a longer horizon adds to that; and whether on the right any interval leaves zero."
    )
    return (caption, alpha.described(results, study), drawing) if drawing else None


def _mechanism(results: Results, study: str) -> Made | None:
    drawing = alpha.fig_mechanism(results, study)
    if drawing is None:
        return None
    caption = (
        f"{findings.of_mechanism(drawing.numbers)} "
        "Down a column: what is assigned, what that earned, and what the coordinator learned from. See how far the "
        "regulated reward lies above the earned one while executors still learn, and whether without it, as alpha "
        "grows, ever fewer pairs are assigned."
    )
    columns = joined(f"{x:g}" for x in alpha.mechanism(results, study))
    alt = f"Line charts of assigned pairs, earned and regulated reward against environment steps, for alpha {columns}."
    return caption, alt, drawing


def _assigned(results: Results, study: str) -> Made | None:
    watched = beyond.fig_assignments(results, study)
    if watched is None:
        return None
    caption = (
        f"{findings.of_assigned(watched.numbers)} "
        "The mechanism behind the ablation: see whether pairs grow fewer, whether two agents are sent to one "
        "target ever less often, and whether targets are left to nobody."
    )
    alt = f"Three line charts against environment steps for {joined(beyond.assigning(results, study))}."
    return caption, alt, watched


def _profile(results: Results, study: str) -> Made | None:
    profile = comparison.profile(results, study)
    if profile is None:
        return None
    caption = (
        f"{findings.of_profile(results, study)} The line furthest right is the arm whose seeds end highest, whatever "
        "score one asks for; lines that cross are not ordered."
    )
    return caption, f"Step chart for {joined(comparison.compared(results, study))}.", profile


def _better(results: Results, study: str) -> Made | None:
    matrix, arms = comparison.matrix(results, study), comparison.compared(results, study)
    if matrix is None:
        return None
    caption = (
        f"{findings.of_matrix(results, study)} Rows are sorted by mean: the bluer the row, the more often it wins."
    )
    alt = f"Matrix of the probability that a seed of one arm beats one of another, for {joined(arms)}."
    return caption, alt, matrix


def _moved(results: Results) -> Made | None:
    moved = beyond.fig_transfer(results)
    if moved is None:
        return None
    caption = (
        f"{findings.of_moved(moved.numbers)} "
        "No step of training with the other numbers: see how far a policy follows the planner as sensors or "
        "targets are added, and where it falls below sensors that each seek their own best window."
    )
    return caption, "Two line charts of return against numbers of sensors and of targets.", moved


def curve_caption(results: Results, study: str) -> str:
    """The result that the curves of a study show, from its numbers, then how they are read."""
    waiting = [arm for arm in results.arms(study) if not len(results.finals(study, arm))]
    listed = (
        joined(waiting) if len(waiting) <= comparison.MOST else f"{len(waiting)} of {len(results.arms(study))} arms"
    )
    words = f" No finished run yet: {listed}." if waiting else ""
    means = {arm: float(results.finals(study, arm).mean()) for arm in comparison.compared(results, study)}
    found = findings.of_curves(results, study)
    return f"{found}{_against_scripts(results, study, means)} {HOW}{words}" if means else f"{found}{words}"


def _against_scripts(results: Results, study: str, means: dict[str, float]) -> str:
    level = comparison.reference(results, study)
    if level is None or FINAL not in results.yardsticks_of(study):
        return ""
    over = [arm for arm, mean in means.items() if mean > level.value]
    count = "None" if not over else "All" if len(over) == len(means) else f"{len(over)} of {len(means)} arms"
    return f" {count} end{'s' if len(over) == 1 or not over else ''} above {number(level.value)}, {level.words}."


def _curves(results: Results, spec: Curves, name: str) -> Iterator[Picture]:
    """All arms in one frame, and where they are many each in a frame of its own."""

    def whole() -> Made | None:
        drawing = panels.panels(results, spec) or figures.learning_curves(results, spec)
        return (curve_caption(results, spec.study), _finals(results, spec.study), drawing) if drawing else None

    def each() -> Made | None:
        drawing = figures.each_arm(results, spec) if len(results.arms(spec.study)) <= EACH else None
        caption = (
            f"{findings.of_spread(results, spec.study)} The same curves one by one: see the width of each band, and "
        )
        caption += "where a curve bends down again."
        return (caption, f"Small line charts. {_finals(results, spec.study)}", drawing) if drawing else None

    yield from picture(name, spec.title, whole, spec.study, chart=lambda: charts.chart(results, spec, name))
    yield from picture(f"{name}{ARMS}", f"{spec.title}, arm by arm", each, spec.study)


def _finals(results: Results, study: str) -> str:
    """The curves of a study in words."""
    finals = [f"{arm} {number(float(x.mean()))}" for arm in results.arms(study) if len(x := results.finals(study, arm))]
    words = f"Line chart of return against environment steps, {describe_task(results.env(study))}. "
    return words + (f"Final returns: {', '.join(finals)}." if finals else "No run is finished.")


def _networks(results: Results) -> Iterator[Picture]:
    if not results.modules:
        return
    builds = results.modules
    sizes = "; ".join(f"{n.role}, {b.encoder}: {n.parameters:,}" for b in builds for n in b.networks)
    alt = f"Diagram of RHMC's networks. Parameters: {sizes}."
    caption = "Two levels and what runs between them: see how small the networks are, and that the critics see more."
    yield from picture("fig_1", "Architecture of RHMC", lambda: (caption, alt, diagrams.architecture(builds)))
    for name, role, level in (("fig_2", "coordinator", "High"), ("fig_3", "executor", "Low")):
        title = f"{level} level: the {role}{'s' if role == 'executor' else ''}, layer by layer"

        def layers(role: str = role, title: str = title) -> Made:
            words = "Every layer as it ran: the fully connected reading above, the pairwise one below, which pools over"
            return f"{words} pairs.", f"Diagram of the {role}'s layers. {alt}", diagrams.level(builds, role, title)

        yield from picture(name, title, layers)


def _states(results: Results) -> Iterator[Picture]:
    found = results.scenes
    if found is None:
        return
    title = "Regulation: Algorithm 1 on a real instance"
    yield from picture("fig_4", title, lambda: _regulation(found))
    caption = "An episode's first and last state. The task is done when every cross lies under an agent of its own."
    alt = "Two plots of agents and landmarks in the plane, before and after an episode."
    yield from picture("fig_5", "Cooperative navigation", lambda: (caption, alt, scenes.navigation(found.navigation)))
    title = "Sensor coverage with different numbers of sensors"
    yield from picture("fig_8", title, lambda: _sensors(found))


def _regulation(found: Scenes) -> Made:
    ours, best = found.regulation.paths.algorithm_1.reward, found.regulation.paths.optimum.reward
    caption = (
        f"A column is an agent, a box one of its options. Algorithm 1 settles on {number(ours, 2)} (orange) where "
        f"{number(best, 2)} was to be had (blue): it keeps one set of targets per option, chosen by count."
    )
    alt = f"Graph of options by agent with two paths: Algorithm 1, reward {number(ours, 2)}; optimum {number(best, 2)}."
    return caption, alt, scenes.regulation(found.regulation)


def _sensors(found: Scenes) -> Made:
    seen = ", ".join(f"{scenes.covered(s)} of {len(s.targets)} with {s.agents}" for s in found.coverage)
    caption = (
        "Five targets and more and more sensors, each case an episode of its own: see how far apart they stand, how "
        "little a sector of 90 degrees takes in, and how sectors begin to overlap."
    )
    alt = f"Plots of sensors with their sectors of view and targets. Targets seen: {seen} sensors."
    return caption, alt, scenes.coverage(found.coverage)


def _counterexamples(results: Results) -> Iterator[Picture]:
    found = results.scenes.counterexamples if results.scenes else ()
    if found:
        title = "Theorem 1: the smallest counterexamples"
        yield from picture("counterexamples", title, lambda: _missed(found), "-", "rhmc drawings")


def _missed(found: Sequence[Counterexample]) -> Made:
    rewards = [(number(case.paths.algorithm_1.reward, 2), number(case.paths.optimum.reward, 2)) for case in found]
    caption = (
        "Theorem 1 says that Algorithm 1 finds the largest reward. See where the orange way, which keeps the first of "
        f"two sets of equal size, leaves the blue one: {joined([f'{a} instead of {b}' for a, b in rewards])}."
    )
    alt = "Graphs of options by agent with two paths: " + "; ".join(
        f"Algorithm 1, reward {ours}, optimum {best}" for ours, best in rewards
    )
    return caption, f"{alt}.", scenes.counterexamples(found)


def _scaling(results: Results) -> Iterator[Picture]:
    yield from _sweep(results, scaling.STUDY, "fig_9")


def _sweep(results: Results, study: str, name: str) -> Iterator[Picture]:
    found = scaling.sweep(results, study)
    if found:
        yield from picture(name, "Final return by number of agents", lambda: _by_agents(results, found), study)


def _by_agents(results: Results, found: Sweep) -> Made | None:
    drawing = scaling.figure(results, found)
    if drawing is None:
        return None
    caption = f"{findings.of_sweep(results, found)} One line is one method; where bars overlap, the order is open."
    alt = f"Line chart of final return against {joined(map(str, found.counts))} agents for {joined(found.arms)}."
    return caption, alt, drawing


def _order(name: str) -> tuple[int, str]:
    digits = name.removeprefix(PAPERS).partition("_")[0]
    return (int(digits) if digits.isdigit() else 99, name)
