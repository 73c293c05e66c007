"""Kill every verb that writes at random writes, start it again, and compare the end with an undisturbed one.

    python -m tests.robustness.killed --kills 30 --seed 1

The verbs are the registration of policies as models, a search (between ask and tell, and elsewhere), `rhmc export`,
`rhmc report`, `rhmc study import` and the pipeline's stage (run, then export), each started as often as it takes. A
process kills itself with SIGKILL at a write that follows from the seed (see `chaos.Fuse`). Prints a Markdown table;
exit code 1 if a table, a report or a winner differs, a run was lost, doubled or left open, or a file was left.
"""

import argparse
import os
import platform
import random
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from pipelines.bundles import bundle
from pipelines.execution import ray_driver, run
from pipelines.export import tables as export
from pipelines.specs.search import Search
from pipelines.tracking import mlflow_tracker, registry
from pipelines.tracking.plan import Commit, study_card
from pipelines.tracking.tracker import StudyCard
from pipelines.tuning import ray_workers, search_run, trials
from pipelines.tuning.ray_workers import Failed, TrialJob, Worker
from reports.pages import build
from tests.pipelines.support import setting, tiny
from tests.robustness import chaos
from tests.robustness.chaos import KILLED, Fuse, Run, faults, fit_here, logged, settle, start

STUDY = tiny("killed", 6, {name: setting(lr=1e-2) for name in ("fast", "twin")})  # one is trained and the other copied
SEARCH = """\
question: Which?
base:
  env: {kind: navigation, agents: 2, episode: 7}
  algo: {kind: iql, learning_starts: 64, batch_size: 32, train_freq: 16, hidden_dim: 16, buffer_size: 400}
  trainer: {num_envs: 8, evaluations: 3, eval_episodes: 4, final_episodes: 8}
arms:
  IQL: {space: {lr: {low: 1e-4, high: 1e-2, log: true}, gamma: {low: 0.5, high: 0.9}}}
trials: {quick: 3, paper: 3}
seeds: 1
steps: 400
sampler: {startup: 2}
resources: {concurrent: 1, checkpoint_every: 1}
"""
UNNAMED = re.compile(r"(?<![0-9a-f])[0-9a-f]{32}(?![0-9a-f])")  # what MLflow made up
OUT = "out"  # what a verb writes for people, in its folder
SHORTEST = 3  # writes that a fuse lets pass at the most, where a verb has hardly more


class World(NamedTuple):
    """The state before any verb: a finished study, and a bundle of it."""

    home: Path
    bundle: Path


class Verb(NamedTuple):
    """One verb of the campaign.

    Attributes:
        name: in the table.
        act: does it in a work folder and returns an exit code.
        logs: whose log is compared; None where it writes none.
        begun: whether it needs the finished study in its folder.
        between: arms the fuse at some writes alone.
    """

    name: str
    act: Callable[[Path, Path], int]  # work folder, bundle
    logs: Callable[[Path], StudyCard] | None = None
    begun: bool = False
    between: Callable[[Fuse], None] = lambda fuse: None


class End(NamedTuple):
    """The state that a verb left."""

    runs: list[Run]
    files: dict[str, bytes]  # below `OUT`
    names: Counter[str]  # of all files


# What the verbs do


def study_run(home: Path, bundle: Path) -> int:
    """`rhmc study run`."""
    return run.run_studies([STUDY], home)


def stage(home: Path, bundle: Path) -> int:
    """The commands of the pipeline's stage `studies`."""
    return study_run(home, bundle) or exported(home, bundle)


def exported(home: Path, bundle: Path) -> int:
    """`rhmc export`."""
    return export.export_study(STUDY, home / OUT, home)


def reported(home: Path, bundle: Path) -> int:
    """`rhmc report`, from tables that were exported before."""
    return int(build.write_report(home.parent / "tables", home / OUT, study=STUDY.name) != "whole")


def imported(home: Path, packed: Path) -> int:
    """`rhmc study import`."""
    bundle.unpack(packed, home)
    return 0


def searched(home: Path, bundle: Path) -> int:
    """`rhmc search run`."""
    return search_run.run_search(the_search(home), home, home / OUT)


def the_search(home: Path) -> Search:
    """Its file lies beside the work folders."""
    return Search.load(home.parent / "search_killed.yaml", "quick", [])


def in_registration(fuse: Fuse) -> None:
    """Arm the fuse while a model is registered."""
    inside, register = [False], registry.register
    fuse.counts = lambda: inside[0]

    def watched(*args: Any) -> None:
        inside[0] = True
        register(*args)
        inside[0] = False

    registry.register = watched


def asked(fuse: Fuse, *, between: bool) -> None:
    """Arm the fuse while a trial is asked for and not told, or while none is."""
    arm_studies: list[trials.ArmStudy] = []
    make = trials.ArmStudy.__init__

    def noted(self: trials.ArmStudy, *args: Any) -> None:
        make(self, *args)
        arm_studies.append(self)

    trials.ArmStudy.__init__ = noted  # type: ignore[method-assign]
    fuse.counts = lambda: between == any(one.live for one in arm_studies)


def asked_for(fuse: Fuse) -> None:
    """See `asked`."""
    asked(fuse, between=True)


def told(fuse: Fuse) -> None:
    """See `asked`."""
    asked(fuse, between=False)


def _card(home: Path) -> StudyCard:
    return study_card(STUDY)


def _search_card(home: Path) -> StudyCard:
    return search_run.search_card(the_search(home))


VERBS = (
    Verb("registration of models", study_run, _card, between=in_registration),
    Verb("search, between ask and tell", searched, _search_card, between=asked_for),
    Verb("search, elsewhere", searched, _search_card, between=told),
    Verb("export", exported, None, begun=True),
    Verb("report", reported),
    Verb("study import", imported, _card),
    Verb("the pipeline's stage", stage, _card),
)


# Processes


class PoolHere:
    """The work of `Pool`, one trial at a time in this process."""

    def __init__(self, size: int, cpus: int) -> None:
        self.worker, self.key = Worker(), ""
        self.results: dict[str, dict[str, Any] | Failed] = {}

    @property
    def free(self) -> int:
        """See `Pool`."""
        return int(not self.key)

    def begin(self, job: TrialJob) -> None:
        """See `Pool`."""
        self.key = job["key"]
        self.results = {self.key: self.worker.begin(job)}

    def next(self, timeout: float) -> dict[str, dict[str, Any] | Failed]:
        """See `Pool`."""
        return self.results

    def go_on(self, key: str) -> None:
        """See `Pool`."""
        self.results = {key: self.worker.step()}

    def end(self, key: str) -> None:
        """See `Pool`."""
        self.worker.end()
        self.key = ""


def _act(number: int, home: str, packed: str, length: int, count: str) -> None:
    settle(Path(f"{home}.log"))
    os.chdir(Path(home).parent)
    tempfile.tempdir = f"{home}/tmp"
    Path(tempfile.tempdir).mkdir(exist_ok=True)
    for module in (run, search_run):
        module.read_commit = lambda: Commit("c0ffee")  # type: ignore[attr-defined]  # the code may be worked on meanwhile
    ray_driver.ray_session = lambda *args: nullcontext([])  # type: ignore[assignment,return-value]
    ray_driver.fit = fit_here  # type: ignore[assignment]
    ray_workers.Pool = PoolHere  # type: ignore[assignment,misc]
    fuse = Fuse(length)
    VERBS[number].between(fuse)
    fuse.lay(home)
    status = VERBS[number].act(Path(home), Path(packed))
    Path(count).write_text(str(fuse.count), encoding="utf-8")
    sys.exit(status)


def act(verb: Verb, home: Path, world: World, length: int = chaos.FOREVER) -> int:
    """Do it in a process of its own, which is killed at the `length`-th write, and return the exit code."""
    process = start(_act, VERBS.index(verb), str(home), str(world.bundle), length, f"{home}.writes")
    process.join()
    assert process.exitcode is not None
    return process.exitcode


# The campaign


def make_world(folder: Path, template: Path | None = None) -> World:
    """Train the study once and pack it; undisturbed."""
    (folder / "search_killed.yaml").write_text(SEARCH, encoding="utf-8")
    empty = folder / "empty"
    empty.mkdir()
    if template:
        shutil.copy(template, empty / "mlflow.db")
    else:
        mlflow_tracker.create_database(empty / "mlflow.db")
    world = World(folder / "world", folder / "bundle.zip")
    shutil.copytree(empty, world.home)
    pipeline = VERBS[-1]
    assert act(pipeline, world.home, world) == 0, log(world.home)
    shutil.copytree(world.home / OUT, folder / "tables")
    bundle.pack(STUDY, world.bundle, world.home)
    return world


def fresh(folder: Path, verb: Verb, world: World) -> Path:
    """A work folder as the verb finds it."""
    shutil.copytree(world.home if verb.begun else world.home.parent / "empty", folder)
    shutil.rmtree(folder / OUT, ignore_errors=True)
    return folder


def log(home: Path) -> str:
    """The output of the processes."""
    return Path(f"{home}.log").read_text(encoding="utf-8")


def end_of(verb: Verb, home: Path) -> End:
    """The files that a verb left in a folder."""
    runs = logged(verb.logs(home), home) if verb.logs else []
    files = {str(path.relative_to(home)): path for path in sorted(home.rglob("*")) if path.is_file()}
    written = {name: path.read_bytes() for name, path in files.items() if name.startswith(f"{OUT}/")}
    if verb.act is stage or verb.act is exported:
        written = {name: content for name, content in written.items() if not name.endswith(".made.parquet")}  # seconds
    return End(runs, written, Counter(UNNAMED.sub("*", name) for name in files))


def wrong(found: End, wanted: End) -> Counter[str]:
    """Counts of each fault."""
    counts = faults(found.runs, wanted.runs)
    names = found.files.keys() | wanted.files.keys()
    left = found.names - wanted.names
    return Counter(
        {
            "tables that differ": sum(found.files.get(name) != wanted.files.get(name) for name in names),
            "lost": counts.pop("runs lost"),
            "doubled": counts.pop("runs doubled") + counts.pop("values doubled"),
            "open": counts.pop("runs left open"),
            "other differences": sum(counts.values()),
            "files left": left.total(),
            "files missing": (wanted.names - found.names).total(),
        }
    )


WRONG = tuple(wrong(End([], {}, Counter()), End([], {}, Counter())))


class Disturbed(NamedTuple):
    """The outcome of a verb."""

    kills: int
    starts: int
    wrong: Counter[str]
    left: Counter[str]  # names of files


def disturb(verb: Verb, folder: Path, world: World, kills: int, rng: random.Random) -> Disturbed:
    """Kill a verb so often, over as many work folders as that takes."""
    whole = fresh(folder / "whole", verb, world)
    shutil.copy(folder.parent / "search_killed.yaml", folder)
    shutil.copytree(folder.parent / "tables", folder / "tables")
    assert act(verb, whole, world) == 0, log(whole)
    wanted, writes = end_of(verb, whole), int(Path(f"{whole}.writes").read_text(encoding="utf-8"))
    assert writes, f"{verb.name}: nothing was written"
    done, starts, number, sums, left = 0, 0, 0, Counter[str](), Counter[str]()
    while done < kills:
        number += 1
        home = fresh(folder / str(number), verb, world)
        status = KILLED
        while status != 0:
            length = rng.randrange(1, max(writes // 2, SHORTEST) + 1) if done < kills else chaos.FOREVER
            status = act(verb, home, world, length)
            starts += 1
            assert status in (0, KILLED), log(home)
            done += status == KILLED
        found = end_of(verb, home)
        sums += wrong(found, wanted)
        left += found.names - wanted.names
    return Disturbed(done, starts, sums, left)


def campaign(folder: Path, kills: int, seed: int, only: str = "") -> dict[str, Disturbed]:
    """Share the kills among the verbs."""
    rng, world = random.Random(seed), make_world(folder)
    chosen = [verb for verb in VERBS if only in verb.name]
    shares = [kills // len(chosen) + (i < kills % len(chosen)) for i in range(len(chosen))]
    found = {}
    for verb, share in zip(chosen, shares, strict=True):
        place = folder / f"verb{VERBS.index(verb)}"
        place.mkdir()
        began = time.monotonic()
        found[verb.name] = disturb(verb, place, world, share, rng)
        took = time.monotonic() - began
        print(f"{verb.name}: {share} kills, {took:.0f} s, {dict(found[verb.name].left)}", file=sys.stderr, flush=True)
    return found


def table(found: dict[str, Disturbed]) -> str:
    """The Markdown table."""
    head = ["verb", "kills", "starts", *WRONG]
    rows = [[name, one.kills, one.starts, *(one.wrong[kind] for kind in WRONG)] for name, one in found.items()]
    total = [sum(row[i] for row in rows) for i in range(1, len(head))]  # type: ignore[misc]
    lines = [head, ["---", *(["---:"] * (len(head) - 1))], *rows, ["all", *total]]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="part of a verb's name")
    parser.add_argument("--folder", type=Path, help="keep everything there")
    chosen = parser.parse_args()
    began = time.monotonic()
    with TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        folder = chosen.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        found = campaign(folder.resolve(), chosen.kills, chosen.seed, chosen.only)
    print(f"Seed {chosen.seed}, {time.monotonic() - began:,.0f} s, {os.cpu_count()} cores, {platform.platform()}.\n")
    print(table(found))
    return int(any(one.wrong.total() for one in found.values()))


if __name__ == "__main__":
    from tests.robustness import killed  # its functions have to be those that the forked processes import

    sys.exit(killed.main())
