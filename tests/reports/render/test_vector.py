"""Figures as small SVGs: what a reader sees stays, what nobody sees goes."""

import re
from xml.etree import ElementTree

from reports.render.canvas import blank, styled
from reports.render.vector import slim, svg

WORDS = "a <b> & \"c\" 0.12345 'd'"


def drawn() -> str:
    with styled():
        figure = blank(4, 3)
        axes = figure.add_subplot()
        axes.plot([0.123456, 1.234567, 2], [3.333333, 4, 5])
        axes.set_title(WORDS)
    return svg(figure)


def test_words_stay_words_and_lines_lines() -> None:
    text = drawn()
    root = ElementTree.fromstring(text)
    assert WORDS in [node.text for node in root.iter() if node.text]
    assert len([node for node in root.iter() if node.tag.endswith("path")]) > 3
    assert "DejaVu Sans, Verdana, sans-serif" in text
    assert root.attrib["viewBox"] == "0 0 288 216"


def test_the_same_figure_is_the_same_bytes() -> None:
    assert drawn() == drawn()


def test_what_nobody_sees_is_gone() -> None:
    text = drawn()
    assert not re.search(r"<!|<\?|metadata|\n|\d\.\d{3,}(?=[^<]*>)", text)
    names, used = set(re.findall(r" id='([^']+)'", text)), set(re.findall(r"#([\w.-]+)\)", text))
    assert used
    assert used <= names
    assert not names & {"figure_1", "axes_1"}
    assert "fill:#ffffff" not in text.replace(" ", "").partition("<text")[0]  # no slab behind it


def test_numbers_are_short_in_tags_alone() -> None:
    assert slim('<?x?><svg a="1.23456 -0.001"><g id="a"/>1.23456</svg>') == "<svg a='1.23 -0'>1.23456</svg>"
