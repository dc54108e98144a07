"""Charts of parameters, tests, gains, friction, excitations, studies: those of
the HTML report alone.
"""

import re
from collections.abc import Sequence

import numpy as np

from ..design import Excitation
from ..model import friction_alone
from ..regression import base_name, rigid_torque_at_rows
from ..report import Level, ParameterSet, differences
from ..results import Fit
from ..study import Run, VariedFit, moves_of
from ..trust import Trust
from .axes import Axis, decades, linear, logarithmic
from .colors import COMPARED, GREEN, GREY, LIGHT, ORANGE, PREDICTED, PURPLE, SKY, VERMILLION, Color
from .panels import Column, Curve, Graph, Mark, Rows, Shape

MAX_ROWS, MAX_COLUMNS = 30, 4  # of a chart
MAX_HALF_WIDTHS_SHOWN = 3.0  # larger differences are drawn at the edge of their chart
MAX_TRUSTED_SIGMAS = 3.0  # limit of a difference
# percentiles of the load that curves of friction are drawn at
LOADS = {10.0: SKY, 50.0: ORANGE, 90.0: VERMILLION}
SPEEDS = np.linspace(0.02, 1.0, 80)  # of these curves in each direction, relative to the peak
MAX_DOTS = 400  # of a friction chart
STUDY_ROWS = 5  # that the runs of a study by one method are spread over
LEVEL_COLORS: dict[Level, Color] = {"do not use": VERMILLION, "caution": ORANGE, "ok": SKY}


def deviation_charts(own: ParameterSet, others: Sequence[ParameterSet]) -> list[Rows]:
    """Every parameter: its 95 % interval in percent of the value, and other sets, in
    half-widths of this interval.
    """
    names, charts = list(own.parameters), []
    percent, labels = logarithmic(0.01, 100.0, 4), " and ".join(values.label for values in others)
    ends = MAX_HALF_WIDTHS_SHOWN
    far = Axis(
        low=-ends,
        high=ends,
        ticks={x: f"{x:+g}" if x else "0" for x in (-ends, -1.0, 0.0, 1.0, ends)},
    )
    off = [{d.name: d.off_sigma or 0.0 for d in differences(own, values)} for values in others]
    exact = [all(p.sigma == 0 for p in values.parameters.values()) for values in others]
    legend = [
        ("● essential", ORANGE),
        ("○ not essential", GREY),
        *(
            (f"{'|' if is_exact else '×'} {values.label}", color)
            for values, is_exact, color in zip(others, exact, COMPARED, strict=False)
        ),
        *([("beyond 3 σ", VERMILLION)] if others else []),
    ]
    for part in _parts(names, MAX_ROWS):
        heads, halves, marks = list[tuple[str, Color]](), list[Mark](), list[Mark]()
        for row, name in enumerate(part):
            p = own.parameters[name]
            color, shape = _look(p.essential)
            heads.append((name, color))
            halves.append(
                Mark(
                    row=row,
                    value=max(100 * p.half / abs(p.value) if p.value else 100.0, 0.01),
                    color=color,
                    shape="bar",
                )
            )
            marks.append(Mark(row=row, value=0.0, half=float(p.half > 0), color=color, shape=shape))
            for k, other in enumerate(others):
                if (q := other.parameters.get(name)) is not None:
                    at, shape = (row + 0.28, "cross") if q.sigma else (row, "tick")
                    scale, color = p.half or q.half or 1.0, COMPARED[k]
                    color = VERMILLION if abs(off[k].get(name, 0.0)) > MAX_TRUSTED_SIGMAS else color
                    marks.append(
                        Mark(
                            row=at,
                            value=(q.value - p.value) / scale,
                            half=q.half / scale,
                            color=color,
                            shape=shape,
                        )
                    )
        columns = [Column(head="± 95 %, % of value", axis=percent, marks=halves)]
        if others:
            columns.append(
                Column(
                    head=f"{labels} minus {own.label}, in ± 95 %",
                    axis=far,
                    marks=marks,
                    lines=(-1.0, 0.0, 1.0),
                )
            )
        charts.append(
            Rows(
                path=("deviations", part[0]),
                title=f"parameters of {own.label}, {part[0]} to {part[-1]}",
                names=heads,
                columns=columns,
                legend=legend,
            )
        )
    return charts


def _parts(names: Sequence[str], most: int) -> list[Sequence[str]]:
    """Names in pieces of like lengths of at most `most`."""
    size = -(-len(names) // -(-len(names) // most))
    return [names[k : k + size] for k in range(0, len(names), size)]


def _look(known: bool) -> tuple[Color, Shape]:
    return (ORANGE, "dot") if known else (GREY, "ring")


def trust_charts(trust: Trust) -> list[Rows]:
    """Figures of the tests by joint or block, with expected values."""
    charts = list[Rows]()
    for line in trust.lines:
        if line.figures:
            color = LEVEL_COLORS.get(line.level, GREY)
            marks = [
                *(
                    Mark(row=k, value=expected, color=GREEN, shape="tick")
                    for k, (*_, expected) in enumerate(line.figures)
                ),
                *(
                    Mark(row=k, value=value, half=half, color=color)
                    for k, (_, value, half, _) in enumerate(line.figures)
                ),
            ]
            head = "● value ± 95 %" if any(mark.half for mark in marks) else "● value"
            legend = ((head, color), ("| expected", GREEN))
            charts.append(
                Rows(
                    path=("tests", line.test),
                    title=f"{line.test}: {line.level}",
                    names=[(name, LIGHT) for name, *_ in line.figures],
                    columns=[Column(head=line.unit, axis=_around(marks), marks=marks)],
                    legend=legend,
                )
            )
    return charts


def _around(marks: Sequence[Mark]) -> Axis:
    ends = [mark.value + side * mark.half for mark in marks for side in (-1, 1)]
    margin = max(0.06 * (max(ends) - min(ends)), 1e-9)
    return linear(min(ends) - margin, max(ends) + margin, 4)


def friction_charts(fit: Fit, of: str = "") -> list[Graph]:
    """Friction of each joint over its speed: rows as dots, the identified curve with its 95 %
    interval; a color per load.

    Dots are the measured torque minus all other predicted torque, the offset too, in the rows of
    all recordings; in the first rows of a long one. If recordings have parameters of their own,
    dots use each recording's and curves their means.
    """
    problem, estimate, charts, found = fit.problem, fit.estimate, list[Graph](), []
    model, robot = problem.model, problem.signals.robot
    columns = problem.base.columns[
        [fit.base.names.index(base_name(name)) for name in estimate.names]
    ]
    applies = np.array(
        [[n in one.arm.names for n in estimate.names] for one in fit.recordings], dtype=float
    )
    for one, own in zip(fit.recordings, applies, strict=True):
        dq, rigid = rigid_torque_at_rows(one.problem.for_errors, one.arm.values(estimate))
        found.append(
            (
                dq,
                np.abs(rigid),
                (one.tau - one.tau_predicted)[: len(dq)],
                np.tile(own, (len(dq), 1)),
            )
        )
    moved, loads, residuals, own = (np.concatenate(x) for x in zip(*found, strict=True))
    for j, (joint, unit) in enumerate(zip(robot.joints, robot.effort_units, strict=True)):
        peak = np.abs(moved[:, j]).max(initial=0.0)
        rows = np.flatnonzero(np.abs(moved[:, j]) > 0.02 * peak)
        at, looks = [0.0], [(PREDICTED, GREY, "identified")]
        if "load" in joint.terms and len(rows):
            at = np.percentile(loads[rows, j], list(LOADS)).tolist()
            looks = [
                (color, color, f"load {x:.3g} {unit}")
                for x, color in zip(at, LOADS.values(), strict=True)
            ]
        rows = rows[:: max(1, len(rows) // MAX_DOTS)]
        v, load, curves, dots = moved[rows, j], loads[rows, j], list[Curve](), []
        torque = (
            friction_alone(model, columns, j, v, load) * own[rows]
        ) @ estimate.beta + residuals[rows, j]
        nearest = np.abs(load[:, None] - at).argmin(axis=1)
        for k, (color, of_dots, name) in enumerate(looks):
            dots.append((np.stack([v, torque], axis=1)[nearest == k], of_dots))
            for fastest in (-peak, peak) if peak > 0 else ():
                speed = fastest * SPEEDS
                G = friction_alone(
                    model, columns, j, speed, np.full(len(speed), at[k])
                ) * applies.mean(axis=0)
                variance = np.sum((G @ fit.intervals.covariance) * G, axis=1)
                half = fit.intervals.reach * np.sqrt(np.maximum(variance, 0.0))
                for side, text in ((0, name), (-1, "95 % interval"), (1, "95 % interval")):
                    curves.append(
                        Curve(
                            key=f"{k}{len(curves):02}",
                            name=text,
                            color=color,
                            line=(speed, G @ estimate.beta + side * half),
                            width=1.0 if side else 2.5,
                            dashed=bool(side),
                        )
                    )
        charts.append(
            Graph(
                path=("friction", joint.name, *([of] if of else [])),
                title=f"friction {joint.name}{of and f', {of}'} [{unit}] over speed "
                f"[{joint.position_unit}/s]",
                curves=tuple(curves),
                dots=dots,
            )
        )
    return charts


def interval_charts(excitation: Excitation) -> list[Rows]:
    """Expected half-width of every parameter's 95 % interval; in grey that
    of the plain reference.
    """
    e = excitation
    halves = {
        name: (float(e.half[i]), float(e.plain_half[i])) for i, name in enumerate(e.base.names)
    }
    axis, legend = (
        decades(list(halves.values()), 5),
        (("this reference", ORANGE), ("plain reference", GREY)),
    )
    charts = []
    for part in _parts(list(halves), MAX_ROWS):
        marks = [
            Mark(row=row + shift, value=half, color=color, shape="bar")
            for row, name in enumerate(part)
            for half, shift, color in zip(halves[name], (-0.16, 0.16), (ORANGE, GREY), strict=True)
        ]
        charts.append(
            Rows(
                path=("intervals", part[0]),
                title=f"expected ± 95 %, {part[0]} to {part[-1]}",
                names=[(name, LIGHT) for name in part],
                columns=[Column(head="SI", axis=axis, marks=marks)],
                legend=legend,
            )
        )
    return charts


def sensitivity_charts(fits: Sequence[VariedFit]) -> list[Rows]:
    """The essential parameters in all variants by both methods with 95 % intervals; lines at
    that of IV by the rules.
    """
    legend = (("× LS", PURPLE), ("● IV", ORANGE), ("| interval of IV by the rules", GREY))
    names = [
        (f"{fit.variant.changed if k else 'by'} {fit.variant.to}", LIGHT)
        for k, fit in enumerate(fits)
    ]
    charts = []
    for part in _parts(fits[0].essential or tuple(fits[0].values), MAX_COLUMNS):
        columns = []
        for name in part:
            found = {row: fit.values[name] for row, fit in enumerate(fits) if name in fit.values}
            marks = [
                Mark(row=k - 0.2, value=x[0], half=x[1], color=PURPLE, shape="cross")
                for k, x in found.items()
            ]
            marks += [
                Mark(row=k + 0.2, value=x[2], half=x[3], color=ORANGE) for k, x in found.items()
            ]
            lines = found[0][2] - found[0][3], found[0][2] + found[0][3]
            columns.append(
                Column(head=f"{name} ± 95 %", axis=_around(marks), marks=marks, lines=lines)
            )
        charts.append(
            Rows(
                path=("sensitivity", part[0]),
                title=", ".join(part),
                names=names,
                columns=columns,
                legend=legend,
            )
        )
    return charts


def noise_chart(fits: Sequence[VariedFit]) -> Graph | None:
    """The parameter that noise moves most with LS, over this noise, by both methods, and its known
    value, if there is noise.
    """
    noisy = [fits[0], *(fit for fit in fits if fit.values and fit.variant.noise)]
    if len(noisy) < 2:
        return None
    moves = {
        name: moves_of(noisy, name)[:, 0].max() for name in fits[0].essential or fits[0].values
    }
    name = max(moves, key=lambda name: moves[name])
    noisy.sort(key=lambda fit: fit.variant.noise)
    x = 1e6 * np.array([fit.variant.noise for fit in noisy])
    ls, ls_half, iv, iv_half = np.array([fit.values[name] for fit in noisy]).T
    curves = list[Curve]()
    for label, color, values, half in (("LS", PURPLE, ls, ls_half), ("IV", ORANGE, iv, iv_half)):
        ends = np.stack([values - half, values + half], axis=1)
        lines = [(x, values), *((np.full(2, at), both) for at, both in zip(x, ends, strict=True))]
        for line in lines:
            curves.append(
                Curve(
                    key=f"{len(curves):03}",
                    name=f"{label} ± 95 %",
                    color=color,
                    line=line,
                    width=2.0,
                )
            )
    known, described = fits[0].known
    if name in described:
        curves.append(
            Curve(
                key="true",
                name=known,
                color=GREEN,
                line=(x[[0, -1]], np.full(2, described[name])),
                width=2.0,
                dashed=True,
            )
        )
    unit = re.sub(r"\b(rad|m)\b", r"µ\1", noisy[-1].variant.to.partition(" ")[2])
    return Graph(
        path=("noise", name),
        title=f"{name} [{fits[0].units.get(name, '')}] over position noise [{unit}]",
        curves=tuple(curves),
    )


def study_chart(runs: Sequence[Run]) -> Rows:
    """Errors of all runs by method, with medians of least squares and of instrumental
    variables that converged.
    """
    names, marks, step = list[tuple[str, Color]](), list[Mark](), (STUDY_ROWS - 0.4) / len(runs)
    for top, name in ((0, "LS"), (STUDY_ROWS, "IV")):
        errors = list[float]()
        for k, run in enumerate(runs):
            fit, ended = (run.iv, run.status == "converged") if top else (run.ls, True)
            if fit and fit.error > 0:
                color, shape = _look(ended) if top else (PURPLE, "cross")
                marks.append(
                    Mark(
                        row=top - 0.3 + step * (k + 0.5),
                        value=100 * fit.error,
                        color=color,
                        shape=shape,
                    )
                )
                errors += [100 * fit.error] * ended
        median = float(np.median(errors)) if errors else None
        heads = [
            name if median is None else f"{name}: median {median:.3g}",
            *[""] * (STUDY_ROWS - 1),
        ]
        names += [(head, LIGHT) for head in heads]
        if median is not None:
            marks += [
                Mark(row=top + k, value=median, color=LIGHT, shape="tick")
                for k in range(STUDY_ROWS)
            ]
    axis = decades([mark.value for mark in marks] or [1.0, 100.0], 6)
    legend = (("× LS", PURPLE), ("● IV converged", ORANGE), ("○ IV not", GREY), ("| median", LIGHT))
    return Rows(
        path=("study",),
        title=f"total error of {len(runs)} runs, of the true values",
        names=names,
        columns=[Column(head="%", axis=axis, marks=marks)],
        legend=legend,
    )
