"""Curves over time of a recording, a fit, an excitation."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Array, Ints
from ..data import Signals
from ..design import Excitation
from ..regression import BLOCK_SAMPLES, FilteredMotion, Settings
from ..report import Number
from ..results import FitOnRecording
from .panels import (
    COMPARED_FITS,
    JOINTS,
    LIGHT,
    MEASURED,
    PREDICTED,
    REFERENCE,
    RESIDUAL,
    SIMULATED,
    VERMILLION,
    Curve,
    Line,
    Plot,
)

BUCKETS = 5000  # of a long curve, each drawn as its minimum and maximum; a screen has fewer columns
# With this many drawn samples per cut-off period a long filtered curve still looks smooth.
SAMPLES_PER_PERIOD = 20.0

# For `measured`, `filtered`, `reference` or `simulated` and a quantity (q, dq, ddq, torque,
# error), a line per joint.
Lines = Mapping[tuple[str, str], list[Line]]
# Color, width, key and name of a curve by where it is from; keys sort in the order of
# drawing, the last in front.
LOOKS = {
    "measured": (MEASURED, 2.0, "measured", ""),
    "filtered": (PREDICTED, 1.0, "measured_filtered", "filtered"),
    "reference": (REFERENCE, 1.5, "reference", ""),
    "simulated": (SIMULATED, 0.75, "simulated", ""),
}


def lines_of(signals: Signals, settings: Settings | None, fit: FitOnRecording | None) -> Lines:
    """Return decimated curves of a recording; `settings` are those of the filter.

    `measured` covers the recording. `filtered`, if there is a low-pass, covers the fitted time
    range, in place of raw derivatives. `simulated` is the robot with the estimate, if the fit
    simulated one. Errors are positions minus the measured one.
    """
    # The motion of the fit is filtered already, so it is not filtered twice.
    filtered = (
        {}
        if settings is None or settings.cutoff_hz is None
        else _decimate(signals, settings, fit.problem.motion if fit else FilteredMotion(signals))
    )
    lines = {("filtered", quantity): joints for quantity, joints in filtered.items()}
    lines |= {
        ("measured", quantity): joints
        for quantity, joints in _decimate(signals, None, FilteredMotion(signals)).items()
        if quantity in ("q", "torque") or not filtered
    }
    if (q_ref := signals.q_ref) is not None:
        lines |= _lines("reference", signals.t_s, {"q": q_ref, "error": q_ref - signals.q})
    if fit and fit.simulated and (m := fit.simulated.motion):
        # The times of the motion are index / rate; the recording's own may be interpolated.
        t_s = signals.t_s[np.rint(m.t_s * signals.sample_rate_hz).astype(int)]
        lines |= _lines(
            "simulated", t_s, {"q": m.q, "dq": m.dq, "ddq": m.ddq, "error": fit.simulated.error}
        )
    return lines


def _lines(source: str, t_s: Array, series: Mapping[str, Array]) -> Lines:
    return {(source, key): [_line(t_s, column) for column in x.T] for key, x in series.items()}


def _line(t_s: Array, x: Array) -> Line:
    """Return a series (N,), decimated if it is long."""
    k = extremes(x, bucket_size(len(x)))
    return t_s[k], x[k]


def _decimate(
    signals: Signals, settings: Settings | None, motion: FilteredMotion
) -> dict[str, list[Line]]:
    """Return lines of the raw motion and torque, or of the filtered motion.

    There are lines for each quantity and joint.
    """
    start, stop, stride = (
        (0, len(signals.q), 1)
        if settings is None
        else (settings.start, settings.stop, model_stride(signals, settings))
    )
    pieces: dict[str, list[list[Line]]] = defaultdict(lambda: [[] for _ in range(signals.robot.n)])
    step = bucket_size(-(-(stop - start) // stride))
    size = max(1, BLOCK_SAMPLES // (step * stride)) * step * stride
    for a in range(start, stop, size):
        m = motion.between(a, min(stop, a + size), settings.cutoff_hz if settings else None)
        series = {
            "q": m.q,
            "dq": m.dq,
            "ddq": m.ddq,
            **({"torque": m.tau} if settings is None else {}),
        }
        for quantity, x in series.items():
            for j, parts in enumerate(pieces[quantity]):
                k = stride * extremes(x[::stride, j], step)
                parts.append((signals.t_s[a + k], x[k, j]))
    return {
        quantity: [
            (np.concatenate([t for t, _ in parts]), np.concatenate([x for _, x in parts]))
            for parts in joints
        ]
        for quantity, joints in pieces.items()
    }


def bucket_size(N: int) -> int:
    """Return the samples per bucket of a curve of N samples; 1 if all are drawn."""
    return 1 if N <= 2 * BUCKETS else -(-N // BUCKETS)


def model_stride(signals: Signals, settings: Settings) -> int:
    """Return the number of filtered samples from one drawn to the next.

    It is 1 for a short recording, else 20 remain per cut-off period.
    """
    return (
        1
        if bucket_size(len(signals.q)) == 1 or settings.cutoff_hz is None
        else max(1, int(signals.sample_rate_hz / (SAMPLES_PER_PERIOD * settings.cutoff_hz)))
    )


def extremes(x: Array, step: int) -> Ints:
    """Return indices of the minimum and maximum of every `step` samples of x (N,)."""
    whole = len(x) // step * step
    buckets, first = x[:whole].reshape(-1, step), np.arange(0, whole, step)
    both = np.stack([first + buckets.argmin(axis=1), first + buckets.argmax(axis=1)], axis=1)
    both.sort(axis=1)
    return np.concatenate(
        [
            np.delete(both.reshape(-1), np.flatnonzero(both[:, 0] == both[:, 1]) * 2),
            np.arange(whole, len(x)),
        ]
    )


def position_plots(signals: Signals, lines: Lines) -> list[Plot]:
    """Plot per joint the reference and simulated position minus the measured one.

    The unit is a readable one. Without a reference and a simulation the position itself is plotted.
    """
    joints, errors = signals.robot.joints, [lines[key] for key in lines if key[1] == "error"]
    if not errors:
        return [plot(signals, lines, "q", j) for j in range(len(joints))]
    peaks = [
        max(float(np.abs(x).max()) for _, x in of_joint) for of_joint in zip(*errors, strict=True)
    ]
    units, plots = [joint.position_unit for joint in joints], []
    for j, joint in enumerate(joints):
        # Joints of one type share a unit, so that their plots can be compared.
        factor, unit = readable_unit(
            max(x for x, unit in zip(peaks, units, strict=True) if unit == units[j]), units[j]
        )
        error = plot(signals, lines, "error", j)
        plots.append(
            replace(
                error,
                title=f"position error {joint.name} [{unit}]",
                curves=tuple(
                    replace(c, line=(c.line[0], factor * c.line[1])) for c in error.curves
                ),
            )
        )
    return plots


def motion_plots(signals: Signals, lines: Lines, j: int) -> list[Plot]:
    """Plot position, speed and acceleration of joint j; no position if the first view has it."""
    return [
        plot(signals, lines, quantity, j, alone=True)
        for quantity in (("q",) if any(quantity == "error" for _, quantity in lines) else ())
        + ("dq", "ddq")
    ]


def plot(signals: Signals, lines: Lines, quantity: str, j: int, *, alone: bool = False) -> Plot:
    """Plot what is known of a quantity of joint j.

    Of more than three joints side by side the first has the legend.
    """
    joint, unit = signals.robot.joints[j], signals.robot.joints[j].position_unit
    units = {"dq": f"{unit}/s", "ddq": f"{unit}/s²", "torque": signals.robot.effort_units[j]}
    return Plot(
        path=(quantity, joint.name),
        title=f"{quantity} {joint.name} [{units.get(quantity, unit)}]",
        curves=tuple(
            Curve(
                key=key,
                name=f"{source} − measured" if quantity == "error" else name,
                color=color,
                line=lines[source, quantity][j],
                width=width,
                dashed=source == "reference",
            )
            for source, (color, width, key, name) in LOOKS.items()
            if (source, quantity) in lines
        ),
        legend=alone or j == 0 or signals.robot.n < 4,
    )


def row_plots(one: FitOnRecording) -> dict[str, list[Plot]]:
    """Plot per joint the `torque` of decimated rows, measured and predicted, and the `residual`.

    The plots of the torque have its residual too.
    """
    robot, tau, tau_predicted = one.signals.robot, one.tau, one.tau_predicted
    torques, residuals, errors = [], [], one.errors
    for j, (joint, unit) in enumerate(zip(robot.joints, robot.effort_units, strict=True)):
        rest = Curve(
            key="residual",
            color=RESIDUAL,
            line=(one.t_s, tau[:, j] - tau_predicted[:, j]),
            below=True,
        )
        error = Number(errors[j].relative_error_percent, ".3g", most=1000).text
        path, title = ("residual", joint.name), f"residual {joint.name} [{unit}]"
        residuals.append(Plot(path=path, title=title, curves=(rest,), legend=False))
        torques.append(
            Plot(
                path=path,
                title=f"torque {joint.name} [{unit}]: error {error} % in motion",
                curves=(
                    # The measured curve is wide and drawn first, so that it stays visible behind
                    # the model.
                    Curve(key="measured", color=MEASURED, line=(one.t_s, tau[:, j]), width=5.0),
                    Curve(key="model", color=PREDICTED, line=(one.t_s, tau_predicted[:, j])),
                    rest,
                ),
            )
        )
    return {"torque": torques, "residual": residuals if (tau != tau_predicted).any() else []}


def compared_plots(fits: Sequence[FitOnRecording], labels: Sequence[str]) -> dict[str, list[Plot]]:
    """Plot per joint the `torque` of two fits on one timeline, and their `residual`.

    Measured torque of one recording is drawn once. Lines are narrower than those behind them.
    """
    torques, residuals, same = list[Plot](), list[Plot](), len({x.signals.sha256 for x in fits}) < 2
    for j, (joint, *_) in enumerate(zip(*(x.signals.robot.joints for x in fits), strict=False)):
        measured, models, rests = (
            tuple(
                Curve(
                    key=f"{key} {label}",
                    name=name.format(label),
                    color=color,
                    line=(one.t_s, x[:, j]),
                    width=width,
                )
                for one, x, label, color, width in zip(
                    fits, values, labels, colors, widths, strict=True
                )
            )
            for key, values, name, colors, widths in (
                (
                    "measured",
                    [one.tau for one in fits],
                    "measured" if same else "measured, {}",
                    (MEASURED, LIGHT),
                    (5.0, 2.5),
                ),
                ("model", [one.tau_predicted for one in fits], "{}", COMPARED_FITS, (3.0, 1.5)),
                (
                    "residual",
                    [one.tau - one.tau_predicted for one in fits],
                    "{}",
                    COMPARED_FITS,
                    (3.0, 1.5),
                ),
            )
        )
        for plots, kind, shown in (
            (torques, "torque", (*measured[: 2 - same], *models)),
            (residuals, "residual", rests),
        ):
            plots.append(
                Plot(
                    path=(kind, joint.name),
                    title=f"{kind} {joint.name} [{fits[0].signals.robot.effort_units[j]}]",
                    curves=shown,
                    legend=j == 0,
                )
            )
    return {"torque": torques, "residual": residuals}


def column_plots(signals: Signals) -> list[Plot]:
    """Plot other recorded columns.

    Each quantity has a plot with a curve per joint, or per motor for feedforward.
    """
    robot, plots = signals.robot, []
    of_joints, of_motors = (
        [joint.name for joint in robot.joints],
        [motor.name for motor in robot.motors],
    )
    for key, title, values, names, units in (
        (
            "velocity",
            "velocity measured",
            signals.velocity,
            of_joints,
            [f"{j.position_unit}/s" for j in robot.joints],
        ),
        (
            "known_torque",
            "external torque",
            signals.known_torque,
            of_joints,
            list(robot.effort_units),
        ),
        (
            "feedforward",
            "feed-forward",
            signals.feedforward,
            of_motors,
            [m.recorded_unit for m in robot.motors],
        ),
    ):
        if values is not None:
            unit, curves = curves_of(
                {name: _line(signals.t_s, x) for name, x in zip(names, values.T, strict=True)},
                units,
            )
            plots.append(Plot(path=("column", key), title=title + unit, curves=curves))
    return plots


def curves_of(lines: Mapping[str, Line], units: Sequence[str]) -> tuple[str, tuple[Curve, ...]]:
    """Return a curve per line, and their unit for the title.

    If the units differ, they are given in the names of the curves.
    """
    one = len(set(units)) == 1
    return f" [{units[0]}]" if one else "", tuple(
        Curve(
            key=name,
            name="" if one else f"{name} [{unit}]",
            color=JOINTS[k % len(JOINTS)],
            line=line,
        )
        for k, ((name, line), unit) in enumerate(zip(lines.items(), units, strict=True))
    )


def excitation_plots(excitation: Excitation) -> dict[str, list[Plot]]:
    """Plot for each joint position, speed and, if known, torque over one period.

    The plots show the limits of these quantities, and are returned by quantity.
    """
    robot, limits = excitation.robot, excitation.limits.effort
    t_s, q, dq, tau = excitation.curves()
    most = dict(zip(limits.names, limits.limits, strict=True))
    plots = dict[str, list[Plot]]()
    for j, joint in enumerate(robot.joints):
        unit, speed = joint.position_unit, joint.si("speed")
        effort = most.get(f"joint {joint.name}")
        for quantity, shown, x, ends in (
            ("q", unit, q, joint.si("position")),
            ("dq", f"{unit}/s", dq, (-speed, speed)),
            ("torque", robot.effort_units[j], tau, () if effort is None else (-effort, effort)),
        ):
            if x is not None:
                plots.setdefault(quantity, []).append(
                    Plot(
                        path=(quantity, joint.name),
                        title=f"{quantity} {joint.name} [{shown}]",
                        curves=(
                            Curve(key="reference", color=REFERENCE, line=(t_s, x[:, j])),
                            *(
                                Curve(
                                    key=key,
                                    color=VERMILLION,
                                    line=(t_s[[0, -1]], np.full(2, end)),
                                    width=0.75,
                                )
                                for key, end in zip(("low", "high"), ends, strict=False)
                            ),
                        ),
                        legend=False,
                    )
                )
    return plots


def readable_unit(peak: float, unit: str) -> tuple[float, str]:
    """Return factor and unit in which values up to `peak` rad or m are readable.

    The unit of an angle is rad, mrad or µrad.
    """
    small = (1e3, f"m{unit}") if peak >= 1e-3 else (1e6, f"µ{unit}")
    return (1.0, unit) if peak >= 1 or peak == 0 else small
