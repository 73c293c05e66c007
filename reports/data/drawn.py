"""The JSON files of the package, checked as it is read: methods (Table 1), networks and scenes (Figures 1 to 5, 8).

A part that is not there draws nothing; a part of another form is a fault of one line.
"""

import json
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from reports.data.schema import TASKS

METHODS, MODULES, SCENES = "methods.json", "modules.json", "scenes.json"
METHOD = ("kind", "name", "source", "family", "training", "execution", "critic", "coordination")
OURS = "what `rhmc drawings --out` writes"
Point = tuple[float, float]
Count = Annotated[int, Field(ge=0)]
T = TypeVar("T")


class Part(BaseModel):
    """A part of a file."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class Kind(BaseModel):
    """The fields that every task states; the rest of its configuration is kept as it is."""

    model_config = ConfigDict(frozen=True, extra="allow")
    kind: str


class Size(Part):
    """Parameters of a method's networks: those that act, and all that learn."""

    task: Kind
    encoder: str
    acting: int
    all: int


class Method(Part):
    """A method of Table 1."""

    kind: str
    name: str
    source: str
    family: str
    training: str
    execution: str
    critic: str
    coordination: str
    actions: tuple[str, ...]
    parameters: tuple[Size, ...]
    defaults: dict[str, Any] = {}  # of its settings; earlier exports lack them


class Said(Part):
    """Words of a task of another package about itself."""

    unit: Annotated[str, Field(max_length=80)]  # of its return, in words


class Input(Part):
    """The input of a network; shape without the batch."""

    name: str
    shape: tuple[int, ...]


class Layer(Part):
    """A layer: its class, and the width of its input and its output."""

    name: str
    kind: str
    width_in: Count = Field(alias="in")
    width_out: Count = Field(alias="out")
    parameters: Count


class Edge(Part):
    """From an input or a layer to a layer or `output`; `through` names what happens on the way."""

    source: str = Field(alias="from")
    target: str = Field(alias="to")
    through: tuple[str, ...]


class Network(Part):
    """A network as it ran once."""

    role: str
    kind: str
    parameters: Count
    inputs: tuple[Input, ...]
    output: tuple[int, ...]
    layers: tuple[Layer, ...]
    edges: tuple[Edge, ...]


class Settings(Part):
    """The steps of the method beside its networks."""

    filter: str
    regulator: str
    horizon: int
    alpha: float
    assignment_period: int


class Build(Part):
    """The method on one encoder."""

    encoder: str
    task: dict[str, Any]
    settings: Settings
    networks: tuple[Network, ...]

    def network(self, role: str) -> Network:
        """The network of a role. Raises KeyError."""
        return {network.role: network for network in self.networks}[role]


class Navigation(Part):
    """An episode: positions by time and agent, landmarks, radius of an agent and of a landmark's disc."""

    policy: str
    positions: tuple[tuple[Point, ...], ...]
    landmarks: tuple[Point, ...]
    radius: float
    near: float


class Coverage(Part):
    """A state: sensors with headings in degrees, targets, and which sensor sees which target."""

    agents: int
    policy: str
    step: int
    sensors: tuple[Point, ...]
    heading: tuple[float, ...]
    targets: tuple[Point, ...]
    seen: tuple[tuple[bool, ...], ...]
    range: float
    half_view: float
    half_area: float


class Joint(Part):
    """A joint option: one choice per agent, the targets that it completes, its reward by Eq. 6."""

    choices: tuple[int, ...]
    completed: tuple[bool, ...]
    reward: float


class Paths(Part):
    """The choice of Algorithm 1, and a best joint option."""

    algorithm_1: Joint
    optimum: Joint


class Met(Part):
    """States met on the way with a drawn assignment: how many, and on how many Algorithm 1 is below the optimum."""

    horizon: int
    states: int
    lost: int
    max_gap: float


class Instance(Part):
    """An instance: assignment (N, M), what each agent's options complete (N, D_i, M), and both paths."""

    alpha: float
    assignment: tuple[tuple[int, ...], ...]
    options: tuple[tuple[tuple[int, ...], ...], ...]
    paths: Paths


class Regulation(Instance):
    """An instance met on the way, and how often Algorithm 1 fell short there."""

    horizon: int
    met: tuple[Met, ...]


class Counterexample(Instance):
    """A smallest instance on which Algorithm 1 misses the largest reward, or the largest count of targets."""

    by: Literal["reward", "count"]


class Scenes(Part):
    """Everything that is drawn of states."""

    navigation: Navigation
    coverage: tuple[Coverage, ...]
    regulation: Regulation
    counterexamples: tuple[Counterexample, ...] = ()


def read_methods(folder: Path, faults: list[str]) -> list[dict[str, Any]]:
    """The records of the methods, as plain values; none without the file."""
    what = "the methods as `rhmc methods --out` writes them"
    found = _read(folder / METHODS, TypeAdapter(tuple[Method, ...]), faults, what) or ()
    return [method.model_dump() for method in found]


def read_units(folder: Path, faults: list[str]) -> dict[str, str]:
    """The unit of the return of each task that is not this project's, by kind."""
    what = "what `rhmc export` writes of tasks of other packages"
    files = [_read(file, TypeAdapter(dict[str, Said]), faults, what) or {} for file in files_in(folder, f"*{TASKS}")]
    return {kind: said.unit for file in files for kind, said in file.items()}


def read_modules(folder: Path, faults: list[str]) -> tuple[Build, ...]:
    """The method's networks, one build per encoder; none without the file."""
    return _read(folder / MODULES, TypeAdapter(tuple[Build, ...]), faults) or ()


def read_scenes(folder: Path, faults: list[str]) -> Scenes | None:
    """The scenes; None without the file."""
    return _read(folder / SCENES, TypeAdapter(Scenes), faults)


def content(path: Path) -> bytes:
    """The bytes of a file.

    Raises:
        OSError: it cannot be read, or is no file: a pipe would be waited for, and a device has no end.
    """
    if not path.is_file():
        raise OSError("not a file" if path.exists() else "not there")
    return path.read_bytes()


def files_in(folder: Path, pattern: str) -> list[Path]:
    """The files of a folder that fit a pattern, sorted; none if it is not there.

    Raises:
        OSError: it cannot be looked at. From Python 3.13 on `glob` does not say so.
    """
    with suppress(FileNotFoundError):
        folder.stat()
    return sorted(folder.glob(pattern))


def told(error: ValidationError) -> str:
    """The first fault that pydantic found, with its place."""
    first = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(map(str, first["loc"]))
    return f"{where}: {first['msg']}" if where else first["msg"]


def _read(path: Path, form: TypeAdapter[T], faults: list[str], what: str = OURS) -> T | None:
    if not path.exists():
        return None
    try:
        return form.validate_python(json.loads(content(path)))
    except ValidationError as error:
        text = told(error)
    except RecursionError:
        text = "nested too deeply"
    except (OSError, ValueError) as error:
        text = str(error)
    faults.append(f"{path.name}: not {what} ({text})")
    return None
