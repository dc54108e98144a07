"""The content of pages as plain data, and its colors.

The content is curves, rows of values on axes, logs, and robots.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..report import Document

Line = tuple[Array, Array]  # t_s (k,), values (k,)
Shape = Literal["dot", "ring", "cross", "tick", "bar"]
Color = tuple[int, int, int]

# Okabe and Ito's colors, distinguishable for the color-blind (Color Universal Design, 2008), on
# dark and light background.
ORANGE, SKY, GREEN, YELLOW = (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66)
BLUE, VERMILLION, PURPLE = (0, 114, 178), (213, 94, 0), (204, 121, 167)
GREY, LIGHT = (140, 140, 140), (205, 205, 205)
# Like grey and orange, but the page has shades of them that can be told apart when they overlap.
MEASURED, PREDICTED = (141, 141, 141), (230, 160, 0)
REFERENCE, SIMULATED, RESIDUAL = GREEN, SKY, VERMILLION
JOINTS = (SKY, ORANGE, GREEN, VERMILLION, PURPLE, YELLOW, BLUE, GREY)  # in turn
COMPARED = (PURPLE, GREEN)  # the parameter sets that a fit is compared with
COMPARED_FITS = (ORANGE, PURPLE)  # two fits, as their parameters
CLASSES: dict[Color, str] = {  # of the style sheet, which has a shade of each for light and dark
    ORANGE: "orange", SKY: "sky", GREEN: "green", YELLOW: "yellow", BLUE: "blue",
    VERMILLION: "vermillion",
    PURPLE: "purple", GREY: "grey", LIGHT: "light", MEASURED: "measured", PREDICTED: "model",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class _Panel:
    """A view: the path of its entities and its title."""

    path: tuple[str, ...]
    title: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A line of a plot; `key` is the last part of its entity's path.

    Lines are drawn in order of their keys, last in front.

    A `dashed` line is dashed where the renderer can do it, so that its shape too distinguishes it
    from grey. A line `below` has axes of its own below the others, over the same time.
    """

    key: str
    color: Color
    line: Line
    name: str = ""
    width: float = 1.0
    dashed: bool = False
    below: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Graph(_Panel):
    """Curves over another quantity than time, on logarithmic axes if `log`; only HTML shows it.

    Behind the curves `dots`, points (k, 2) of a color; `marks` are texts at vertical lines.
    """

    curves: tuple[Curve, ...]
    legend: bool = True
    log: bool = False
    dots: Sequence[tuple[Array, Color]] = ()
    marks: Mapping[float, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, eq=False)
class Plot(Graph):
    """Curves over time in seconds."""


@dataclass(frozen=True, kw_only=True)
class Axis:
    """A scale through the monotonic function `by`, with texts at its `ticks`."""

    low: float
    high: float
    ticks: Mapping[float, str]
    by: Callable[[Array], Array] = np.asarray

    def place(self, x: ArrayLike, left: float, right: float) -> Array:
        """Return positions between two edges; values beyond the ends are drawn at the ends."""
        low, high = self.by(np.array([self.low, self.high]))
        share = np.clip(
            (self.by(np.asarray(x, dtype=float)) - low) / ((high - low) or 1.0), 0.0, 1.0
        )
        return np.asarray(left + (right - left) * share)


def linear(low: float, high: float, most: int) -> Axis:
    """Return an axis between two ends, with at most `most` ticks.

    The ticks are at multiples of 1, 2 or 5 times a power of ten.
    """
    if not high > low:
        return Axis(low=low, high=high, ticks={low: f"{low:.3g}"})
    least = (high - low) / most
    power = 10.0 ** math.floor(math.log10(least))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least * (1 - 1e-9))
    values = [step * k + 0.0 for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
    form = f".{max(0, -math.floor(math.log10(step) + 1e-9))}f" if 1e-7 < step < 1e5 else ".3g"
    return Axis(low=low, high=high, ticks={value: f"{value:{form}}" for value in values})


def logarithmic(low: float, high: float, most: int) -> Axis:
    """Return an axis between two ends above zero, with ticks at powers of ten."""
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    return Axis(
        low=low,
        high=high,
        ticks={
            10.0**power: f"{10.0**power:g}" if -3 <= power <= 4 else f"1e{power}"
            for power in range(first, last + 1, max(1, math.ceil((last - first) / most)))
        },
        by=lambda x: np.log10(np.maximum(x, low)),
    )


def decades(values: ArrayLike, most: int) -> Axis:
    """Return a logarithmic axis of whole powers of ten around values above zero."""
    low, high = float(np.min(values)), float(np.max(values))
    return logarithmic(
        10.0 ** math.floor(math.log10(low)), 10.0 ** math.ceil(math.log10(high)), most
    )


@dataclass(frozen=True, kw_only=True)
class Mark:
    """A value in a row, or between two rows, with its interval; a tick is an upright stroke."""

    row: float
    value: float
    color: Color
    half: float = 0.0
    shape: Shape = "dot"


@dataclass(frozen=True, kw_only=True, eq=False)
class Column:
    """Values of rows on an axis of their own, under a head.

    `lines` are values that all rows are compared with.
    """

    head: str
    axis: Axis
    marks: Sequence[Mark]
    lines: Sequence[float] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows(_Panel):
    """A row of values for each name; `legend` explains shapes and colors."""

    names: Sequence[tuple[str, Color]]
    columns: Sequence[Column]
    legend: Sequence[tuple[str, Color]] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Log(_Panel):
    """Lines of text over time: (t_s, is a warning, text)."""

    lines: Sequence[tuple[float, bool, str]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Moving:
    """A robot with the joint positions q (K, n) at t_s (K,)."""

    key: str
    t_s: Array
    q: Array
    ghost: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene(_Panel):
    """Robots in one view, drawn with the shapes of a `urdf`, whose joints are `joints`.

    `up` (3,) is opposite to gravity; `floor` is the ground's height along it. The camera at `eye`
    (3,) looks at `target`.
    """

    robots: tuple[Moving, ...]
    urdf: str
    joints: tuple[str, ...]
    up: Array
    floor: float
    eye: Array
    target: Array


Panel = Graph | Rows | Log | Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class Page:
    """Panels of one view, in groups of one kind, or with `tabs` of one thing.

    Rerun shows a group at a time.
    """

    name: str
    groups: Mapping[str, Sequence[Panel]]
    tabs: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """A result with its name, report and views.

    `sha256` are those of its files by name, `first` is the panel to look at first. A page has the
    panels of `front` in its place, and others `beside` the sections with these titles.
    """

    name: str
    document: Document
    pages: tuple[Page, ...]
    sha256: Mapping[str, str]
    first: Panel | None = None
    front: Page | None = None
    beside: Mapping[str, Panel] = field(default_factory=dict)

    @property
    def figures(self) -> tuple[Panel, ...]:
        """The main panels: those of `front`, and those beside sections."""
        groups = () if self.front is None else self.front.groups.values()
        return (*(panel for group in groups for panel in group), *self.beside.values())
