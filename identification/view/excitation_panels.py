"""A reference with its limits, and the intervals that are expected of it."""

import math

import numpy as np

from ..arrays import Array
from ..excitation import Excitation
from .panels import GREY, LIGHT, ORANGE, REFERENCE, VERMILLION, Curve, Drawing, Plot, Scale, Sheet, log10


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


def intervals_drawing(excitation: Excitation) -> Drawing:
    """Half the expected 95 % interval of every parameter, and below it in grey that of the plain reference."""
    e, sheet = excitation, Sheet()
    names, columns = e.base.names, 1 if e.base.b <= 20 else 2
    rows, pitch, width = -(-len(names) // columns), 17.0 if e.base.b > 12 else 24.0, 540.0 / columns
    height = 54 + pitch * rows
    both = np.concatenate([e.half, e.plain_half])
    low, high = math.floor(log10(float(both.min()))), math.ceil(log10(float(both.max())))
    scales = [
        Scale(left=width * c + 60, right=width * (c + 1) - 15, low=10.0**low, high=10.0**high, by=log10)
        for c in range(columns)
    ]
    for scale in scales:
        for power in range(low, high + 1):
            sheet.line(scale(10.0**power), 44, scale(10.0**power), height)
            sheet.labels.append((scale(10.0**power), 22, f"1e{power}", GREY))
    sheet.labels.append((270.0, 0.0, "half the 95 % interval, SI units", LIGHT))
    for i, name in enumerate(names):
        c, row = divmod(i, rows)
        y = 58 + pitch * row
        sheet.labels.append((width * c + 30, y - 9, name, LIGHT))
        for half, level, color in ((e.half[i], y - 2, ORANGE), (e.plain_half[i], y + 3, GREY)):
            sheet.line(scales[c].left, level, scales[c](float(half)), level, color, 1.75)
    title = "expected ± 95 %: orange this reference, grey the plain one"
    return sheet.drawing(("intervals",), title, (540.0, height + 20))
