"""Quality of the signals: spectra, events of the session, counters, figures of the curves."""

import numpy as np

from ..arrays import Array
from ..data import Signals
from ..regression import Settings
from .colors import JOINTS
from .curves import curves_of
from .panels import Curve, Graph, Log, Plot

MAX_LINES = 2000  # of the log
# kinds that are no warnings
ROUTINE_EVENTS = ("phase", "plan", "mark", "operator", "disabled", "end")
MIN_SPECTRUM_SAMPLES = 16  # fewer give no spectrum
# they count no faults, and are much larger than the others
UNCHARTED_COUNTERS = ("frames", "syncs")


def event_logs(signals: Signals) -> list[Log]:
    """Events of the session, if there are any.

    Events outside of the samples are drawn at their ends.
    """
    end_s, lines = float(signals.t_s[-1]), []
    for event in signals.events[:MAX_LINES]:
        t_s = 1e-9 * (event.stamp_ns - signals.first_ns)
        at = min(max(t_s, 0.0), end_s)
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
    """The recorder's fault counters, if there was a fault; the title has the final counts."""
    curves = list[Curve]()
    for name, (t_s, counts) in signals.health.items():
        known = np.isfinite(counts)
        if name in UNCHARTED_COUNTERS or name.endswith("_s") or not known.any():
            continue
        # before and after the samples: at their ends
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
        [Plot(path=("health",), title=f"fault counters: {', '.join(faults)}", curves=tuple(curves))]
        if faults
        else []
    )


def spectrum_charts(signals: Signals, settings: Settings | None) -> list[Graph]:
    """Spectra of position and effort of all joints over the span of the settings,
    with cut-off frequencies.
    """
    robot, fs, charts = signals.robot, signals.sample_rate_hz, []
    start, stop = (settings.start, settings.stop) if settings else (0, len(signals.q))
    low_pass = settings.cutoff_hz if settings else None
    decimation = 0.4 * fs / settings.decimation if settings and settings.decimation > 1 else None
    if stop - start < MIN_SPECTRUM_SAMPLES:
        return []
    for key, x, units, name, cutoff in (
        (
            "position",
            signals.q,
            [joint.position_unit for joint in robot.joints],
            "low-pass",
            low_pass,
        ),
        ("effort", signals.effort, robot.effort_units, "decimation", decimation),
    ):
        unit, curves = curves_of(
            {joint.name: _spectrum(x[start:stop, j], fs) for j, joint in enumerate(robot.joints)},
            [f"{unit}/√Hz" for unit in units],
        )
        curves = tuple(curve for curve in curves if len(curve.line[0]))
        marks = (
            {}
            if signals.motion_hz is not None
            else {robot.bandwidth_hz: f"bandwidth {robot.bandwidth_hz:g} Hz"}
        )
        marks |= {} if cutoff is None else {cutoff: f"{name} {cutoff:g} Hz"}
        if curves:
            charts.append(
                Graph(
                    path=("spectrum", key),
                    title=f"{key}{unit} over frequency [Hz]",
                    curves=curves,
                    marks=marks,
                    log=True,
                )
            )
    return charts


def _spectrum(x: Array, sample_rate_hz: float) -> tuple[Array, Array]:
    """Frequencies in Hz and amplitude density of x (N,) by Welch's method, averaged
    in 40 bands per decade.
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
    """Power density of x (N,) as by `scipy.signal.welch`, whose import takes longer than all
    pictures (Hann, lines removed).
    """
    t, window = np.arange(length) - 0.5 * (length - 1), np.hanning(length + 1)[:-1]
    starts, power = range(0, len(x) - length + 1, length - length // 2), np.zeros(length // 2 + 1)
    for start in starts:
        part = x[start : start + length]
        power += np.abs(np.fft.rfft(window * (part - part.mean() - t * (t @ part) / (t @ t)))) ** 2
    power[1 : (length + 1) // 2] *= 2  # one side stands for both
    return power / (len(starts) * sample_rate_hz * (window @ window))
