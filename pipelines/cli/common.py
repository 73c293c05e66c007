"""Parts that the verbs share: options, reading a study, printing. Imports nothing heavy."""

import json
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer

from pipelines.specs.safe_names import PROFILES
from pipelines.workspace.errors import InputError, visible, visible_lines

if TYPE_CHECKING:
    from pipelines.specs.document import Node
    from pipelines.specs.initial import Policy
    from pipelines.specs.search import Search
    from pipelines.specs.study import Study

Loaded = TypeVar("Loaded")
Kind = Literal["study", "search"]
WIDTH = 140  # columns of a table that is not shown on a terminal

SET_HELP = (
    "Change the study: KEY=VALUE, KEY a dotted path of its file, VALUE read as YAML (seeds=1, steps=1e5, "
    "base.algo.lr=1e-3, arms.full.env.agents=6, grid.algo.alpha=[0,0.1]). env., algo. and trainer. stand for "
    "base.env., base.algo. and base.trainer., and trainer.steps for steps. Merged as an arm is into the base. It goes "
    "before what a profile changes in the base; an arm keeps what it states itself, or the profile for it. Can be "
    "given several times."
)


def files_in(folder: str, pattern: str, incomplete: str) -> list[str]:
    """Completion of a file, in the folder where they usually are."""
    return [str(p) for p in sorted(Path(folder).glob(pattern)) if str(p).startswith(incomplete)]


def studies(incomplete: str) -> list[str]:
    """Completion of a study."""
    return files_in("studies", "*.yaml", incomplete)


def _profiles(incomplete: str) -> list[str]:
    return [name for name in PROFILES if name.startswith(incomplete)]


def _given(ctx: typer.Context) -> list[Path]:
    """The files on a command line that is being completed. While it is not whole, they may be left unassigned."""
    values = [*(ctx.params.get("files") or ()), ctx.params.get("file"), ctx.params.get("what"), *ctx.args]
    return [Path(str(value)) for value in values if str(value).endswith(".yaml")]


def _names(ctx: typer.Context, group: str, incomplete: str) -> list[str]:
    """The keys of a mapping in these files."""
    from pipelines.specs.document import read

    roots = [root for file in _given(ctx) if (root := read(file)[0])]
    names = dict.fromkeys(name for root in roots if group in root.children for name in root.children[group].children)
    return [name for name in names if name.startswith(incomplete)]


def _variants(ctx: typer.Context, incomplete: str) -> list[str]:
    return _names(ctx, "variants", incomplete)


def _arms(ctx: typer.Context, incomplete: str) -> list[str]:
    """Completion of an arm; those of a grid or of readings have names that only the whole study tells."""
    if not (_names(ctx, "grid", "") or _names(ctx, "readings", "")):
        return _names(ctx, "arms", incomplete)
    profile, variant = ctx.params.get("profile") or "quick", ctx.params.get("variant")
    with suppress(InputError):
        studies = load_studies(_given(ctx), profile, ctx.params.get("overrides"), variant)
        return [arm for study in studies for arm in study.arms if arm.startswith(incomplete)]
    return []


File = Annotated[
    Path, typer.Argument(metavar="FILE", help="A study, such as studies/ablation.yaml.", autocompletion=studies)
]
Files = Annotated[list[Path], typer.Argument(metavar="FILE...", help="Studies.", autocompletion=studies)]
Profile = Annotated[str, typer.Option(help="The budget: quick or paper.", autocompletion=_profiles)]
Variant = Annotated[
    str | None,
    typer.Option(help="One of the file's variants, which changes every arm.", autocompletion=_variants),
]
Arms = Annotated[
    list[str] | None,
    typer.Option("--arm", metavar="NAME", help="Only this arm. Can be given several times.", autocompletion=_arms),
]
Sets = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help=SET_HELP)]
Folder = Annotated[Path | None, typer.Option(help="Where the files are; studies if not given.")]
Json = Annotated[bool, typer.Option("--json", help="JSON on stdout instead of a table.")]


def studies_folder(folder: Path | None) -> Path:
    """The folder of studies: the given one, else `studies` here, else that of the project around."""
    from pipelines.workspace.root import project

    if folder is not None or Path("studies").is_dir():
        return folder or Path("studies")
    return Path(os.path.relpath(project() / "studies"))


def files_of_kind(folder: Path, kind: Kind, *, optional: bool = False) -> list[tuple[Path, "Node | None", list[Any]]]:
    """The studies or the searches in a folder, with what was read and its faults. A file that is neither is a study.

    Raises:
        InputError: there is no such file, and it is not `optional`.
    """
    from pipelines.specs.document import read

    with suppress(FileNotFoundError):
        folder.stat()  # a name that cannot be looked at: from Python 3.13 on `glob` passes over it
    files = sorted(folder.glob("*.yaml"))
    found = [(file, *read(file)) for file in files]
    wanted = [(file, root, faults) for file, root, faults in found if kind_of(root) == kind]
    if not optional and not (wanted if kind == "search" else files):
        if kind == "search":
            raise InputError(f"{folder}: no searches (an arm has a space) here; `rhmc search check FILE` takes one")
        raise InputError(f"{folder}: no studies (*.yaml) here; `rhmc study copy NAME` writes one of this package")
    return wanted


def kind_of(root: "Node | None") -> Kind:
    """A search has a space in an arm."""
    arms = root.children.get("arms") if root else None
    return "search" if arms and any("space" in arm.children for arm in arms.children.values()) else "study"


def listing(folder: Path | None, kind: Kind, as_json: bool) -> None:
    """List what is in a folder with its questions, and the variants of studies or the arms of searches."""
    group = "variants" if kind == "study" else "arms"
    found: list[dict[str, Any]] = []
    for file, root, faults in files_of_kind(studies_folder(folder), kind):
        nodes = root.children if root else {}
        question = " ".join(str(nodes["question"].value).split()) if "question" in nodes else ""
        fault = "" if question else str(faults[0]) if faults else "no question"
        names = list(nodes[group].children) if group in nodes else []
        found.append({kind: str(file), "question": question, group: names, "fault": fault})
    if as_json:
        say_json(found)
        return
    rows = [[one[kind], one["question"] or one["fault"], ", ".join(one[group])] for one in found]
    table([kind, "question", group], rows)


def load_study(file: Path, profile: str, overrides: Sequence[str] | None, variant: str | None) -> "Study":
    """The study that the options name.

    Raises:
        InputError: with every fault.
    """
    from pipelines.specs.study import Study

    return Study.load(file, profile, overrides or [], variant, find=_find)


def _find(address: str, folder: Path) -> "Policy":
    """Look for a policy that a run of a study starts from."""
    from pipelines.tracking.initial import finder
    from pipelines.workspace.work_folder import work_folder

    return finder(work_folder())(address, folder)


def load_search(file: Path, profile: str, overrides: Sequence[str] | None) -> "Search":
    """The search that the options name.

    Raises:
        InputError: with every fault.
    """
    from pipelines.specs.search import Search

    return Search.load(file, profile, overrides or [], find=_find)


def load_studies(
    files: Sequence[Path], profile: str, overrides: Sequence[str] | None, variant: str | None
) -> "list[Study]":
    """The studies that the options name, all of which take the same options.

    Raises:
        InputError: with every fault of all of them.
    """
    return load_each(files, lambda file: load_study(file, profile, overrides, variant))


def load_each(files: Sequence[Path], load: Callable[[Path], Loaded]) -> list[Loaded]:
    """Contents of each of the files.

    Raises:
        InputError: with every fault of all of them.
    """
    found: list[Loaded] = []
    faults: dict[Path, list[str]] = {}
    for file in files:
        try:
            found.append(load(file))
        except InputError as error:
            faults[file] = [str(line) for line in error.args]
    if faults:
        raise InputError(*_of_files(faults, len(set(files))))
    return found


def _of_files(faults: Mapping[Path, Sequence[str]], files: int) -> list[str]:
    """The faults of several files: one of an option is said once if all have it, else it names the file."""
    counts = Counter(line for lines in faults.values() for line in lines)
    return list(
        dict.fromkeys(
            f"{file}: {line}" if line.startswith("--") and counts[line] < files else line
            for file, lines in faults.items()
            for line in lines
        )
    )


@contextmanager
def folder_option(out: Path | None) -> Iterator[None]:
    """Work with the folder that `--out` names, if any: what is wrong with it is bad input.

    Raises:
        InputError: it is a file, or cannot be written to.
    """
    from pipelines.workspace.work_folder import StoreError

    if out is not None and out.exists() and not out.is_dir():
        raise InputError(f"--out: {out} is not a folder")
    try:
        yield
    except StoreError as error:
        raise InputError(str(error)) from error


def profile_faults(profile: str) -> list[str]:
    """The fault of `--profile`, for verbs that read no study."""
    from pipelines.specs.document import choices, show

    return [] if profile in PROFILES else [f"--profile: {show(profile)} is not allowed; {choices(profile, PROFILES)}"]


def say(text: str) -> None:
    """Lines on stdout, at once."""
    print(visible_lines(text), flush=True)


def tell(text: str) -> None:
    """A line on stderr, at once."""
    print(visible(text), file=sys.stderr, flush=True)


def say_json(value: Any) -> None:
    """One JSON value on stdout, on a line of its own; what cannot be seen stays as JSON's escapes."""
    text = json.dumps(value, ensure_ascii=False)
    print(text if visible(text) == text else json.dumps(value), flush=True)


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[str] = ()) -> None:
    """A table on stdout; `numbers` are the columns that stand to the right."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from pipelines.workspace.terminal import terminal

    drawn = Table(box=box.SIMPLE)
    for column in columns:
        drawn.add_column(Text(column), justify="right" if column in numbers else "left", overflow="fold")
    for row in rows:
        drawn.add_row(*(Text(visible(cell)) for cell in row))
    terminal(None if sys.stdout.isatty() else WIDTH).print(drawn)
