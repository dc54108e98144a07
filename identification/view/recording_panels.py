"""Panels of recordings besides curves over time.

They show spectra, events of the session, counters, and the friction of a fit over speed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Ints
from ..data import Signals
from ..model import InverseModel, friction_alone
from ..regression import Settings, rigid_torque_at_rows
from ..report import FitFile, base_name
from ..results import FitOnRecording
from .curves import curves_of
from .panels import GREY, JOINTS, ORANGE, PREDICTED, SKY, VERMILLION, Curve, Graph, Line, Log, Plot

MAX_LINES = 2000  # of the log
# Events of these kinds are routine; all others are shown as warnings.
ROUTINE_EVENTS = ("phase", "plan", "mark", "operator", "disabled", "end")
MIN_SPECTRUM_SAMPLES = 16  # fewer give no spectrum
# These counters do not count faults, and are so large that they would flatten the others.
UNCHARTED_COUNTERS = ("frames", "syncs")
# Friction curves are drawn at these percentiles of the load, so that they cover what was recorded.
LOADS = {10.0: SKY, 50.0: ORANGE, 90.0: VERMILLION}
SPEEDS = np.linspace(0.02, 1.0, 80)  # of these curves in each direction, relative to the peak
MAX_DOTS = 400  # of a friction chart


def event_logs(signals: Signals) -> list[Log]:
    """Return events of the session, if there are any.

    Events outside of the samples are drawn at their ends.
    """
    lines = []
    for event in signals.events[:MAX_LINES]:
        t_s = 1e-9 * (event.stamp_ns - signals.first_ns)
        at = min(max(t_s, 0.0), float(signals.t_s[-1]))
        where = "" if at == t_s else f" ({'before' if at == 0 else 'after'} the samples)"
        lines.append(
            (
                at,
                event.kind not in ROUTINE_EVENTS,
                f"{t_s:.3f} s  {event.kind}: {event.text}{where}",
            )
        )
    return (
        [Log(path=("events",), title=f"events: {len(signals.events)}", lines=lines)]
        if lines
        else []
    )


def health_plots(signals: Signals) -> list[Plot]:
    """Plot the recorder's fault counters, if there was a fault; the title has the final counts."""
    curves = list[Curve]()
    for name, (t_s, counts) in signals.health.items():
        known = np.isfinite(counts)
        if name in UNCHARTED_COUNTERS or name.endswith("_s") or not known.any():
            continue
        # Events before and after the samples would stretch the axis, so they are drawn at its ends.
        curves.append(
            Curve(
                key=name,
                color=JOINTS[len(curves) % len(JOINTS)],
                line=(np.clip(t_s[known], 0.0, signals.t_s[-1]), counts[known]),
                width=2.0,
            )
        )
    faults = [f"{c.key} {c.line[1][-1]:g}" for c in curves if c.line[1][-1]]
    return (
        [
            Plot(
                path=("health",),
                title=f"fault counters: {', '.join(faults)}",
                curves=tuple(curves),
            )
        ]
        if faults
        else []
    )


def spectrum_charts(signals: Signals, settings: Settings | None) -> list[Graph]:
    """Chart spectra of position and effort of all joints.

    They are over the time range of the settings, with cut-off frequencies.
    """
    robot, fs, charts = signals.robot, signals.sample_rate_hz, []
    start, stop = (settings.start, settings.stop) if settings else (0, len(signals.q))
    if stop - start < MIN_SPECTRUM_SAMPLES:
        return []
    for key, x, units, name, cutoff in (
        (
            "position",
            signals.q,
            [joint.position_unit for joint in robot.joints],
            "low-pass",
            settings.cutoff_hz if settings else None,
        ),
        (
            "effort",
            signals.effort,
            robot.effort_units,
            "decimation",
            0.4 * fs / settings.decimation if settings and settings.decimation > 1 else None,
        ),
    ):
        unit, curves = curves_of(
            {joint.name: _spectrum(x[start:stop, j], fs) for j, joint in enumerate(robot.joints)},
            [f"{unit}/√Hz" for unit in units],
        )
        charts.append(
            Graph(
                path=("spectrum", key),
                title=f"{key}{unit} over frequency [Hz]",
                curves=tuple(curve for curve in curves if len(curve.line[0])),
                marks={
                    **(
                        {robot.bandwidth_hz: f"bandwidth {robot.bandwidth_hz:g} Hz"}
                        if signals.motion_hz is None
                        else {}
                    ),
                    **({} if cutoff is None else {cutoff: f"{name} {cutoff:g} Hz"}),
                },
                log=True,
            )
        )
    return [chart for chart in charts if chart.curves]


def _spectrum(x: Array, sample_rate_hz: float) -> tuple[Array, Array]:
    """Return frequencies in Hz and amplitude density of x (N,) by Welch's method.

    The density is averaged in 40 bands per decade.
    """
    length = int(min(len(x) // 2, 20 * sample_rate_hz))
    f, power = (
        np.fft.rfftfreq(length, 1 / sample_rate_hz)[1:],
        _welch(x, length, sample_rate_hz)[1:],
    )
    band = np.floor(40 * np.log10(f / f[0])).astype(int)
    count = np.bincount(band)
    used = count > 0
    mean_f, mean_power = (np.bincount(band, z)[used] / count[used] for z in (f, power))
    seen = mean_power > 0
    return mean_f[seen], np.sqrt(mean_power[seen])


def _welch(x: Array, length: int, sample_rate_hz: float) -> Array:
    """Return the power density of x (N,) as `scipy.signal.welch` does (Hann, lines removed).

    The import of `scipy.signal` takes longer than all plots.
    """
    t, window = np.arange(length) - 0.5 * (length - 1), np.hanning(length + 1)[:-1]
    starts, power = range(0, len(x) - length + 1, length - length // 2), np.zeros(length // 2 + 1)
    for start in starts:
        part = x[start : start + length]
        power += np.abs(np.fft.rfft(window * (part - part.mean() - t * (t @ part) / (t @ t)))) ** 2
    power[1 : (length + 1) // 2] *= 2  # one side stands for both
    return power / (len(starts) * sample_rate_hz * (window @ window))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Friction:
    """The fitted friction, and the rows of all recordings that show it.

    Attributes:
        model, columns: the robot, and the standard parameters of the fitted ones.
        beta, covariance: (b,) and (b, b) of the fitted parameters.
        reach: standard errors in half a 95 % interval.
        share: (b,) of the recordings that have a parameter.
        rows: (3, K, n) speeds, sizes of the links' torques, and residual torques.
        own: (K, b) is 1 for the parameters that a row's recording has.
    """

    model: InverseModel
    columns: Ints
    beta: Array
    covariance: Array
    reach: float
    share: Array
    rows: Array
    own: Array


def friction_charts(
    fit: FitFile, recordings: Sequence[FitOnRecording], of: str = ""
) -> list[Graph]:
    """Chart friction of each joint over its speed.

    Rows are dots, and the identified curve has its 95 % interval. There is a color per load. Dots
    are the measured torque minus all other predicted torque, the offset too, in the rows of all
    recordings; in the first rows of a long one. With per-recording parameters, dots use each
    recording's and curves their means.
    """
    problem, names = recordings[0].problem, [p.name for p in fit.parameters]
    has = np.array([[name in one.names for name in names] for one in recordings], dtype=float)
    rows = []
    for one in recordings:
        dq, rigid = rigid_torque_at_rows(one.problem.for_errors, one.beta)
        rows.append(np.stack([dq, np.abs(rigid), (one.tau - one.tau_predicted)[: len(dq)]]))
    covariance = np.array(fit.covariance.values) if fit.covariance else np.zeros((len(names),) * 2)
    half, sigma = np.array([p.half for p in fit.parameters]), np.sqrt(np.diag(covariance))
    friction = _Friction(
        model=problem.model,
        columns=problem.base.columns[[problem.base.names.index(base_name(x)) for x in names]],
        beta=np.array([p.value for p in fit.parameters]),
        covariance=covariance,
        reach=float(np.median(half[sigma > 0] / sigma[sigma > 0])) if sigma.any() else 0.0,
        share=has.mean(axis=0),
        rows=np.concatenate(rows, axis=1),
        own=np.repeat(has, [x.shape[1] for x in rows], axis=0),
    )
    return [_friction_chart(friction, j, of) for j in range(problem.signals.robot.n)]


def _friction_chart(friction: _Friction, j: int, of: str) -> Graph:
    robot, curves = friction.model.robot, list[Curve]()
    joint, unit = robot.joints[j], robot.effort_units[j]
    dq, load, residual = friction.rows[..., j]
    peak = np.abs(dq).max(initial=0.0)
    moving = np.flatnonzero(np.abs(dq) > 0.02 * peak)
    loads, looks = [0.0], [(PREDICTED, GREY, "identified")]
    if "load" in joint.terms and len(moving):
        loads = np.percentile(load[moving], list(LOADS)).tolist()
        looks = [
            (color, color, f"load {x:.3g} {unit}")
            for x, color in zip(loads, LOADS.values(), strict=True)
        ]
    shown = moving[:: max(1, len(moving) // MAX_DOTS)]
    own = friction_alone(friction.model, friction.columns, j, dq[shown], load[shown])
    points = np.c_[dq[shown], (own * friction.own[shown]) @ friction.beta + residual[shown]]
    nearest = np.abs(load[shown, None] - loads).argmin(axis=1)
    for k, (color, _, name) in enumerate(looks):
        for speed in (-peak * SPEEDS, peak * SPEEDS) if peak > 0 else ():
            middle, half = _friction_curve(friction, j, speed, loads[k])
            curves += [
                Curve(
                    key=f"{k}{len(curves) + i:02}",
                    name="95 % interval" if side else name,
                    color=color,
                    line=(speed, middle + side * half),
                    width=1.0 if side else 2.5,
                    dashed=bool(side),
                )
                for i, side in enumerate((0, -1, 1))
            ]
    return Graph(
        path=("friction", joint.name, *([of] if of else [])),
        title=f"friction {joint.name}{of and f', {of}'} [{unit}] over speed "
        f"[{joint.position_unit}/s]",
        curves=tuple(curves),
        dots=[(points[nearest == k], color) for k, (_, color, _) in enumerate(looks)],
    )


def _friction_curve(friction: _Friction, j: int, speed: Array, load: float) -> Line:
    """Return friction of joint j at speeds (k,) and a load, with half-widths.

    The half-widths are of its 95 % interval.
    """
    G = friction.share * friction_alone(
        friction.model, friction.columns, j, speed, np.full(len(speed), load)
    )
    variance = np.sum((G @ friction.covariance) * G, axis=1)
    return G @ friction.beta, friction.reach * np.sqrt(np.maximum(variance, 0.0))
