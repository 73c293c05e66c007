"""The paper's statements (`paper.yaml`), checked as they are read."""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict
from ruamel.yaml import YAML

FILE = Path(__file__).with_name("paper.yaml")
Text = Annotated[str, BeforeValidator(str)]


class Part(BaseModel):
    """A part of the file; an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Row(Part):
    """A row of Table 2. `stated`: the loss in percent as printed."""

    arm: str
    method: str
    final: float
    stated: float | None = None


class Ablation(Part):
    """Table 2."""

    place: str
    rows: tuple[Row, ...]


class Curves(Part):
    """A figure of learning curves: `levels` are final values that the text gives for its arms."""

    study: str
    title: str
    place: str
    yardsticks: tuple[str, ...]
    levels: dict[str, float]


class Statement(Part):
    """A claim as the paper makes it."""

    text: str
    value: Text
    place: str
    numbers: dict[str, float] = {}


class Paper(Part):
    """Everything the paper states that is compared. `rulers`: scripted policies in the figures of other studies."""

    table_2: Ablation
    figures: dict[str, Curves]
    arms: dict[str, tuple[str, ...]]
    steps: dict[str, int]
    claims: dict[str, Statement]
    rulers: dict[str, tuple[str, ...]]

    def curves_of(self, study: str, task: str) -> Curves:
        """Curves of a study that the paper does not have."""
        rulers = self.rulers.get(task, ())
        return Curves(study=study, title=f"Study {study}: learning curves", place="", yardsticks=rulers, levels={})


def read(path: Path = FILE) -> Paper:
    """The statements of a file. Raises pydantic's error if it does not hold what `Paper` describes."""
    return Paper.model_validate(YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8")))
