"""Looks of arms: nine methods that nobody takes for one another, and the same in every figure."""

from itertools import combinations

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from reports.render.canvas import LOOKS, OTHERS, look

METHODS = ("RHMC", "HiT-MAC", "QMIX", "VDN", "IQL", "COMA", "MAPPO", "IPPO", "MADDPG")
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
# Machado, Oliveira and Fernandes 2009, severity 1, in linear RGB.
SEEN = {
    "all": np.eye(3),
    "no green": np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]]),
    "no red": np.array([[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]]),
}


def linear(colour: str) -> NDArray[np.float64]:
    found = np.array(to_rgb(colour))
    return np.where(found <= 0.04045, found / 12.92, ((found + 0.055) / 1.055) ** 2.4)


def lab(colour: str, eye: str) -> NDArray[np.float64]:
    """CIE L*a*b* under D65."""
    seen = np.clip(SEEN[eye] @ linear(colour), 0, 1)
    x, y, z = np.cbrt(XYZ @ seen / (0.9505, 1, 1.089))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def nearest(colours: list[str], eye: str) -> float:
    return min(float(np.linalg.norm(lab(a, eye) - lab(b, eye))) for a, b in combinations(colours, 2))


@pytest.mark.parametrize(("eye", "least"), [("all", 30), ("no green", 12), ("no red", 12)])
def test_nine_methods_have_nine_hues_for_every_eye(eye: str, least: float) -> None:
    """A difference of about 2.3 is just noticed; below 10 two lines are taken for one."""
    assert nearest([LOOKS[name].colour for name in METHODS], eye) >= least


def test_the_oracle_knows_what_is_alike() -> None:
    assert nearest(["#AA4499", "#AA4499"], "all") == 0
    assert nearest(["#009E73", "#D55E00"], "all") > 60
    assert np.linalg.norm(lab("#ffffff", "all") - (100, 0, 0)) < 1


def test_nine_methods_have_nine_marks() -> None:
    found = [LOOKS[name] for name in METHODS]
    assert len({one.mark for one in found}) == len({one.colour for one in found}) == 9


def test_words_in_every_colour_are_read_on_white() -> None:
    colours = [*(one.colour for one in LOOKS.values()), *OTHERS]
    assert min(1.05 / (float((XYZ @ linear(one))[1]) + 0.05) for one in colours) > 2.7


def test_a_method_has_its_look_whatever_else_its_arm_is_called() -> None:
    assert look("COMA, agents=4", ["COMA, agents=4", "RHMC, agents=4"]) == LOOKS["COMA"]
    several = [f"COMA, agents={n}" for n in (2, 4, 6)]
    assert len({look(arm, several) for arm in several}) == 3
    assert look("RHMC, team reward", ["RHMC", "RHMC, team reward"]) == LOOKS["RHMC, team reward"]


def test_arms_of_no_method_are_told_from_all_methods() -> None:
    arms = [*METHODS, *(f"arm {n}" for n in range(16))]
    found = [look(arm, arms) for arm in arms]
    assert len({(one.colour, one.mark) for one in found}) == len(arms)
