"""More than a hundred malformed inputs through the command line: what is wrong is one line, exit code 2, nothing left.

    python -m tests.robustness.malformed --seed 1
    python -m tests.robustness.malformed --list
    python -m tests.robustness.malformed --only tables

Each input has an empty folder of its own as the current one, and a work folder in it. Most run one after the other in a
process that is replaced if one of them hangs; a sample runs as `rhmc` itself. Prints a Markdown table: how many of
each kind ended in a traceback, a hang, another exit code, files written or changed, or a message that does not say
what it has to or shows control characters. Exit code 1 if any did.
"""

import argparse
import io
import json
import multiprocessing
import os
import random
import resource
import shutil
import socket
import string
import subprocess
import sys
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, redirect_stderr, redirect_stdout
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, NamedTuple

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from pipelines.bundles import bundle
from pipelines.cli import main as cli
from pipelines.export import tables as export
from pipelines.tracking.mlflow_tracker import MlflowTracker, create_database
from pipelines.tracking.plan import items, study_card
from pipelines.tracking.policy import Saved, save
from pipelines.workspace.work_folder import Home
from tests.pipelines.support import setting, tiny

FORKS = multiprocessing.get_context("forkserver")
LIMIT = 60.0  # seconds for an input, on a busy machine
ROOM = 12 * 2**30  # bytes of memory for an input, most of it address space that libraries reserve
SAMPLE = 6  # inputs that run as a process of their own
BAD = 2
HOME = "w"  # the work folder, in the folder of an input
RANDOM = 6  # inputs of a kind that are made by chance
STUDY = tiny("base", 3, {"slow": setting(lr=1e-4), "fast": setting(lr=1e-2)})
GOOD = {
    "question": "One",
    "base": {
        "env": {"kind": "coverage", "agents": 2, "targets": 3},
        "algo": {"kind": "iql", "encoder": "mlp"},
        "trainer": {"num_envs": 16, "evaluations": 1, "eval_episodes": 4, "final_episodes": 4},
    },
    "arms": {"IQL": {}},
    "seeds": 1,
    "steps": 160,
}
SEARCH = GOOD | {
    "arms": {"IQL": {"space": {"lr": {"low": 1e-4, "high": 1e-2}}}},
    "trials": {"quick": 2, "paper": 2},
    "seeds": {"quick": 1, "paper": 1},
    "steps": {"quick": 160, "paper": 160},
}
WRONG = ("tracebacks", "hangs", "other exit codes", "files left", "places not named", "control characters")


class Case(NamedTuple):
    """A malformed input.

    Attributes:
        kind: row of the table.
        name: what is wrong with it.
        words: of the command line, in the folder of the input.
        says: what the message has to name, in any case of letters; of a tuple any of its words.
        make: puts files there.
        env: set for it.
        codes: that are right for it.
        may: beginnings of paths that may be written all the same.
    """

    kind: str
    name: str
    words: tuple[str, ...]
    says: tuple[str | tuple[str, ...], ...] = ()
    make: Callable[[Path, Path], None] = lambda folder, base: None
    env: Mapping[str, str] = MappingProxyType({})
    codes: tuple[int, ...] = (BAD,)
    may: tuple[str, ...] = ()


class Outcome(NamedTuple):
    """The outcome of a command."""

    code: int | None  # None: it hung
    said: str
    trace: str = ""


# Files that an input needs


def text(name: str, content: str | bytes) -> Callable[[Path, Path], None]:
    """A file."""

    def make(folder: Path, base: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)

    return make


def tree(name: str, content: Any) -> Callable[[Path, Path], None]:
    """A file of YAML, as JSON."""
    return text(name, json.dumps(content, ensure_ascii=False))


def special(name: str, kind: str) -> Callable[[Path, Path], None]:
    """Something that is no file."""

    def make(folder: Path, base: Path) -> None:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        elif kind == "loop":
            path.symlink_to(path.name)
        elif kind == "socket":
            here = os.getcwd()
            os.chdir(path.parent)  # a socket's path may have 107 characters
            with closing(socket.socket(socket.AF_UNIX)) as made:
                made.bind(path.name)
            os.chdir(here)
        else:  # a device: never by its own name, which a fault might put an end to for the whole machine
            path.symlink_to(kind)

    return make


def both(*makers: Callable[[Path, Path], None]) -> Callable[[Path, Path], None]:
    """All of them."""

    def make(folder: Path, base: Path) -> None:
        for one in makers:
            one(folder, base)

    return make


def at(content: Any, path: str, value: Any) -> Any:
    """A copy of a tree with another value at a dotted path; `...` takes it away."""
    first, _, rest = path.partition(".")
    copy = dict(content)
    if rest:
        copy[first] = at(copy.get(first, {}), rest, value)
    elif value is ...:
        copy.pop(first)
    else:
        copy[first] = value
    return copy


# Studies and searches


def studies() -> Iterator[Case]:
    """Files that `study check` has to refuse, with the place."""

    def of(name: str, make: Callable[[Path, Path], None], *says: str | tuple[str, ...]) -> Case:
        return Case("study files", name, ("study", "check", "s.yaml"), ("s.yaml", *says), make)

    yield of("empty", text("s.yaml", ""), "empty")
    yield of("not UTF-8", text("s.yaml", b"question: gr\xfc\xdf\n"), "UTF-8")
    yield of("zero bytes", text("s.yaml", b"\0" * 99))
    yield of("2 MB", text("s.yaml", "a: 1\n" * 400_000), "larger")
    yield of("a list", text("s.yaml", "- 1\n"))
    yield of("a bracket left open", text("s.yaml", "question: [\n"), "not YAML")
    yield of("a tab", text("s.yaml", "question:\n\t- 1\n"), "TAB")
    bomb = "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [{f'*a{i - 1},' * 9}]\n" for i in range(1, 9))
    yield of("an alias bomb", text("s.yaml", bomb), "alias")
    yield of("nested 5,000 times", text("s.yaml", "question: " + "[" * 5000), "deep")
    yield of("a tag", text("s.yaml", "question: !!python/object/apply:os.system [touch x]\n"), "tag")
    yield of("a key twice", text("s.yaml", json.dumps(GOOD)[:-1] + ', "seeds": 2}'), "duplicate")
    for key, value, *says in [
        ("seeds", "three", "seeds"),
        ("seeds", 0, "seeds"),
        ("seeds", -1, "seeds"),
        ("seeds", 2**63, "seeds"),
        ("seeds", True, "seeds"),
        ("steps", 1e300, "steps"),
        ("steps", None, "steps"),
        ("base.env.agents", 0, "agents"),
        ("base.env.agents", 2**70, "agents"),
        ("base.env.kind", "covrage", "coverage"),
        ("base.algo.kind", "iqll", "iql"),
        ("base.algo.lr", "fast", "lr"),
        ("base.algo.gamma", 1.5, "gamma"),
        ("base.trainer.num_envs", 10**9, "num_envs"),
        ("base.trainer.device", "gpu", "device", "cpu"),
        ("base.trainer.eval_seed", 2**64, "eval_seed"),
        ("base.algo.hidden_dim", 10**9, "hidden"),
        ("base.algo.extra", 1, "extra"),
        ("arms", {}, "arms"),
        ("arms", {"a\u001b[31mb": {}}, "arms"),
        ("arms", {"a\u0007": {"algo": {"lr": "x"}}}, ("lr", "cannot be seen")),
        ("arms", {"a" * 5000: {}}),
        ("arms", {"x": {"algo": {"include": "../../none.yaml"}}}, "include"),
        ("resources", {"concurrent": 10**9}, "concurrent"),
        ("grid", {"algo.lr": [1e-3] * 2}, "twice"),
        ("grid", {"seed": list(range(2000))}, "grid"),
    ]:
        yield of(f"{key}: {str(value)[:30]!r}", tree("s.yaml", at(GOOD, key, value)), *says)
    for key in ("question", "base", "arms", "steps"):
        yield of(f"no {key}", tree("s.yaml", at(GOOD, key, ...)), key)
    yield of("NaN", text("s.yaml", json.dumps(at(GOOD, "base.algo.lr", float("nan"))).replace("NaN", ".nan")), "finite")
    late = at(at(GOOD, "steps", 3_000), "base.algo.learning_starts", 20_000)
    words = ("study", "check", "s.yaml")  # said, not refused: a study may be a trial of everything but learning
    yield Case(
        "study files",
        "a budget below the warm-up",
        words,
        (("s.yaml", "IQL", "20,064")),
        tree("s.yaml", late),
        {},
        (0,),
    )
    rhmc = at(at(GOOD, "base.env.targets", 13), "base.algo", {"kind": "rhmc", "encoder": "pairwise"})
    rhmc = at(at(rhmc, "base.algo.regulator", "exact"), "base.env.observation", "extended")
    yield of("more targets than the regulator takes", tree("s.yaml", rhmc), ("target", "regulator"))
    for name in ("transfer", "theorem", "yardsticks", "methods"):
        words = ("study", "check", f"{name}.yaml")
        yield Case("names", f"a study named {name}", words, (name, ("reserved", "name")), tree(f"{name}.yaml", GOOD))
    two = both(tree("a/s.yaml", GOOD), tree("b/s.yaml", GOOD))
    yield Case("names", "two of one name", ("study", "run", "a/s.yaml", "b/s.yaml"), ("s:",), two)
    yield Case("names", "a file with a space", ("study", "check", "a b.yaml"), ("a b.yaml",), tree("a b.yaml", GOOD))
    strange = "a\u001b[31m\n.yaml"
    yield Case("names", "a file with control characters", ("study", "check", strange), ("yaml",), tree(strange, GOOD))


def searches() -> Iterator[Case]:
    """Files that `search check` has to refuse."""

    def of(name: str, content: Any, *says: str | tuple[str, ...]) -> Case:
        words = ("search", "check", "s.yaml")
        return Case("search files", name, words, ("s.yaml", *says), tree("s.yaml", content))

    space = "arms.IQL.space"
    yield of("a study", GOOD, "space")
    yield of("no trials", at(SEARCH, "trials", ...), "trials")
    for value in ({}, {"none": {"low": 0, "high": 1}}, {"lr": {"low": 1}}, {"lr": {"low": 1e-2, "high": 1e-4}}):
        yield of(f"space {value}", at(SEARCH, space, value), "space")
    yield of("log from 0", at(SEARCH, f"{space}.lr", {"low": 0, "high": 1, "log": True}), "low")
    yield of("choices of lists", at(SEARCH, f"{space}.lr", {"choices": [[1], [2]]}), "choices")
    yield of("trials 2^70", at(SEARCH, "trials", {"quick": 2**70, "paper": 1}), "trials")
    yield of("sampler", at(SEARCH, "sampler", {"kind": "grid"}), "sampler")
    yield of("a sampler's seed 2^64", at(SEARCH, "sampler", {"seed": 2**64}), "seed")


def includes() -> Iterator[Case]:
    """The files that a study includes."""
    study = at(GOOD, "arms.IQL", {"algo": {"include": "inc.yaml"}})

    def of(name: str, make: Callable[[Path, Path], None], *says: str | tuple[str, ...]) -> Case:
        making = both(tree("s.yaml", study), make)
        return Case("included files", name, ("study", "check", "s.yaml"), ("inc.yaml", *says), making)

    yield of("none", both(), "no such file")
    yield of("empty", text("inc.yaml", ""), "empty")
    yield of("a binary file", text("inc.yaml", bytes(range(256))))
    yield of("no algo", tree("inc.yaml", {"env": {}}), "algo")
    yield of("another include", tree("inc.yaml", {"algo": {"include": "inc.yaml"}}), "include")
    yield of("algo is a list", tree("inc.yaml", {"algo": [1]}), "algo")
    for kind in ("pipe", "folder", "loop", "socket", "/dev/zero"):
        yield of(kind, special("inc.yaml", kind))


# Options, paths, the environment


def options() -> Iterator[Case]:
    """Values of options."""
    study = tree("s.yaml", GOOD)
    for name, words, *says in [
        ("a profile that is a path", "study check s.yaml --profile ../x", "profile", "quick"),
        ("a profile with a semicolon", "study check s.yaml --profile ;", "profile", "quick"),
        ("a profile of the report", "report --profile ../x", "profile"),
        ("a profile of yardsticks", "yardsticks coverage --profile ../x", "profile"),
        ("a variant", "study check s.yaml --variant x", "variant"),
        ("--set without =", "study check s.yaml --set seeds", "--set"),
        ("--set of an unknown key", "study check s.yaml --set sedes=1", "sedes"),
        ("--set with a bracket", "study check s.yaml --set seeds=[", "--set"),
        ("--set device", "study check s.yaml --set trainer.device=gpu", "device", "cpu"),
        ("--set seeds 2^63", "study check s.yaml --set seeds=9223372036854775808", "seeds"),
        ("--set steps 1e30", "study check s.yaml --set steps=1e30", "steps"),
        ("--set a control character", "study check s.yaml --set seeds=\x1b[31m", "seeds"),
        ("--agents 0", "yardsticks coverage --agents 0", "agents"),
        ("--agents 10^12", "yardsticks coverage --agents 1000000000000", "agents"),
        ("--policies", "yardsticks coverage --policies none", "policies"),
        ("an arm", "evaluate s.yaml --arm none", "--arm", "IQL"),
        ("a seed of 2^64", "evaluate s.yaml --seed 18446744073709551616", "seed"),
        ("episodes 10^18", "evaluate s.yaml --episodes 1000000000000000000", "episodes"),
        ("an eval seed of 2^64", "evaluate s.yaml --eval-seed 18446744073709551616", "eval-seed"),
        ("transfer to x", "transfer s.yaml --agents x --out o", "--agents"),
        ("transfer to 10^30", f"transfer s.yaml --agents {10**30} --out o", "--agents"),
        ("a port", "ui --port 70000", "port"),
        ("alpha", "theorem --alpha 2", "alpha"),
        ("theorem's seed 2^64", f"theorem --seed {2**64}", "seed"),
        ("yardsticks' seed 2^64", f"yardsticks coverage --seed {2**64} --episodes 2", "seed"),
        ("render to a PNG", "render s.yaml --out x.png", "--out"),
        ("render an episode of 2^64", f"render s.yaml --out x.gif --episode {2**64}", "episode"),
        ("a variant of no study", "report --variant x", "--variant"),
        ("an option that is none", "study check s.yaml --fast", "fast"),
        ("a verb that is none", "study chek s.yaml", "chek"),
    ]:
        yield Case("option values", name, tuple(words.split(" ")), tuple(says), study)
    out = both(study, text("o", "a file"))
    for words in ("methods --out o", "drawings --out o", "theorem --out o", "yardsticks all --out o"):
        yield Case("option values", f"{words.split()[0]} --out FILE", tuple(words.split(" ")), ("--out", "o"), out)


def paths() -> Iterator[Case]:
    """Paths that verbs are given to read or write, and that are no files."""
    verbs = (
        "study check {}", "study status {}", "search check {}", "evaluate {}", "study import {}", "report --study {}",
        "render {} --out x.gif", "study export {} x.zip", "evaluate p.pt --config {}", "fingerprint {}",
    )  # fmt: skip
    names = {"study import": "x.zip", "render": "x.pt", "evaluate p.pt": "x.yaml", "fingerprint": "x"}
    policy = text("p.pt", b"PK")
    for i, verb in enumerate(verbs):
        name = next((name for start, name in names.items() if verb.startswith(start)), "x.yaml")
        for kind in ("pipe", "/dev/zero" if name != "x" else "folder", ("socket", "loop")[i % 2]):
            words = tuple(verb.replace("{}", name).split(" "))
            make = both(policy, special(name, kind))
            yield Case("paths that are no files", f"{verb.replace(' {}', '')}: {kind}", words, (name,), make)
    long = "x" * 300
    for verb in (*verbs[:8], "study list --folder {}", "report --runs {}", "methods --out {}"):
        words = tuple(verb.replace("{}", long).split(" "))
        yield Case("long names", f"{verb.replace(' {}', '')}, 300 letters", words, ("xxx", ("long", "no ", "not ")))


def environments() -> Iterator[Case]:
    """Variables of the environment."""
    study, search = tree("s.yaml", GOOD), tree("s.yaml", SEARCH)
    home = ("locks", "mlflow.db", "optuna.db")
    for name, value, make in [
        ("a file", "f", text("f", "x")),
        ("below a file", "f/x", text("f", "x")),
        ("a device", "f", special("f", "/dev/null")),
        ("a pipe", "f", special("f", "pipe")),
        ("too long", "x" * 300, both()),
        ("a loop of links", "f", special("f", "loop")),
    ]:
        words = ("study", "run", "s.yaml")
        yield Case("environment", f"RHMC_HOME: {name}", words, (value[:9],), both(study, make), {"RHMC_HOME": value})
    for name, variable, value, verb, making, *says in [
        ("no address", "MLFLOW_TRACKING_URI", "foo", "study status", study, "foo"),
        ("half an address", "MLFLOW_TRACKING_URI", "http://[", "study status", study, ("tracking", "http")),
        ("an empty folder", "MLFLOW_TRACKING_URI", "sqlite:///none/x.db", "study status", study, "missing"),
        (
            "a device",
            "MLFLOW_TRACKING_URI",
            "sqlite:///f",
            "study status",
            both(study, special("f", "/dev/zero")),
            "f:",
        ),
        ("a pipe", "MLFLOW_TRACKING_URI", "sqlite:///f", "study run", both(study, special("f", "pipe")), "f:"),
        ("nobody there", "MLFLOW_TRACKING_URI", "http://u:hide@127.0.0.1:1", "study status", study, "127.0.0.1:1"),
        ("a scheme", "MLFLOW_TRACKING_URI", "ftp://x/y", "study status", study, "ftp"),
        ("a database", "MLFLOW_TRACKING_URI", "postgresql://u:hide@127.0.0.1:1/x", "study status", study, "127.0.0.1"),
        ("a port", "MLFLOW_TRACKING_URI", "http://127.0.0.1:99999999", "study status", study, "99999999"),
        ("no address", "OPTUNA_STORAGE", "foo", "search status", search, "OPTUNA_STORAGE"),
        ("an empty folder", "OPTUNA_STORAGE", "sqlite:///none/x.db", "search run", search, "none"),
        ("a scheme", "OPTUNA_STORAGE", "redis://x", "search status", search, "redis"),
        ("a text file", "OPTUNA_STORAGE", "sqlite:///f", "search status", both(search, text("f", "x" * 999)), "f"),
        ("a database", "OPTUNA_STORAGE", "postgresql://u:hide@127.0.0.1:1/x", "search status", search, "127.0.0.1"),
    ]:
        words = (*verb.split(" "), "s.yaml")
        codes = (3, BAD) if name == "an empty folder" else (BAD,)  # to `status`, nothing is there yet
        env = {variable: value}
        yield Case("environment", f"{variable}: {name}", words, tuple(says), making, env, codes, home)
    for name, value in [("a web address", "http://x"), ("nobody there", "127.0.0.1:1"), ("a port", "127.0.0.1:x")]:
        says = ("RAY_ADDRESS", value)
        yield Case("environment", f"RAY_ADDRESS: {name}", ("doctor",), says, both(), {"RAY_ADDRESS": value}, (1,), home)


# Bundles and tables


def bundles(rng: random.Random) -> Iterator[Case]:
    """Bundles that `study import` has to refuse. Nothing of one may be taken in."""

    def of(
        name: str, change: Callable[[Path], None], *says: str | tuple[str, ...], codes: tuple[int, ...] = ()
    ) -> Case:
        def make(folder: Path, base: Path) -> None:
            shutil.copytree(base / "bundle", folder / "b")
            change(folder / "b")
            with zipfile.ZipFile(folder / "b.zip", "w", zipfile.ZIP_DEFLATED) as archive:
                for file in sorted((folder / "b").rglob("*")):
                    if file.is_file():
                        archive.write(file, file.relative_to(folder / "b").as_posix())
            shutil.rmtree(folder / "b")
            if (folder / "archive").exists():
                (folder / "archive").replace(folder / "b.zip")

        may = ("locks", "mlflow.db") if codes else ()
        return Case(
            "bundles", name, ("study", "import", "b.zip"), ("b.zip", *says), make, codes=codes or (BAD,), may=may
        )

    def manifest(key: str, value: Any) -> Callable[[Path], None]:
        def change(folder: Path) -> None:
            told = json.loads((folder / bundle.MANIFEST).read_text(encoding="utf-8"))
            (folder / bundle.MANIFEST).write_text(json.dumps(at(told, key, value)), encoding="utf-8")

        return change

    def column(table: str, name: str, value: Any) -> Callable[[Path], None]:
        def change(folder: Path) -> None:
            read = pq.read_table(folder / table)
            values = [value, *read[name].to_pylist()[1:]]
            place = read.schema.get_field_index(name)
            made = pa.array(values, read.schema.field(name).type)
            pq.write_table(read.set_column(place, read.schema.field(name), made), folder / table)

        return change

    def archive(content: Callable[[Path], bytes]) -> Callable[[Path], None]:
        return lambda folder: (folder.parent / "archive").write_bytes(content(folder)) and None

    def members(*more: tuple[str, bytes]) -> Callable[[Path], None]:
        def change(folder: Path) -> None:
            with zipfile.ZipFile(folder.parent / "archive", "w", zipfile.ZIP_DEFLATED) as packed:
                for file in sorted(file for file in folder.rglob("*") if file.is_file()):
                    packed.write(file, file.relative_to(folder).as_posix())
                for name, inside in more:
                    packed.writestr(name, inside)

        return change

    def flipped(seed: int) -> Callable[[Path], None]:
        def change(folder: Path) -> None:
            chance = random.Random(seed)
            file = chance.choice(sorted(file for file in folder.rglob("*") if file.is_file()))
            content = bytearray(file.read_bytes())
            for _ in range(4):
                content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
            file.write_bytes(bytes(content))

        return change

    yield of("a text", archive(lambda folder: b"hello"))
    yield of("empty", archive(lambda folder: b""))
    yield of("an empty archive", archive(lambda folder: b"PK\5\6" + bytes(18)), "bundle.json")
    yield of("10 GB of zeros", members(("zeros", bytes(2**28)), ("more", bytes(2**28))), "zeros")
    yield of("20,000 files", members(*((f"f{i}", b"") for i in range(20_000))), ("files", "f0"))
    yield of("a file outside", members(("../../outside", b"x")), ("outside", ".."))
    yield of("an absolute file", members(("/outside", b"x")), "outside")
    for name in ("bundle.json", "runs.parquet", "points.parquet"):
        yield of(f"no {name}", lambda folder, name=name: (folder / name).unlink(), name)  # type: ignore[misc]
    yield of("no policy", lambda folder: shutil.rmtree(folder / "policies"))
    yield of(
        "a policy that is another", lambda folder: [f.write_bytes(b"x") for f in folder.glob("policies/*")] and None
    )
    yield of("a table that is none", text_in("runs.parquet", b"PAR1"))
    yield of("a manifest that is none", text_in("bundle.json", b"{"))
    for key, value in [
        ("format", 99), ("format", None), ("study", "../x"), ("study", ""), ("study", "a\u001b[31m"),
        ("study", "x" * 300), ("profile", "../x"), ("profile", "a b;"), ("fingerprint", "../../x"), ("fingerprint", ""),
        ("arms", None), ("arms", []), ("note", None), ("params", {"a": None}), ("extra", 1),
    ]:  # fmt: skip
        yield of(f"{key}: {str(value)[:20]!r}", manifest(key, value))
    for name, value in [
        ("key", "../../x"), ("key", None), ("arm", ""), ("arm", "a\u001b[31m"), ("arm", None), ("seed", -1),
        ("params", "["), ("params", None), ("config", "{}"), ("config", None), ("policy", "../x"), ("finished", None),
    ]:  # fmt: skip
        yield of(f"runs: {name}: {value!r}", column("runs.parquet", name, value))
    for name, value in [
        ("value", float("nan")), ("value", float("inf")), ("value", None), ("step", None), ("step", -1), ("run", 99),
        ("run", None), ("metric", None), ("metric", "a\u001b[31m"), ("metric", ""),
    ]:  # fmt: skip
        yield of(f"points: {name}: {value!r}", column("points.parquet", name, value))
    for _ in range(RANDOM):
        seed = rng.randrange(2**31)
        yield of(f"four bits of a file, seed {seed}", flipped(seed))


def text_in(name: str, content: bytes) -> Callable[[Path], None]:
    """Overwrite a file."""
    return lambda folder: (folder / name).write_bytes(content) and None


def tables(rng: random.Random) -> Iterator[Case]:
    """Input that `rhmc report` has to refuse: tables of another type or schema, and files beside them."""

    def of(
        name: str, change: Callable[[Path], None], *says: str | tuple[str, ...], codes: tuple[int, ...] = ()
    ) -> Case:
        def make(folder: Path, base: Path) -> None:
            shutil.copytree(base / "tables", folder / "t")
            change(folder / "t")

        words = ("report", "--runs", "t", "--out", "o")
        may = ("o/",) if codes else ()
        return Case("report tables", name, words, says, make, codes=codes or (BAD,), may=may)

    def column(file: str, name: str, change: Callable[[pd.Series], Any] | None) -> Callable[[Path], None]:
        def make(folder: Path) -> None:
            table = pd.read_parquet(folder / file)
            table = table.drop(columns=name) if change is None else table.assign(**{name: change(table[name])})
            table.to_parquet(folder / file)

        return make

    points, runs = "base.parquet", "base.runs.parquet"
    yield of("none", lambda folder: [f.unlink() for f in folder.iterdir()] and None, "t")
    yield of("a text", text_in(points, b"hello"), points)
    yield of("empty", text_in(points, b""), points)
    yield of("no runs", lambda folder: (folder / runs).unlink(), runs)
    yield of("no points", lambda folder: (folder / points).unlink(), points)
    for name in ("value", "step", "metric", "arm", "seed"):
        yield of(f"no {name}", column(points, name, None), points, name)
        yield of(f"{name} a list", column(points, name, lambda old: [[1]] * len(old)), points, name)
    for name in ("status", "config", "profile"):
        yield of(f"runs without {name}", column(runs, name, None), runs, name)
        yield of(f"runs: {name} is empty", column(runs, name, lambda old: [None] * len(old)), name)
    for name, value in [("value", "x"), ("step", 0.5), ("seed", "x"), ("value", float("inf")), ("step", 2.0**70)]:
        said = (name, "is inf")
        yield of(f"{name} is {value!r}", column(points, name, lambda old, value=value: value), said)  # type: ignore[misc]
    for value in ("[]", "null", "{", '{"env": 1}', '{"env": {"kind": 7}, "trainer": []}'):
        yield of(f"config {value}", column(runs, "config", lambda old, value=value: value), "config")  # type: ignore[misc]
    times = column(points, "step", lambda old: pd.Timestamp("2020-01-01"))
    yield of("steps are dates", times, points, "step")
    yield of("a run twice", lambda folder: twice(folder / runs), "twice")
    yield of("a named pipe", lambda folder: special(f"{folder}/x.parquet", "pipe")(folder, folder), "x.parquet")
    yield of("a folder", lambda folder: (folder / "x.parquet").mkdir(), "x.parquet")
    for name in ("methods.json", "modules.json", "scenes.json"):
        for content in (b"[1]", b"{", b"\xff", b'{"a": 1}'):
            yield of(f"{name}: {content!r}", text_in(name, content), name)
        yield of(f"{name}: a named pipe", lambda folder, name=name: os.mkfifo(folder / name), name)  # type: ignore[misc]
    yield of("transfer.parquet of runs", lambda folder: copied(folder / runs, folder / "transfer.parquet"), "transfer")
    for content in ("", "[", "- 1", "table_2: 1", "claims: {a: b}"):
        yield Case(
            "paper.yaml", repr(content), ("report", "--runs", "t", "--out", "o"), ("paper.yaml",), paper(content)
        )


def twice(file: Path) -> None:
    """Repeat the rows of a table."""
    table = pd.read_parquet(file)
    pd.concat([table, table]).to_parquet(file)


def copied(source: Path, target: Path) -> None:
    """Copy a file."""
    shutil.copyfile(source, target)


def paper(content: str) -> Callable[[Path, Path], None]:
    """The paper's statements, which the process that runs the case reads in place of the package's own."""

    def make(folder: Path, base: Path) -> None:
        shutil.copytree(base / "tables", folder / "t")
        (folder / "paper.yaml").write_text(content, encoding="utf-8")

    return make


def by_chance(rng: random.Random) -> Iterator[Case]:
    """Good studies with a few letters changed: whether they are refused depends, how does not."""
    written = json.dumps(GOOD, indent=1)
    for number in range(2 * RANDOM):
        letters = list(written)
        for _ in range(rng.randrange(1, 4)):
            letters[rng.randrange(len(letters))] = rng.choice(string.printable + "\u202e\ufeff\u2028é")
        make = text("s.yaml", "".join(letters))
        yield Case("by chance", f"study {number}", ("study", "check", "s.yaml"), (), make, codes=(0, BAD))


def cases(seed: int) -> list[Case]:
    """All of them."""
    rng = random.Random(seed)
    makers = (studies(), searches(), includes(), options(), paths(), environments(), bundles(rng), tables(rng))
    return [case for maker in (*makers, by_chance(rng)) for case in maker]


# Running one


def make_base(folder: Path, template: Path | None = None) -> Path:
    """A bundle and tables of a study whose values are made up: nothing is trained."""
    home, made = folder / "home", items(STUDY, "abc")
    home.mkdir(parents=True)
    if template:
        shutil.copy(template, home / "mlflow.db")
    else:
        create_database(home / "mlflow.db")
    tracker = MlflowTracker(study_card(STUDY), Home(home))
    for item in made:
        log = tracker.start(item.card)
        steps = range(0, item.spec.trainer.steps + 1, item.spec.trainer.steps // item.spec.trainer.evaluations)
        log.log([{"step": float(s), "eval/return": s / 3, "time/seconds": s / 100} for s in steps])
        log.log([{"step": float(item.spec.trainer.steps), "final/return": 2.5}])
        save(folder / "policy.pt", Saved(item.spec, {"key": item.key}))
        log.artifact(folder / "policy.pt")
        log.finish("finished")
    tracker.close("finished")
    bundle.pack(STUDY, folder / "bundle", home)
    export.write_tables(STUDY, made, tracker, folder / "tables")
    return folder


def look(folder: Path) -> dict[str, bytes]:
    """Every file of a folder, with its content; of what is no file, what it is."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.is_symlink():
            found[str(path.relative_to(folder))] = path.read_bytes()
        elif not path.is_dir() or path.is_symlink():
            found[str(path.relative_to(folder))] = str(path.lstat().st_mode).encode()
    return found


def environment(case: Case, folder: Path) -> dict[str, str]:
    """Of a process that runs a case."""
    mine = ("MLFLOW_TRACKING_URI", "OPTUNA_STORAGE", "RAY_ADDRESS")
    return (
        {k: v for k, v in os.environ.items() if k not in mine} | {"RHMC_HOME": HOME, "COLUMNS": "500"} | dict(case.env)
    )


def run_here(case: Case, folder: Path) -> Outcome:
    """Through the entry point, in this process."""
    from reports.data import paper as stated

    out, err, before = io.StringIO(), io.StringIO(), dict(os.environ)
    argv, defaults, place = sys.argv, stated.read.__defaults__, os.getcwd()
    code: Any = 0
    trace = ""
    try:
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(environment(case, folder))
        if (folder / "paper.yaml").exists():
            stated.read.__defaults__ = (folder / "paper.yaml",)
        sys.argv = ["rhmc", *case.words]
        with redirect_stdout(out), redirect_stderr(err):
            cli.main()
    except SystemExit as error:
        code = error.code or 0
    except BaseException:
        code, trace = 1, traceback.format_exc()
    finally:
        sys.argv, stated.read.__defaults__ = argv, defaults
        os.environ.clear()
        os.environ.update(before)
        os.chdir(place)
    return Outcome(code if isinstance(code, int) else 1, out.getvalue() + err.getvalue(), trace)


def run_apart(case: Case, folder: Path) -> Outcome:
    """As the command `rhmc`."""
    command = [sys.executable, "-m", "pipelines.cli.main", *case.words]
    root = {"PYTHONPATH": str(Path(__file__).parents[2])}
    pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "capture_output": True, "timeout": LIMIT}
    try:
        env = environment(case, folder) | root
        done = subprocess.run(command, cwd=folder, env=env, encoding="utf-8", errors="replace", **pipes)
    except subprocess.TimeoutExpired:
        return Outcome(None, "")
    said = done.stdout + done.stderr
    return Outcome(done.returncode, said, said if "Traceback (most recent call last)" in said else "")


def serve(line: Connection) -> None:
    """Run what comes over the line, case by case."""
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 2)
    resource.setrlimit(resource.RLIMIT_AS, (ROOM, ROOM))
    while True:
        case, folder = cases(line.recv())[line.recv()], line.recv()
        line.send(run_here(case, Path(folder)))


class Runner:
    """A process that runs cases, and another one after a hang. Use as a context."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.process: Any = None

    def __enter__(self) -> "Runner":
        FORKS.set_forkserver_preload(["pipelines.bundles.bundle", "pipelines.tuning.search_run", "reports.pages.build"])
        return self

    def __exit__(self, *exception: object) -> None:
        if self.process:
            self.process.kill()

    def run(self, number: int, folder: Path) -> Outcome:
        """One case, within `LIMIT`."""
        if self.process is None:
            self.line, other = FORKS.Pipe()
            self.process = FORKS.Process(target=serve, args=(other,), daemon=True)
            self.process.start()
            other.close()
        for word in (self.seed, number, str(folder)):
            self.line.send(word)
        outcome = Outcome(None, "")
        try:
            if self.line.poll(LIMIT):
                outcome = self.line.recv()
        except EOFError:
            outcome = Outcome(1, "", "the process died")
        if outcome.code is None or not self.process.is_alive():
            self.process.kill()
            self.process = None
        return outcome


def judge(case: Case, outcome: Outcome, before: dict[str, bytes], after: dict[str, bytes]) -> dict[str, str]:
    """The faults of an outcome, by `WRONG`."""
    found = {}
    if outcome.trace:
        found["tracebacks"] = outcome.trace.strip().splitlines()[-1]
    elif outcome.code is None:
        found["hangs"] = f"not within {LIMIT:.0f} s"
    elif outcome.code not in case.codes:
        found["other exit codes"] = f"{outcome.code}: {last(outcome.said)}"
    changed = [name for name in before.keys() | after.keys() if before.get(name) != after.get(name)]
    inside = tuple(f"{HOME}/{name}" for name in case.may) + case.may
    if left := sorted(name for name in changed if not name.startswith(inside or ("\0",))):
        found["files left"] = ", ".join(left[:5])
    if not found and (outcome.code or case.codes == (0,)):
        said = outcome.said.lower()
        missing = [words for words in case.says if not any(word.lower() in said for word in _any(words))]
        if missing or not said.strip():
            found["places not named"] = f"{missing}: {last(outcome.said)}"
    if odd := sorted({c for c in outcome.said if not c.isprintable() and c != "\n"}):
        found["control characters"] = repr("".join(odd))
    return found


def _any(words: str | tuple[str, ...]) -> tuple[str, ...]:
    return (words,) if isinstance(words, str) else words


def last(said: str) -> str:
    """The last line, cut."""
    lines = [line for line in said.splitlines() if line.strip()]
    return repr(lines[-1][:200]) if lines else "nothing"


@contextmanager
def prepared(case: Case, folder: Path, base: Path) -> Iterator[dict[str, bytes]]:
    """The folder of a case, as it is before; it goes."""
    folder.mkdir()
    (folder / HOME).mkdir()
    case.make(folder, base)
    try:
        yield look(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def campaign(folder: Path, seed: int, only: str, apart: int = SAMPLE) -> tuple[Counter[str], dict[str, Counter[str]]]:
    """Inputs by kind, and what was wrong by kind. Each fault is told on stderr."""
    every, base = cases(seed), make_base(folder / "base")
    chosen = [i for i, case in enumerate(every) if only in case.kind or only in case.name]
    alone = set(random.Random(seed).sample(chosen, min(apart, len(chosen))))
    counts, faults = Counter[str](), dict[str, Counter[str]]()
    with Runner(seed) as runner:
        for i in chosen:
            case, place = every[i], folder / "case"
            with prepared(case, place, base) as before:
                own = i in alone and case.kind != "paper.yaml"
                outcome = run_apart(case, place) if own else runner.run(i, place)
                found = judge(case, outcome, before, look(place))
            counts[case.kind] += 1
            faults.setdefault(case.kind, Counter()).update(found.keys())
            for what, how in found.items():
                print(f"{case.kind}: {case.name}: {what}: {how}", file=sys.stderr, flush=True)
    return counts, faults


def table(counts: Counter[str], faults: dict[str, Counter[str]]) -> str:
    """The Markdown table."""
    lines: list[list[Any]] = [["kind", "inputs", *WRONG], ["---", *(["---:"] * (len(WRONG) + 1))]]
    lines += [[kind, count, *(faults[kind][what] for what in WRONG)] for kind, count in counts.items()]
    lines += [["all", counts.total(), *(sum(one[what] for one in faults.values()) for what in WRONG)]]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="part of a kind or of an input's name")
    parser.add_argument("--apart", type=int, default=SAMPLE, help="inputs that run in a process of their own")
    parser.add_argument("--list", action="store_true", help="name the inputs, run none")
    chosen = parser.parse_args()
    if chosen.list:
        print(
            "\n".join(f"{case.kind}: {case.name}: rhmc {' '.join(case.words)!r}"[:200] for case in cases(chosen.seed))
        )
        return 0
    began = time.monotonic()
    with TemporaryDirectory(prefix="mal-", ignore_cleanup_errors=True) as temporary:
        counts, faults = campaign(Path(temporary).resolve(), chosen.seed, chosen.only, chosen.apart)
    print(f"Seed {chosen.seed}, {time.monotonic() - began:,.0f} s.\n")
    print(table(counts, faults))
    return int(any(one.total() for one in faults.values()))


if __name__ == "__main__":
    from tests.robustness import malformed  # its functions have to be those that the forked process imports

    sys.exit(malformed.main())
