"""Names go to every output as they were typed, and come out of it by that format's own parser."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from matplotlib import font_manager
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.legend import Legend
from matplotlib.text import Text

from reports.analyses import beyond, comparison, scaling
from reports.data import escaping
from reports.data.frame import Results, load
from reports.data.paper import read
from reports.pages.build import Built, build
from reports.render import figures, glyphs
from reports.render.canvas import Drawing, blank, save, styled
from tests.reports.factory import COVERAGE, assignments, noisy, study, write, yardsticks
from tests.reports.hostile import NAMES, QUESTION, Page, csv_words, latex_rows, markdown_words

pytestmark = pytest.mark.usefixtures("quick_resampling")
ARMS = {name: noisy(60 + place / 4) for place, name in enumerate(NAMES)}


def tables(folder: Path) -> Path:
    points, runs = study("reach", ARMS, points=3)
    runs = runs.assign(question=QUESTION, status=["missing", *runs["status"][1:]])
    points = points[points["run"] != runs["run"].iloc[0]]
    write(folder, (points, runs), yardsticks())
    watched = [assignments(points, name, [3.0, 2.0], [0.0, 0.1]) for name in NAMES[:4]]
    pd.concat(watched).to_parquet(folder / "reach.assignments.parquet", index=False)
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tables(tmp_path_factory.mktemp("tables"))


@pytest.fixture(scope="module")
def results(runs: Path) -> Results:
    return load(runs, "quick", "reach")


@pytest.fixture(scope="module")
def built(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Built]:
    out = tmp_path_factory.mktemp("report")
    return out, build(runs, out, "quick", "reach")


@pytest.fixture(scope="module")
def made(built: tuple[Path, Built]) -> Path:
    return built[0]


def test_every_figure_is_drawn_and_no_letter_is_a_warning(built: tuple[Path, Built]) -> None:
    out, report = built
    assert report.undrawn == []
    for name in ("curves_reach", "curves_reach_arms", "profile_reach", "assignments_reach"):
        for kind in ("png", "pdf", "csv"):
            assert (out / "figures" / f"{name}.{kind}").stat().st_size > 0


def test_markdown(made: Path) -> None:
    for name in ("tables/final_reach.md", "tables/runs.md", "index.md"):
        words = markdown_words((made / name).read_text(encoding="utf-8"))
        assert [arm for arm in NAMES if arm not in words.split("\n")] == []
        assert "(tag" not in words
    index = markdown_words((made / "index.md").read_text(encoding="utf-8"))
    assert f"reach: {QUESTION} ({len(NAMES)} arms" in index
    assert rf"Study reach, arm {NAMES[0]}: 1 of 3 seeds not run (seed 0)." in index
    assert "ends highest, at" in index


def test_latex(made: Path) -> None:
    rows = latex_rows((made / "tables" / "final_reach.tex").read_text(encoding="utf-8"))
    assert {row[0] for row in rows} == set(NAMES)
    assert {len(row) for row in rows} == {5}


def test_csv_has_no_formulas_and_numbers_stay_numbers(made: Path) -> None:
    head, *rows = csv_words(made / "tables" / "final_reach.csv")
    arms = [row[head.index("arm")] for row in rows]
    assert {escaping.typed(arm) for arm in arms} == set(NAMES)
    assert "'=1+1" in arms
    assert [cell for row in rows for cell in filter(None, row) if cell[0] in "=+-@\t\r" and not _number(cell)] == []
    assert all(_number(row[head.index("mean")]) for row in rows)
    curves = csv_words(made / "figures" / "curves_reach.csv")
    names = {escaping.typed(row[curves[0].index("name")]) for row in curves[1:]}
    assert set(NAMES) <= names


def _number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def test_page(made: Path) -> None:
    page = Page((made / "index.html").read_text(encoding="utf-8"))
    assert [arm for arm in NAMES if arm not in page.cells] == []
    assert QUESTION in page.words
    assert f"arm {NAMES[0]}: 1 of 3 seeds not run" in page.words
    assert any(all(arm in alt for arm in NAMES[1:]) for alt in page.values("alt"))
    assert not [attributes for _, attributes in page.tags if "onerror" in attributes]
    ids = [name for name in page.values("id") if name]
    assert len(ids) == len(set(ids))
    assert [name for name in ids if re.search(r"\s", name)] == []
    targets = [link[1:] for link in page.values("href") if link.startswith("#")]
    assert [link for link in targets if link not in ids] == []
    files = [link for link in page.values("href") if not link.startswith("#")]
    assert [link for link in files if not (made / link).exists()] == []


def drawings(results: Results) -> Iterator[Drawing]:
    spec = read().curves_of("reach", "coverage")
    for found in (
        figures.learning_curves(results, spec),
        figures.each_arm(results, spec),
        comparison.profile(results, "reach"),
    ):
        assert found is not None
        yield found


def bare(text: str) -> str:
    """A name without the breaks and spaces that long ones get or lose."""
    return "".join(text.split())


def texts(figure: Figure) -> list[Text]:
    return [text for text in figure.findobj(Text) if isinstance(text, Text)]


def test_figures_hold_the_names_and_no_mathematics(results: Results) -> None:
    for drawing in drawings(results):
        found = [bare(text.get_text()) for text in texts(drawing.figure)]
        assert [arm for arm in NAMES if not any(one.startswith(bare(arm)) for one in found)] == []
        assert [text for text in texts(drawing.figure) if text.get_text() and text.get_parse_math()] == []


def test_legends_name_every_arm(results: Results) -> None:
    spec = read().curves_of("reach", "coverage")
    for drawing in (figures.learning_curves(results, spec), comparison.profile(results, "reach")):
        assert drawing is not None
        (legend,) = (found for found in drawing.figure.findobj(Legend) if isinstance(found, Legend))
        shown = [bare(text.get_text()).rpartition("(")[0] for text in legend.get_texts()]
        assert sorted(shown) == sorted(map(bare, NAMES))
        assert len(legend.legend_handles) == len(NAMES)


def test_a_matrix_names_its_rows(tmp_path: Path) -> None:
    few = {name: ARMS[name] for name in NAMES[:11]}
    results = load(write(tmp_path, study("reach", few, points=3)), "quick")
    drawing = comparison.matrix(results, "reach")
    assert drawing is not None
    axes = drawing.figure.axes[0]
    assert sorted(text.get_text() for text in axes.get_yticklabels()) == sorted(few)
    save(drawing, tmp_path, "matrix")
    assert "[U+57FA U+7EBF]" in [text.get_text() for text in axes.get_xticklabels()]
    assert {row[0] for row in csv_words(tmp_path / "matrix.csv")[1:]} == {escaping.cell(name) for name in few}


def test_sweeps_and_transfer_name_their_methods(tmp_path: Path) -> None:
    arms = {f"{name}, {n} sensors": noisy(60.0) for name in NAMES[:5] for n in (2, 4)}
    points, runs = study("scaling", arms, points=3)
    agents = runs["arm"].str.extract(r"(\d) sensors$")[0].astype(int)
    both = zip(runs["config"], agents, strict=True)
    configs = [json.dumps(json.loads(config) | {"env": COVERAGE | {"agents": n}}) for config, n in both]
    results = load(write(tmp_path, (points, runs.assign(config=configs))), "quick")
    found = scaling.sweep(results)
    assert found is not None
    assert set(found.arms) == set(NAMES[:5])
    drawing = scaling.figure(results, found)
    assert drawing is not None
    assert save(drawing, tmp_path, "sweep") is False
    assert beyond.fig_transfer(results) is None


# Escapes

SIGNS = "\\`*_{}[]()#+-.!|<>&;$~=:'\"@%^ x1é中/?,"
TYPED = st.text(st.sampled_from(SIGNS), min_size=1, max_size=12).map(str.strip).filter(bool)


@settings(deadline=None, max_examples=400)
@given(TYPED)
@example("&amp; &#35; &x1;")
@example("[x](y) ![x](y) [x]: y")
@example("1. x")
@example("<!-- x --> <b>x</b>")
def test_markdown_means_what_was_typed(text: str) -> None:
    marked = escaping.markdown(text)
    for page, words in (
        (f"| a | b |\n|---|---|\n| {marked} | y |\n", f"a\nb\n{text}\ny"),
        (f"- {marked}\n", text),
        (f"> {marked}\n", text),
        (marked, text),
        (f"## {marked}", text),
        (f"*z {marked}.* {marked} `q`", f"z {text}. {text} q"),
        (f"- **{marked}**: z", f"{text}: z"),
        (f"- {escaping.code(text)}", text),
    ):
        assert markdown_words(page) == words
    assert escaping.words(f"{marked} `r`") == f"{text} r"


@given(TYPED)
def test_latex_means_what_was_typed(text: str) -> None:
    head = "\\midrule\n"
    assert latex_rows(f"{head}{escaping.latex(text)} & y \\\\\n\\bottomrule") == [[text, "y"]]


@given(st.text(st.sampled_from("'=+-@\t x1"), max_size=5))
def test_a_cell_of_csv_is_undone(text: str) -> None:
    assert escaping.typed(escaping.cell(text)) == text
    assert not re.match(r"[=+\-@\t\r]", escaping.cell(text))


def test_what_needs_no_escape_is_left_alone() -> None:
    for text in ("66.1 [64.0, 67.9]", "< 0.001", "+4.6 % [+3.2 %, +5.6 %]", "best_window", "a * b", "70 & 3"):
        assert escaping.markdown(text) == text


def test_code_in_a_question_stays_code() -> None:
    assert escaping.prose("What does `rhmc <x>` do to a_ *b*?") == r"What does `rhmc <x>` do to a\_ \*b\*?"
    assert escaping.prose("one ` alone") == r"one \` alone"


def test_new_lines_end_no_cell_and_no_item() -> None:
    assert escaping.markdown("a\n\n# b\u2028c") == "a # b c"
    assert escaping.latex("a\nb") == "a b"


@settings(deadline=None)
@given(st.lists(st.text(st.sampled_from("aA-_@. é中"), min_size=1, max_size=8), unique=True, min_size=2, max_size=20))
def test_no_two_names_share_a_file(names: list[str]) -> None:
    stems = [escaping.stem(name) for name in names]
    assert len({stem.casefold() for stem in stems}) == len(names)
    assert all(re.fullmatch(r"[a-z0-9_@-]+", stem) for stem in stems)


def test_plain_names_are_their_own_stems() -> None:
    for name in ("coverage_paper_faithful", "reach@hard", "7e67c370d8f2"):
        assert escaping.stem(name) == name
    assert escaping.stem("reach_arms") != "reach_arms"  # which are the files of the study `reach`


@pytest.mark.usefixtures("unpainted")
def test_studies_whose_names_are_alike_have_files_of_their_own(tmp_path: Path) -> None:
    seven = {f"arm {n}": noisy(60 + n) for n in range(7)}
    names = ("reach", "Reach", "reach_arms", "基线")
    out = tmp_path / "out"
    build(write(tmp_path / "runs", *(study(name, seven, points=2) for name in names)), out, "quick")
    page = Page((out / "index.html").read_text(encoding="utf-8"))
    ids = [name for name in page.values("id") if name]
    assert len(ids) == len(set(ids))
    assert len(list((out / "figures").glob("curves_*.png"))) == 2 * len(names)
    for name in names:
        assert f"Study {name}: learning curves" in page.words
        assert (out / "tables" / f"final_{escaping.stem(name)}.csv").exists()


# Letters


def test_a_letter_in_no_font_is_its_number() -> None:
    font = FontProperties(family=["DejaVu Sans"])
    assert glyphs.readable("基线 a", font) == "[U+57FA U+7EBF] a"
    assert glyphs.readable("消融", font) == "[U+6D88 U+878D]"
    assert glyphs.readable("🐞\u2068\nx", font) == "[U+1F41E]\nx"  # a mark that orders letters is not seen
    assert glyphs.readable("שלום αβ − ≥", font) == "שלום αβ − ≥"


def test_a_font_that_has_the_letter_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    family = _font(tmp_path, "基")
    monkeypatch.setattr(glyphs, "FALLBACKS", (family,))
    glyphs.families.cache_clear()
    try:
        with styled():
            figure = blank(3, 2)
            text = figure.text(0.1, 0.5, "基线")
        assert glyphs.settle(figure)
        assert text.get_text() == "基[U+7EBF]"
        with styled():
            figure.savefig(tmp_path / "x.png")
            figure.savefig(tmp_path / "x.pdf")
    finally:
        glyphs.families.cache_clear()


def _font(folder: Path, letter: str) -> str:
    """A font with one letter, a box, which matplotlib then knows. Returns its family."""
    from fontTools.fontBuilder import FontBuilder
    from fontTools.pens.ttGlyphPen import TTGlyphPen

    pen = TTGlyphPen(None)
    pen.moveTo((0, 0))
    for corner in ((0, 700), (700, 700), (700, 0)):
        pen.lineTo(corner)
    pen.closePath()
    box = pen.glyph()
    builder = FontBuilder(1000, isTTF=True)
    builder.setupGlyphOrder([".notdef", "box"])
    builder.setupCharacterMap({ord(letter): "box"})
    builder.setupGlyf({".notdef": box, "box": box})
    builder.setupHorizontalMetrics({".notdef": (800, 0), "box": (800, 0)})
    builder.setupHorizontalHeader(ascent=800, descent=-200)
    builder.setupNameTable({"familyName": "One Letter", "styleName": "Regular"})
    builder.setupOS2()
    builder.setupPost()
    builder.save(folder / "one.ttf")
    font_manager.fontManager.addfont(folder / "one.ttf")
    return "One Letter"
