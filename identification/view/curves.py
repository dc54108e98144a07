"""The curves of a recording and of its fit over time: tracking, torque, motion, and what is left of the torque as bars."""

import math
from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..data import Signals
from ..estimation import are_moving, autocorrelation
from ..methods import Fit
from ..model import InverseModel
from ..regression import Motion, Settings, motion_between, predicted_torque, torque_of_recording
from .panels import MEASURED, PREDICTED, REFERENCE, RESIDUAL, SIMULATED, Bars, Curve, Line, Plot

Vector = NDArray[np.float64]

BUCKETS = 5000  # of a long curve, each kept as its lowest and highest sample: more than a screen has columns
MODEL_PER_CUTOFF = (
    20.0  # instants per period of the cut-off at which long filtered curves are drawn: straight to the eye
)
DROWNED = 3.0  # a raw derivative whose peak is this many times the filtered one's is off until asked for
LAGS = 60  # of the autocorrelation, in decimated samples
SHOWN_DEVIATIONS = 4.0  # of the residual: to where its distribution is drawn
TO_DEVIATION = 1.4826  # from the median of |x| to the standard deviation of normal x
_BLOCK = 200_000  # samples at a time, so that a long recording is not held in every form at once


@dataclass(frozen=True, kw_only=True, eq=False)
class Observed:
    """What curves show, for each joint by quantity (q, dq, ddq, tau), thinned.

    Attributes:
        measured: all of the recording, with differences of the raw position.
        filtered: the span fitted, through the low-pass; its tau is the model's prediction. Empty without a plan; without
            a fit it has no tau.
        simulated: the robot simulated with the estimate; empty where there is none.
        rows_t_s, residual: (rows,), (rows, n) the decimated rows that the estimator saw, all of them.
        moving: (rows, n) where a row's joint moves.
    """

    measured: dict[str, list[Line]]
    filtered: dict[str, list[Line]]
    simulated: dict[str, list[Line]]
    rows_t_s: Vector
    residual: Vector
    moving: NDArray[np.bool_]


def observed(signals: Signals, plan: Settings | None, fit: Fit | None) -> Observed:
    """What the plots of a recording show; `plan` says how it is, or would be, filtered."""
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
    if plan is None:
        return only
    stride = model_stride(signals, plan)
    step = thinning(-(-(plan.stop - plan.start) // stride))
    filtered = _thinned(signals, plan, plan.start, plan.stop, step=step, stride=stride, fit=fit)
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
    tau, predicted, speed = torque_of_recording(signals, plan, InverseModel(signals.robot), fit.base, fit.beta)
    return Observed(
        measured=measured,
        filtered=filtered,
        simulated=simulated,
        # Decimation keeps the last sample and every n_d-th before it.
        rows_t_s=signals.t_s[plan.stop - 1 - plan.decimation * np.arange(len(tau))[::-1]],
        residual=tau - predicted,
        moving=are_moving(speed),
    )


def _thinned(
    signals: Signals,
    plan: Settings | None,
    start: int,
    stop: int,
    *,
    step: int,
    stride: int = 1,
    fit: Fit | None = None,
) -> dict[str, list[Line]]:
    """Lines of every `stride`-th sample between start and stop, thinned by `step`; a fit gives its prediction as tau."""
    pieces: dict[str, list[list[Line]]] = defaultdict(lambda: [[] for _ in range(signals.robot.n)])
    idm = InverseModel(signals.robot) if fit else None
    size = max(1, _BLOCK // (step * stride)) * step * stride
    for a in range(start, stop, size):
        b = min(stop, a + size)
        m = motion_between(
            signals.q,
            signals.effort,
            cutoff_hz=plan.cutoff_hz if plan else None,
            sample_rate_hz=signals.sample_rate_hz,
            start=a,
            stop=b,
        )
        if stride > 1:
            m = Motion(**{name: x[::stride] for name, x in vars(m).items()})
        series = {"q": m.q, "dq": m.dq, "ddq": m.ddq}
        if idm is not None and fit is not None:
            series["tau"] = predicted_torque(m, idm, fit.base, fit.beta)
        elif plan is None:
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


def model_stride(signals: Signals, plan: Settings) -> int:
    """Of how many filtered samples one is drawn: all of a short recording, 20 a period of the cut-off of a long one."""
    if thinning(len(signals.q)) == 1 or plan.cutoff_hz is None:
        return 1
    return max(1, int(signals.sample_rate_hz / (MODEL_PER_CUTOFF * plan.cutoff_hz)))


def extremes(x: Vector, step: int) -> NDArray[np.intp]:
    """Indices of the lowest and the highest of every `step` samples of x (N,); of all samples where `step` is 1."""
    if step == 1:
        return np.arange(len(x))
    whole = len(x) // step * step
    buckets, first = x[:whole].reshape(-1, step), np.arange(0, whole, step)
    both = np.stack([first + buckets.argmin(axis=1), first + buckets.argmax(axis=1)], axis=1)
    both.sort(axis=1)
    twice = np.flatnonzero(both[:, 0] == both[:, 1]) * 2
    return np.concatenate([np.delete(both.reshape(-1), twice), np.arange(whole, len(x))])


def tracking_plot(signals: Signals, fit: Fit | None, seen: Observed, j: int, *, legend: bool = True) -> Plot:
    """Did joint j follow: its position measured, filtered, simulated, and its reference where one was recorded."""
    joint = signals.robot.joints[j]
    curves = [Curve(key="measured", color=MEASURED, line=seen.measured["q"][j], width=2.5)]
    if fit is not None and fit.settings.cutoff_hz is not None:
        # The key puts it after, so in front of, what is measured.
        curves.append(Curve(key="measured_filtered", name="filtered", color=PREDICTED, line=seen.filtered["q"][j]))
    # The robot's own tracking and the simulation's, in few words: six of these panels share a screen's width.
    title = f"q {joint.name} [{joint.position_unit}]"
    if signals.q_ref is not None:
        k = extremes(signals.q_ref[:, j], thinning(len(signals.q_ref)))
        curves.append(Curve(key="reference", color=REFERENCE, line=(signals.t_s[k], signals.q_ref[k, j]), width=1.5))
        rms = float(np.sqrt(np.mean((signals.q_ref[:, j] - signals.q[:, j]) ** 2)))
        title = f"q {joint.name}, {'' if seen.simulated else 'tracked to '}{rms:.2g} {joint.position_unit} rms"
    if seen.simulated:
        curves.append(Curve(key="simulated", color=SIMULATED, line=seen.simulated["q"][j]))
        off = fit.iv.direct[j].position_error_percent if fit is not None and fit.iv is not None else None
        title += "" if off is None else f", sim {off:.2g} %"
    return Plot(path=("q", joint.name), title=title, curves=tuple(curves), legend=legend)


def torque_plot(signals: Signals, fit: Fit | None, seen: Observed, j: int, *, legend: bool = True) -> Plot:
    """Is the torque of joint j explained: measured, inverse model, simulated robot, residual."""
    name, off = signals.robot.joints[j].name, {}
    curves = [Curve(key="measured", color=MEASURED, line=seen.measured["tau"][j], width=2.0)]
    if fit is not None:
        off["IDM"] = fit.errors[j].relative_error_percent
        curves.append(Curve(key="model_idm", name="IDM", color=PREDICTED, line=seen.filtered["tau"][j]))
        curves.append(Curve(key="residual", color=RESIDUAL, line=(seen.rows_t_s, seen.residual[:, j])))
    if seen.simulated:
        off["DDM"] = fit.iv.direct[j].torque_error_percent if fit is not None and fit.iv is not None else None
        curves.append(Curve(key="model_ddm", name="DDM", color=SIMULATED, line=seen.simulated["tau"][j]))
    # The peak in words: of the axis a small panel shows one number or none.
    told = [f"{name} [{signals.robot.effort_units[j]}]", f"peak {np.abs(signals.effort[:, j]).max():.3g}"]
    told += [f"{model} {error:.1f} %" for model, error in off.items() if error is not None]
    title = ", ".join(told) + (" off" if len(told) > 2 else "")
    return Plot(path=("torque", name), title=title, curves=tuple(curves), legend=legend)


def motion_plots(signals: Signals, fit: Fit | None, seen: Observed, j: int) -> list[Plot]:
    """Position errors of joint j, where there are any, and its speed and acceleration: measured, filtered, simulated."""
    joint, plots = signals.robot.joints[j], []
    errors = []
    if signals.q_ref is not None:
        off = signals.q_ref[:, j] - signals.q[:, j]
        k = extremes(off, thinning(len(off)))
        errors.append(Curve(key="reference", name="reference", color=REFERENCE, line=(signals.t_s[k], off[k])))
    if seen.simulated:
        errors.append(Curve(key="simulated", name="simulated", color=SIMULATED, line=seen.simulated["error"][j]))
    if errors:
        ends = signals.t_s[[0, -1]]
        errors.insert(0, Curve(key="measured", color=MEASURED, line=(ends, np.zeros(2))))  # as long as the other plots
        title = f"off the measured position: {joint.name} [{joint.position_unit}]"
        plots.append(Plot(path=("error", joint.name), title=title, curves=tuple(errors)))
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


def residual_bars(signals: Signals, fit: Fit, seen: Observed, j: int) -> list[Bars]:
    """Is the residual of joint j white noise: its autocorrelation, its distribution; none where nothing is left.

    The distribution is of rows that move: friction at rest is not in the model, and a few such rows would hide the others.
    """
    rho, name = seen.residual[:, j], signals.robot.joints[j].name
    T = len(rho)
    if not rho.any():
        return []
    period_s, bound = fit.settings.decimation / signals.sample_rate_hz, 2.0 / math.sqrt(T)
    lags = np.arange(1.0, min(LAGS, T - 1) + 1)
    r = np.array([autocorrelation(rho, int(k)) or 0.0 for k in lags])
    told = f", lag-1 {r[0]:.2f}" if len(r) else ""
    shown = moving if len(moving := rho[seen.moving[:, j]]) else rho
    # Of the middle of the rows, so that a few far ones do not make it.
    s = float(TO_DEVIATION * np.median(np.abs(shown))) or float(np.sqrt(np.mean(rho**2)))
    edge = SHOWN_DEVIATIONS * s
    outside = int((np.abs(shown) > edge).sum())
    counts, edges = np.histogram(shown, bins=31, range=(-edge, edge))
    width, x = float(edges[1] - edges[0]), np.linspace(-edge, edge, 301)[:-1]
    normal = len(shown) * width / (s * math.sqrt(2 * math.pi)) * np.exp(-0.5 * (x / s) ** 2)
    return [
        Bars(
            path=("residual", name, "autocorrelation"),
            title=f"{name} autocorrelation over lag [s]{told}, grey ±2/√N",
            front=((lags - 0.3) * period_s, 0.6 * period_s, r),
            back=(np.zeros(2), (len(lags) + 0.5) * period_s, np.array([bound, -bound])),
        ),
        Bars(
            path=("residual", name, "distribution"),
            title=f"{name} residual [{signals.robot.effort_units[j]}], sigma {s:.2g}, {outside} outside",
            front=(np.asarray(edges[:-1], dtype=float), width, counts.astype(float)),
            back=(x, float(x[1] - x[0]), normal),
        ),
    ]
