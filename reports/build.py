"""Build a report: `python -m reports.build --profile quick`. The same tables give the same bytes."""

import argparse
import json
import math
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from reports import claims as rules
from reports import figures, tables
from reports.claims import VERDICTS, Claim
from reports.frame import Results, TableError, load
from reports.paper import Curves, Paper, read
from reports.stats import FEW
from reports.tables import Table, joined, steps

MADE = ("figures", "tables", "claims.md", "claims.csv", "claims.json", "index.md")

DEFINITIONS = f"""\
- **Final return**: mean over seeds of `final/return`, the greedy policy after the last step on a bank of episodes that
  no curve uses. Coverage: 100 × mean reward per step; navigation: sum over an episode.
- **Curve**: mean over seeds of `eval/return`, the greedy policy on a smaller fixed bank, on one grid of steps. Faint
  where fewer seeds have come so far.
- **[95 %]**: bootstrap over seeds (40 000 resamples, one fixed generator), the percentile interval widened to the width
  of Student's t. With fewer than {FEW} seeds it is narrower than its name (three seeds: their range, which holds the
  true mean in about 3 of 4 cases).
- **IQM**: mean without the lowest and the highest quarter of seeds; with fewer than four seeds that is the mean.
- **Change**: of the mean against full RHMC, in percent. **P(full better)**: probability that a random seed of full RHMC
  beats a random one of the other arm.
- **provisional**: the verdict rests on less than the paper's training budget or on fewer than {FEW} seeds.
"""


def build(runs: Path, out: Path, profile: str) -> list[Path]:
    """Read the tables in `runs`, write the report to `out`, and return its files.

    Everything is made in a folder beside the old report first, so that a failure leaves the old one as it was.

    Raises:
        TableError: the tables are missing or faulty; nothing is written.
    """
    results, paper = load(runs, profile), read()
    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".report-", dir=out) as folder:
        _write(results, paper, Path(folder))
        for name in MADE:
            _replace(Path(folder) / name, out / name)
    return sorted(path for name in MADE for path in [out / name, *(out / name).rglob("*")] if path.is_file())


def main(argv: Sequence[str] | None = None) -> int:
    """Build the report of a profile from its exported tables. Returns 0, or 2 if the tables are faulty."""
    parser = argparse.ArgumentParser(prog="python -m reports.build", description=main.__doc__)
    parser.add_argument("--profile", default="quick", help="profile that made the runs (default: quick)")
    parser.add_argument("--runs", type=Path, help="folder of the tables (default: reports/PROFILE/runs)")
    parser.add_argument("--out", type=Path, help="folder of the report (default: reports/PROFILE)")
    args = parser.parse_args(argv)
    home = Path("reports") / args.profile
    try:
        files = build(args.runs or home / "runs", args.out or home, args.profile)
    except TableError as error:
        print(error, file=sys.stderr)
        return 2
    print(f"{len(files)} files; start with {(args.out or home) / 'index.md'}")
    return 0


def _write(results: Results, paper: Paper, folder: Path) -> None:
    pictures, sheets = folder / "figures", folder / "tables"
    pictures.mkdir()
    sheets.mkdir()
    drawn = {}
    for name, spec in _figures(results, paper).items():
        drawing = figures.learning_curves(results, spec)
        if drawing:
            figures.save(drawing, pictures, name)
            drawn[name] = spec
    made = _tables(results, paper)
    for name, table in made.items():
        _save(table, sheets, name)
    found = rules.judge(results, paper)
    listed = rules.table(found)
    listed.numbers.to_csv(folder / "claims.csv", index=False, lineterminator="\n")
    (folder / "claims.json").write_text(
        json.dumps([_plain(claim) for claim in found], indent=1, ensure_ascii=False) + "\n"
    )
    (folder / "claims.md").write_text("\n".join(_claims_page(found, listed)) + "\n")
    captions = {name: _caption(name, spec) for name, spec in drawn.items()}
    (folder / "index.md").write_text("\n".join(_index(results, paper, captions, listed, made)) + "\n")


def _figures(results: Results, paper: Paper) -> dict[str, Curves]:
    """The paper's figures of curves, then one for each study that the paper does not have."""
    others = [study for study in results.studies if study not in {spec.study for spec in paper.figures.values()}]
    return paper.figures | {
        f"curves_{study}": paper.curves_of(study, results.env(study).get("kind", "")) for study in others
    }


def _tables(results: Results, paper: Paper) -> dict[str, Table]:
    """Tables by file name; those with nothing to show are left out."""
    made = {"table_1": tables.table_1(results)} if results.methods else {}
    made |= {"table_2": tables.table_2(results, paper)} if results.arms("ablation") else {}
    made |= {f"final_{study}": tables.finals(results, study) for study in results.studies}
    made |= {
        f"steadiness_{study}": t for study in results.studies if len((t := tables.steadiness(results, study)).shown)
    }
    made |= {"yardsticks": tables.yardsticks(results)} if results.yardsticks else {}
    return made | {"runs": tables.runs(results)}


def _save(table: Table, folder: Path, name: str) -> None:
    table.numbers.to_csv(folder / f"{name}.csv", index=False, float_format="%.6g", lineterminator="\n")
    (folder / f"{name}.md").write_text(f"{table.markdown()}\n")
    (folder / f"{name}.tex").write_text(table.latex())


def _index(
    results: Results, paper: Paper, captions: dict[str, str], claims: Table, made: dict[str, Table]
) -> Iterator[str]:
    yield f"# Results, profile `{results.profile}`\n"
    yield f"{_summary(results)}\n"
    gaps = [] if results.methods else ["Table 1: no methods; `rhmc methods --out` writes them."]
    gaps += results.gaps(paper.arms)
    if gaps:
        yield "Not everything is there yet: see [what is missing](#what-is-missing).\n"
    yield "## Learning curves\n"
    for name, caption in captions.items():
        yield f"![{caption}](figures/{name}.png)\n"
        yield f"*{caption}.* [PDF](figures/{name}.pdf), [numbers](figures/{name}.csv)\n"
    if not captions:
        yield "No study has a curve yet.\n"
    yield "## The paper's claims\n"
    yield f"{_count(claims)} A rule computes each verdict: [claims.md](claims.md) prints it beside the runs used.\n"
    yield f"{claims.markdown()}\n"
    for name, table in made.items():
        if name != "runs":
            yield f"## {table.title}\n"
            if table.note:
                yield f"{table.note}\n"
            yield f"{table.markdown()}\n"
            yield f"[CSV](tables/{name}.csv), [LaTeX](tables/{name}.tex)\n"
    yield "## Definitions\n"
    yield DEFINITIONS
    yield "## What is missing\n"
    yield "\n".join(f"- {gap}" for gap in gaps) + "\n" if gaps else "Nothing: every planned run is finished.\n"
    yield "## Runs behind the numbers\n"
    yield f"{_origin(results)}\n"
    yield made["runs"].markdown()


def _summary(results: Results) -> str:
    """Which studies, with budget and seeds, in one sentence each."""
    lines = []
    for study in results.studies:
        plan, budget = results.plan(study), results.budget(study)
        done = int((plan["status"] == "finished").sum())
        question = str(plan["question"].iloc[0])
        words = f"{done} of {len(plan)} runs finished, {steps(budget) if budget else 'unknown'} steps each"
        episodes = results.final_episodes(study)
        words += f", final return over {episodes} episodes" if episodes else ""
        lines.append(f"- **{study}**: {question} ({len(results.arms(study))} arms, {words})")
    return "\n".join(lines) or "No study has runs yet."


def _origin(results: Results) -> str:
    """Code and commit that made the runs."""
    found = []
    for column, word in (("fingerprint", "code fingerprint"), ("commit", "commit")):
        values = sorted(set(results.runs[column].dropna().astype(str)) - {""})
        mixed = " (**the runs were not all made by the same code**)" if column == "fingerprint" and values[1:] else ""
        found.append(f"{word} {joined(f'`{value}`' for value in values) or 'unknown'}{mixed}")
    return f"Made by {found[0]}, {found[1]}."


def _count(claims: Table) -> str:
    """How many claims got each verdict."""
    counts = claims.numbers["verdict"].value_counts()
    parts = [f"{counts[verdict]} {verdict}" for verdict in VERDICTS if verdict in counts]
    return f"Of {len(claims.numbers)} claims: {', '.join(parts)}."


def _claims_page(found: Sequence[Claim], listed: Table) -> Iterator[str]:
    yield "# The paper's claims\n"
    yield f"{_count(listed)}\n"
    for claim in found:
        yield f"## {claim.id}: {claim.judgement}\n"
        yield f"> {claim.text} ({claim.place})\n"
        yield f"- Paper: {claim.paper}"
        yield f"- Ours: {rules.describe(claim.ours) or 'nothing to show'}"
        yield f"- Why: {claim.reason}"
        if claim.provisional:
            yield f"- Provisional: {'; '.join(claim.caveats)}"
        yield f"- Rule: {claim.rule}"
        yield f"- Runs: {', '.join(f'`{run}`' for run in claim.runs) or 'none'}\n"


def _plain(claim: Claim) -> dict[str, object]:
    """A claim as JSON: NaN, which JSON has not, as null."""
    ours = {
        name: {key: None if math.isnan(value) else value for key, value in x._asdict().items()}
        for name, x in claim.ours.items()
    }
    return claim._asdict() | {"ours": ours, "provisional": claim.provisional}


def _caption(name: str, spec: Curves) -> str:
    """ "Fig. 7. Title" for the paper's figures, the title alone for others."""
    return f"{name.replace('fig_', 'Fig. ')}. {spec.title}" if name.startswith("fig_") else spec.title


def _replace(new: Path, old: Path) -> None:
    """Put a finished file or folder in the place of the old one."""
    if old.is_dir():
        shutil.rmtree(old)
    new.replace(old)


if __name__ == "__main__":
    sys.exit(main())
