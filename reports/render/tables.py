"""Tables: plain numbers for the CSV, and the same as text for Markdown and LaTeX."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from reports.data.escaping import latex, line, markdown
from reports.data.frame import EPISODE_ERROR, FINAL, METHOD, OWN, PLACE, TOLD, Results, adopted
from reports.data.paper import Paper
from reports.data.stats import FEW, LEVEL, Interval, Range, change, improvement, interval, iqm

NONE = "–"  # where there is nothing to show
SPAN = "[95 %] or (range)"  # the two forms of `estimate`, in a heading
TABLES, MEASURED = "tables", "measured"  # folders; in the second is what depends on machine, commit or time


class Table(NamedTuple):
    """A table twice: `numbers` with full digits, one quantity a column; `shown` as text, for people.

    Words stand as they were typed, and what writes a table escapes them; a new line in a cell is one on paper.
    """

    title: str
    numbers: pd.DataFrame
    shown: pd.DataFrame
    note: str = ""  # what a reader has to know
    marked: bool = False  # whether the cells are Markdown already
    folder: str = TABLES

    def markdown(self) -> str:
        """As a Markdown table."""
        write = str if self.marked else _markdown_cell
        body = [[write(str(cell)) for cell in row] for row in self.shown.to_numpy(object)]
        heads = [_markdown_cell(str(name)) for name in self.shown.columns]
        return "\n".join(f"| {' | '.join(row)} |" for row in [heads, ["---"] * len(heads), *body])

    def latex(self) -> str:
        """As a LaTeX table (packages: booktabs)."""
        body, title = self.shown.map(_latex_cell).rename(columns=_latex_cell), _latex_cell(self.title)
        return body.to_latex(index=False, column_format="l" + "r" * (body.shape[1] - 1), caption=title)


def table_1(results: Results) -> Table:
    """Properties of the methods, in the order of the code's table; parameters of the networks that act and of all."""
    numbers, shown, tasks = [], [], []
    for method in results.methods:
        row = {name: method[name] for name in METHOD} | {"actions": ", ".join(method["actions"])}
        sizes: dict[str, list[str]] = {}
        for size in method["parameters"]:
            task = describe_task(size["task"])
            tasks += [task] if task not in tasks else []
            for part in ("acting", "all"):
                row[f"{size['task']['kind']}_{size['encoder']}_{part}"] = size[part]
            heading = f"Parameters, {size['task']['kind']} (all)"
            sizes.setdefault(heading, []).append(f"{size['encoder']} {size['acting']:,} ({size['all']:,})")
        numbers.append(row)
        words = {name.capitalize(): method[name] for name in METHOD if name not in ("kind", "name")}
        shown.append(
            {"Method": method["name"]}
            | words
            | {"Actions": row["actions"]}
            | {heading: "; ".join(counts) for heading, counts in sizes.items()}
        )
    note = (
        "Generated from the code's table of algorithms. Parameters are counted in the networks that each method builds "
        f"with its default settings for {joined(tasks)}: those that act, and in brackets all that learn; target "
        "networks are not counted."
    )
    return Table("Table 1: the methods", pd.DataFrame(numbers), pd.DataFrame(shown), note)


def table_2(results: Results, paper: Paper) -> Table:
    """The ablation: the paper's rows in its order, then the study's further arms."""
    study, rows = "ablation", paper.table_2.rows
    reference = results.finals(study, rows[0].arm)
    named = {row.arm: row for row in rows}
    numbers, shown = [], []
    for arm in [*named, *(arm for arm in results.arms(study) if arm not in named)]:
        values, row = results.finals(study, arm), named.get(arm)
        theirs = row.final if row else np.nan
        is_reference = arm == rows[0].arm
        recomputed = np.nan if is_reference else 100 * (theirs / rows[0].final - 1)
        stated = -row.stated if row and row.stated is not None else np.nan
        ours = _estimates(values)
        against = None if is_reference or not len(values) or not len(reference) else reference
        lost = change(values, against) if against is not None else None
        worse = improvement(against, values) if against is not None else None
        numbers.append(
            {"arm": arm, "paper_final": theirs, "paper_change_stated": stated, "paper_change_recomputed": recomputed}
            | ours
            | _columns("change", lost)
            | _columns("probability_full_better", worse)
        )
        shown.append(
            {
                "Method": row.method if row else arm,
                "Paper: final": number(theirs),
                "Paper: change, stated": percent(stated),
                "recomputed": percent(recomputed),
                f"Ours: final {SPAN}": estimate(interval(values) if len(values) else None),
                "IQM": number(ours["iqm"]),
                "Seeds": seeds(results, study, arm),
                f"Change {SPAN}": estimate(lost, percent),
                "P(full better) [95 %]": estimate(worse, lambda x: f"{x:.2f}"),
            }
        )
    return Table("Table 2: ablation, final return", pd.DataFrame(numbers), pd.DataFrame(shown))


def finals(results: Results, study: str) -> Table:
    """Final values of every arm of a study, best mean first; arms without results last."""
    order = sorted(results.arms(study), key=lambda arm: -_mean(results.finals(study, arm)))
    order = [arm for arm in order if len(results.finals(study, arm))] + [
        arm for arm in order if not len(results.finals(study, arm))
    ]
    numbers, shown = [], []
    for arm in order:
        values = results.finals(study, arm)
        ours = _estimates(values)
        low, high = (values.min(), values.max()) if len(values) else (np.nan, np.nan)
        errors = results.finals(study, arm, EPISODE_ERROR)
        luck = float(np.sqrt(np.mean(errors**2))) if len(errors) else np.nan
        numbers.append(
            {"study": study, "arm": arm} | ours | {"worst_seed": low, "best_seed": high, "episode_error": luck}
        )
        shown.append(
            {
                "Arm": arm,
                f"Final return {SPAN}": estimate(interval(values) if len(values) else None),
                f"IQM {SPAN}": estimate(interval(values, iqm) if len(values) else None),
                "Worst and best seed": f"{number(low)}, {number(high)}" if len(values) else NONE,
                "Seeds": seeds(results, study, arm),
            }
        )
    return Table(f"Final results of study {study}", pd.DataFrame(numbers), pd.DataFrame(shown), _luck(results, study))


def _luck(results: Results, study: str) -> str:
    """Spread that the evaluation episodes add to a final return, in words; none where no run says it."""
    errors = np.concatenate(
        [results.finals(study, arm, EPISODE_ERROR) for arm in results.arms(study)] or [np.array([])]
    )
    errors = errors[errors > 0]  # a single episode has none
    if not len(errors):
        return ""
    span, episodes = (
        " to ".join(dict.fromkeys(number(x, 2) for x in np.sort(errors)[[0, -1]])),
        results.final_episodes(study),
    )
    return (
        f"Luck of the evaluation episodes: the standard error of one run's final return is {span} points"
        f"{f' ({episodes:,} episodes)' if episodes else ''}. All runs play the same episodes: what their luck has in "
        "common is not in the intervals and ranges, and cancels in the difference of two arms."
    )


def steadiness(results: Results, study: str) -> Table:
    """The steadiness of arms: the curve's mean at a quarter of the budget, its best and its last."""
    numbers, shown = [], []
    for arm in results.arms(study):
        points = results.curve(study, arm)
        if not len(points):
            continue
        rows = results.mean_curve(study, arm)
        rows = rows[rows["n"] == rows["n"].max()]
        quarter = rows[rows["step"] >= rows["step"].iloc[-1] / 4].iloc[0]
        best, last = rows.loc[rows["mean"].idxmax()], rows.iloc[-1]
        falls = [x["value"].max() - x["value"].iloc[-1] for _, x in points.groupby("seed")]
        numbers.append(
            {"study": study, "arm": arm, "quarter": quarter["mean"], "quarter_step": quarter["step"]}
            | {"best": best["mean"], "best_step": best["step"], "last": last["mean"], "last_step": last["step"]}
            | {"fall": best["mean"] - last["mean"], "largest_fall_of_a_seed": max(falls), "seeds": int(last["n"])}
        )
        shown.append(
            {
                "Arm": arm,
                "At a quarter": f"{number(quarter['mean'])} ({steps(quarter['step'])})",
                "Best": f"{number(best['mean'])} ({steps(best['step'])})",
                "Last": f"{number(last['mean'])} ({steps(last['step'])})",
                "Below the best": number(best["mean"] - last["mean"]),
                "Worst seed": number(max(falls)),
                "Seeds": str(int(last["n"])),
            }
        )
    return Table(
        f"Steadiness in study {study}: mean return along the budget", pd.DataFrame(numbers), pd.DataFrame(shown)
    )


def yardsticks(results: Results) -> Table:
    """Yardsticks of every task: mean, standard error in brackets."""
    numbers, shown = [], []
    for task, table in results.yardsticks:
        names = [name for name in table.columns if not name.endswith("_sem")]
        for row in table.reset_index().to_dict("records"):
            numbers.append({"task": describe_task(task), "policy": row["arm"]} | {k: row[k] for k in table.columns})
            cells = {_title(name): _with_error(row[name], row.get(f"{name}_sem", np.nan)) for name in names}
            shown.append({"Task": describe_task(task), "Policy": readable(str(row["arm"]))} | cells)
    return Table("Yardsticks", pd.DataFrame(numbers), pd.DataFrame(shown).fillna(NONE))


def theorem(results: Results) -> Table | None:
    """The shortfall of Algorithm 1, by size and density; None if it was not tried."""
    table = results.theorem.reset_index()
    if table.empty:
        return None
    numbers = table.assign(share=100 * table["lost"] / table["instances"])
    shown = pd.DataFrame(
        {
            "Instances (agents x options x targets)": numbers["arm"],
            "Tried": [f"{x:,.0f}" for x in numbers["instances"]],
            "Below the optimum": [f"{x:.2f} %" for x in numbers["share"]],
        }
        | {
            words: [number(x, 2) for x in numbers[name]]
            for name, words in (("mean_gap", "Mean gap there"), ("max_gap", "Largest gap"))
            if name in numbers
        }
    )
    note = "Random instances: each option completes, and each pair is assigned, with the probability in the name."
    return Table("Theorem 1: Algorithm 1 against the optimum", numbers, shown, note)


def provenance(results: Results) -> Table:
    """The provenance of the runs of every study: code, commit, machine, libraries, time."""
    numbers, shown = [], []
    for study, rows in results.runs.groupby("study"):
        known = {name: sorted(set(rows[name].dropna().astype(str)) - {""}) for name in ("fingerprint", "commit", *TOLD)}
        done, seconds = int((rows["status"] == "finished").sum()), float(rows["seconds"].fillna(0).sum())
        numbers.append(
            {"study": study, "finished": done, "planned": len(rows), "seconds": seconds}
            | {name: "; ".join(values) for name, values in known.items()}
        )
        shown.append(
            {
                "Study": str(study),
                "Finished": f"{done} of {len(rows)}",
                "Code": "\n".join(map(line, known["fingerprint"])) or NONE,
                "Commit": "\n".join(line(_short(commit)) for commit in known["commit"]) or NONE,
                "Machine": "\n".join(map(line, known["machine"])) or NONE,
                "Versions": "\n".join(map(line, known["versions"])) or NONE,
                **({"Adopted": "\n".join(map(line, known["adopted"])) or NONE} if adopted(results.runs) else {}),
                "Processor time": f"{number(seconds / 60)} min" if seconds else NONE,
            }
        )
    note = "Code: one name for each method in each task. A commit with + had changes that were not committed."
    note += f" Run by run: {MEASURED}/made.csv."
    if adopted(results.runs):
        note += " Adopted: made by older code, and repeated bit for bit by what is named there."
    return Table("What made the runs", pd.DataFrame(numbers), pd.DataFrame(shown), note, folder=MEASURED)


def made(results: Results) -> Table:
    """The machine and code that made every planned run."""
    rows = results.runs.sort_values(PLACE, kind="stable")
    numbers = rows[[*PLACE, *OWN]].reset_index(drop=True)
    shown = numbers[PLACE].assign(
        commit=[_short(commit) or NONE for commit in numbers["commit"]],
        processor_time=[NONE if np.isnan(x) else f"{number(x / 60)} min" for x in numbers["seconds"]],
    )
    shown.columns = pd.Index([_title(name) for name in shown.columns])
    return Table("How each run was made", numbers, shown.astype(str), folder=MEASURED)


def _short(commit: str) -> str:
    """Twelve digits of a commit, with a + where files differed from it."""
    name, _, dirty = commit.partition("-")
    return f"{name[:12]}{'+' if dirty else ''}"


def runs(results: Results) -> Table:
    """Every planned run, with its status and its final return."""
    numbers = results.runs.sort_values(PLACE, kind="stable")
    finals = results.points[results.points["metric"] == FINAL][[*PLACE, "value"]]
    numbers = numbers.merge(finals, how="left", on=PLACE)
    numbers = numbers[[*PLACE, "status", "value", "fingerprint"]]
    numbers = numbers.rename(columns={"value": "final_return"}).reset_index(drop=True)
    shown = numbers.assign(final_return=[number(x) for x in numbers["final_return"]])
    shown = shown.drop(columns="fingerprint").astype(str)
    shown.columns = pd.Index([_title(name) for name in shown.columns])
    return Table("Runs behind the numbers", numbers, shown)


def describe_task(env: dict[str, object]) -> str:
    """A task in a few words: `coverage flat, 4 sensors x 5 targets`."""
    kind = env.get("kind", "unknown task")
    if kind == "coverage":
        return f"coverage {env.get('preset', '')}, {env.get('agents')} sensors x {env.get('targets')} targets"
    parts = [
        f"{env.get('agents')} agents" if "agents" in env else "",
        f"reward {env['reward']}" if "reward" in env else "",
    ]
    return ", ".join([str(kind), *filter(None, parts)])


def readable(name: str) -> str:
    """A policy's name for people: `free_heading_bound` is `free heading (bound)`."""
    words = name.replace("_", " ")
    return f"{words.removesuffix(' bound')} (bound)" if words.endswith(" bound") else words


def seeds(results: Results, study: str, arm: str) -> str:
    """The number of finished seeds: `3`, `2 of 3`, or `missing`."""
    done, planned = len(results.finished(study, arm)), len(results.plan(study, arm))
    if not planned:
        return "missing"
    return str(done) if done == planned else f"{done} of {planned}"


def number(x: float, digits: int = 1) -> str:
    """One decimal, and a minus sign that is one; a dash for NaN."""
    return NONE if np.isnan(x) else f"{x:.{digits}f}".replace("-", "−")


def percent(x: float) -> str:
    """A signed percentage."""
    return NONE if np.isnan(x) else f"{x:+.1f} %".replace("-", "−")


def tick(x: float, place: object = None) -> str:
    """A number at an axis, as matplotlib asks for it: `−0.5`."""
    return f"{x:g}".replace("-", "−")


def capital(text: str) -> str:
    """Text with its first letter large."""
    return text[:1].upper() + text[1:]


def estimate(found: Interval | None, show: Callable[[float], str] = number) -> str:
    """`66.1 [64.0, 67.9]`; `66.1 (64.0 to 67.9)` if it is a range; without brackets if one seed gives neither."""
    if found is None or np.isnan(found.value):
        return NONE
    if np.isnan(found.low):
        return show(found.value)
    value, low, high = map(show, (found.value, found.low, found.high))
    return f"{value} ({low} to {high})" if isinstance(found, Range) else f"{value} [{low}, {high}]"


def spans(counts: Iterable[int]) -> str:
    """The name of what stands around a mean over seeds. counts: of seeds, of every mean of a figure."""
    found = set(counts)
    kinds = {
        "95 % bootstrap interval": max(found, default=0) >= FEW,
        f"range over fewer than {FEW} seeds": found & {*range(2, FEW)},
    }
    parts = [" or ".join(name for name, there in kinds.items() if there), "none with one seed" if 1 in found else ""]
    return ", ".join(filter(None, parts))


def steps(x: float) -> str:
    """A number of steps: `150 k`, `1.5 M`."""
    if x >= 1e6:
        return f"{x / 1e6:.3g} M"
    return f"{x / 1e3:.3g} k" if x >= 1e3 else f"{x:.0f}"


def _estimates(values: NDArray[np.float64]) -> dict[str, float]:
    found = interval(values) if len(values) else Interval(np.nan, np.nan, np.nan, 0)
    middle = float(iqm(values)) if len(values) else np.nan
    level = np.nan if isinstance(found, Range) or np.isnan(found.low) else LEVEL
    return _columns("mean", found) | {"iqm": middle, "seeds": found.n, "level": level}


def _columns(name: str, found: Interval | None) -> dict[str, float]:
    value, low, high = (found.value, found.low, found.high) if found else (np.nan, np.nan, np.nan)
    return {name: value, f"{name}_low": low, f"{name}_high": high}


def _with_error(value: float, error: float) -> str:
    if np.isnan(value):
        return NONE
    digits = 1 if abs(value) >= 1 else 2
    return number(value, digits) + ("" if np.isnan(error) else f" ({number(error, 2)})")


def _title(name: str) -> str:
    """A metric's or a column's name as a heading."""
    return name.rpartition("/")[2].replace("_", " ").capitalize()


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else -np.inf


def _markdown_cell(text: str) -> str:
    return "<br>".join(map(markdown, text.splitlines()))


def _latex_cell(text: object) -> str:
    return latex("; ".join(str(text).splitlines())).replace(NONE, "--")


def joined(names: Iterable[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    listed: Sequence[str] = list(names)
    return f"{', '.join(listed[:-1])} and {listed[-1]}" if len(listed) > 1 else "".join(listed)
