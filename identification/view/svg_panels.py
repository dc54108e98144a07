"""Panels as SVG: curves reduced to the pixels of a page, colours as classes that a style sheet sets for light and dark."""

import math
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime, timedelta
from html import escape
from typing import Any

import numpy as np

from ..arrays import Array
from .curves import extremes
from .panels import (
    BLUE,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    PURPLE,
    RESIDUAL,
    SKY,
    VERMILLION,
    YELLOW,
    Bars,
    Chart,
    Color,
    Curve,
    Lanes,
    Plot,
)

COLORS = {"orange": ORANGE, "sky": SKY, "green": GREEN, "yellow": YELLOW, "blue": BLUE, "vermillion": VERMILLION}
COLORS |= {"purple": PURPLE, "grey": GREY, "light": LIGHT}
CLASSES: dict[Color, str] = {color: name for name, color in COLORS.items()}  # of the style sheet
WIDTH, HEIGHT = 480.0, 200.0  # of a plot, in pixels
LEFT, RIGHT, TOP, BOTTOM = 56.0, 472.0, 8.0, 178.0  # edges of its axes
STEPS = 2.0  # coordinates of curves are whole numbers, this many in a pixel
MIN_DATES_S = 2 * 86_400.0  # a shorter axis has times of day


def draw_plot(plot: Plot) -> str:
    """Curves over time as SVG; curves that wait for a click in Rerun are left out."""
    curves = [curve for curve in plot.curves if curve.visible and np.isfinite(curve.line[1]).any()]
    t, x = (np.concatenate([curve.line[k] for curve in curves]) for k in (0, 1))
    x = x[np.isfinite(x)]
    margin = 0.04 * float(np.ptp(x)) or 0.05 * float(np.abs(x).max()) or 1.0
    across, up = (float(t.min()), float(t.max())), (float(x.min()) - margin, float(x.max()) + margin)
    parts = _axes(across, up, plot.start)
    parts += [
        f'<g transform="scale({1 / STEPS:g})">',
        *(_curve(curve, across, up) for curve in sorted(curves, key=lambda curve: curve.key)),
        "</g>",
    ]
    return _svg(plot.title, WIDTH, HEIGHT, parts)


def draw_bars(bars: Bars) -> str:
    """Bars in front of grey ones as SVG."""
    ends = [(left, left + width) for left, width, _ in (bars.front, bars.back)]
    across = min(float(low.min()) for low, _ in ends), max(float(high.max()) for _, high in ends)
    heights = np.concatenate([bars.front[2], bars.back[2], [0.0]])
    up = float(heights.min()), 1.05 * float(heights.max()) or 1.0
    parts = _axes(across, up, None)
    for (left, width, heights), color in ((bars.back, GREY), (bars.front, RESIDUAL)):
        place = zip(_place(left, across, LEFT, RIGHT), _place(heights, up, BOTTOM, TOP), strict=True)
        wide, zero = (RIGHT - LEFT) * width / (across[1] - across[0]), float(_place(np.zeros(1), up, BOTTOM, TOP)[0])
        path = "".join(f"M{_n(x)} {_n(zero)}V{_n(y)}h{_n(wide)}V{_n(zero)}z" for x, y in place)
        parts.append(f'<path class="f {CLASSES[color]}{" soft" if color == GREY else ""}" d="{path}"/>')
    return _svg(bars.title, WIDTH, HEIGHT, parts)


def draw_chart(chart: Chart) -> str:
    """A sheet of strokes, markers and texts as SVG."""
    parts = []
    strokes: dict[tuple[Color, float], list[str]] = {}
    for points, color, radius in chart.strokes:
        strokes.setdefault((color, radius), []).append(_path(points))
    for color, marks in _by_color(chart.cloud).items():
        parts.append(f'<path class="l cloud {CLASSES[color]}" d="{"".join(f"M{_n(x)} {_n(y)}h0" for x, y in marks)}"/>')
    for (color, radius), paths in strokes.items():
        width = max(1.1, 2 * radius) if radius > 0.25 else 0.6
        name = CLASSES[color] + ("" if radius > 0.25 else " soft")
        parts.append(f'<path class="l {name}" stroke-width="{width:g}" d="{"".join(paths)}"/>')
    for name, shape, marks_of in (
        ("l", "m-4-4l8 8m0-8l-8 8", chart.crosses),
        ("l", _RING, chart.rings),
        ("f", _RING, chart.dots),
    ):
        for color, marks in _by_color(marks_of).items():
            path = "".join(f"M{_n(x)} {_n(y)}{shape}" for x, y in marks)
            parts.append(f'<path class="{name} {CLASSES[color]}" stroke-width="1.6" d="{path}"/>')
    parts += [_text(x, y + 14, text, color) for x, y, text, color in chart.labels]
    return _svg(chart.title, *chart.size, parts)


def draw_lanes(lanes: Lanes) -> str:
    """Bands of states over time as SVG, each with its text where it has room."""
    height = 26.0 * len(lanes.lanes)
    across, parts = (0.0, lanes.end_s), list[str]()
    for row, (name, bands) in enumerate(lanes.lanes.items()):
        y = 26.0 * row
        parts.append(_text(4, y + 17, name.replace("_", " "), LIGHT, "start"))
        ends = [*(t_s for t_s, _, _ in bands[1:]), across[1]]
        for (t_s, text, color), stop in zip(bands, ends, strict=True):
            x0, x1 = (float(x) for x in _place(np.array([t_s, stop]), across, 130.0, 2 * RIGHT))
            if text:
                box = f'x="{_n(x0)}" y="{_n(y + 3)}" width="{_n(max(1.5, x1 - x0))}" height="20"'
                parts.append(f'<rect class="f band {CLASSES[color]}" {box}><title>{escape(text)}</title></rect>')
            if text and x1 - x0 > 8 * len(text):
                parts.append(_text(x0 + 4, y + 17, text, LIGHT, "start"))
    marks = _place(np.array(_ticks(*across, 8)), across, 130.0, 2 * RIGHT)
    parts += [_text(float(x), height + 14, f"{t:g}", GREY) for x, t in zip(marks, _ticks(*across, 8), strict=True)]
    return _svg(lanes.title, 2 * WIDTH, height + 20, parts)


_RING = "m-3.2 0a3.2 3.2 0 1 0 6.4 0a3.2 3.2 0 1 0-6.4 0"


def _svg(title: str, width: float, height: float, parts: Iterable[str]) -> str:
    label = f'role="img" aria-label="{escape(title)}" viewBox="0 0 {width:g} {height:g}"'
    return f'<svg {label} style="max-width:{1.35 * width if width < 600 else width:.0f}px">{"".join(parts)}</svg>'


def _axes(across: tuple[float, float], up: tuple[float, float], start: datetime | None) -> list[str]:
    """Grid lines with numbers; with a `start`, dates below."""
    parts, lines = list[str](), ""
    levels, times = _ticks(*up, 5), _ticks(*across, 6 if start is None else 3)
    for value, y in zip(levels, _place(np.array(levels), up, BOTTOM, TOP), strict=True):
        lines += f"M{LEFT:g} {_n(y)}H{RIGHT:g}"
        parts.append(_text(LEFT - 6, float(y) + 4, _number(value, levels), GREY, "end"))
    for value, x in zip(times, _place(np.array(times), across, LEFT, RIGHT), strict=True):
        lines += f"M{_n(x)} {TOP:g}V{BOTTOM:g}"
        text = _number(value, times)
        if start is not None:
            date = start.astimezone(UTC) + timedelta(seconds=value)
            text = date.strftime("%Y-%m-%d" if across[1] - across[0] > MIN_DATES_S else "%m-%d %H:%M")
        parts.append(_text(min(float(x), RIGHT - 4 * len(text)), HEIGHT - 6, text, GREY))
    return [f'<path class="l soft grey" stroke-width="0.6" d="{lines}"/>', *parts]


def _ticks(low: float, high: float, most: int) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten within the edges, at most `most`."""
    if not high > low:
        return [low]
    least = (high - low) / most
    power = 10.0 ** math.floor(math.log10(least))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least * (1 - 1e-9))
    return [step * k + 0.0 for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _number(value: float, ticks: Sequence[float]) -> str:
    """A tick with the digits that tell it from its neighbours."""
    step = ticks[1] - ticks[0] if len(ticks) > 1 else abs(value) or 1.0
    if not 1e-4 < step < 1e5:
        return f"{value:.3g}"
    return f"{value:.{max(0, -math.floor(math.log10(step) + 1e-9))}f}"


def _place(x: Array, edges: tuple[float, float], low: float, high: float) -> Array:
    """Positions in pixels of values between edges."""
    return low + (high - low) * (x - edges[0]) / (edges[1] - edges[0] or 1.0)


def _curve(curve: Curve, across: tuple[float, float], up: tuple[float, float]) -> str:
    """A curve by its minimum and maximum in each column of pixels."""
    known = np.isfinite(curve.line[1])
    t, x = curve.line[0][known], curve.line[1][known]
    share = (t[-1] - t[0]) / ((across[1] - across[0]) or 1.0)
    k = extremes(x, max(1, math.ceil(len(x) / max(1.0, share * (RIGHT - LEFT)))))
    places = _place(t[k], across, LEFT, RIGHT), _place(x[k], up, BOTTOM, TOP)
    xy = np.rint(STEPS * np.stack(places, axis=1)).astype(int)
    steps = " ".join(f"{dx} {dy}" for dx, dy in np.diff(xy, axis=0).tolist() if dx or dy).replace(" -", "-")
    if not steps:  # one moment, or a constant: a point that is seen
        steps = f"{STEPS:g} 0"
    look = f"l {CLASSES[curve.color]}{' dash' if curve.dashed else ''}"
    return f'<path class="{look}" stroke-width="{max(1.2, 0.8 * curve.width):g}" d="M{xy[0, 0]} {xy[0, 1]}l{steps}"/>'


def _path(points: Any) -> str:
    """A stroke through points, without those that lie on the pixel of the one before."""
    xy = np.rint(10 * np.asarray(points, dtype=float)) / 10
    moved = np.r_[True, (np.diff(xy, axis=0) != 0).any(axis=1)] if len(xy) else []
    return "M" + "L".join(f"{_n(x)} {_n(y)}" for x, y in xy[moved]) if len(xy) else ""


def _by_color(marks: Iterable[tuple[float, float, Color]]) -> dict[Color, list[tuple[float, float]]]:
    found: dict[Color, list[tuple[float, float]]] = {}
    for x, y, color in marks:
        found.setdefault(color, []).append((x, y))
    return found


def _text(x: float, y: float, text: str, color: Color, anchor: str = "middle") -> str:
    return f'<text class="f {CLASSES[color]} {anchor}" x="{_n(x)}" y="{_n(y)}">{escape(text)}</text>'


def _n(x: float) -> str:
    """A coordinate with one decimal at most."""
    return f"{x:.1f}".removesuffix(".0")


DRAWERS: dict[type, Callable[[Any], str]] = {Plot: draw_plot, Bars: draw_bars, Chart: draw_chart, Lanes: draw_lanes}
