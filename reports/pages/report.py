"""Everything that a report holds, before it is written."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from reports.analyses import readings, scaling, searches, standing
from reports.claims import verdicts as rules
from reports.claims.evidence import READINGS
from reports.claims.verdicts import ENOUGH, SHORT, Claim
from reports.data.frame import YARDSTICKS, Results
from reports.data.paper import Paper
from reports.data.stats import FEW
from reports.pages import sheets
from reports.pages.gallery import Picture, gallery, in_short, search_gallery, study_gallery
from reports.render.tables import Table, steps

ORDER = ("navigation", "coverage", "scaling", "ablation")  # studies of the paper's figures, as they come there
DEFINITIONS = (
    (
        "Final return",
        "mean over seeds of final/return, the greedy policy after the last step in {episodes} that no curve "
        "uses. Coverage: 100 × mean reward per step; navigation: sum over an episode.",
    ),
    (
        "Curve",
        "mean over seeds of eval/return, the greedy policy in fewer fixed episodes, on one grid of steps. Faint where "
        "fewer seeds have come so far.",
    ),
    (
        "[95 %]",
        "bootstrap over seeds (40 000 resamples, one fixed generator), the percentile interval widened to the width of "
        "Student's t; of P Newcombe's, over readings from the pooled variance.",
    ),
    (
        "(range)",
        f"with fewer than {FEW} seeds a bootstrap ends at the worst and the best seed. Round brackets have this range "
        "of the resamples, which is no 95 % interval; rules take it for one. Three seeds' range holds the true mean in "
        "about 3 of 4 cases.",
    ),
    ("IQM", "mean without the lowest and the highest quarter of seeds; with fewer than four seeds that is the mean."),
    ("Change", "of the mean against full RHMC, in percent."),
    (
        "P(full better), P(first better)",
        "probability that a random seed of the first arm beats a random one of the other, with Newcombe's score "
        "interval. A bootstrap would say [0, 0] or [1, 1] where every seed of one arm wins. Three seeds that all win "
        "against three can show no more than [0.50, 1.00].",
    ),
    (
        "provisional",
        f"the verdict rests on less than {readings.percent_of(ENOUGH)} of the paper's training budget, on fewer than "
        f"{FEW} seeds, on unfinished runs, or on one reading of the text.",
    ),
    ("depends on the reading", "what the text leaves open decides it: the specification curve has the factors."),
    ("too short to judge", f"the runs have less than {readings.percent_of(SHORT)} of the paper's training budget."),
)


class Report(NamedTuple):
    """Everything that is written, before it is. `paper`: None in the report of one study."""

    results: Results
    title: str
    lead: str
    pictures: list[Picture]
    tables: dict[str, Table]
    gaps: list[str]  # everything that is missing
    claims: Sequence[Claim] = ()
    short: Sequence[str] = ()  # what came out, a sentence a figure of the paper
    smoke: str = ""  # a warning that the runs are too short
    paper: Paper | None = None
    open: int = 0  # gaps in what the claims rest on
    answer: str = ""  # of a study's own report: where its arms stand
    tables_at: str = ""  # the folder that was read, as the page links it, if it lies beside the page

    @property
    def own(self) -> list[str]:
        """The studies that the claims rest on, in the paper's order. Others are a reader's own, or go beyond it."""
        mine = _mine(self.results, self.paper) if self.paper else []
        return [*(name for name in ORDER if name in mine), *(name for name in mine if name not in ORDER)]

    @property
    def others(self) -> list[str]:
        """All other studies."""
        return [name for name in self.results.studies if name not in self.own]


def whole(results: Results, paper: Paper) -> Report:
    """The report on the paper. Its answer rests on the paper's studies; whatever else is there is shown after it."""
    mine = only(results, [*_mine(results, paper), YARDSTICKS])
    gaps = [] if results.methods else ["Table 1: no methods; `rhmc methods --out` writes them."]
    gaps += [] if results.modules else ["Figures 1 to 3: no networks; `rhmc drawings --out` writes them."]
    gaps += [] if results.scenes else ["Figures 4, 5 and 8: no scenes; `rhmc drawings --out` writes them."]
    gaps += [] if results.episodes else ["Animations: none; `rhmc render --out` writes them."]
    expected = paper.arms | {scaling.STUDY: ()}
    return Report(
        results=results,
        title=f"Does it hold? The paper's results, profile {results.profile}",
        lead=_lead(mine),
        pictures=gallery(results, paper),
        tables=sheets.whole(results, paper),
        gaps=gaps + results.gaps(expected),
        claims=rules.judge(results, paper),
        short=in_short(results, paper),
        smoke=rules.smoke_test(mine if mine.studies else results, paper),
        paper=paper,
        open=len(gaps) + len(mine.gaps(expected)),
    )


def single(results: Results, paper: Paper, study: str) -> Report:
    """The report on one study or one search, without claims."""
    own, gaps = only(results, results.studies), results.gaps({})
    asked, noted = question(results, study), f"profile {results.profile}"
    if study in results.searches:
        lead, made = f"{asked} {searches.spoken(results, study)}.", sheets.of_search(results, study) | sheets.last(own)
        pictures = list(search_gallery(results, study))
        return Report(results, f"Search {study}, {noted}", lead, pictures, made, gaps, open=len(gaps))
    lead, made = f"{asked} {_lead(results)}", sheets.of_study(results, study) | sheets.last(own)
    pictures = study_gallery(results, paper, study)
    smoke = rules.smoke_test(own, paper) if _mine(results, paper) else ""  # the paper has no budget for other studies
    about: dict[str, Any] = {"smoke": smoke, "open": len(gaps)}
    if not results.has_readings(study):
        about["answer"] = standing.sentence(results, study)
    return Report(results, f"Study {study}, {noted}", lead, pictures, made, gaps, **about)


def only(results: Results, studies: Sequence[str]) -> Results:
    """The runs of some studies alone, without searches and notes; yardsticks are a study here."""
    return Results(results.points, results.runs[results.runs["study"].isin(studies)], results.profile)


def _mine(results: Results, paper: Paper) -> list[str]:
    """The studies that the claims rest on."""
    return [name for name in results.studies if name in paper.studies | {READINGS}]


def definitions(results: Results) -> list[tuple[str, str]]:
    """The meaning of the words, with the number of final evaluation episodes."""
    counts = sorted({n for study in results.studies if (n := results.final_episodes(study))})
    episodes = f"{' to '.join(map(str, dict.fromkeys((counts[0], counts[-1]))))} episodes" if counts else "episodes"
    return [(name, words.replace("{episodes}", episodes)) for name, words in DEFINITIONS]


def question(results: Results, study: str) -> str:
    """Question of a study or a search."""
    if study in results.searches:
        return searches.question(results, study)
    return str(results.plan(study)["question"].iloc[0])


def _lead(results: Results) -> str:
    """The amount of data behind the report, in a sentence."""
    runs = results.runs[results.runs["study"].isin(results.studies)]
    done, budgets = int((runs["status"] == "finished").sum()), [results.budget(study) for study in results.studies]
    known = sorted({budget for budget in budgets if budget})
    span = f", {' to '.join(dict.fromkeys((steps(known[0]), steps(known[-1]))))} steps each" if known else ""
    count = len(results.studies)
    return f"{done} of {len(runs)} planned runs finished in {count} {'study' if count == 1 else 'studies'}{span}."
