"""States of the tasks as pictures, drawn with Pillow: a small GIF costs a second, not the half minute of a plot.

A picture is drawn at twice its size and made smaller, which smooths its edges.
"""

from collections.abc import Callable, Sequence
from io import BytesIO
from typing import Any, NamedTuple

import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from pipelines.workspace.errors import InputError
from rhmc.envs import EnvConfig, coverage, navigation
from rhmc.yardsticks import offered

SIDE = 280  # pixels of a panel
LINES = 34  # pixels of the text below it
FINE = 2  # drawn at so many times the size
PAUSE = 1200  # milliseconds on the last frame
INK, PALE, SEEN, MISSED = (40, 44, 52), (205, 210, 216), (28, 126, 62), (200, 52, 44)
TEAM = ((31, 119, 180), (255, 127, 14), (148, 103, 189), (23, 150, 160), (188, 150, 34), (200, 90, 160))
COVERAGE_VIEW = 1350.0  # half-width of what a panel shows
NAVIGATION_VIEW = (1.4, 3.0)  # the same, at least and at most: it grows if agents leave


class Scene(NamedTuple):
    """A moment of one episode: a state with B = 1, and what has happened until then."""

    state: Any
    assignment: Tensor | None  # (N, M) 0 or 1, where the method assigns
    text: str


class Panel(NamedTuple):
    """One policy's episode."""

    title: str
    scenes: Sequence[Scene]


def gif(env: EnvConfig, panels: Sequence[Panel], frames: int, milliseconds: int, note: str = "") -> bytes:
    """The panels side by side as a GIF.

    Args:
        env: the task of all panels, whose episodes are equally long.
        frames: at most so many; the steps between are left out, the last one never.
        milliseconds: of each frame.
        note: kept in the file, as a comment that no viewer shows.

    Raises:
        InputError: the task offers no painter.
    """
    paint, half_width = painter(env.kind)
    steps = len(panels[0].scenes)
    stride = max(1, -(-(steps - 1) // max(1, frames - 1)))
    shown = sorted({*range(0, steps, stride), steps - 1})
    half = max(map(half_width, panels))
    pictures = [_picture(paint, panels, half, step) for step in shown]
    palette = _palette()
    flat = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    out = BytesIO()
    times = [milliseconds] * (len(flat) - 1) + [max(PAUSE, milliseconds)]
    comment = {"comment": note.encode()} if note else {}
    flat[0].save(out, "GIF", save_all=True, append_images=flat[1:], duration=times, loop=0, optimize=False, **comment)
    return out.getvalue()


def _palette() -> Image.Image:
    """The palette of all frames: every colour, and its mixtures with white that views and smooth edges need."""
    solid = [INK, PALE, SEEN, MISSED, *TEAM]
    mixed = [tuple(round(255 + share * (part - 255)) for part in colour) for colour in solid for share in (0.22, 0.55)]
    flat = [part for colour in [(255, 255, 255), *solid, *mixed] for part in colour]
    image = Image.new("P", (1, 1))
    image.putpalette(flat)
    return image


def _navigation_view(panel: Panel) -> float:
    furthest = max(float(scene.state.position.abs().max()) for scene in panel.scenes)
    return min(max(NAVIGATION_VIEW[0], 1.1 * furthest), NAVIGATION_VIEW[1])


def _picture(paint: "Paint", panels: Sequence[Panel], half: float, step: int) -> Image.Image:
    sheet = Image.new("RGB", (SIDE * len(panels), SIDE + LINES), "white")
    write = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(12)
    for place, panel in enumerate(panels):
        scene, left = panel.scenes[step], place * SIDE
        large = Image.new("RGB", (FINE * SIDE, FINE * SIDE), "white")
        brush = Brush(ImageDraw.Draw(large, "RGBA"), half)
        paint(brush, scene)
        sheet.paste(large.resize((SIDE, SIDE), Image.Resampling.BOX), (left, 0))
        write.text((left + 6, SIDE + 2), panel.title, fill=INK, font=font)
        write.text((left + 6, SIDE + 17), scene.text, fill=INK, font=font)
        write.line([(left, 0), (left, SIDE + LINES)], fill=PALE)
    return sheet


class Brush:
    """Draws in the task's coordinates: x to the right, y upwards, the origin in the middle.

    Args:
        draw: of a square image of FINE * SIDE pixels.
        half: half-width of what is shown.
    """

    def __init__(self, draw: ImageDraw.ImageDraw, half: float) -> None:
        self.draw, self.scale, self.half = draw, FINE * SIDE / (2 * half), half

    def at(self, x: float, y: float) -> tuple[float, float]:
        """The pixel of a point."""
        return (x + self.half) * self.scale, (self.half - y) * self.scale

    def _box(self, x: float, y: float, radius: float) -> list[tuple[float, float]]:
        return [self.at(x - radius, y + radius), self.at(x + radius, y - radius)]

    def ring(self, x: float, y: float, radius: float, colour: tuple[int, ...], width: int = FINE) -> None:
        """A circle's outline."""
        self.draw.ellipse(self._box(x, y, radius), outline=colour, width=width)

    def disc(self, x: float, y: float, radius: float, colour: tuple[int, ...]) -> None:
        """A filled circle."""
        self.draw.ellipse(self._box(x, y, radius), fill=colour)

    def sector(self, x: float, y: float, radius: float, degrees: tuple[float, float], colour: tuple[int, ...]) -> None:
        """A slice between two directions, counter-clockwise from +x; Pillow counts clockwise."""
        low, high = degrees
        self.draw.pieslice(self._box(x, y, radius), -high, -low, fill=colour)

    def line(self, points: Sequence[tuple[float, float]], colour: tuple[int, ...], width: int = FINE) -> None:
        """Straight from point to point."""
        self.draw.line([self.at(*point) for point in points], fill=colour, width=width)


def paint_coverage(brush: Brush, scene: Scene) -> None:
    """Sensors with range, view and assigned targets; targets in view are filled, others are rings."""
    state: coverage.State = scene.state
    area = coverage.HALF_AREA
    brush.line([(-area, -area), (area, -area), (area, area), (-area, area), (-area, -area)], PALE)
    sensors, targets = state.sensors[0].tolist(), state.targets[0].tolist()
    headings = state.heading[0].tolist()
    for i, (x, y) in enumerate(sensors):
        brush.ring(x, y, coverage.RANGE, (*_team(i), 70))
        view = (headings[i] - coverage.HALF_VIEW, headings[i] + coverage.HALF_VIEW)
        brush.sector(x, y, coverage.RANGE, view, (*_team(i), 56))
    _lines(brush, sensors, targets, scene.assignment)
    for i, (x, y) in enumerate(sensors):
        brush.disc(x, y, 45, _team(i))
    seen = coverage.visible(*coverage.relation(state))[0].any(0).tolist()
    for (x, y), inside in zip(targets, seen, strict=True):
        brush.disc(x, y, 38, SEEN if inside else MISSED)
        if not inside:
            brush.disc(x, y, 22, (255, 255, 255))


def paint_navigation(brush: Brush, scene: Scene) -> None:
    """Agents with their assigned landmarks; a landmark with an agent on it is filled, others are rings."""
    state: navigation.State = scene.state
    agents, landmarks = state.position[0].tolist(), state.landmarks[0].tolist()
    brush.line([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)], PALE)
    gaps = torch.cdist(state.position[0], state.landmarks[0])
    covered = (gaps.amin(0) < navigation.NEAR).tolist()
    for (x, y), inside in zip(landmarks, covered, strict=True):
        brush.ring(x, y, navigation.NEAR, SEEN if inside else MISSED, 2 * FINE)
    _lines(brush, agents, landmarks, scene.assignment)
    near = torch.cdist(state.position[0], state.position[0]) < navigation.CONTACT
    bumping = (near.sum(-1) > 1).tolist()
    for i, (x, y) in enumerate(agents):
        brush.disc(x, y, navigation.CONTACT / 2, (*_team(i), 150))
        brush.ring(x, y, navigation.CONTACT / 2, MISSED if bumping[i] else _team(i))


def _lines(brush: Brush, agents: Any, targets: Any, assignment: Tensor | None) -> None:
    if assignment is None:
        return
    for i, j in assignment.bool().nonzero().tolist():
        brush.line([tuple(agents[i]), tuple(targets[j])], (*_team(i), 130))


def _team(i: int) -> tuple[int, int, int]:
    return TEAM[i % len(TEAM)]


Paint = Callable[["Brush", Scene], None]


class Painter(NamedTuple):
    """Drawing of a task."""

    paint: Paint
    half_width: Callable[[Panel], float]  # of what a panel shows


PAINTERS = {  # of this project's tasks
    "coverage": Painter(paint_coverage, lambda panel: COVERAGE_VIEW),
    "navigation": Painter(paint_navigation, _navigation_view),
}


def painter(kind: str) -> Painter:
    """Painter of a task, as this project or the task itself has it.

    Raises:
        InputError: neither has.
    """
    offers = offered(kind)
    if kind in PAINTERS:
        return PAINTERS[kind]
    if offers.painter is None:
        raise InputError(f"the task '{kind}' offers no painter, so its episodes are not drawn")
    return Painter(offers.painter, lambda panel: offers.half_width)
