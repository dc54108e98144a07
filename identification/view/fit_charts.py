"""Charts of a fit: passes of the iteration, tests, drive gains, friction over speed."""

import math
from collections.abc import Callable

import numpy as np

from ..design import JointFriction
from ..methods import Fit, Gains, Pass
from ..report import Level
from ..trust import Trust
from .panels import GREEN, GREY, LIGHT, ORANGE, PREDICTED, SHEET, SKY, VERMILLION, Chart, Color, Scale, log10

LOADS = (SKY, ORANGE, VERMILLION)  # low, medium and high load
MAX_DOTS = 400  # of a chart
ROW = 26.0  # pixels of a test
LEVEL_COLORS: dict[Level, Color] = {
    "do not use": VERMILLION,
    "caution": ORANGE,
    "cannot tell": GREY,
    "not made": GREY,
    "ok": SKY,
}


def passes_drawing(fit: Fit) -> Chart:
    """Convergence of the iteration: residual, largest change, condition number and tracking error of each pass."""
    assert fit.iv is not None
    passes, width, strip, left, right = fit.iv.passes, 470.0, 0.24 * SHEET[1], 40.0, 450.0
    last = len(passes)
    across = Scale(left=left + 30, right=right - 30, low=0.5, high=last + 0.5)
    strips: list[tuple[str, Callable[[Pass], float | None], bool, Color]] = [
        ("weighted residual norm", lambda p: p.estimate.residual_norm, False, VERMILLION),
        ("largest change of a parameter [σ]", lambda p: p.change_sigma, True, ORANGE),
        ("condition number of Z'W, unit columns", lambda p: p.estimate.condition_number_scaled, False, LIGHT),
        ("tracking error of the simulation [%]", lambda p: p.z.tracking_percent, False, SKY),
    ]
    settled = f"settled in pass {last}" if passes[-1].settled else f"not settled after {last} passes"
    title, size = f"passes of IV: {fit.status}, {settled}", (width, strip * len(strips) + 30)
    chart = Chart(path=("passes",), title=title, size=size)
    for s, (title, number, logarithmic, color) in enumerate(strips):
        top, bottom = 40 + strip * s, strip * (s + 1) - 25
        chart.label(0.5 * (left + right), top - 36, title, color)
        chart.line(left, bottom, right, bottom, GREY, 0.5)
        points = [(k, x) for k, p in enumerate(passes, 1) if (x := number(p)) is not None and math.isfinite(x)]
        if not points:
            continue
        low, high = min(x for _, x in points), max(x for _, x in points)
        if logarithmic:
            low, high = max(min(low, 0.5), 1e-3), max(high, 1.0)
            up = Scale(left=bottom - 10, right=top + 22, low=low, high=high, by=log10)
            chart.line(left, up(0.5), right, up(0.5), GREY, 0.75)
            chart.label(left - 18, up(0.5) - 10, "σ/2")
        else:
            margin = max(0.5 * (high - low), 0.02 * abs(high), 1e-12)
            up = Scale(left=bottom - 10, right=top + 22, low=low - margin, high=high + margin)
        line = [(across(k), up(x)) for k, x in points]
        if len(line) > 1:
            chart.strokes.append((line, color, 0.75))
        for (x, y), (_, value) in zip(line, points, strict=True):
            chart.dots.append((x, y, color))
            chart.label(x, y - 26, f"{value:.3g}" if value < 1e4 else f"{value:.1e}", color)
    for k, p in enumerate(passes, 1):
        label = f"{k}" if p.z.kind == "simulated" else f"{k}: {p.z.kind}"
        chart.label(across(k), strip * len(strips) - 10, label, GREEN if p.settled else GREY)
    return chart


def trust_drawing(trust: Trust) -> Chart:
    """A row per test: level, figure, its bar from 0 to its limit; below, figures by joint or block and expected values."""
    lines, rows = [line for line in trust.lines if line.figures], 34 + ROW * len(trust.lines)
    (width, height), left = (900.0, SHEET[1]), 90.0
    strip = min(200.0, max(140.0, (height - 40 - rows) / max(1, len(lines))))
    title = "tests: figure, limit | below: value and 95 % interval, green bar expected"
    chart = Chart(path=("tests",), title=title, size=(width, 20 + rows + strip * len(lines)))
    bar = Scale(left=520.0, right=820.0, low=0.0, high=1.0)
    for x, head in ((80.0, "level"), (250.0, "test"), (420.0, "figure"), (bar.left, "0"), (bar.right, "limit")):
        chart.label(x, 2, head)
    chart.line(bar.right, 26, bar.right, rows, GREY, 0.5)
    for number, line in enumerate(trust.lines):
        y, color = 44 + ROW * number, LEVEL_COLORS[line.level]
        chart.label(80.0, y - 10, line.level, color)
        chart.label(250.0, y - 10, line.test, LIGHT)
        chart.line(20.0, y + 0.5 * ROW, width - 20, y + 0.5 * ROW)
        if line.value is not None:
            limit = "" if line.limit is None else f" of {line.limit:.3g}"
            chart.label(420.0, y - 10, f"{line.value:.3g}{limit}", LIGHT)
        if line.value is not None and line.limit:
            share = abs(line.value) / line.limit
            chart.line(bar.left, y, min(bar.left + share * (bar.right - bar.left), width - 30), y, color, 4.0)
    for number, line in enumerate(lines):
        top, bottom, color = rows + strip * number + 50, rows + strip * (number + 1) - 40, LEVEL_COLORS[line.level]
        ends = [f.value + side * f.half_width for f in line.figures for side in (-1, 1)]
        ends += [f.expected for f in line.figures]
        margin = max(0.1 * (max(ends) - min(ends)), 1e-9)
        up = Scale(left=bottom, right=top, low=min(ends) - margin, high=max(ends) + margin)
        across = Scale(left=left, right=width - 20, low=0, high=len(line.figures))
        chart.label(0.5 * width, top - 44, f"{line.test}{f', {line.unit}' if line.unit else ''}: {line.level}", color)
        levels = sorted({f"{x:.3g}" for x in (min(ends), max(ends))})
        chart.ticks_up(up, {float(level): level for level in levels}, (left - 20, width - 20), 40)
        for k, figure in enumerate(line.figures):
            x = across(k + 0.5)
            chart.line(across(k + 0.2), up(figure.expected), across(k + 0.8), up(figure.expected), GREEN, 0.75)
            chart.line(x, up(figure.value - figure.half_width), x, up(figure.value + figure.half_width), color, 1.5)
            chart.dots.append((x, up(figure.value), color))
            chart.label(x, bottom + 6, figure.name, LIGHT)
    return chart


def gains_drawing(gains: Gains) -> Chart:
    """Drive gains by motor: the described one, and the identified one with its 95 % interval, in percent of it."""
    of = np.where(np.isfinite(gains.described), gains.described, gains.values)
    percent, half = 100 * gains.values / of, 100 * gains.half / np.abs(of)
    low, high = min(95.0, float((percent - half).min())), max(105.0, float((percent + half).max()))
    title = "drive gains, green described, ring uncertain"
    chart = Chart(path=("gains",), title=title, size=(560.0, 70.0 + 40 * len(percent)))
    across = Scale(left=325.0, right=510.0, low=max(low, 0.0), high=min(high, 300.0))
    chart.ticks_across(across, {x: f"{x:.0f} %" for x in (across.low, across.high)}, (34, chart.size[1] - 10), 4)
    chart.line(across(100.0), 34, across(100.0), chart.size[1] - 10, GREEN, 1.0)
    for k, motor in enumerate(gains.motors):
        y, color = 60 + 40.0 * k, ORANGE if gains.determined[k] else GREY
        chart.label(60.0, y - 10, motor, LIGHT)
        described = f"{gains.described[k]:.4g} to " if np.isfinite(gains.described[k]) else ""
        chart.label(210.0, y - 10, f"{described}{gains.values[k]:.4g} ± {gains.half[k]:.2g} {gains.units[k]}", color)
        chart.line(across(percent[k] - half[k]), y, across(percent[k] + half[k]), y, color, 1.5)
        (chart.dots if gains.determined[k] else chart.rings).append((across(percent[k]), y, color))
    return chart


def friction_drawing(friction: JointFriction, *, of: str = "") -> Chart:
    """Friction of a joint over its speed: rows as dots, the identified curve with its interval; a color per load."""
    title = f"{friction.joint}{of and f' {of}'} [{friction.unit}, {friction.speed_unit}]"
    path = ("friction", friction.joint, *([of] if of else []))
    chart, (left, top, right, bottom) = Chart(path=path, title=title, size=(470.0, 340.0)), (105.0, 30.0, 430.0, 295.0)
    every = slice(None, None, max(1, len(friction.speed) // MAX_DOTS))
    v, torque, load = friction.speed[every], friction.torque[every], friction.load[every]
    shown = np.concatenate([np.abs(torque), *(np.abs(curve.torque) + curve.half for curve in friction.curves)])
    size = float(np.abs(shown).max(initial=1e-9))
    peak = float(np.abs(friction.curves[0].speed).max(initial=1e-9)) or 1e-9
    across, up = (
        Scale(left=left, right=right, low=-peak, high=peak),
        Scale(left=bottom, right=top, low=-size, high=size),
    )
    chart.ticks_across(across, {x: f"{x:.3g}" for x in (-peak, 0.0, peak)}, (top, bottom), bottom + 5)
    chart.ticks_up(up, {y: f"{y:.3g}" for y in (-size, 0.0, size)}, (left, right), 50.0)
    levels = np.array([curve.load for curve in friction.curves])
    nearest = np.zeros(len(v), dtype=int) if len(levels) == 1 else np.abs(load[:, None] - levels).argmin(axis=1)
    colors = (GREY,) if len(levels) == 1 else LOADS
    chart.cloud.extend((across(x), up(y), colors[k]) for x, y, k in zip(v, torque, nearest, strict=True))
    for k, curve in enumerate(friction.curves):
        color = PREDICTED if len(levels) == 1 else LOADS[k]
        for side in (curve.speed < 0, curve.speed > 0):
            for offset, radius in ((0.0, 1.25), (-1.0, 0.4), (1.0, 0.4)):
                edge = curve.torque + offset * curve.half
                line = [(across(a), up(b)) for a, b in zip(curve.speed[side], edge[side], strict=True)]
                chart.strokes.append((line, color, radius))
        if len(levels) > 1:
            chart.label(left + 60, top + 20 * k, f"load {curve.load:.3g} {friction.unit}", color)
    return chart
