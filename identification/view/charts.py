"""Charts of parameters with intervals, of studies and of excitations."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from ..design import Excitation
from ..report import ParameterSet, differences
from ..study import Run
from .panels import GREEN, GREY, LIGHT, ORANGE, PURPLE, SHEET, VERMILLION, Chart, Color, Scale, log10

COMPARED = (PURPLE, GREEN)  # colors of the parameter sets that a fit is compared with
MAX_SIGMAS_SHOWN = 6.0  # larger differences are drawn at the edge of their chart
STUDY_SHEET = (1140.0, 960.0)  # pixels of a study's chart, next to its report
MAX_TRUSTED_SIGMAS = 3.0  # limit of a difference


def parameter_drawing(own: ParameterSet, others: Sequence[ParameterSet]) -> Chart:
    """Every parameter's value with its 95 % interval, and the values of other sets, in one or two columns."""
    names, sets = list(own.parameters), [own, *others]
    columns = 1 if len(names) <= 20 else 2
    rows, pitch = -(-len(names) // columns), 17.0 if len(names) > 12 else 24.0
    width, height = 540.0 / columns, 30 + pitch * rows
    title = f"{own.label} ± 95 %: orange dot essential, grey ring not{_marks(others)}"
    chart = Chart(path=("parameters",), title=title, size=(540.0, height + 30))
    scale_of, ticks, axis = _value_scale(sets, names, 3 if columns == 1 else 2)
    chart.label(270.0, height + 4, axis)
    for c in range(columns):
        place = scale_of(width * c + 55, width * (c + 1) - 20)
        _value_axis(chart, place, ticks, 22, height)
        for row, name in enumerate(names[c * rows : (c + 1) * rows]):
            y = 34 + pitch * row
            chart.label(width * c + 27, y - 9, name, _color(own, name))
            _value(chart, place, sets, name, y, pitch)
    return chart


def deviation_drawing(own: ParameterSet, others: Sequence[ParameterSet]) -> Chart:
    """Every parameter's value, the half-width of its 95 % interval in percent, and its difference to other sets in sigma."""
    names, sets = list(own.parameters), [own, *others]
    columns = 1 if len(names) <= 20 else 2
    rows = -(-len(names) // columns)
    width, pitch = SHEET[0] / columns, min(60.0, max(24.0, (SHEET[1] - 106) / rows))
    height = 96 + pitch * rows
    title = f"{own.label}: orange dot essential, grey ring not{_marks(others)}"
    title += ", vermillion beyond 3 σ" if others else ""
    chart = Chart(path=("deviations",), title=title, size=(SHEET[0], height + 10))
    scale_of, ticks, axis = _value_scale(sets, names, 2)
    sigmas = [{d.name: d.off_sigma for d in differences(own, values)} for values in others]
    parts = (0.46, 0.72) if others else (0.55, 1.0)  # right edges of the charts, as shares of a column
    for c in range(columns):
        left = width * c
        value = scale_of(left + 90, left + parts[0] * width - 20)
        chart.label(value.middle, 2, "value ± 95 %, SI units", LIGHT)
        chart.label(value.middle, 26, axis)
        _value_axis(chart, value, ticks, 78, height)
        edges = {"left": left + parts[0] * width + 15, "right": left + parts[1] * width - 15}
        percent = Scale(**edges, low=0.01, high=100.0, by=log10)
        chart.label(percent.middle, 2, "± 95 % in % of the value", LIGHT)
        chart.ticks_across(percent, {x: f"{x:g}" for x in (0.01, 0.1, 1.0, 10.0, 100.0)}, (78, height), 54)
        far = Scale(
            left=left + parts[1] * width + 20, right=left + width - 30, low=-MAX_SIGMAS_SHOWN, high=MAX_SIGMAS_SHOWN
        )
        if others:
            labels = " and ".join(values.label for values in others)
            chart.label(far.middle, 2, f"{own.label} minus {labels}, in σ", LIGHT)
            marks = {
                x: f"{x:+g}" if x else "0"
                for x in (-MAX_SIGMAS_SHOWN, -MAX_TRUSTED_SIGMAS, 0.0, MAX_TRUSTED_SIGMAS, MAX_SIGMAS_SHOWN)
            }
            chart.ticks_across(far, marks, (78, height), 54)
            for limit in (-MAX_TRUSTED_SIGMAS, MAX_TRUSTED_SIGMAS):
                chart.line(far(limit), 78, far(limit), height, GREY, 0.75)
        for row, name in enumerate(names[c * rows : (c + 1) * rows]):
            y, p = 92 + pitch * row, own.parameters[name]
            chart.label(left + 45, y - 9, name, _color(own, name))
            _value(chart, value, sets, name, y, pitch)
            size = abs(p.value)
            share = 100 * p.half / size if size > 0 else 100.0
            chart.line(percent.left, y, percent(max(share, 0.01)), y, _color(own, name), 2.5)
            for k, sigmas_of in enumerate(sigmas):
                if (x := sigmas_of.get(name)) is not None:
                    level = y + (k - 0.5 * (len(sigmas) - 1)) * 0.3 * pitch
                    chart.line(far(0.0), level, far(x), level, COMPARED[k], 1.0)
                    ends = chart.dots if _is_exact(others[k], name) else chart.crosses
                    ends.append((far(x), level, COMPARED[k] if abs(x) <= MAX_TRUSTED_SIGMAS else VERMILLION))
    return chart


def _value_scale(
    sets: Sequence[ParameterSet], names: Sequence[str], decades: int
) -> tuple[Callable[[float, float], Scale], list[float], str]:
    """An axis linear about zero and logarithmic beyond, to be placed between two edges; its ticks and its description."""
    shown = [values.parameters[name] for values in sets for name in names if name in values.parameters]
    reach = max(abs(p.value) + p.half for p in shown)
    top = math.ceil(math.log10(reach)) if reach > 0 else 0
    typical = float(np.median([p.half for p in shown if p.half > 0] or [10.0 ** (top - 5)]))
    lowest = max(top - 5, min(top - 1, math.floor(math.log10(max(typical, 10.0 ** (top - 5))))))
    linear = 2 * 10.0**lowest

    def scale(left: float, right: float) -> Scale:
        return Scale(left=left, right=right, low=-(10.0**top), high=10.0**top, by=lambda x: math.asinh(x / linear))

    steps = range(top, lowest, -max(1, math.ceil((top - lowest) / decades)))
    ticks = [0.0, *(sign * 10.0**d for d in steps for sign in (-1, 1))]
    return scale, ticks, f"asinh scale: linear within ±{linear:g}, logarithmic beyond"


def _value_axis(chart: Chart, place: Scale, ticks: Sequence[float], top: float, bottom: float) -> None:
    chart.ticks_across(place, {tick: f"{tick:g}" for tick in ticks}, (top, bottom), top - 20)
    chart.line(place(0.0), top, place(0.0), bottom, GREY, 0.75)


def _value(chart: Chart, place: Scale, sets: Sequence[ParameterSet], name: str, y: float, pitch: float) -> None:
    """The first set as a dot (a ring if not essential), others as crosses below, with intervals; exact values as lines."""
    p, color = sets[0].parameters[name], _color(sets[0], name)
    (chart.dots if p.essential else chart.rings).append((place(p.value), y, color))
    chart.line(place(p.value - p.half), y, place(p.value + p.half), y, color, 1.5)
    for k, values in enumerate(sets[1:]):
        if (other := values.parameters.get(name)) is None:
            continue
        x, level = place(other.value), y + 0.3 * pitch
        if _is_exact(values, name):
            chart.line(x, y - 0.42 * pitch, x, y + 0.42 * pitch, COMPARED[k], 1.0)
        else:
            chart.crosses.append((x, level, COMPARED[k]))
            chart.line(
                place(other.value - other.half), level, place(other.value + other.half), level, COMPARED[k], 0.75
            )


def _is_exact(values: ParameterSet, name: str) -> bool:
    return values.parameters[name].sigma == 0


def _marks(others: Sequence[ParameterSet]) -> str:
    """Marker and color of each compared set, for the title."""
    names = {PURPLE: "purple", GREEN: "green"}
    marks = ["|" if all(_is_exact(values, name) for name in values.parameters) else "×" for values in others]
    return "".join(f", {mark} {names[COMPARED[k]]} {others[k].label}" for k, mark in enumerate(marks))


def _color(own: ParameterSet, name: str) -> Color:
    return ORANGE if own.parameters[name].essential else GREY


def study_drawing(runs: Sequence[Run]) -> Chart:
    """Errors of all runs with their medians; a line joins least squares and instrumental variables of a run."""
    title = (
        f"|beta - true| / |true|, {len(runs)} runs: × purple LS, orange IV converged, vermillion IV not; bars medians"
    )
    chart, (width, height) = Chart(path=("study",), title=title, size=STUDY_SHEET), STUDY_SHEET
    by_ls = [100 * run.ls.error for run in runs if run.ls]
    by_iv = [100 * run.iv.error for run in runs if run.iv and run.status == "converged"]
    errors = [100 * fit.error for run in runs for fit in (run.ls, run.iv) if fit and fit.error > 0]
    low, high = math.floor(log10(min(errors, default=1.0))), math.ceil(log10(max(errors, default=100.0)))
    up = Scale(left=height - 80, right=60, low=10.0**low, high=10.0**high, by=log10)
    across = Scale(left=90, right=width - 30, low=0, high=1)
    chart.ticks_up(up, {10.0**d: f"{10.0**d:g} %" for d in range(low, high + 1)}, (70, width - 20), 40)
    for k, run in enumerate(runs):
        shift = 0.2 * ((k + 0.5) / len(runs) - 0.5)
        x_ls, x_iv = across(0.3 + shift), across(0.7 + shift)
        if run.ls and run.iv:
            chart.line(x_ls, up(100 * run.ls.error), x_iv, up(100 * run.iv.error))
        if run.ls:
            chart.crosses.append((x_ls, up(100 * run.ls.error), PURPLE))
        if run.iv:
            ended = ORANGE if run.status == "converged" else VERMILLION
            chart.dots.append((x_iv, up(100 * run.iv.error), ended))
    for found, at, outside, color in ((by_ls, 0.3, -0.23, PURPLE), (by_iv, 0.7, 0.23, ORANGE)):
        if found:
            y = up(float(np.median(found)))
            chart.line(across(at - 0.14), y, across(at + 0.14), y, color, 2.0)
            chart.label(across(at + outside), y - 10, f"{np.median(found):.3g} %", color)
    return chart


def intervals_drawing(excitation: Excitation) -> Chart:
    """Expected half-width of every parameter's 95 % interval; in grey that of the plain reference."""
    e, names = excitation, excitation.base.names
    columns = 1 if e.base.b <= 20 else 2
    rows, pitch, width = -(-len(names) // columns), 17.0 if e.base.b > 12 else 24.0, 540.0 / columns
    height = 54 + pitch * rows
    title = "expected ± 95 %: orange this reference, grey the plain one"
    chart = Chart(path=("intervals",), title=title, size=(540.0, height + 20))
    both = np.concatenate([e.half, e.plain_half])
    low, high = math.floor(log10(float(both.min()))), math.ceil(log10(float(both.max())))
    scales = [
        Scale(left=width * c + 60, right=width * (c + 1) - 30, low=10.0**low, high=10.0**high, by=log10)
        for c in range(columns)
    ]
    for scale in scales:
        powers = {10.0**power: f"1e{power}" for power in range(low, high + 1)}
        chart.ticks_across(scale, powers, (44, height), 22)
    chart.label(270.0, 0.0, "half-width of the 95 % interval, SI units", LIGHT)
    for i, name in enumerate(names):
        c, row = divmod(i, rows)
        y = 58 + pitch * row
        chart.label(width * c + 30, y - 9, name, LIGHT)
        for half, level, color in ((e.half[i], y - 2, ORANGE), (e.plain_half[i], y + 3, GREY)):
            chart.line(scales[c].left, level, scales[c](float(half)), level, color, 1.75)
    return chart
