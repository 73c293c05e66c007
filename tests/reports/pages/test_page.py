"""The report as one page: whole, readable without scripts, open about what is not there."""

import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest

from reports.data.frame import TableError
from reports.data.paper import read as paper
from reports.pages import page
from reports.pages.build import build, write_report
from tests.reports.factory import NAVIGATION, drawings, episode, methods, noisy, study, write, yardsticks

pytestmark = pytest.mark.usefixtures("quick_resampling")
LAST = ("definitions", "provenance", "runs")
VOID = {"meta", "img", "br", "link", "hr", "input"}


class Reader(HTMLParser):
    """Tags with their attributes, and whether they close in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self.open):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def of(self, tag: str) -> Iterator[dict[str, str]]:
        return (attributes for name, attributes in self.tags if name == tag)


PAPER = f"https://doi.org/{paper().source.doi}"


@pytest.fixture(scope="module")
def read(made: Path) -> Reader:
    return Reader((made / "index.html").read_text())


def test_nothing_is_fetched(made: Path, read: Reader) -> None:
    text = re.sub(r'"data:image/[^"]+"', '""', (made / "index.html").read_text())
    assert "http://" not in text.replace("http://www.w3.org", "")
    assert "https://" not in text.replace(f'href="{PAPER}"', "")  # a link, which is followed if one wants
    assert not re.search(r"@import|url\(|<link|<script src", text)
    kinds = {re.split("[;,]", image["src"])[0] for image in read.of("img")}
    assert kinds == {f"data:image/{kind}" for kind in ("svg+xml", "webp")}
    for image in read.of("img"):
        drawn = unquote(image["src"].partition(",")[2]) if "svg" in image["src"][:20] else ""
        assert not re.search(
            r"(href|src)=.(?!#|data:)|@import|url\((?!#)", drawn
        )  # of itself it shows parts, and no files


def test_every_link_leads_somewhere(made: Path, read: Reader) -> None:
    places = [attributes["id"] for _, attributes in read.tags if attributes.get("id")]
    assert len(places) == len(set(places))
    links = [link["href"] for link in read.of("a")]
    assert len(links) > 20
    assert [x for x in links if x.startswith("#") and x[1:] not in places] == []
    assert [x for x in links if not x.startswith("#") and not (made / x).is_file()] == [PAPER]


def test_every_figure_has_words_for_those_who_do_not_see_it(made: Path, read: Reader) -> None:
    images = list(read.of("img"))
    charts = [box for box in read.of("div") if box.get("class", "").startswith("chart")]
    assert len(charts) == 2
    assert len(images) + len(charts) == len(list((made / "figures").glob("*.png"))) + 1  # and an animation
    drawn = [found["aria-label"] for found in read.of("svg") if found.get("role") == "img"]
    assert sum(label.startswith("Line chart of return") for label in drawn) == 2
    assert all(len(label) > 30 for label in drawn)
    assert all(figure.get("aria-label") for figure in read.of("figure"))
    for image in images:
        assert len(image["alt"]) > 30
        assert int(image["width"]) > int(image["height"]) / 3 > 0
    for n in (1, 2, 3, 4, 5, 8, 10):
        assert f"Fig. {n}. " in read.text
    assert "Fig. 9" not in read.text  # no study of it


def test_the_answer_comes_first_and_the_evidence_after_the_results(made: Path, read: Reader) -> None:
    text = (made / "index.html").read_text()
    places = [text.index(f'id="{name}"') for name in ("main", "forest", "study-ablation", "method", "studies")]
    assert places == sorted(places)
    parts = [attributes["id"] for attributes in read.of("section")]
    assert parts == ["study-ablation", "method", "study-reach", "scale", "claims", "missing", *LAST]
    assert text.index(page_sentence(made)) < text.index('id="forest"')


def page_sentence(made: Path) -> str:
    """The bold sentence of the page in Markdown: that of the other page."""
    return next(line.strip("*") for line in (made / "index.md").read_text().splitlines() if line.startswith("**Of "))


def test_claims_have_all_that_belongs_to_them(read: Reader) -> None:
    assert len(list(read.of("article"))) == 23
    for words in (
        "Without the regulation mechanism the final reward falls.",
        "70.5 to 35.6 (Table 2)",
        "full − no regulation: 10.0 (",
        "rhmc study run studies/ablation.yaml --profile quick && rhmc export",
        "4 x 3 x 5: % lost: 4.0",
        "C13",
    ):
        assert words in read.text


def test_tables_sort_by_keyboard(made: Path, read: Reader) -> None:
    heads = list(read.of("th"))
    assert [box for box in read.of("div") if box.get("class") == "bar" and "hidden" not in box] == []
    assert heads
    assert all(head == {"scope": "col"} for head in heads)
    buttons = [attributes for attributes in read.of("button") if attributes == {"type": "button"}]
    assert len(buttons) == len(heads)
    script = (made / "index.html").read_text().partition("<script>")[2]
    assert "aria-sort" in script
    assert all("data-key" in cell for cell in read.of("td"))


def test_a_half_finished_study_says_so(made: Path, read: Reader) -> None:
    assert "Not everything is there yet." in read.text
    assert "Study reach, arm one <step>: 1 of 3 seeds not run (seed 0)." in read.text
    assert "Study reach, arm one <step>: 1 of 3 seeds unfinished (seed 1)." in read.text
    assert "Study reach (4 of 6 runs finished)" in read.text
    assert "Study `navigation`: no results." in (made / "index.md").read_text()
    finals = pd.read_csv(made / "tables" / "final_reach.csv").set_index("arm")
    assert finals.loc["one <step>", "mean"] == 68.0  # the one finished seed, and no zero beside it
    assert np.isnan(finals.loc["one <step>", "mean_low"])
    listed = pd.read_csv(made / "tables" / "runs.csv").set_index("status")["final_return"]
    assert np.isnan(listed["missing"])
    assert np.isnan(listed["partial"])


@pytest.mark.usefixtures("unpainted")
def test_an_animation_leads_to_its_gif_where_that_is_beside_the_page(tmp_path: Path) -> None:
    runs = write(episode(methods(tmp_path / "runs")), study("coverage", {"RHMC": noisy(67)}, points=3))
    for out, linked in ((tmp_path, True), (tmp_path / "far", False)):
        build(runs, out, "quick")
        links = {link["href"] for link in Reader((out / "index.html").read_text()).of("a")}
        assert ("runs/episode_coverage.gif" in links) is linked
        assert "#episode_coverage" not in links  # the file does not say whose episode it is
        words = Reader((out / "index.html").read_text()).text
        assert "the seed that this was trained with, and the number of the episode" in words


@pytest.mark.usefixtures("unpainted")
def test_rows_lead_to_the_curve_of_their_arm_and_to_the_animation_of_their_run(tmp_path: Path) -> None:
    points, plan = study("coverage", {"RHMC": noisy(67), "IQL": noisy(63)}, points=3)
    runs = write(tmp_path / "runs", (points, plan))
    note = b'{"run": "%s", "episode": 1}' % plan["run"][1].encode()
    (runs / "episode_coverage.gif").write_bytes(GIF[:19] + b"\x21\xfe" + bytes([len(note)]) + note + b"\0" + GIF[19:])
    build(runs, tmp_path, "quick")
    text = (tmp_path / "index.html").read_text()
    assert "The trained policy: study coverage, arm RHMC, seed 1." in Reader(text).text
    table = text[text.index('id="table-runs"') :]
    cells = re.findall(r"<tr id.*?</tr>", table)
    assert ["#episode_coverage" in row for row in cells] == [plan["run"][1] in row for row in cells]
    finals = re.findall(r"<tr>.*?</tr>", text[text.index('id="table-final_coverage"') :])[1:3]
    assert ["animation" in row for row in finals] == [True, False]
    assert [re.findall(r'href="#(fig_7\.\d)">(\w+)', row) for row in finals] == [
        [("fig_7.1", "RHMC")],
        [("fig_7.2", "IQL")],
    ]


@pytest.mark.usefixtures("unpainted", "quick_resampling")
def test_a_complete_report_does_not_speak_of_what_is_missing(tmp_path: Path) -> None:
    finals = {arm: noisy(60) for arms in paper().arms.values() for arm in arms}
    coverage, navigation = ({arm: finals[arm] for arm in paper().arms[name]} for name in ("coverage", "navigation"))
    both = (yardsticks(), yardsticks({"nearest": -35.0}, NAVIGATION))
    tables = (
        study("ablation", {arm: finals[arm] for arm in paper().arms["ablation"]}, points=3),
        study("coverage", coverage, points=3),
        study("navigation", navigation, env=NAVIGATION, points=3),
        study("scaling", {"RHMC": noisy(60)}, points=3),
        (pd.concat(points for points, _ in both), pd.concat(runs for _, runs in both)),
    )
    build(write(drawings(episode(methods(tmp_path / "runs"))), *tables), tmp_path / "out", "quick")
    read = Reader((tmp_path / "out" / "index.html").read_text())
    assert "issing" not in read.text
    assert "Not everything" not in read.text
    assert "missing" not in {attributes.get("id") for _, attributes in read.tags}
    assert "Nothing: every planned run is finished." in (tmp_path / "out" / "index.md").read_text()


def test_what_made_the_runs(read: Reader) -> None:
    for words in ("Code 0123456789ab", " c0ffee ", "Machine not exported", "Processor time of all runs"):
        assert words in read.text
    assert "not all made by the same code" not in read.text


@pytest.mark.usefixtures("unpainted")
def test_machine_and_versions_where_they_are_exported(tmp_path: Path) -> None:
    points, runs = study("coverage", {"RHMC": noisy(67), "IQL": noisy(63)}, points=4)
    told = runs.assign(machine="two cores", versions="torch 2.13.0", fingerprint=["a", "a", "b"] * 2, seconds=1800.0)
    build(write(tmp_path, (points, told)), tmp_path / "out", "quick")
    text = Reader((tmp_path / "out" / "index.html").read_text()).text
    assert "Machine two cores Versions torch 2.13.0 Processor time of all runs 3 h 0 min" in text
    assert "The runs were not all made by the same code." in text


def test_a_page_without_how_the_runs_were_made(tmp_path: Path) -> None:
    folder = write(tmp_path, study("coverage", {"RHMC": noisy(67), "IQL": noisy(63)}, points=4))
    (folder / "coverage.made.parquet").unlink()
    build(folder, tmp_path / "out", "quick")
    text = Reader((tmp_path / "out" / "index.html").read_text()).text
    assert "Machine not exported Versions not exported Processor time of all runs not exported" in text
    assert "commit unknown." in (tmp_path / "out" / "index.md").read_text()
    assert not (tmp_path / "out" / "measured" / "time_coverage.csv").exists()
    assert pd.read_csv(tmp_path / "out" / "measured" / "made.csv")["commit"].isna().all()


@pytest.mark.usefixtures("unpainted")
def test_one_study(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arms = {"one": noisy(67), "two": noisy(63), "three": noisy(50)}
    runs = write(tmp_path / "runs", study("reach", arms, points=4), study("other", {"x": noisy(1)}), yardsticks())
    out = tmp_path / "out"
    assert write_report(runs, out, study="reach") == "whole"
    assert f"start with {out / 'index.html'}" in capsys.readouterr().out
    names = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    assert {"index.html", "index.md", "figures/curves_reach.pdf", "tables/pairs_reach.tex"} <= names
    assert not [name for name in names if "other" in name or "claims" in name or "yardsticks" in name]
    text = Reader((out / "index.html").read_text()).text
    assert "Study reach, profile quick" in text
    assert "Pairs of arms, study reach" in text
    assert "The paper's claims" not in text
    assert write_report(runs, out, study="raech") == "refused"
    assert "no table of study 'raech' here (there are other, reach)" in capsys.readouterr().err


@pytest.mark.usefixtures("unpainted")
def test_a_study_answers_first_and_shows_its_pairs(tmp_path: Path) -> None:
    arms = {"one": noisy(67, 5, 0.1), "two": noisy(63, 5, 0.1), "three": noisy(50, 5, 0.1)}
    build(write(tmp_path / "runs", study("reach", arms, points=3)), tmp_path / "out", "quick", "reach")
    said = "one ends highest, at 67.0, clearly better than two and three (by 4.0 to 17.0)."
    page_, index = ((tmp_path / "out" / name).read_text() for name in ("index.html", "index.md"))
    assert page_.index(f'<p class="answer">{said}</p>') < page_.index("planned runs finished")
    assert index.splitlines()[2] == f"**{said}**"
    assert page_.index('id="table-pairs_reach"') < page_.index('<details class="more">')
    build(tmp_path / "runs", tmp_path / "all", "quick")
    whole = (tmp_path / "all" / "index.html").read_text()
    assert whole.index('<details class="more">') < whole.index('id="table-pairs_reach"')


@pytest.mark.usefixtures("unpainted")
def test_hundreds_of_pairs_are_folded_and_the_clear_ones_come_first(tmp_path: Path) -> None:
    arms = {f"arm {n:02}": noisy(50 + n / 5, 5, 0.4) for n in range(13)}
    build(write(tmp_path / "runs", study("reach", arms, points=2)), tmp_path / "out", "quick", "reach")
    text = (tmp_path / "out" / "index.html").read_text()
    assert "<details><summary>Pairs of arms, study reach: 78 rows</summary>" in text
    Reader(text)
    clear = (tmp_path / "out" / "tables" / "pairs_reach.md").read_text().splitlines()[2:]
    cells = [line.split(" | ")[6] for line in clear]
    assert cells == sorted(cells, reverse=True)
    assert set(cells) == {"yes", "no"}
    assert "\n\n12 more rows:\n\n[CSV](tables/pairs_reach.csv)" in (tmp_path / "out" / "index.md").read_text()


@pytest.mark.usefixtures("unpainted")
def test_a_fault_in_another_study_does_not_stop_it(tmp_path: Path) -> None:
    points, runs = study("other", {"x": noisy(1)}, points=4)
    write(tmp_path, study("reach", {"one": noisy(67)}, points=4), (points.assign(value=np.nan), runs))
    assert build(tmp_path, tmp_path / "out", "quick", "reach")
    with pytest.raises(TableError, match="is nan"):
        build(tmp_path, tmp_path / "all", "quick")


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("66.1 [64.0, 67.9]", "66.1"),
        ("−25.6", "-25.6"),
        ("+4.6 % [+3.2 %, +5.6 %]", "4.6"),
        ("150 k", "150000"),
        ("1.5 M", "1500000"),
        ("10,644 (22,568)", "10644"),
        ("< 0.001", "0.001"),
        ("–", ""),
        ("missing", ""),
        ("HiT-MAC", "hit-mac"),
        ("2 of 3", "2"),
        ("4 x 3 x 5", "4"),
    ],
)
def test_what_a_cell_is_sorted_by(text: str, key: str) -> None:
    assert page.sort_key(text) == key


def test_words_are_escaped_and_breaks_kept() -> None:
    assert page.cell("a<b>\nc & d").text == "a&lt;b&gt;<br>c &amp; d"


@pytest.mark.parametrize(("seconds", "words"), [(0, "0 s"), (89, "89 s"), (95, "2 min"), (11_530, "3 h 12 min")])
def test_durations(seconds: float, words: str) -> None:
    assert page.duration(seconds) == words


GIF = bytes.fromhex("47494638396102000100800000ffffff00000021f90400000000002c00000000020001000002020c0a003b")


@pytest.mark.parametrize(
    ("gif", "whole"),
    [
        (GIF, True),
        (b"GIF87a" + GIF[6:], True),
        (b"GIF88a" + GIF[6:], False),
        (GIF[:-1], False),
        (GIF[:6] + bytes(2) + GIF[8:], False),
        (GIF[:8] + bytes(2) + GIF[10:], False),
        (b"", False),
    ],
)
def test_what_is_a_whole_animation(gif: bytes, whole: bool) -> None:
    assert page.animation_fault(gif) == ("" if whole else f"the file is not a whole GIF ({len(gif)} bytes)")
