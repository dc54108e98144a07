"""Charts of parameters, tests, excitations, studies."""

import re
from collections.abc import Sequence

import numpy as np

from ..design import Excitation
from ..report import Level, Parameter, ParameterSet, TrustResult, differences
from ..study import Run, VariedFit, changes_of
from .panels import (
    COMPARED,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    Axis,
    Color,
    Column,
    Curve,
    Graph,
    Mark,
    Rows,
    Shape,
    decades,
    linear,
)

MAX_ROWS, MAX_COLUMNS = 30, 4  # of a chart
MAX_HALF_WIDTHS_SHOWN = 3.0  # larger differences are drawn at the edge of their chart
MAX_TRUSTED_SIGMAS = 3.0  # limit of a difference
STUDY_ROWS = 5  # that the runs of a study by one method are spread over
LEVEL_COLORS: dict[Level, Color] = {"do not use": VERMILLION, "caution": ORANGE, "ok": SKY}


def deviation_charts(own: ParameterSet, others: Sequence[ParameterSet]) -> list[Rows]:
    """Chart every parameter with its 95 % interval.

    It is relative to its end farther from zero. Other sets are in half-widths of this interval.
    """
    legend = [
        ("● essential", ORANGE),
        ("○ not essential", GREY),
        *(
            (f"{'×' if any(p.sigma for p in x.parameters.values()) else '|'} {x.label}", color)
            for x, color in zip(others, COMPARED, strict=False)
        ),
        *([("more than 3 standard errors", VERMILLION)] if others else []),
    ]
    return [
        Rows(
            path=("deviations", part[0]),
            title=f"Parameters of {own.label}: {part[0]} to {part[-1]}",
            names=[(name, _look(own.parameters[name].essential)[0]) for name in part],
            columns=[
                _interval_column([own.parameters[name] for name in part]),
                *([_difference_column(own, others, part)] if others else []),
            ],
            legend=legend,
        )
        for part in _parts(list(own.parameters), MAX_ROWS)
    ]


def _interval_column(parameters: Sequence[Parameter]) -> Column:
    """Return the 95 % intervals in percent of their end that is farther from zero.

    All intervals fit the axis, and one that contains zero crosses the line at zero.
    """
    return Column(
        head="95 % interval, farther end = 100 %",
        axis=linear(-100.0, 100.0, 4),
        marks=[
            Mark(row=row, value=scale * p.value, half=scale * p.half, color=color, shape=shape)
            for row, p in enumerate(parameters)
            for scale in [100.0 / (abs(p.value) + p.half or 1.0)]
            for color, shape in [_look(p.essential)]
        ],
        lines=(0.0,),
    )


def _difference_column(
    own: ParameterSet, others: Sequence[ParameterSet], names: Sequence[str]
) -> Column:
    """Return other sets minus the own parameters, in half-widths of the own intervals."""
    marks, ends = list[Mark](), MAX_HALF_WIDTHS_SHOWN
    far = [
        {d.name for d in differences(own, x) if abs(d.off_sigma or 0.0) > MAX_TRUSTED_SIGMAS}
        for x in others
    ]
    for row, name in enumerate(names):
        p = own.parameters[name]
        color, shape = _look(p.essential)
        marks.append(Mark(row=row, value=0.0, half=float(p.half > 0), color=color, shape=shape))
        for k, other in enumerate(others):
            if (q := other.parameters.get(name)) is not None:
                scale = p.half or q.half or 1.0
                marks.append(
                    Mark(
                        row=row + 0.28 if q.sigma else row,
                        value=(q.value - p.value) / scale,
                        half=q.half / scale,
                        color=VERMILLION if name in far[k] else COMPARED[k],
                        shape="cross" if q.sigma else "tick",
                    )
                )
    return Column(
        head=f"{' and '.join(x.label for x in others)} minus {own.label}, half-widths",
        axis=Axis(
            low=-ends,
            high=ends,
            ticks={x: f"{x:+g}" if x else "0" for x in (-ends, -1.0, 0.0, 1.0, ends)},
        ),
        marks=marks,
        lines=(-1.0, 0.0, 1.0),
    )


def _parts(names: Sequence[str], most: int) -> list[Sequence[str]]:
    """Divide names into pieces of similar length of at most `most`."""
    size = -(-len(names) // -(-len(names) // most))
    return [names[k : k + size] for k in range(0, len(names), size)]


def _look(known: bool) -> tuple[Color, Shape]:
    return (ORANGE, "dot") if known else (GREY, "ring")


def trust_charts(tests: Sequence[TrustResult]) -> list[Rows]:
    """Chart the figures of the tests by joint or block, with expected values."""
    return [_trust_chart(line) for line in tests if line.figures]


def _trust_chart(line: TrustResult) -> Rows:
    color = LEVEL_COLORS.get(line.level, GREY)
    marks = [
        *(
            Mark(row=k, value=expected, color=GREEN, shape="tick")
            for k, (*_, expected) in enumerate(line.figures)
            if expected is not None
        ),
        *(
            Mark(row=k, value=value, half=half or 0.0, color=color)
            for k, (_, value, half, _) in enumerate(line.figures)
            if value is not None
        ),
    ]
    return Rows(
        path=("tests", line.test),
        title=f"{line.test}: {'passed' if line.level == 'ok' else line.level}",
        names=[(name, LIGHT) for name, *_ in line.figures],
        columns=[Column(head=line.unit, axis=_around(marks), marks=marks)],
        legend=(
            (
                "● value with 95 % interval" if any(mark.half for mark in marks) else "● value",
                color,
            ),
            ("| expected", GREEN),
        ),
    )


def _around(marks: Sequence[Mark]) -> Axis:
    ends = [mark.value + side * mark.half for mark in marks for side in (-1, 1)]
    margin = max(0.06 * (max(ends) - min(ends)), 1e-9)
    return linear(min(ends) - margin, max(ends) + margin, 4)


def interval_charts(excitation: Excitation) -> list[Rows]:
    """Chart the expected half-width of every parameter's 95 % interval.

    The half-width of the plain reference is grey.
    """
    pairs = np.stack([excitation.half, excitation.plain_half], axis=1).tolist()
    axis, halves = decades(pairs, 5), dict(zip(excitation.base.names, pairs, strict=True))
    looks = ((-0.16, ORANGE), (0.16, GREY))  # shift and color of this reference and the plain one
    return [
        Rows(
            path=("intervals", part[0]),
            title=f"Expected 95 % half-width: {part[0]} to {part[-1]}",
            names=[(name, LIGHT) for name in part],
            columns=[
                Column(
                    head="SI",
                    axis=axis,
                    marks=[
                        Mark(row=row + shift, value=half, color=color, shape="bar")
                        for row, name in enumerate(part)
                        for half, (shift, color) in zip(halves[name], looks, strict=True)
                    ],
                )
            ],
            legend=(("this reference", ORANGE), ("plain reference", GREY)),
        )
        for part in _parts(list(halves), MAX_ROWS)
    ]


def sensitivity_charts(fits: Sequence[VariedFit]) -> list[Rows]:
    """Chart the essential parameters in all variants by both methods with 95 % intervals.

    Lines mark the interval of IV by default settings.
    """
    return [
        Rows(
            path=("sensitivity", part[0]),
            title=", ".join(part),
            names=[
                (f"{fit.variant.changed if k else 'by'} {fit.variant.to}", LIGHT)
                for k, fit in enumerate(fits)
            ],
            columns=[_sensitivity_column(fits, name) for name in part],
            legend=(("× LS", PURPLE), ("● IV", ORANGE), ("| IV by default settings", GREY)),
        )
        for part in _parts(fits[0].essential or tuple(fits[0].values), MAX_COLUMNS)
    ]


def _sensitivity_column(fits: Sequence[VariedFit], name: str) -> Column:
    found = {row: fit.values[name] for row, fit in enumerate(fits) if name in fit.values}
    marks = [
        *(
            Mark(row=row - 0.2, value=ls, half=half, color=PURPLE, shape="cross")
            for row, (ls, half, _, _) in found.items()
        ),
        *(
            Mark(row=row + 0.2, value=iv, half=half, color=ORANGE)
            for row, (_, _, iv, half) in found.items()
        ),
    ]
    return Column(
        head=f"{name}, 95 % interval",
        axis=_around(marks),
        marks=marks,
        lines=(found[0][2] - found[0][3], found[0][2] + found[0][3]),
    )


def noise_chart(fits: Sequence[VariedFit]) -> Graph | None:
    """Chart the parameter that noise changes most with LS, over this noise, by both methods.

    Its known value is shown; there is no chart without noise.
    """
    noisy = [fits[0], *(fit for fit in fits if fit.values and fit.variant.noise)]
    if len(noisy) < 2:
        return None
    name = max(
        fits[0].essential or fits[0].values,
        key=lambda name: float(changes_of(noisy, name)[:, 0].max()),
    )
    noisy.sort(key=lambda fit: fit.variant.noise)
    x = 1e6 * np.array([fit.variant.noise for fit in noisy])
    ls, ls_half, iv, iv_half = np.array([fit.values[name] for fit in noisy]).T
    lines = [
        (label, color, line)
        for label, color, y, half in (("LS", PURPLE, ls, ls_half), ("IV", ORANGE, iv, iv_half))
        for line in ((x, y), *zip(np.c_[x, x], np.c_[y - half, y + half], strict=True))
    ]
    curves = [
        Curve(key=f"{k:03}", name=f"{label}, 95 % interval", color=color, line=line, width=2.0)
        for k, (label, color, line) in enumerate(lines)
    ]
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
    """Chart errors of all runs by method.

    The chart has the medians of least squares and of converged instrumental variables.
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
        names += [
            (name if median is None else f"{name}: median {median:.3g}", LIGHT),
            *[("", LIGHT)] * (STUDY_ROWS - 1),
        ]
        if median is not None:
            marks += [
                Mark(row=top + k, value=median, color=LIGHT, shape="tick")
                for k in range(STUDY_ROWS)
            ]
    return Rows(
        path=("study",),
        title=f"Total error of {len(runs)} runs, % of the true values",
        names=names,
        columns=[
            Column(
                head="%",
                axis=decades([mark.value for mark in marks] or [1.0, 100.0], 6),
                marks=marks,
            )
        ],
        legend=(
            ("× LS", PURPLE),
            ("● IV converged", ORANGE),
            ("○ IV not converged", GREY),
            ("| median", LIGHT),
        ),
    )
