"""User text as each format wants it: a name, a question or a note stands in every output as it was typed.

One function a format, and no other place escapes. HTML is Jinja's, which escapes whatever is not `Markup`; JSON is
`json`'s; a figure's is `reports.render.glyphs`. Imports the standard library alone: the descriptions of a log use it as
well.
"""

import re
from hashlib import sha256

BREAK = re.compile(r"\s*[\n\r\v\f\x1c-\x1e\x85\u2028\u2029]\s*")  # what a format may take for a new line
PUNCTUATION = r"!-/:-@\[-`{-~"  # what Markdown lets a backslash stand before
MARKS = re.compile(
    rf"""
    \\(?=[{PUNCTUATION}]|$)                 # a backslash, where it would escape
    | [|$`~]                                # cells, mathematics, code, struck words
    | (?<!\s)\* | \*(?!\s)                  # emphasis, but not a lone star between spaces
    | (?<![^\W_])_ | _(?![^\W_])            # emphasis, but not inside a word
    | <(?=[A-Za-z/!?]) | &(?=\#?\w{{1,40}};)  # tags, comments, entities
    | \](?=[(\[:])                          # links
    | ^[#>] | ^[+-](?=[\s-]|$) | ^=(?==*\s*$) | ^\[(?=[\sxX]\])  # headings, quotes, lists, lines, boxes to tick
    | (?<=\s)\#(?=\#*\s*$)                  # the end of a heading
    """,
    re.VERBOSE,
)
NUMBERED = re.compile(r"^(\d{1,9})([.)])(?=\s|$)")  # an item of a list
LATEX = str.maketrans(
    {sign: f"\\{sign}" for sign in "%&_#${}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "`": r"\textasciigrave{}"}
    | {"|": r"\textbar{}", "−": "$-$", "<": "$<$", ">": "$>$"}
)
FORMULA = re.compile(r"'*[=+\-@\t\r\n＝＋－＠]")  # what spreadsheets compute, and what `cell` makes of it
STEM = re.compile(r"[a-z0-9_@-]{1,100}")
DIGEST = re.compile(r"-[0-9a-f]{8}\Z|_arms\Z")  # ends of names that `stem` and the report give themselves


def line(text: str) -> str:
    """On one line."""
    return BREAK.sub(" ", text).strip()


def markdown(text: str) -> str:
    """Text on a line of Markdown, at its start, behind other text or in a cell. What needs no escape is left alone."""
    return NUMBERED.sub(r"\1\\\2", MARKS.sub(r"\\\g<0>", line(text)))


def prose(text: str) -> str:
    """Sentences, such as a study's question, on a line of Markdown: what stands between two backticks is code."""
    parts = re.split(r"(?<!`)(`[^`]+`)(?!`)", line(text))  # every second one is code
    return "".join(part if place % 2 else _between(part) for place, part in enumerate(parts))


def _between(part: str) -> str:
    """A part of a line, with the spaces at its ends."""
    bare = part.strip()
    return part.replace(bare, markdown(bare), 1) if bare else part


def words(marked: str) -> str:
    """The text of a line of ours: that of `markdown` and code between backticks, without the marks of either."""
    return re.sub(rf"\\([{PUNCTUATION}])|`", r"\1", marked)


def code(text: str) -> str:
    """Text as code in Markdown: a fence longer than any in it."""
    flat = line(text) or " "
    fence = "`" * (1 + max(map(len, re.findall("`+", flat)), default=0))
    pad = " " if "`" in (flat[0], flat[-1]) else ""
    return f"{fence}{pad}{flat}{pad}{fence}"


def latex(text: str) -> str:
    """Text in LaTeX, at the start of a row as well, where a bracket or a star would belong to the row before."""
    plain = re.sub("-(?=-)", "-{}", line(text).translate(LATEX))
    return re.sub(r"^[\[*]", r"{\g<0>}", plain)


def cell(text: str) -> str:
    """Text in a cell of CSV, with an apostrophe before what a spreadsheet would compute. Undone by `typed`."""
    return f"'{text}" if FORMULA.match(text) else text


def typed(text: str) -> str:
    """The text that was typed in a cell of CSV."""
    return text[1:] if text[:1] == "'" and FORMULA.match(text) else text


def stem(name: str) -> str:
    """A name as part of a file's name and of an anchor: no two names have the same, on no file system.

    Lower-case letters of ASCII, digits, `_`, `-` and `@` stand for themselves; where anything is changed, or the name
    ends as the report's own do, eight digits of its digest follow.
    """
    if STEM.fullmatch(name) and not DIGEST.search(name):
        return name
    reading = re.sub(r"[^a-z0-9_@]+", "-", name.lower()).strip("-")[:60]
    return f"{reading or 'name'}-{sha256(name.encode('utf-8', 'surrogatepass')).hexdigest()[:8]}"
