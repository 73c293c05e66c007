"""A figure as a small SVG for the page: words as words in the reader's font, so that a phone can enlarge them."""

import io
import re

from matplotlib.figure import Figure

from reports.render.canvas import styled

FAMILY = "DejaVu Sans, Verdana, sans-serif"  # as wide as what the figure was laid out with, or narrower
DIGITS = 2  # of a coordinate in points: a hundredth is less than any screen shows

TAG = re.compile(r"<[^>]+>")
LONG = re.compile(r"-?\d+\.\d{3,}")


def svg(figure: Figure) -> str:
    """A figure as SVG, on one line, without a background. It has to be settled (`glyphs.settle`) and saved before."""
    kept = io.StringIO()
    with styled():
        figure.savefig(kept, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    return slim(kept.getvalue())


def slim(text: str) -> str:
    """The same picture without what no reader sees: comments, names that nothing refers to, digits, line breaks."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    used = set(re.findall(r"#([\w.-]+)", text))
    text = re.sub(r' id="([^"]*)"', lambda found: found[0] if found[1] in used else "", text)
    text = TAG.sub(lambda found: _tag(found[0]), text)
    return re.sub(r">\s+<", "><", re.sub(r"<g\s*/>", "", text)).strip()


def _tag(text: str) -> str:
    """A tag with short numbers and no line breaks."""
    text = LONG.sub(lambda found: f"{float(found[0]):.{DIGITS}f}".rstrip("0").rstrip("."), text)
    text = re.sub(r"font-family: [^;\"]+", f"font-family: {FAMILY}", text)
    text = re.sub(r"\s+", " ", text).replace("; ", ";").replace(": ", ":")
    return text if "'" in text else text.replace('"', "'")  # shorter as part of an address
