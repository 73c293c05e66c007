"""The paper's statements (`paper.yaml`), checked as they are read."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from reports.data.drawn import content

FILE = Path(__file__).with_name("paper.yaml")


def _as_text(value: object) -> object:
    """A number as it is written; what is neither a number nor text is left for the check to refuse."""
    return str(value) if isinstance(value, int | float) and not isinstance(value, bool) else value


Text = Annotated[str, BeforeValidator(_as_text)]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Count = Annotated[int, Field(strict=True, ge=0)]


class PaperError(ValueError):
    """The paper's statements cannot be used; the message holds one line per fault."""


class Part(BaseModel):
    """A part of the file; an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Source(Part):
    """The paper itself; what the text at hand does not state stays empty. `doi`: `10....`, no address."""

    title: str
    authors: tuple[str, ...] = ()
    venue: str = ""
    year: Count | None = None
    doi: Annotated[str, Field(pattern=r"^(10\.\S+)?$")] = ""

    @property
    def about(self) -> str:
        """Authors, venue and year, as far as they are there: `A. One, B. Two. Journal, 2024`."""
        where = ", ".join(filter(None, (self.venue, str(self.year or ""))))
        return ". ".join(filter(None, (", ".join(self.authors), where)))


class Row(Part):
    """A row of Table 2. `stated`: the loss in percent as printed."""

    arm: str
    method: str
    final: Number
    stated: Number | None = None


class Ablation(Part):
    """Table 2."""

    place: str
    rows: Annotated[tuple[Row, ...], Field(min_length=1)]


class Curves(Part):
    """A figure of learning curves: `levels` are final values that the text gives for its arms."""

    study: str
    title: str
    place: str
    yardsticks: tuple[str, ...]
    levels: dict[str, Number]


class Statement(Part):
    """A claim as the paper makes it. `label`: in a few words, for a row of a figure."""

    text: str
    label: str = ""
    value: Text
    place: str
    numbers: dict[str, Number] = {}


class Paper(Part):
    """Everything the paper states that is compared. `yardsticks`: those in the figures of other studies, by task."""

    source: Source
    table_2: Ablation
    figures: dict[str, Curves]
    arms: dict[str, tuple[str, ...]]
    steps: dict[str, Count]
    claims: dict[str, Statement]
    yardsticks: dict[str, tuple[str, ...]]

    @property
    def studies(self) -> frozenset[str]:
        """The studies that the paper has: of a figure, of its arms, or with a budget of its text."""
        return frozenset({*(figure.study for figure in self.figures.values()), *self.arms, *self.steps})

    def curves_of(self, study: str, task: str) -> Curves:
        """Curves of a study that the paper does not have."""
        yardsticks = self.yardsticks.get(task, ())
        return Curves(study=study, title=f"Study {study}: learning curves", place="", yardsticks=yardsticks, levels={})


def read(path: Path | None = None) -> Paper:
    """The statements of a file, `FILE` if none is given.

    Raises:
        PaperError: it cannot be read, is no YAML, or does not hold what `Paper` describes.
    """
    path = path or FILE
    try:
        return Paper.model_validate(_document(content(path).decode("utf-8")))
    except ValidationError as error:
        faults = [_fault(one) for one in error.errors(include_url=False)]
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        faults = [f"{f'line {mark.line + 1}: ' if mark else ''}no YAML ({error.problem or error.context})"]
    except (YAMLError, RecursionError) as error:
        faults = [f"no YAML ({' '.join(str(error).split())})"]
    except UnicodeDecodeError as error:
        faults = [f"no text in UTF-8 (byte {error.start})"]
    except OSError as error:
        faults = [f"cannot be read ({error.strerror or error})"]
    except ValueError as error:  # a date, say, that there is not
        faults = [f"no YAML ({error})"]
    raise PaperError("\n".join(f"{path.name}: {fault}" for fault in faults))


def _document(text: str) -> Any:
    return YAML(typ="safe", pure=True).load(text)


def _fault(error: Any) -> str:
    """A fault that pydantic found, with the value where it is a plain one."""
    where, value = ".".join(map(str, error["loc"])), error["input"]
    shown = f", not {value!r}" if isinstance(value, str | int | float) and len(repr(value)) < 80 else ""
    return f"{where}: {error['msg']}{shown}" if where else f"{error['msg']}{shown}"
