"""The content of a picture as plain data: curves, rows of values, logs, robots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from ..arrays import Array
from ..report import Document
from .axes import Axis
from .colors import Color

Line = tuple[Array, Array]  # t_s (k,), values (k,)
Shape = Literal["dot", "ring", "cross", "tick", "bar"]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Panel:
    """A view: the path of its entities and its title."""

    path: tuple[str, ...]
    title: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A line of a plot; `key` is the last part of its entity's path.

    Lines are drawn in order of their keys, last in front.

    `dashed` where the renderer can: told from grey by its shape too.
    """

    key: str
    color: Color
    line: Line
    name: str = ""
    width: float = 1.0
    dashed: bool = False


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
class Mark:
    """A value in a row, or between two rows, with its interval; a tick is an upright stroke."""

    row: float
    value: float
    color: Color
    half: float = 0.0
    shape: Shape = "dot"


@dataclass(frozen=True, kw_only=True, eq=False)
class Column:
    """Values of rows on an axis of their own, under a head; `lines` are values that all
    rows are compared with.
    """

    head: str
    axis: Axis
    marks: Sequence[Mark]
    lines: Sequence[float] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows(_Panel):
    """A row of values for each name; `legend` explains shapes and colors. Only HTML shows it."""

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
    """Robots in one picture, drawn with the shapes of a `urdf`, whose joints are `joints`.

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
    """Panels that are looked at together, in groups of one kind, or with `tabs` of one thing; Rerun
    shows a group at a time.
    """

    name: str
    groups: Mapping[str, Sequence[Panel]]
    tabs: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """A result: its name, report and pages; `sha256` are those of its files by name, `first` is the
    panel to look at first.
    """

    name: str
    document: Document
    pages: tuple[Page, ...]
    sha256: Mapping[str, str]
    first: Panel | None = None
