"""Text is UTF-8 in every call that reads or writes some: what follows the locale fails on somebody's machine."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PARTS = ("rhmc", "pipelines", "reports", "benchmarks", "examples")
FILES = sorted(path for name in PARTS for path in (ROOT / name).rglob("*.py"))
TEXT = ("read_text", "write_text", "fdopen", "open", "NamedTemporaryFile", "TemporaryFile")


def test_no_text_follows_the_locale() -> None:
    found = [f"{path.relative_to(ROOT)}:{call.lineno}" for path in FILES for call in following(path.read_bytes())]
    assert not found


@pytest.mark.parametrize(
    "call",
    ["p.read_text()", "(p / 'a').write_text('x')", "open('x')", "p.open('w')", "run(['x'], text=True)",
     "Popen(['x'], universal_newlines=True)", "os.fdopen(3, 'w')"],
)  # fmt: skip
def test_what_follows_the_locale_is_seen(call: str) -> None:
    assert len(list(following(call.encode()))) == 1


@pytest.mark.parametrize(
    "call",
    ["p.read_text(encoding='utf-8')", "p.open('rb')", "open('x', mode='wb')", "run(['x'], text=True, encoding='utf-8')",
     "run(['x'])", "os.open('x', os.O_RDONLY)", "Image.open(file)"],
)  # fmt: skip
def test_what_says_its_encoding_or_is_no_text_passes(call: str) -> None:
    assert not list(following(call.encode()))


def following(source: bytes) -> Iterator[ast.Call]:
    """Calls that read or write text, or start a process whose words are text, and do not say in which encoding."""
    for call in ast.walk(ast.parse(source)):
        if isinstance(call, ast.Call):
            given = {word.arg: word.value for word in call.keywords}
            words = [given[name] for name in ("text", "universal_newlines") if name in given]
            text = any(isinstance(word, ast.Constant) and word.value is True for word in words)
            if (text or _opens(call, given)) and "encoding" not in given:
                yield call


def _opens(call: ast.Call, given: dict[str | None, ast.expr]) -> bool:
    """True if it reads or writes a file as text."""
    if isinstance(call.func, ast.Attribute):
        return call.func.attr in TEXT and not _binary(call, given) and not _of(call, "os", "zipfile", "Image")
    return getattr(call.func, "id", "") == "open" and not _binary(call, given)


def _binary(call: ast.Call, given: dict[str | None, ast.expr]) -> bool:
    modes = [*call.args, *([given["mode"]] if "mode" in given else [])]
    return any(isinstance(mode, ast.Constant) and mode.value in ("rb", "wb", "ab", "r+b", "w+b") for mode in modes)


def _of(call: ast.Call, *modules: str) -> bool:
    """True if it is the `open` of one of these modules, which is of bytes."""
    owner = call.func.value if isinstance(call.func, ast.Attribute) and call.func.attr == "open" else None
    return isinstance(owner, ast.Name) and owner.id in modules
