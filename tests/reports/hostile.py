"""Names that some output took for something else, and every output's own parser to read them back."""

import csv
import re
from html.parser import HTMLParser
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

NAMES = (
    r"$\x$",
    "_c",
    "d [x]",
    "5$ to 6$ {~}",
    ":bug:",
    "=1+1",
    "a|b",
    "<img src=x onerror=alert(1)>",
    "**bold**",
    "基线",
    "消融",
    "🐞 emoji",
    "שלום עולם",
    "long " * 39 + "words",
    "[link](http://x)",
    r"back\slash_ `code` &amp; <br>",
    "'@quoted",
    '50 % of #1 ^ & -- "x"',
)
QUESTION = r"Is $\x$ <b>better</b> than a|b, **really** & _truly_?"


def markdown_words(text: str) -> str:
    """The visible text of a Markdown page: a cell or a paragraph a line, a tag or a picture marked as such."""
    parser = MarkdownIt("commonmark").enable(["table", "strikethrough"])
    return "\n".join(_words(token) for token in parser.parse(text) if token.type in ("inline", "html_block"))


def _words(token: Token) -> str:
    if token.type in ("html_inline", "html_block"):
        return "\n" if token.content == "<br>" else f"(tag {token.content})"
    if token.type in ("softbreak", "hardbreak"):
        return "\n"
    if token.children is not None:
        return "".join(map(_words, token.children))
    return token.content


def csv_words(path: Path) -> list[list[str]]:
    """The cells of a CSV file as its own parser has them."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))


LATEX = {  # what our escapes mean to LaTeX
    **{f"\\{sign}": sign for sign in "%&_#${}"},
    r"\textbackslash{}": "\\",
    r"\textasciitilde{}": "~",
    r"\textasciicircum{}": "^",
    r"\textasciigrave{}": "`",
    r"\textbar{}": "|",
    "$-$": "−",
    "$<$": "<",
    "$>$": ">",
    "{[}": "[",
    "{*}": "*",
    "-{}": "-",
}


def latex_rows(text: str) -> list[list[str]]:
    """The cells of the body of a LaTeX table; a sign that LaTeX would read as a command stays in the cell as it is."""
    body = text.partition("\\midrule\n")[2].partition("\\bottomrule")[0]
    token = re.compile("|".join(map(re.escape, sorted(LATEX, key=len, reverse=True))))
    rows = [row for row in body.split("\\\\\n") if row.strip()]
    assert not [row for row in rows if re.match(r"\s*[\[*]", row)]  # it would belong to the row before
    bare = [token.sub("", row) for row in rows]
    assert not [row for row in bare if re.search(r"[\\${}~^%#_`|]", row)]  # nothing is left for TeX to act on
    return [[token.sub(lambda m: LATEX[m[0]], cell.strip()) for cell in re.split(r"(?<!\\)&", row)] for row in rows]


class Page(HTMLParser):
    """A page's words by element, its attributes, and where it leads to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.cells: list[str] = []
        self.words = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag == "td":
            self.cells.append("")

    def handle_data(self, data: str) -> None:
        self.words += data
        if self.cells:
            self.cells[-1] += data

    def values(self, attribute: str) -> list[str]:
        """Every value of an attribute."""
        return [attributes[attribute] for _, attributes in self.tags if attribute in attributes]
