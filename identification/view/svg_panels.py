"""Panels as SVG: curves reduced to the pixels of a page, colours as classes that a style sheet
sets for light and dark.
"""

import math
from collections.abc import Iterable
from html import escape

import numpy as np

from ..arrays import Array
from .axes import Axis, decades, linear, logarithmic
from .colors import CLASSES, GREY, LIGHT, Color
from .curves import extremes
from .panels import Curve, Graph, Mark, Panel, Rows

WIDTH, HEIGHT = 480.0, 200.0  # of a plot, in pixels
LEFT, RIGHT, TOP, BOTTOM = 56.0, 472.0, 8.0, 178.0  # edges of its axes
SHEET, WIDE = 560.0, 1180.0  # widths of rows with two or three columns, and with more
HEAD, PITCH = 36.0, 18.0  # heights of the heads of rows, and of a row
STEPS = 2.0  # coordinates of curves are whole numbers, this many in a pixel


def draw_graph(graph: Graph) -> str:
    """Curves with their axes."""
    curves = [curve for curve in graph.curves if np.isfinite(curve.line[1]).any()]
    points = np.concatenate(
        [
            *(np.stack(c.line, axis=1) for c in curves),
            *(dots for dots, _ in graph.dots),
            np.zeros((0, 2)),
        ]
    )
    known = points[np.isfinite(points).all(axis=1)]
    t, x = (known if len(known) else np.zeros((1, 2))).T  # of a joint that stands still
    if graph.log:
        axes = (
            logarithmic(t.min(), t.max(), 6),
            decades([max(x.min(), 1e-12 * x.max()), x.max()], 6),
        )
    else:
        margin = 0.04 * float(np.ptp(x)) or 0.05 * float(np.abs(x).max()) or 1.0
        axes = linear(t.min(), t.max(), 6), linear(x.min() - margin, x.max() + margin, 5)
    parts = _grid(*axes)
    inside = ((mark, text) for mark, text in graph.marks.items() if t.min() < mark < t.max())
    for number, (mark, text) in enumerate(inside):
        at = float(axes[0].place(mark, LEFT, RIGHT))
        parts.append(f'<path class="l grey" stroke-width="1.5" d="M{_n(at)} {TOP:g}V{BOTTOM:g}"/>')
        parts.append(_text(at - 4, BOTTOM - 24 + 16 * number, text, GREY, "end"))
    for dots, color in graph.dots:
        path = "".join(
            f"M{_n(x)} {_n(y)}h0"
            for x, y in zip(*_places(axes, (dots[:, 0], dots[:, 1])), strict=True)
        )
        parts.append(f'<path class="l cloud {CLASSES[color]}" d="{path}"/>')
    parts += [
        f'<g transform="scale({1 / STEPS:g})">',
        *(_curve(curve, axes) for curve in sorted(curves, key=lambda curve: curve.key)),
        "</g>",
    ]
    return _svg(graph.title, WIDTH, HEIGHT, parts)


def draw_rows(rows: Rows) -> str:
    """Values by row: names at the left, then the columns with their heads, ticks and lines."""
    width, count = width_of(rows), len(rows.names)
    left, bottom = 20 + 7.0 * max(len(name) for name, _ in rows.names), HEAD + PITCH * count
    bands = "".join(
        f"M0 {HEAD + PITCH * row:g}H{width:g}v{PITCH:g}H0z" for row in range(0, count, 2)
    )
    parts = [
        f'<path class="band" d="{bands}"/>',
        *(
            _text(4, HEAD + PITCH * row + 13, name, color, "start")
            for row, (name, color) in enumerate(rows.names)
        ),
    ]
    step = (width - left) / len(rows.columns)
    for number, column in enumerate(rows.columns):
        edges = left + step * number + 16, left + step * (number + 1) - 18
        parts.append(_text(0.5 * sum(edges), 13, column.head, LIGHT))
        for value in [*column.axis.ticks, *column.lines]:
            line = f"M{_n(float(column.axis.place(value, *edges)))} {HEAD:g}V{bottom:g}"
            width_of_line = 1.5 if value in column.lines else 0.6
            parts.append(f'<path class="l soft grey" stroke-width="{width_of_line:g}" d="{line}"/>')
        parts += [
            _text(float(column.axis.place(value, *edges)), HEAD - 5, text, GREY)
            for value, text in column.axis.ticks.items()
        ]
        parts += [_mark(mark, column.axis, edges) for mark in column.marks]
    return _svg(rows.title, width, bottom + 4, parts)


def width_of(panel: Panel) -> float:
    """Pixels of a chart on a page."""
    return (
        {1: WIDTH, 2: SHEET, 3: SHEET}.get(len(panel.columns), WIDE)
        if isinstance(panel, Rows)
        else WIDTH
    )


def _mark(mark: Mark, axis: Axis, edges: tuple[float, float]) -> str:
    """A value's shape and interval."""
    y = HEAD + PITCH * (mark.row + 0.5)
    low, x, high = axis.place(
        [mark.value - mark.half, mark.value, mark.value + mark.half], *edges
    ).tolist()
    color, zero = CLASSES[mark.color], float(axis.place(max(axis.low, 0.0), *edges))
    if mark.shape == "bar":
        seen = math.copysign(max(1.5, abs(x - zero)), x - zero)
        return f'<path class="l {color}" stroke-width="4" d="M{_n(zero)} {_n(y)}h{_n(seen)}"/>'
    interval = f"M{_n(low)} {_n(y)}H{_n(high)}" if high - low > 2 else ""
    kind, shape = {
        "dot": ("f", _RING), "ring": ("l", _RING), "cross": ("l", "m-4-4l8 8m0-8l-8 8"),
        "tick": ("l", "m0-8v16")
    }[mark.shape]  # fmt: skip
    line = f'<path class="l {color}" stroke-width="2.2" d="{interval}"/>' if interval else ""
    return f'{line}<path class="{kind} {color}" stroke-width="1.6" d="M{_n(x)} {_n(y)}{shape}"/>'


_RING = "m-3.2 0a3.2 3.2 0 1 0 6.4 0a3.2 3.2 0 1 0-6.4 0"


def _svg(title: str, width: float, height: float, parts: Iterable[str]) -> str:
    label = f'role="img" aria-label="{escape(title)}" viewBox="0 0 {width:g} {height:g}"'
    return (
        f"<svg {label} "
        f'style="max-width:{1.35 * width if width < SHEET else width:.0f}px">{"".join(parts)}</svg>'
    )


def _grid(across: Axis, up: Axis) -> list[str]:
    """Lines and texts at the ticks."""
    parts, lines = list[str](), ""
    for value, text in up.ticks.items():
        y = float(up.place(value, BOTTOM, TOP))
        lines += f"M{LEFT:g} {_n(y)}H{RIGHT:g}"
        parts.append(_text(LEFT - 6, y + 4, text, GREY, "end"))
    for value, text in across.ticks.items():
        x = float(across.place(value, LEFT, RIGHT))
        lines += f"M{_n(x)} {TOP:g}V{BOTTOM:g}"
        parts.append(_text(min(x, RIGHT - 4 * len(text)), HEIGHT - 6, text, GREY))
    return [f'<path class="l soft grey" stroke-width="0.6" d="{lines}"/>', *parts]


def _places(axes: tuple[Axis, Axis], xy: tuple[Array, Array]) -> tuple[Array, Array]:
    """Points in pixels."""
    return axes[0].place(xy[0], LEFT, RIGHT), axes[1].place(xy[1], BOTTOM, TOP)


def _curve(curve: Curve, axes: tuple[Axis, Axis]) -> str:
    """A curve by its minimum and maximum in each column of pixels."""
    known = np.isfinite(curve.line[1])
    x, y = _places(axes, (curve.line[0][known], curve.line[1][known]))
    k = extremes(y, max(1, math.ceil(len(y) / max(1.0, float(np.ptp(x))))))
    xy = np.rint(STEPS * np.stack([x[k], y[k]], axis=1)).astype(int)
    steps = " ".join(f"{dx} {dy}" for dx, dy in np.diff(xy, axis=0).tolist() if dx or dy).replace(
        " -", "-"
    )
    if not steps:  # one moment, or a constant: a point that is seen
        steps = f"{STEPS:g} 0"
    look = f"l {CLASSES[curve.color]}{' dash' if curve.dashed else ''}"
    return (
        f'<path class="{look}" stroke-width="{max(1.2, 0.8 * curve.width):g}" d="M{xy[0, 0]} '
        f'{xy[0, 1]}l{steps}"/>'
    )


def _text(x: float, y: float, text: str, color: Color, anchor: str = "middle") -> str:
    return (
        f'<text class="f {CLASSES[color]} {anchor}" x="{_n(x)}" y="{_n(y)}">{escape(text)}</text>'
    )


def _n(x: float) -> str:
    """A coordinate with one decimal at most."""
    return f"{x:.1f}".removesuffix(".0")
