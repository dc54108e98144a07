"""Pages of experiments: a reference with its limits and the intervals expected of it; friction over speed; a fleet's drift."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun.blueprint as rrb

from ..arrays import Array
from ..design import Excitation, JointFriction, friction_of_joints
from ..methods import Fit
from ..report import Document
from ..study import Drift
from .curves import drift_plots
from .panels import (
    GREY,
    LIGHT,
    ORANGE,
    PREDICTED,
    REFERENCE,
    SKY,
    VERMILLION,
    Chart,
    Curve,
    Plot,
    Scale,
    log10,
    report_note,
)
from .rerun_panels import Show, shown_text
from .robot_drawing import excitation_scene

MOST_DOTS = 400  # of a drawing
LOADS = (SKY, ORANGE, VERMILLION)  # a low load, the middle, a high one


def excitation_plots(excitation: Excitation) -> list[list[Plot]]:
    """By joint: position, speed and, where it is known, torque over one period, with their limits."""
    e = excitation
    t_s, q, dq, tau = e.curves()
    efforts = dict(zip(e.limits.effort.names, e.limits.effort.limits, strict=True))
    out = []
    for j, joint in enumerate(e.robot.joints):
        unit, speed = joint.position_unit, joint.si("speed")
        plots = [
            _plot("q", joint.name, unit, (t_s, q[:, j]), joint.si("position")),
            _plot("dq", joint.name, f"{unit}/s", (t_s, dq[:, j]), (-speed, speed)),
        ]
        if tau is not None:
            limit = efforts.get(f"joint {joint.name}")
            limits = None if limit is None else (-limit, limit)
            plots.append(_plot("torque", joint.name, e.robot.effort_units[j], (t_s, tau[:, j]), limits))
        out.append(plots)
    return out


def _plot(quantity: str, joint: str, unit: str, line: tuple[Array, Array], limits: tuple[float, float] | None) -> Plot:
    ends = line[0][[0, -1]]
    curves = [Curve(key="reference", color=REFERENCE, line=line)]
    for key, limit in zip(("low", "high"), limits or (), strict=False):
        curves.append(Curve(key=key, color=VERMILLION, line=(ends, np.full(2, limit)), width=0.75))
    return Plot(path=(quantity, joint), title=f"{quantity} {joint}, {unit}", curves=tuple(curves), legend=False)


def intervals_drawing(excitation: Excitation) -> Chart:
    """Half the expected 95 % interval of every parameter, and below it in grey that of the plain reference."""
    e, names = excitation, excitation.base.names
    columns = 1 if e.base.b <= 20 else 2
    rows, pitch, width = -(-len(names) // columns), 17.0 if e.base.b > 12 else 24.0, 540.0 / columns
    height = 54 + pitch * rows
    title = "expected ± 95 %: orange this reference, grey the plain one"
    chart = Chart(path=("intervals",), title=title, size=(540.0, height + 20))
    both = np.concatenate([e.half, e.plain_half])
    low, high = math.floor(log10(float(both.min()))), math.ceil(log10(float(both.max())))
    scales = [
        Scale(left=width * c + 60, right=width * (c + 1) - 15, low=10.0**low, high=10.0**high, by=log10)
        for c in range(columns)
    ]
    for scale in scales:
        powers = {10.0**power: f"1e{power}" for power in range(low, high + 1)}
        chart.ticks_across(scale, powers, (44, height), 22)
    chart.label(270.0, 0.0, "half the 95 % interval, SI units", LIGHT)
    for i, name in enumerate(names):
        c, row = divmod(i, rows)
        y = 58 + pitch * row
        chart.label(width * c + 30, y - 9, name, LIGHT)
        for half, level, color in ((e.half[i], y - 2, ORANGE), (e.plain_half[i], y + 3, GREY)):
            chart.line(scales[c].left, level, scales[c](float(half)), level, color, 1.75)
    return chart


def friction_drawing(friction: JointFriction, *, of: str = "") -> Chart:
    """Friction of a joint over its speed: rows as dots, the identified curve and its interval; colors are of the load."""
    title = f"{friction.joint}{of and f', {of}'}: friction [{friction.unit}] over speed [{friction.speed_unit}]"
    path = ("friction", friction.joint, *([of] if of else []))
    chart, (left, top, right, bottom) = Chart(path=path, title=title, size=(470.0, 340.0)), (70.0, 30.0, 440.0, 300.0)
    every = slice(None, None, max(1, len(friction.speed) // MOST_DOTS))
    v, torque, load = friction.speed[every], friction.torque[every], friction.load[every]
    shown = np.concatenate([np.abs(torque), *(np.abs(curve.torque) + curve.half for curve in friction.curves)])
    size = float(np.abs(shown).max(initial=1e-9))
    peak = float(np.abs(friction.curves[0].speed).max(initial=1e-9)) or 1e-9
    across, up = (
        Scale(left=left, right=right, low=-peak, high=peak),
        Scale(left=bottom, right=top, low=-size, high=size),
    )
    chart.ticks_across(across, {x: f"{x:.3g}" for x in (-peak, 0.0, peak)}, (top, bottom), bottom + 5)
    chart.ticks_up(up, {y: f"{y:.3g}" for y in (-size, 0.0, size)}, (left, right), 35.0)
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


def excitation_page(show: Show, excitation: Excitation, document: Document) -> list[Any]:
    """One page: the reference joint by joint with its limits, the robot that moves along it, the expected intervals."""
    motion = [rrb.Vertical(*map(show, plots)) for plots in excitation_plots(excitation)]
    side = rrb.Vertical(show(intervals_drawing(excitation)), show(report_note(document)), row_shares=[3, 2])
    seen = rrb.Vertical(show(excitation_scene(excitation)), rrb.Horizontal(*motion), row_shares=[2, 3])
    return [rrb.Horizontal(seen, side, column_shares=[5, 2], name="excitation")]


def friction_page(show: Show, fits: Mapping[str, Fit]) -> Any:
    """Friction of each joint over its speed, of one fit or several by name, side by side."""
    drawings = [
        show(friction_drawing(friction, of=name)) for name, fit in fits.items() for friction in friction_of_joints(fit)
    ]
    n = len(drawings) // len(fits)
    order = [drawings[j + n * k] for j in range(n) for k in range(len(fits))]
    columns = min(3, n) if len(fits) == 1 else 2 if n < 3 else 4
    return rrb.Grid(*order, grid_columns=columns, name="friction")


def fleet_pages(show: Show, series: Sequence[Drift], document: Document) -> list[Any]:
    """By robot: charts in tabs, those with something beyond the limits first; beside them the report."""
    report, pages = show(report_note(document)), []
    for drift in series:
        views = [show(plot) for plot in drift_plots(drift)]
        starts = range(0, len(views), 16)
        tabs = [rrb.Grid(*views[k : k + 16], grid_columns=4, name=f"from {k + 1}") for k in starts]
        charts = rrb.Tabs(*tabs, active_tab=0)
        pages.append(rrb.Horizontal(charts, report, column_shares=[5, 2], name=shown_text(drift.name)))
    return pages or [rrb.Horizontal(report, name="report")]
