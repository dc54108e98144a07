"""The content of a picture as plain data: curves over time, bars, charts, lanes, notes, robots."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from ..arrays import Array
from ..report import Document

Color = tuple[int, int, int]
Line = tuple[Array, Array]  # t_s (k,), values (k,)
Ticks = Mapping[float, str]  # values of a scale and their texts
Steps = tuple[Array, float, Array]  # left edges (k,), width, heights (k,)

# Okabe and Ito's colors, distinguishable for the color-blind (Color Universal Design, 2008), on dark and light background.
ORANGE, SKY, GREEN, YELLOW = (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66)
BLUE, VERMILLION, PURPLE = (0, 114, 178), (213, 94, 0), (204, 121, 167)
GREY, LIGHT = (140, 140, 140), (205, 205, 205)
# A color has the same meaning on all pages.
MEASURED, REFERENCE, SIMULATED, PREDICTED, RESIDUAL = GREY, GREEN, SKY, ORANGE, VERMILLION
SHEET = (1430.0, 960.0)  # pixels of a large chart on a screen of 1920 by 1080
JOINTS = (SKY, ORANGE, GREEN, VERMILLION, PURPLE, YELLOW, BLUE, GREY)  # in turn


@dataclass(frozen=True, kw_only=True, eq=False)
class _Panel:
    """A view: the path of its entities and its title."""

    path: tuple[str, ...]
    title: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A line of a plot; `key` is the last part of its entity's path. Lines are drawn in order of their keys, last in front.

    `dashed` where the renderer can: told from grey by its shape too.
    """

    key: str
    color: Color
    line: Line
    name: str = ""
    width: float = 1.0
    visible: bool = True
    dashed: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Plot(_Panel):
    """Curves over time in seconds; with a `start`, the time of second 0, over dates."""

    curves: tuple[Curve, ...]
    legend: bool = True
    start: datetime | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Bars(_Panel):
    """Bars in front of grey ones; `names` of both, in words."""

    front: Steps
    back: Steps
    names: tuple[str, str]
    legend: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class Chart(_Panel):
    """Strokes (points (k, 2), color, radius), markers and labels on a sheet of `size` pixels, y downwards.

    Markers are `dots`, `rings`, `crosses` (for least squares), and the `cloud` of small ones behind the strokes.
    """

    size: tuple[float, float]
    strokes: list[tuple[Any, Color, float]] = field(default_factory=list)
    dots: list[tuple[float, float, Color]] = field(default_factory=list)
    rings: list[tuple[float, float, Color]] = field(default_factory=list)
    crosses: list[tuple[float, float, Color]] = field(default_factory=list)
    cloud: list[tuple[float, float, Color]] = field(default_factory=list)
    labels: list[tuple[float, float, str, Color]] = field(default_factory=list)

    def line(self, x0: float, y0: float, x1: float, y1: float, color: Color = GREY, radius: float = 0.25) -> None:
        """Draw a straight stroke."""
        self.strokes.append((((x0, y0), (x1, y1)), color, radius))

    def label(self, x: float, y: float, text: str, color: Color = GREY) -> None:
        """Write text with its top at y, centred at x."""
        self.labels.append((x, y, text, color))

    def ticks_across(self, scale: "Scale", ticks: "Ticks", edges: tuple[float, float], label_y: float) -> None:
        """Draw vertical lines between two edges, and texts, at the ticks of a horizontal scale."""
        for value, text in ticks.items():
            self.line(scale(value), edges[0], scale(value), edges[1])
            self.label(scale(value), label_y, text)

    def ticks_up(self, scale: "Scale", ticks: "Ticks", edges: tuple[float, float], label_x: float) -> None:
        """Draw horizontal lines between two edges, and texts, at the ticks of a vertical scale."""
        for value, text in ticks.items():
            self.line(edges[0], scale(value), edges[1], scale(value))
            self.label(label_x, scale(value) - 10, text)


@dataclass(frozen=True, kw_only=True, eq=False)
class Scale:
    """Map a number to pixels between two edges, through the monotonic function `by`; clamp it at the edges."""

    left: float
    right: float
    low: float
    high: float
    by: Callable[[float], float] = float

    @property
    def middle(self) -> float:
        """Midway between the edges, in pixels."""
        return 0.5 * (self.left + self.right)

    def __call__(self, value: float) -> float:
        """The position of the number in pixels."""
        low, high = self.by(self.low), self.by(self.high)
        return self.left + (self.right - self.left) * min(1.0, max(0.0, (self.by(value) - low) / (high - low or 1.0)))


def log10(x: float) -> float:
    """The decimal logarithm, also defined for 0."""
    return math.log10(max(x, 1e-300))


@dataclass(frozen=True, kw_only=True, eq=False)
class Lanes(_Panel):
    """Bands over time up to `end_s`: for each lane its changes of state (t_s, text, color); an empty text ends a band."""

    lanes: Mapping[str, Sequence[tuple[float, str, Color]]]
    end_s: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Log(_Panel):
    """Lines of text over time: (t_s, is a warning, text)."""

    lines: Sequence[tuple[float, bool, str]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Note(_Panel):
    """A report."""

    document: Document


@dataclass(frozen=True, kw_only=True, eq=False)
class Moving:
    """A robot with the joint positions q (K, n) at t_s (K,)."""

    key: str
    t_s: Array
    q: Array
    ghost: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene(_Panel):
    """Robots in one picture, drawn with the shapes of a `urdf`, whose joints are `joints`.

    `up` (3,) is opposite to gravity; `floor` is the ground's height along it. The camera at `eye` (3,) looks at `target`.
    """

    robots: tuple[Moving, ...]
    urdf: str
    joints: tuple[str, ...]
    up: Array
    floor: float
    eye: Array
    target: Array


Panel = Plot | Bars | Chart | Lanes | Log | Note | Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class Page:
    """Panels that are looked at together, in groups of one kind; `layout` names their arrangement on a screen."""

    name: str
    groups: Mapping[str, Sequence[Panel]]
    layout: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """A result: its name, report and pages; `sha256` are those of its files by name, `timeline` that of Rerun."""

    name: str
    document: Document
    pages: tuple[Page, ...]
    sha256: Mapping[str, str]
    timeline: str = "time"
