"""What a viewer is to show, as plain data: curves over time, bars, charts, lanes, notes, robots; `viewer` shows it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..arrays import Array

Color = tuple[int, int, int]
Line = tuple[Array, Array]  # t_s (k,), values (k,)
Ticks = Mapping[float, str]  # of a scale: values and their texts
Steps = tuple[Array, float, Array]  # left edges (k,), width, heights (k,)

# Okabe and Ito's colors, told apart by the color-blind too (Color Universal Design, 2008), on a dark ground and a light one.
ORANGE, SKY, GREEN, YELLOW = (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66)
BLUE, VERMILLION, PURPLE = (0, 114, 178), (213, 94, 0), (204, 121, 167)
GREY, LIGHT = (140, 140, 140), (205, 205, 205)
# One color, one meaning on all pages.
MEASURED, REFERENCE, SIMULATED, PREDICTED, RESIDUAL = GREY, GREEN, SKY, ORANGE, VERMILLION
JOINTS = (SKY, ORANGE, GREEN, VERMILLION, PURPLE, YELLOW, BLUE, GREY)  # in turn


@dataclass(frozen=True, kw_only=True, eq=False)
class _Panel:
    """What has a view of its own: the path of its entities and the view's title."""

    path: tuple[str, ...]
    title: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A line of a plot; `key` ends its entity's path. Lines are drawn in the order of their keys, the last in front."""

    key: str
    color: Color
    line: Line
    name: str = ""
    width: float = 1.0
    visible: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class Plot(_Panel):
    """Curves over time."""

    curves: tuple[Curve, ...]
    legend: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class Bars(_Panel):
    """Bars in front of grey ones, over what their edges measure."""

    front: Steps
    back: Steps


@dataclass(frozen=True, kw_only=True, eq=False)
class Chart(_Panel):
    """Strokes (points (k, 2), color, radius), markers and labels on a sheet of `size` pixels, y downwards: any other chart.

    Markers are `dots`, and for least squares `crosses`; small ones behind the strokes are the `cloud`.
    """

    size: tuple[float, float]
    strokes: list[tuple[Any, Color, float]] = field(default_factory=list)
    dots: list[tuple[float, float, Color]] = field(default_factory=list)
    crosses: list[tuple[float, float, Color]] = field(default_factory=list)
    cloud: list[tuple[float, float, Color]] = field(default_factory=list)
    labels: list[tuple[float, float, str, Color]] = field(default_factory=list)

    def line(self, x0: float, y0: float, x1: float, y1: float, color: Color = GREY, radius: float = 0.25) -> None:
        """A straight stroke."""
        self.strokes.append((((x0, y0), (x1, y1)), color, radius))

    def label(self, x: float, y: float, text: str, color: Color = GREY) -> None:
        """Text whose top is at y, its middle at x."""
        self.labels.append((x, y, text, color))

    def ticks_across(self, scale: "Scale", ticks: "Ticks", edges: tuple[float, float], label_y: float) -> None:
        """Upright lines between two edges at the ticks of a scale from left to right, with their texts."""
        for value, text in ticks.items():
            self.line(scale(value), edges[0], scale(value), edges[1])
            self.label(scale(value), label_y, text)

    def ticks_up(self, scale: "Scale", ticks: "Ticks", edges: tuple[float, float], label_x: float) -> None:
        """Level lines between two edges at the ticks of a scale from bottom to top, with their texts."""
        for value, text in ticks.items():
            self.line(edges[0], scale(value), edges[1], scale(value))
            self.label(label_x, scale(value) - 10, text)


@dataclass(frozen=True, kw_only=True, eq=False)
class Scale:
    """Where a number goes between two edges of the sheet, by way of a monotonic function; beyond them it stays there."""

    left: float
    right: float
    low: float
    high: float
    by: Callable[[float], float] = float

    @property
    def middle(self) -> float:
        """Between the edges, in pixels."""
        return 0.5 * (self.left + self.right)

    def __call__(self, value: float) -> float:
        """Where the number goes, in pixels."""
        low, high = self.by(self.low), self.by(self.high)
        return self.left + (self.right - self.left) * min(1.0, max(0.0, (self.by(value) - low) / (high - low or 1.0)))


def log10(x: float) -> float:
    """The decimal logarithm, defined for 0 too."""
    return math.log10(max(x, 1e-300))


@dataclass(frozen=True, kw_only=True, eq=False)
class Lanes(_Panel):
    """Bands over time: by lane, the states (t_s, text, color) it changes to; an empty text ends a band."""

    lanes: Mapping[str, Sequence[tuple[float, str, Color]]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Log(_Panel):
    """Lines of text at times: (t_s, whether it is a warning, text)."""

    lines: Sequence[tuple[float, bool, str]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Note(_Panel):
    """A page of Markdown."""

    text: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Moving:
    """A robot in motion: at t_s (K,) its joints' positions q (K, n)."""

    key: str
    t_s: Array
    q: Array
    ghost: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene(_Panel):
    """Robots in one picture, made of the shapes of a `urdf`, whose joints are `joints`.

    `up` (3,) is the direction against gravity, `floor` the height along it of the ground; the eye stands at `eye` (3,) and
    looks at `target`.
    """

    robots: tuple[Moving, ...]
    urdf: str
    joints: tuple[str, ...]
    up: Array
    floor: float
    eye: Array
    target: Array


Panel = Plot | Bars | Chart | Lanes | Log | Note | Scene
