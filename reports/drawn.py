"""What the package writes for the drawn figures, checked as it is read: networks (Figures 1 to 3) and scenes (4, 5, 8).

A part that is not there draws nothing; a part of another form is a fault of one line.
"""

import json
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

MODULES, SCENES = "modules.json", "scenes.json"
Point = tuple[float, float]
Count = Annotated[int, Field(ge=0)]
T = TypeVar("T")


class Part(BaseModel):
    """A part of a file."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class Input(Part):
    """What a network is given; shape without the batch."""

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
    """What shapes the method beside its networks."""

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
    """What Algorithm 1 settles on, and a best joint option."""

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


def read_modules(folder: Path, faults: list[str]) -> tuple[Build, ...]:
    """The method's networks, one build per encoder; none without the file."""
    return _read(folder / MODULES, TypeAdapter(tuple[Build, ...]), faults) or ()


def read_scenes(folder: Path, faults: list[str]) -> Scenes | None:
    """The scenes; None without the file."""
    return _read(folder / SCENES, TypeAdapter(Scenes), faults)


def _read(path: Path, form: TypeAdapter[T], faults: list[str]) -> T | None:
    if not path.exists():
        return None
    try:
        if not path.is_file():  # reading a named pipe would wait for ever
            raise ValueError("no regular file")
        return form.validate_python(json.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        text = f"{where}: {first['msg']}" if where else first["msg"]
    except (OSError, ValueError) as error:
        text = str(error)
    faults.append(f"{path.name}: not what `rhmc drawings --out` writes ({text})")
    return None
