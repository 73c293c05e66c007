"""Colours of arms in MLflow: it picks a group's by a hash of its name, so that four arms may come in three greens.

A run's tag `legend` is therefore its arm's name with a few characters of no width behind it, chosen so that the hash
falls on the colour that the arm should have. Hash and palette are those of the pinned MLflow's web interface; a test
compares them. Should either change, colours are arbitrary again, and nothing else is lost.
"""

from collections.abc import Iterator
from functools import cache
from itertools import product

TAG, COLOUR = "legend", "mlflow.runColor"  # tags of a run; the second colours it where runs are not grouped
MARKS, MOST = "\u200b\u200c\u200d\u2060", 4  # invisible characters, and how many are put behind a name at most
PALETTE = (  # MLflow's, in its order
    *("#a6630c", "#c83243", "#b45091", "#8a63bf", "#434a93", "#137dae", "#04867d", "#308613", "#facb66", "#1f272d"),
    *("#445461", "#5f7281", "#8396a5", "#93320b", "#be501e", "#de7921", "#f2be88", "#115026", "#277c43", "#3ba65e"),
    *("#8ddda8", "#9e102c", "#c82d4c", "#e65b77", "#f792a6", "#0e538b", "#2272b4", "#4299e0", "#8acaff"),
)
FIRST = (26, 15, 7, 1, 3, 13, 24, 12, 8, 28)  # blue, orange, green, red, ...: told apart best, and as in our figures
ORDER = (*FIRST, *(place for place in range(len(PALETTE)) if place not in FIRST))


def colour(place: int) -> str:
    """The colour of a study's arm, counted from 0. After the last colour the first one comes again."""
    return PALETTE[ORDER[place % len(ORDER)]]


@cache
def legend(arm: str, place: int) -> str:
    """The group of an arm's runs in MLflow: it reads as the arm's name and has the colour of its place."""
    wanted = ORDER[place % len(ORDER)]
    return next((name for name in _readings(arm) if _hash(group(name)) % len(PALETTE) == wanted), arm)


def group(name: str) -> str:
    """MLflow's own name of the group of runs with this legend."""
    return f"tag.{TAG}.{name}"


def _readings(arm: str) -> Iterator[str]:
    """All that reads as the name, the shortest first."""
    for length in range(MOST + 1):
        for marks in product(MARKS, repeat=length):
            yield arm + "".join(marks)


def _hash(text: str) -> int:
    """Fletcher's checksum of the text's UTF-16 units."""
    units = text.encode("utf-16-le", "surrogatepass")
    low = high = 0
    for at in range(0, len(units), 2):
        low = (low + int.from_bytes(units[at : at + 2], "little")) % 255
        high = (high + low) % 255
    return low | high << 8
