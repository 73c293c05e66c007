"""Names: of metrics in MLflow, of profiles, and what a person's name becomes where not every character may stand.

Metrics have a few headline names without a group in MLflow, everything else is under its group.
Inside the program, in exported tables and in checkpoints a metric keeps its full name (`eval/return`). A log written
before there were headline names is read all the same: a name that is no headline stands for itself.

Arms, studies and variants are named by people. Where such a name becomes a part of a file's or a registered model's,
`slug` makes it; what `faults_of_study` and `alike` refuse could not be kept apart there.
"""

import hashlib
import re
import unicodedata
from collections.abc import Iterable
from pathlib import Path

PROFILES = ("quick", "paper")
RESERVED = {  # what the program itself writes beside the tables of studies, by the file's name up to its first dot
    "transfer": "`rhmc transfer`",
    "theorem": "`rhmc theorem`",
    "yardsticks": "`rhmc yardsticks`",
    "methods": "`rhmc methods`",
    "modules": "`rhmc drawings`",
    "scenes": "`rhmc drawings`",
}
BY_ARM = "_arms"  # ends the name of the figure with a study's curves arm by arm
STUDY = 80  # bytes of a study's name: with what is put around it a file name keeps below 255
ARM = 200  # characters of an arm's name
READABLE = 60  # characters of a slug before its digest
_OTHER = re.compile(r"[^A-Za-z0-9._+-]+")
_DIGEST = re.compile(r"-[0-9a-f]{8}\Z", re.IGNORECASE)

MEASURES = ("return", "coverage", "landmarks_covered", "collisions")  # of evaluations, with a short name in MLflow
HEADLINES = {name: f"eval/{name}" for name in MEASURES} | {"steps_per_second": "time/steps_per_second"}
SHOWN = {full: short for short, full in HEADLINES.items()}


def shown(metric: str) -> str:
    """The name in MLflow of a metric of the program."""
    return SHOWN.get(metric, metric)


def full(metric: str) -> str:
    """The name in the program of a metric in MLflow."""
    return HEADLINES.get(metric, metric)


def slug(text: str, of: str = "") -> str:
    """A name for a file or a model: the text where that will do, else what of it may stand, and a digest.

    Other texts have other slugs, and also where case is not looked at, but for texts that `alike` finds alike.

    Args:
        text: to be read.
        of: what is named, where the text alone does not tell.
    """
    plain = _OTHER.sub("-", text).strip("-.")[:READABLE]
    if plain == (of or text) and not _DIGEST.search(plain):
        return plain
    return f"{plain or 'name'}-{hashlib.sha256((of or text).encode()).hexdigest()[:8]}"


def folded(name: str) -> str:
    """The name as people and some file systems see it: no case, one normal form, single blanks."""
    return " ".join(unicodedata.normalize("NFKC", name).casefold().split())


def alike(names: Iterable[str]) -> list[tuple[str, str]]:
    """Every name that differs from an earlier one in case, blanks or normal form alone, with the earlier one."""
    first: dict[str, str] = {}
    pairs = [(name, first.setdefault(folded(name), name)) for name in dict.fromkeys(names)]
    return [(name, other) for name, other in pairs if name != other]


def simple(name: str) -> bool:
    """True if a name may be part of a file's, wherever that is: letters, digits, `-` and `_`."""
    return name.replace("_", "").replace("-", "").isalnum()


def study_name(file: Path, variant: str = "") -> str:
    """The name of a study: its file's stem, in the normal form that most file systems keep, and its variant."""
    return unicodedata.normalize("NFC", file.stem) + (f"@{variant}" if variant else "")


def fault_of_study(stem: str) -> str:
    """The reason why a file of this stem can be no study or search; nothing if it can."""
    if not simple(stem):
        return "a study's file is named with letters, digits, '-' and '_' only"
    if stem.startswith("-"):
        return "a study's file is named with no '-' in front, which would make it an option"
    if stem.endswith(BY_ARM):
        return f"a study's name does not end in '{BY_ARM}', as a figure of the study '{stem.removesuffix(BY_ARM)}' does"
    if folded(stem) in RESERVED:
        return (
            f"a study cannot be named '{stem}': {RESERVED[folded(stem)]} writes results of that name; rename the file"
        )
    return too_long(stem)


def too_long(name: str) -> str:
    """The reason why a study's name is too long; nothing if it is not."""
    size = len(name.encode())
    return f"a name of {size} bytes; at most {STUDY}, for it is part of other names" if size > STUDY else ""
