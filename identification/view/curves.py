"""The curves of a recording and of its fit over time: position errors, torque, motion."""

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..data import Signals
from ..estimation import are_moving
from ..methods import Fit
from ..regression import FilteredMotion, Motion, Settings, predicted_torque
from ..study import ControlChart, Drift
from .panels import JOINTS, MEASURED, PREDICTED, REFERENCE, RESIDUAL, SIMULATED, Curve, Line, Plot

BUCKETS = 5000  # of a long curve, each kept as its lowest and highest sample: more than a screen has columns
MODEL_PER_CUTOFF = 20.0  # instants per period of the cut-off of long filtered curves drawn: straight to the eye
DROWNED = 3.0  # a raw derivative whose peak is this many times the filtered one's is off until asked for
_POSITION_COLORS = {"reference": REFERENCE, "simulated": SIMULATED}
_BLOCK = 200_000  # samples at a time, so that a long recording is not held in every form at once


@dataclass(frozen=True, kw_only=True, eq=False)
class Observed:
    """What curves show, for each joint by quantity (q, dq, ddq, tau), thinned.

    Attributes:
        measured: all of the recording, with differences of the raw position.
        filtered: the span fitted, through the low-pass; its tau is the model's prediction. Empty without settings; without
            a fit it has no tau.
        simulated: the robot simulated with the estimate; empty where there is none.
        rows_t_s, residual: (rows,), (rows, n) the decimated rows that the estimator saw, all of them.
        moving: (rows, n) where a row's joint moves.
    """

    measured: dict[str, list[Line]]
    filtered: dict[str, list[Line]]
    simulated: dict[str, list[Line]]
    rows_t_s: Array
    residual: Array
    moving: NDArray[np.bool_]


def observed(signals: Signals, settings: Settings | None, fit: Fit | None) -> Observed:
    """What the plots of a recording show; `settings` says how it is, or would be, filtered."""
    n, N, fs = signals.robot.n, len(signals.q), signals.sample_rate_hz
    measured = _thinned(signals, None, 0, N, step=thinning(N))
    only = Observed(
        measured=measured,
        filtered={},
        simulated={},
        rows_t_s=np.zeros(0),
        residual=np.zeros((0, n)),
        moving=np.zeros((0, n), bool),
    )
    if settings is None:
        return only
    stride = model_stride(signals, settings)
    step = thinning(-(-(settings.stop - settings.start) // stride))
    filtered = _thinned(signals, settings, settings.start, settings.stop, step=step, stride=stride, fit=fit)
    if fit is None:
        return replace(only, filtered=filtered)
    simulated: dict[str, list[Line]] = {}
    if fit.iv is not None and fit.iv.simulated is not None:
        m = fit.iv.simulated
        t_s = signals.t_s[np.rint(m.t_s * fs).astype(int)]  # its own times are indices over the rate
        step = thinning(len(t_s))
        for quantity, x in (("q", m.q), ("dq", m.dq), ("ddq", m.ddq), ("tau", m.tau), ("error", m.q - fit.iv.q)):
            kept = [extremes(x[:, j], step) for j in range(n)]
            simulated[quantity] = [(t_s[k], x[k, j]) for j, k in enumerate(kept)]
    return Observed(
        measured=measured,
        filtered=filtered,
        simulated=simulated,
        rows_t_s=fit.t_s,
        residual=fit.tau - fit.tau_predicted,
        moving=are_moving(fit.speed),
    )


def _thinned(
    signals: Signals,
    settings: Settings | None,
    start: int,
    stop: int,
    *,
    step: int,
    stride: int = 1,
    fit: Fit | None = None,
) -> dict[str, list[Line]]:
    """Lines of every `stride`-th sample between start and stop, thinned by `step`; a fit gives its prediction as tau."""
    pieces: dict[str, list[list[Line]]] = defaultdict(lambda: [[] for _ in range(signals.robot.n)])
    idm = fit.problem.model if fit else None
    motion = fit.problem.motion if fit else FilteredMotion(signals)
    size = max(1, _BLOCK // (step * stride)) * step * stride
    for a in range(start, stop, size):
        b = min(stop, a + size)
        m = motion.between(a, b, settings.cutoff_hz if settings else None)
        if stride > 1:
            m = Motion(**{name: x[::stride] for name, x in vars(m).items()})
        series = {"q": m.q, "dq": m.dq, "ddq": m.ddq}
        if idm is not None and fit is not None:
            series["tau"] = predicted_torque(m, idm, fit.base, fit.beta)
        elif settings is None:
            series["tau"] = m.tau
        for quantity, x in series.items():
            for j, parts in enumerate(pieces[quantity]):
                k = extremes(x[:, j], step)
                parts.append((signals.t_s[a + stride * k], x[k, j]))
    return {
        quantity: [(np.concatenate([t for t, _ in parts]), np.concatenate([x for _, x in parts])) for parts in lines]
        for quantity, lines in pieces.items()
    }


def thinning(N: int) -> int:
    """Samples per bucket of a curve of N samples; 1 where all are shown."""
    return 1 if N <= 2 * BUCKETS else -(-N // BUCKETS)


def model_stride(signals: Signals, settings: Settings) -> int:
    """Of how many filtered samples one is drawn: all of a short recording, 20 a period of the cut-off of a long one."""
    if thinning(len(signals.q)) == 1 or settings.cutoff_hz is None:
        return 1
    return max(1, int(signals.sample_rate_hz / (MODEL_PER_CUTOFF * settings.cutoff_hz)))


def extremes(x: Array, step: int) -> NDArray[np.intp]:
    """Indices of the lowest and the highest of every `step` samples of x (N,); of all samples where `step` is 1."""
    if step == 1:
        return np.arange(len(x))
    whole = len(x) // step * step
    buckets, first = x[:whole].reshape(-1, step), np.arange(0, whole, step)
    both = np.stack([first + buckets.argmin(axis=1), first + buckets.argmax(axis=1)], axis=1)
    both.sort(axis=1)
    twice = np.flatnonzero(both[:, 0] == both[:, 1]) * 2
    return np.concatenate([np.delete(both.reshape(-1), twice), np.arange(whole, len(x))])


def position_plots(signals: Signals, fit: Fit | None, seen: Observed) -> list[Plot]:
    """One plot per joint of how far reference and simulated position are off the measured one, in a readable unit.

    Positions themselves where neither a reference nor a simulation is known.
    """
    joints, legends = signals.robot.joints, _legends(signals)
    if signals.q_ref is None and not seen.simulated:
        return [_position_plot(signals, fit, seen, j, legend=legends[j]) for j in range(signals.robot.n)]
    errors = [_off_measured(signals, seen, j) for j in range(signals.robot.n)]
    peaks: dict[str, float] = defaultdict(float)  # joints of one kind share a unit, so that they compare at a glance
    for joint, lines in zip(joints, errors, strict=True):
        peaks[joint.position_unit] = max(peaks[joint.position_unit], *(np.abs(x).max() for _, x in lines.values()))
    plots = []
    for joint, lines, legend in zip(joints, errors, legends, strict=True):
        factor, unit = readable_unit(peaks[joint.position_unit], joint.position_unit)
        curves = [
            Curve(key=key, name=f"{key} − measured", color=_POSITION_COLORS[key], line=(t_s, factor * x))
            for key, (t_s, x) in lines.items()
        ]
        title = f"{joint.name} [{unit}]"
        plots.append(Plot(path=("error", joint.name), title=title, curves=tuple(curves), legend=legend))
    return plots


def torque_plots(signals: Signals, fit: Fit | None, seen: Observed) -> list[Plot]:
    """One plot per joint of its torque: measured, inverse model, simulated robot, residual."""
    plots = []
    for j, (joint, legend) in enumerate(zip(signals.robot.joints, _legends(signals), strict=True)):
        curves = [Curve(key="measured", color=MEASURED, line=seen.measured["tau"][j], width=2.0)]
        if fit is not None:
            curves.append(Curve(key="model_idm", name="IDM", color=PREDICTED, line=seen.filtered["tau"][j]))
            curves.append(Curve(key="residual", color=RESIDUAL, line=(seen.rows_t_s, seen.residual[:, j])))
        if seen.simulated:
            curves.append(Curve(key="model_ddm", name="DDM", color=SIMULATED, line=seen.simulated["tau"][j]))
        title = f"{joint.name} [{signals.robot.effort_units[j]}]"
        plots.append(Plot(path=("torque", joint.name), title=title, curves=tuple(curves), legend=legend))
    return plots


def column_plots(signals: Signals) -> list[Plot]:
    """What was recorded beside position and effort, a plot per quantity with a curve per joint, of feed-forward per motor."""
    robot = signals.robot
    of_joints = [joint.name for joint in robot.joints]
    of_motors = [motor.name for motor in robot.motors]
    plots = []
    for key, title, values, names, units in (
        ("velocity", "velocity measured", signals.velocity, of_joints, [f"{j.position_unit}/s" for j in robot.joints]),
        ("known_torque", "known torque", signals.known_torque, of_joints, list(robot.effort_units)),
        ("feedforward", "feed-forward", signals.feedforward, of_motors, [m.recorded_unit for m in robot.motors]),
    ):
        if values is None:
            continue
        curves, one_unit = [], len(set(units)) == 1
        for c, (name, unit) in enumerate(zip(names, units, strict=True)):
            k = extremes(values[:, c], thinning(len(values)))
            shown, line = "" if one_unit else f"{name} [{unit}]", (signals.t_s[k], values[k, c])
            curves.append(Curve(key=name, name=shown, color=JOINTS[c % len(JOINTS)], line=line))
        title = f"{title} [{units[0]}]" if one_unit else title
        plots.append(Plot(path=("column", key), title=title, curves=tuple(curves)))
    return plots


def motion_plots(signals: Signals, fit: Fit | None, seen: Observed, j: int) -> list[Plot]:
    """Position, speed and acceleration of joint j: measured, filtered, simulated; no position where the first page has it."""
    joint, plots = signals.robot.joints[j], []
    if signals.q_ref is not None or seen.simulated:
        plots.append(_position_plot(signals, fit, seen, j))
    filters = bool(seen.filtered) and (fit is None or fit.settings.cutoff_hz is not None)
    for quantity, per in (("dq", "/s"), ("ddq", "/s²")):
        raw = seen.measured[quantity][j]
        drowns = filters and bool(np.abs(raw[1]).max() > DROWNED * np.abs(seen.filtered[quantity][j][1]).max())
        curves = [Curve(key="measured", color=MEASURED, line=raw, width=2.0, visible=not drowns)]
        if filters:
            line = seen.filtered[quantity][j]
            curves.append(Curve(key="measured_filtered", name="filtered", color=PREDICTED, line=line))
        if seen.simulated:
            line = seen.simulated[quantity][j]
            curves.append(Curve(key="simulated", color=SIMULATED, line=line, width=0.75))
        title = f"{quantity} {joint.name} [{joint.position_unit}{per}]"
        plots.append(Plot(path=(quantity, joint.name), title=title, curves=tuple(curves)))
    return plots


def drift_plots(drift: Drift) -> list[Plot]:
    """A plot per number of a fleet's fits with its interval and control limits; those with something beyond them first."""
    charts = sorted((c for c in drift.charts if len(c.x)), key=lambda chart: not chart.outside)
    return [_drift_plot(drift.name, chart, legend=k == 0) for k, chart in enumerate(charts)]


def _drift_plot(name: str, chart: ControlChart, *, legend: bool) -> Plot:
    curves = [Curve(key="value", color=SIMULATED, line=(chart.t_s, chart.x), width=2.0)]
    if not np.isnan(chart.low).any():
        interval = (("interval_low", "95 % interval", chart.low), ("interval_high", "95 % interval", chart.high))
        curves += [Curve(key=key, name=text, color=MEASURED, line=(chart.t_s, x)) for key, text, x in interval]
    keys = ("centre", "limit_low", "limit_high")
    ends = chart.t_s[[0, -1]]
    for key, color, limit in zip(keys, (REFERENCE, RESIDUAL, RESIDUAL), chart.limits or (), strict=False):
        curves.append(Curve(key=key, name=key.replace("_", " "), color=color, line=(ends, np.full(2, limit))))
    beyond = f", {len(chart.outside)} beyond" if chart.outside else ""
    title = f"{chart.name} [{chart.unit}]{beyond}"
    return Plot(path=("drift", name, chart.name), title=title, curves=tuple(curves), legend=legend)


def readable_unit(peak: float, unit: str) -> tuple[float, str]:
    """A factor and the unit it leads to, in which values up to `peak`, given in rad or m, read well: rad, mrad or µrad."""
    if peak >= 1 or peak == 0:
        return 1.0, unit
    return (1e3, f"m{unit}") if peak >= 1e-3 else (1e6, f"µ{unit}")


def _legends(signals: Signals) -> list[bool]:
    """Which of the joints' plots have a legend: all of few, the first of many."""
    return [j == 0 or signals.robot.n < 4 for j in range(signals.robot.n)]


def _position_plot(signals: Signals, fit: Fit | None, seen: Observed, j: int, *, legend: bool = True) -> Plot:
    """Joint j's position measured, filtered, simulated, and its reference where one was recorded."""
    joint = signals.robot.joints[j]
    curves = [Curve(key="measured", color=MEASURED, line=seen.measured["q"][j], width=2.5)]
    if fit is not None and fit.settings.cutoff_hz is not None:
        # The key puts it after, so in front of, what is measured.
        curves.append(Curve(key="measured_filtered", name="filtered", color=PREDICTED, line=seen.filtered["q"][j]))
    if signals.q_ref is not None:
        k = extremes(signals.q_ref[:, j], thinning(len(signals.q_ref)))
        curves.append(Curve(key="reference", color=REFERENCE, line=(signals.t_s[k], signals.q_ref[k, j]), width=1.5))
    if seen.simulated:
        curves.append(Curve(key="simulated", color=SIMULATED, line=seen.simulated["q"][j]))
    title = f"q {joint.name} [{joint.position_unit}]"
    return Plot(path=("q", joint.name), title=title, curves=tuple(curves), legend=legend)


def _off_measured(signals: Signals, seen: Observed, j: int) -> dict[str, Line]:
    """Reference and simulated position of joint j less the measured one, what there is of them."""
    lines = {}
    if signals.q_ref is not None:
        off = signals.q_ref[:, j] - signals.q[:, j]
        k = extremes(off, thinning(len(off)))
        lines["reference"] = signals.t_s[k], off[k]
    if seen.simulated:
        lines["simulated"] = seen.simulated["error"][j]
    return lines
