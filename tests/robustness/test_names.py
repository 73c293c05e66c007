"""Names that people give: kept apart wherever they become names of files and models, and shown without their tricks."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import unicodedata
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from itertools import product
from pathlib import Path

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from pipelines.specs.safe_names import PROFILES, RESERVED, STUDY, folded, simple, slug
from pipelines.specs.search import Search
from pipelines.specs.study import Study, StudyError
from pipelines.tracking.plan import chosen
from pipelines.tracking.registry import model_name
from pipelines.tracking.source_file import another, remember
from pipelines.tracking.tracker import StudyCard
from pipelines.tuning.best_params import file_name, stem
from pipelines.workspace.errors import LONGEST, MOST, InputError, visible
from pipelines.workspace.work_folder import Home
from tests.pipelines.support import Said, run_rhmc, tiny

ROOT = Path(__file__).parents[2]
FILE = """\
question: Names
base: {env: {kind: coverage, agents: 2, targets: 3}, algo: {kind: iql}}
arms:
%s
seeds: 1
steps: 160
"""
ARMS = ["a b", "a-b", "基线", "消融", "_c", "d [x]", "5$ to 6$ {~}", "$\\x$"]
PIECES = ["a", "b", "B", " ", "-", "_", ".", "$", "é", "基", "\u0301", "ß", "ﬁ", "quick", "deadbeef", "x" * 70]


@pytest.fixture(autouse=True)
def _in_a_project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RHMC_HOME", str(tmp_path / "work"))
    (tmp_path / "studies").mkdir()


def rhmc(*words: str) -> Said:
    out, err = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = run_rhmc(*words)
    return Said(code, out.getvalue(), err.getvalue())


def written(arms: list[str], name: str = "x", more: str = "") -> Path:
    """A study with these arms."""
    file = Path(f"studies/{name}.yaml")
    rows = [f"  {json.dumps(arm)}: {{algo: {{gamma: {0.5 + i / 100}}}}}" for i, arm in enumerate(arms)]
    file.write_text(FILE % "\n".join(rows) + more, encoding="utf-8")
    return file


def faults(file: Path) -> list[str]:
    with pytest.raises(StudyError) as caught:
        Study.load(file)
    return str(caught.value).splitlines()


def card(study: str, profile: str = "quick") -> StudyCard:
    return StudyCard(study, profile, "", {}, [])


# One to one


def test_names_that_need_no_change_are_kept() -> None:
    kept = [name for name in ("full", "HiT-MAC", "1.5", "a_b+c", "RHMC") if slug(name) == name]
    assert kept == ["full", "HiT-MAC", "1.5", "a_b+c", "RHMC"]
    for file in sorted((ROOT / "studies").glob("*.yaml")):
        if file.name.startswith(("search_", "template")):
            continue
        study = Study.load(file)
        plain = [arm for arm in study.arms if re.fullmatch(r"[A-Za-z0-9._+-]+", arm)]
        names = [model_name(card(study.name), arm) for arm in plain]
        assert names == [f"{study.name}-quick-{arm}" for arm in plain]


def test_winners_that_are_committed_keep_their_names() -> None:
    search = Search.load(ROOT / "studies/search_rhmc.yaml")
    there = {file.name for file in (ROOT / "studies/best_params").glob("*.quick.yaml")}
    assert there
    assert there <= {file_name(search, arm) for arm in search.arms}


def test_hostile_arms_have_a_model_and_a_file_each() -> None:
    study = Study.load(written(ARMS))
    assert list(study.arms) == ARMS
    models = [model_name(card("names_min"), arm) for arm in ARMS]
    assert len(set(models)) == len({stem(arm) for arm in ARMS}) == len(ARMS)
    assert all(re.fullmatch(r"names_min-quick-?[A-Za-z0-9._+-]*", name) for name in models)  # no quote for a filter
    assert models[1] == "names_min-quick-a-b"
    assert re.fullmatch(r"names_min-quick-a-b-[0-9a-f]{8}", models[0])


@settings(max_examples=400, deadline=None)
@given(st.lists(st.sampled_from(PIECES), min_size=1, max_size=5), st.lists(st.sampled_from(PIECES), max_size=5))
def test_no_two_names_have_one_slug(one: list[str], other: list[str]) -> None:
    first, second = "".join(one), "".join(other)
    for text in (second, slug(first), slug(first).upper(), first.swapcase()):
        if folded(text) != folded(first):
            assert slug(first).lower() != slug(text).lower()
    assert re.fullmatch(r"[A-Za-z0-9_+][A-Za-z0-9._+-]*", slug(first))
    assert len(slug(first)) <= 69


def test_no_two_studies_share_a_model() -> None:
    names = ["a", "a-quick", "a-quick-b", "a-paper", "a@b", "a-b", "quick", "a-quicker"]
    arms = ["b", "quick-b", "b-quick-b", "paper-b", "quick-quick-b"]
    models = {(s, p, arm): model_name(card(s, p), arm) for s, p, arm in product(names, PROFILES, arms)}
    assert len(set(models.values())) == len(models)
    assert models["a", "quick", "quick-b"] == "a-quick-quick-b"
    assert models["a-quicker", "quick", "b"] == "a-quicker-quick-b"


# What cannot be kept apart


@pytest.mark.parametrize(
    ("one", "other"),
    [("IQL", "iql"), ("a b", "a  b"), ("a b", "A  B"), ("é", "e\u0301"), ("x²", "x2"), ("STRASSE", "straße")],
)
def test_arms_that_look_alike_are_refused(one: str, other: str) -> None:
    said = faults(written([one, other]))
    assert len(said) == 1
    assert said[0].startswith("studies/x.yaml:5:3: arms.")
    assert said[0].endswith(" in case, blanks or the form of a letter alone; give it another name")
    search = FILE % "\n".join(
        f"  {json.dumps(arm)}: {{space: {{lr: {{low: 1e-4, high: 1e-3}}}}}}" for arm in (one, other)
    )
    Path("studies/s.yaml").write_text(search.replace("steps", "trials: 2\nsteps"), encoding="utf-8")
    with pytest.raises(StudyError):
        Search.load("studies/s.yaml")


def test_variants_that_look_alike_are_refused() -> None:
    more = "variants: {faithful: {algo: {lr: 0.1}}, Faithful: {algo: {lr: 0.2}}}\n"
    (said,) = faults(written(["a"], more=more))
    assert "'Faithful' differs from variant 'faithful' in case" in said


@pytest.mark.parametrize("name", [*RESERVED, "Transfer", "THEOREM"])
def test_reserved_names_are_refused_by_every_verb(name: str) -> None:
    file = str(written(["a"], name))
    for verb in (["study", "check"], ["study", "run"], ["study", "status"], ["export"]):
        said = rhmc(*verb, file)
        assert (said.code, said.out) == (2, "")
        assert said.err.startswith(f"{file}: a study cannot be named '{name}': `rhmc ")
    assert rhmc("report", "--study", file).code == 2
    assert not Path("work").exists()


def test_all_that_the_program_writes_beside_the_tables_is_reserved() -> None:
    pipeline = YAML(typ="safe").load((ROOT / "dvc.yaml").read_text(encoding="utf-8"))
    outs = [next(iter(out)) for stage in pipeline["stages"].values() for out in stage["outs"]]
    made = {Path(out).name.partition(".")[0] for out in outs if "/runs/" in out and not out.endswith(".gif")}
    studies = {file.stem for file in (ROOT / "studies").glob("*.yaml")}
    assert made - studies == set(RESERVED)
    files = [file for file in (ROOT / "pipelines").rglob("*.py") if "bundles" not in file.parts]
    found = {name for file in files for name in tables_in(file)}
    assert found - {"claims"} == set(RESERVED)  # a report's, which is read, and not beside the tables


def tables_in(file: Path) -> set[str]:
    """Stems of tables that a module names, and what it calls `STUDY` in place of one."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    texts = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    made = {text.partition(".")[0] for text in texts if re.fullmatch(r"[a-z_]+\.(parquet|json)", text)}
    for node in ast.walk(tree):
        match node:
            case ast.Assign([ast.Name("STUDY")], ast.Constant(str(name))):
                made.add(name)
            case ast.Assign([ast.Tuple([ast.Name("STUDY"), *_])], ast.Tuple([ast.Constant(str(name)), *_])):
                made.add(name)
    return made


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("b" * 81, f"a name of 81 bytes; at most {STUDY}, for it is part of other names"),
        ("基" * 30, f"a name of 90 bytes; at most {STUDY}, for it is part of other names"),
        ("x_arms", "a study's name does not end in '_arms', as a figure of the study 'x' does"),
        ("x@paper_faithful", "a study's file is named with letters, digits, '-' and '_' only"),
        ("a b", "a study's file is named with letters, digits, '-' and '_' only"),
        ("-x", "a study's file is named with no '-' in front, which would make it an option"),
    ],
)
def test_a_stem_that_cannot_be_part_of_other_names(name: str, said: str) -> None:
    assert faults(written(["a"], name)) == [f"studies/{name}.yaml: {said}"]


def test_a_variant_that_makes_a_name_too_long() -> None:
    file = written(["a"], "b" * 60, f"variants: {{{'v' * 30}: {{algo: {{lr: 0.1}}}}}}\n")
    (said,) = faults(file)
    assert said.endswith(f"with the study's, a name of 91 bytes; at most {STUDY}, for it is part of other names")


def test_a_letter_of_two_forms_is_one_study() -> None:
    assert Study.load(written(["a"], "e\u0301t\u00e9")).name == "\u00e9t\u00e9"


def test_the_longest_names_fit_into_a_file_system(tmp_path: Path) -> None:
    search = Search.load(ROOT / "studies/search_rhmc.yaml").model_copy(update={"name": "s" * STUDY})
    for name in (
        f"{'s' * STUDY}.assignments.parquet",
        file_name(search, "基" * 200),
        f"{stem('a' * 200)}.importance.png",
    ):
        (tmp_path / f"{name}.{'h' * 64}-4194304.part").touch()


def test_an_arm_of_many_letters_is_refused() -> None:
    (said,) = faults(written(["a" * 201]))
    assert "a key of 201 characters" in said
    grid = "grid: {algo.gamma: [0.1, 0.2]}\n"
    said = "; ".join(faults(written(["a" * 190], more=grid)))
    assert "is not a name for an arm; it has 201 characters, at most 200" in said


# Two files of one stem


def test_two_files_of_one_stem_do_not_go_together() -> None:
    for folder in ("a", "b"):
        Path(folder).mkdir()
        written(["a"], "one").rename(f"{folder}/one.yaml")
    for verb in (["study", "run"], ["export"]):
        said = rhmc(*verb, "a/one.yaml", "b/one.yaml")
        line = "one: given 2 times (a/one.yaml, b/one.yaml); studies that go together need names of their own\n"
        assert said == (2, "", line)
    assert not Path("work").exists()


def test_a_launch_from_another_file_of_the_stem_is_said(tmp_path: Path) -> None:
    home, (a, b) = Home(tmp_path / "work"), (Path("a/one.yaml"), Path("b/one.yaml"))
    for file in (a, b):
        file.parent.mkdir()
        written(["a"], "one").rename(file)
    assert another(home, "one", "quick", str(a)) == ""
    remember(home, "one", "quick", str(a))
    assert another(home, "one", "quick", str(a.resolve())) == ""
    assert another(home, "one", "paper", str(b)) == ""
    said = another(home, "one", "quick", str(b))
    assert said.startswith(f"one (quick): launched from {a.resolve()} before and b/one.yaml now; ")
    assert said in rhmc("study", "check", "b/one.yaml").out.splitlines()
    assert said == rhmc("export", "b/one.yaml", "--out", "out").err.splitlines()[0]
    assert said not in rhmc("study", "check", "a/one.yaml").out
    a.rename("a/two.yaml")  # it was moved
    assert another(home, "one", "quick", str(b)) == ""


# What is shown

NASTY = [
    *("\x01\x07\x08\t\n\r\x1b[31m\x7f\x85\x9b", "\u00ad\u200b\u200d\u200e\u202e\u2028\u2029\u2066\ufeff", "\udc80"),
    *("\ue000\U000e0001\U0010ffff", "\x1b]0;x\x07", "a", "b: c", "é", "基", "'\"", "[x]", "\\", "#", "%s{0}", ".."),
]
hostile = st.lists(st.sampled_from([c for text in NASTY for c in (text, *text)]), min_size=1, max_size=6).map("".join)


def is_shown(character: str) -> bool:
    return unicodedata.category(character)[0] != "C" and unicodedata.category(character) not in ("Zl", "Zp")


def document(key: str) -> Callable[[str], list[str]]:
    """A study that holds a text, in quotes, in the place of TEXT."""

    def words(text: str) -> list[str]:
        quoted = "".join(c if c.isascii() and c.isalnum() else f"\\U{ord(c):08x}" for c in text)
        body = FILE % "  a: {}"
        Path("studies/x.yaml").write_text(key.replace("BODY", body).replace("TEXT", f'"{quoted}"'), encoding="utf-8")
        return ["study", "check", "studies/x.yaml"]

    return words


def existing(text: str) -> list[str]:
    name = text.replace("/", "").replace("\0", "")
    Path(f"studies/{name}.yaml").write_text(FILE % "  a: {}", encoding="utf-8")
    return ["study", "check", f"studies/{name}.yaml"]


def of_x(*words: str) -> Callable[[str], list[str]]:
    def put(text: str) -> list[str]:
        written(["a"])
        return [word.replace("TEXT", text) for word in words]

    return put


PLACES = {
    "no file": lambda text: ["study", "check", f"{text}.yaml"],
    "file": existing,
    "key": document("BODYTEXT: 1\n"),
    "inner key": document(FILE % "  a: {algo: {TEXT: 1}}"),
    "arm": document(FILE % "  TEXT: {algo: {gamma: 0.5, x: 1}}"),
    "variant": document("BODYvariants: {TEXT: {algo: {x: 1}}}\n"),
    "grid": document("BODYgrid: {algo.encoder: [TEXT]}\n"),
    "value": document(FILE % "  a: {algo: {encoder: TEXT}}"),
    "include": document(FILE % "  a: {algo: {include: TEXT}}"),
    "kind": document(FILE % "  a: {algo: {kind: TEXT}}"),
    "question": document("BODYquestion: TEXT\n"),
    "tag": of_x("study", "check", "studies/x.yaml", "--set", "algo.lr=!xTEXT 1"),
    "--set key": of_x("study", "check", "studies/x.yaml", "--set", "TEXT=1"),
    "--set value": of_x("study", "check", "studies/x.yaml", "--set", "algo.encoder=TEXT"),
    "--set arm": of_x("study", "check", "studies/x.yaml", "--set", "arms.TEXT.algo.lr=1"),
    "--profile": of_x("study", "check", "studies/x.yaml", "--profile", "xTEXT"),
    "--variant": of_x("study", "check", "studies/x.yaml", "--variant", "TEXT"),
    "option": of_x("study", "check", "studies/x.yaml", "--xTEXT"),
    "word": of_x("study", "check", "studies/x.yaml", "TEXT"),
    "verb": of_x("xTEXT"),
    "folder": of_x("study", "list", "--folder", "TEXT"),
    "report": of_x("report", "--study", "TEXT.yaml"),
    "search": of_x("search", "check", "TEXT.yaml"),
    "policies": of_x("yardsticks", "coverage", "--policies", "TEXT"),
}


@pytest.mark.parametrize("place", PLACES)
@settings(max_examples=25, deadline=None, derandomize=True)
@given(text=hostile)
def test_whatever_is_typed_is_shown_as_what_it_is(place: str, text: str) -> None:
    assume("/" not in text and not simple(text))
    said = rhmc(*PLACES[place](text))
    assert "Traceback" not in said.err
    assert (said.code, bool(said.err)) == (2, True)
    lines = (said.out + said.err).split("\n")
    assert [line for line in lines if not all(map(is_shown, line))] == []
    assert len(lines) < 12


def test_text_that_may_be_shown_is_shown_as_typed() -> None:
    assert visible("Naïve : 基线 $x$ {~} 🐞 [x]") == "Naïve : 基线 $x$ {~} 🐞 [x]"
    assert visible("a\x1b[31m\u202e\n\udc80") == "a\\x1b[31m\\u202e\\n\\udc80"
    assert str(InputError("one\ntwo", "three")) == "one\\ntwo\nthree"


def test_names_in_json_stay_what_they_are(tmp_path: Path) -> None:
    (tmp_path / "l").mkdir()
    Path("l/a\u202e\x1b.yaml").write_text(FILE % "  a: {}")
    said = rhmc("study", "list", "--folder", "l", "--json")
    assert json.loads(said.out)[0]["study"] == "l/a\u202e\x1b.yaml"
    assert all(map(is_shown, said.out.strip()))
    table = rhmc("study", "list", "--folder", "l")
    assert "l/a\\u202e\\x1b.yaml" in table.out


def test_an_arm_that_is_asked_for_is_shown(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        chosen(tiny(), ["a\x1b\nb"])
    assert str(caught.value).startswith("--arm: 'a\\x1b\\nb' is not allowed; ")


# What a file may cost


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "a: &a [x]\n"
            + "".join(f"{chr(98 + i)}: &{chr(98 + i)} [*{chr(97 + i)}, *{chr(97 + i)}]\n" for i in range(20)),
            "1:4: b.0: used again by an alias; aliases are not read here, write the value out",
        ),
        ("a: " + "[" * 100_000, "1:33: nested too deeply; this is not a study"),
        ("a: " + "{b: " * 40 + "1" + "}" * 40, "1:117: nested too deeply; this is not a study"),
        ("".join(f"k{i}: 1\n" for i in range(20_000)), "5000:8: more than 10,000 keys and values; this is not a study"),
        ("arms:\n" + "".join(f"  a{i}: {{}}\n" for i in range(1001)), "1:1: arms: 1,001 of them; at most 1,000"),
        ("variants:\n" + "".join(f"  a{i}: {{}}\n" for i in range(101)), "1:1: variants: 101 of them; at most 100"),
    ],
    ids=["bomb", "deep", "deep maps", "many", "arms", "variants"],
)
def test_a_bomb_is_one_line(text: str, said: str) -> None:
    Path("studies/x.yaml").write_text(text)
    assert rhmc("study", "check", "studies/x.yaml") == (2, "", f"studies/x.yaml:{said}\n")


def test_many_faults_end_in_a_count() -> None:
    Path("studies/x.yaml").write_text(FILE % "  a: {}" + "".join(f"k{i}: 1\n" for i in range(3000)))
    lines = rhmc("study", "check", "studies/x.yaml").err.splitlines()
    assert (len(lines), lines[-1]) == (MOST + 1, f"and {3000 - MOST:,} more")


def test_a_long_key_and_a_long_line_are_cut() -> None:
    Path("studies/x.yaml").write_text(FILE % "  a: {}" + f"? {'k' * 100_000}\n: 1\n")
    (line,) = rhmc("study", "check", "studies/x.yaml").err.splitlines()
    assert line.startswith("studies/x.yaml:7:3: a key of 100,000 characters, 'kkkk")
    said = rhmc("study", "check", "studies/x.yaml", "--set", f"{'k' * 50_000}=1")
    assert len(said.err) < LONGEST + 2 + 200
    assert said.err.splitlines()[0].startswith("studies/x.yaml:7:3:") or said.err.startswith("--set kkk")


# Paths that are too long

LONG = "a" * 300


@pytest.mark.parametrize(
    "words",
    [
        *(["study", verb, f"{LONG}.yaml"] for verb in ("check", "run", "status")),
        ["study", "check", "studies/x.yaml", "--set", f"base.algo.include={LONG}.yaml"],
        ["study", "export", "studies/x.yaml", LONG],
        ["study", "import", f"{LONG}.zip"],
        ["study", "list", "--folder", LONG],
        ["export", f"{LONG}.yaml"],
        ["export", "studies/x.yaml", "--out", LONG],
        *(["search", verb, f"{LONG}.yaml"] for verb in ("check", "run", "status")),
        ["search", "run", "studies/search.yaml", "--out", LONG],
        ["evaluate", f"{LONG}.yaml"],
        ["evaluate", f"{LONG}.pt"],
        ["transfer", f"{LONG}.yaml", "--out", "out", "--agents", "2"],
        ["assignments", "studies/x.yaml", "--out", LONG],
        ["render", LONG, "--out", "x.gif"],
        ["render", f"{LONG}.yaml", "--out", "x.gif"],
        ["report", "--study", f"{LONG}.yaml"],
        ["report", "--runs", LONG],
        ["theorem", "--instances", "1", "--out", LONG],
        ["methods", "--out", LONG],
        ["drawings", "--out", LONG],
        ["fingerprint", LONG],
        ["profile", LONG],
        ["yardsticks", "all", "--out", LONG],
        ["yardsticks", "coverage", "--out", LONG],
        ["study", "check", "x/" * 3000 + "a.yaml"],
    ],
    ids=lambda words: " ".join(word[:12] for word in words),
)
def test_a_path_that_is_too_long_is_one_line(words: list[str], tmp_path: Path) -> None:
    written(["a"])
    Path("studies/search.yaml").write_text(
        FILE.replace("steps", "trials: 1\nsteps") % "  a: {space: {lr: {low: 1e-4, high: 1e-3}}}"
    )
    before = sorted(tmp_path.rglob("*"))
    said = rhmc(*words)
    assert said.code == 2
    assert [("name too long" in line, len(line) < LONGEST + 100) for line in said.err.splitlines()] == [(True, True)]
    assert sorted(path for path in tmp_path.rglob("*") if path.name != "work") == before


def test_a_work_folder_that_is_too_long_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RHMC_HOME", LONG)
    written(["a"])
    for verb in (["study", "run"], ["study", "status"], ["export"]):
        said = rhmc(*verb, "studies/x.yaml")
        (line,) = (line for line in said.err.splitlines() if not line.startswith("note: "))
        assert said.code == 2
        assert "File name too long" in line


def test_a_nul_in_the_path_of_an_include() -> None:
    written(["a"])
    Path("studies/x.yaml").write_text(FILE % '  a: {algo: {include: "a\\0b"}}')
    (line,) = rhmc("study", "check", "studies/x.yaml").err.splitlines()
    assert line.startswith(
        "studies/x.yaml:4:23: arms.a.algo.include: studies/a\N{REPLACEMENT CHARACTER}b.yaml: no such file"
    )


# The profile of the pipeline

PROFILE_ATTACKS = [
    '"; touch pwned; #"',
    "../../x",
    '"$(touch pwned)"',
    "'`touch pwned`'",
    "[quick]",
    "",
    "1",
    "quick x",
]


@pytest.mark.parametrize("value", PROFILE_ATTACKS)
def test_a_profile_that_is_none_is_one_line(value: str) -> None:
    Path("params.yaml").write_text(f"profile: {value}\n")
    said = rhmc("profile")
    assert (said.code, said.out, said.err.count("\n")) == (2, "", 1)
    assert said.err.startswith("params.yaml:")
    assert said.err.endswith(" is not allowed; allowed: quick, paper\n") or "did you mean" in said.err


def test_the_profile_is_looked_at_before_a_shell_meets_it() -> None:
    pipeline = YAML(typ="safe").load((ROOT / "dvc.yaml").read_text(encoding="utf-8"))
    for name, stage in pipeline["stages"].items():
        lines = [stage["cmd"]] if isinstance(stage["cmd"], str) else stage["cmd"]
        if any("${profile}" in line for line in lines):
            assert lines[0] == "rhmc profile", name
    assert "params.yaml" not in (ROOT / "Makefile").read_text(encoding="utf-8").split("help:")[0]


@pytest.mark.parametrize("value", ['"; touch pwned; #"', "../../x"])
def test_dvc_runs_nothing_for_a_profile_that_is_none(value: str, tmp_path: Path) -> None:
    """The real pipeline, in a folder of its own: before, the shell ran the first of these and made `pwned`."""
    shutil.copy(ROOT / "dvc.yaml", tmp_path)
    Path("params.yaml").write_text(f"profile: {value}\n", encoding="utf-8")
    Path(".fingerprint").touch()
    tools = Path(sys.executable).parent
    env = os.environ | {"PATH": f"{tools}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT), "DVC_NO_ANALYTICS": "1"}
    subprocess.run([tools / "dvc", "init", "-q", "--no-scm"], env=env, check=True, cwd=tmp_path)
    before = files(tmp_path)
    done = subprocess.run(
        [tools / "dvc", "repro", "--single-item", "theorem"],
        env=env,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    said = [line for line in done.stderr.splitlines() if line.startswith("params.yaml:")]
    assert [line.endswith(" is not allowed; allowed: quick, paper") for line in said] == [True]
    assert files(tmp_path) == before


@pytest.mark.parametrize("goal", ["repro", "report"])
def test_make_runs_nothing_for_a_profile_that_is_none(goal: str, tmp_path: Path) -> None:
    for name in ("Makefile", "requirements.lock", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    Path(".venv").mkdir()
    Path(".venv/.ready").touch()
    Path("params.yaml").write_text("profile: quick; touch pwned; echo\n", encoding="utf-8")
    tools = Path(sys.executable).parent
    env = os.environ | {"PATH": f"{tools}:{os.environ['PATH']}"}
    done = subprocess.run(["make", goal], env=env, cwd=tmp_path, capture_output=True, text=True, check=False)
    said = [line for line in done.stderr.splitlines() if not re.match(r"make(\[\d+\])?: ", line)]
    assert said == ["params.yaml:1:10: profile: 'quick; touch pwned; echo' is not allowed; allowed: quick, paper"]
    assert (done.returncode, done.stdout) == (2, "")
    assert not Path("pwned").exists()


def files(folder: Path) -> set[Path]:
    """All but what DVC notes for itself."""
    return {path for path in folder.rglob("*") if ".dvc" not in path.parts}
