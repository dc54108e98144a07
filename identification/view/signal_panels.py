"""Quality of the signals: spectra, residual, phases and events of the session, counters; a description of the curves."""

import math
from collections.abc import Sequence

import numpy as np

from ..arrays import Array
from ..data import Signals
from ..estimation import are_moving, autocorrelation
from ..methods import Fit
from ..regression import Settings
from ..report import Cell, Number, Section, Table, columns
from .curves import bucket_size, model_stride
from .panels import GREEN, GREY, JOINTS, ORANGE, SKY, Bars, Chart, Color, Curve, Lanes, Log, Plot, Scale, log10
from .robot_drawing import pose_stride

TRACKING_PHASE = "track"  # the phase used by a fit
MAX_LINES = 2000  # of the log
ROUTINE_EVENTS = ("phase", "plan", "mark", "operator", "disabled", "end")  # kinds that are no warnings
MAX_LAGS = 60  # of the autocorrelation, in decimated samples
MAX_RESIDUAL_SIGMAS = 4.0  # range of the drawn distribution
MIN_SPECTRUM_SAMPLES = 16  # fewer give no spectrum
SIGMA_PER_MEDIAN = 1.4826  # standard deviation over median of |x|, for normal x
UNCHARTED_COUNTERS = ("frames", "syncs")  # they count no faults, and are much larger than the others


def span_lanes(signals: Signals, settings: Settings | None, *, fitted: bool) -> Lanes | None:
    """The session's phases and the span that a fit uses, or would use; None if both are unknown."""
    end_s = float(signals.t_s[-1])
    lanes: dict[str, list[tuple[float, str, Color]]] = {}
    phases = [event for event in signals.events if event.kind == "phase"]
    if phases:
        colors: dict[str, Color] = {TRACKING_PHASE: GREEN}
        states: dict[float, tuple[float, str, Color]] = {}
        for event in phases:
            color = colors.setdefault(event.text, (GREY, SKY, *JOINTS[3:7])[len(colors) % 6])
            at = clamp_time(event.t_s, end_s)
            states[at] = (at, event.text, color)  # of the phases before the first sample the last is drawn
        lanes["phase"] = list(states.values())
    if settings is not None:
        start, stop = (float(signals.t_s[k]) for k in (settings.start, settings.stop - 1))
        name = "fitted" if fitted else "to_be_fitted"
        lanes[name] = [(start, settings.span, ORANGE), (stop, "", GREY)]
        if start > 0:
            lanes[name].insert(0, (0.0, "", GREY))
    if not lanes:
        return None
    title = "phases of the session, span to fit" if phases else "span to fit"
    return Lanes(path=("session",), title=title, lanes=lanes, end_s=end_s)


def event_log(signals: Signals) -> Log | None:
    """Events of the session, None without any. Events outside of the samples are drawn at their ends.

    The text repeats the time, since the viewer's time column is too narrow.
    """
    end_s, lines = float(signals.t_s[-1]), []
    for event in signals.events[:MAX_LINES]:
        at = clamp_time(event.t_s, end_s)
        where = "" if at == event.t_s else f" ({'before' if at == 0 else 'after'} the samples)"
        lines.append((at, event.kind not in ROUTINE_EVENTS, f"{event.t_s:.3f} s  {event.kind}: {event.text}{where}"))
    return Log(path=("events",), title=f"events: {len(signals.events)}", lines=lines) if lines else None


def health_plot(signals: Signals) -> Plot | None:
    """The recorder's fault counters, None without a fault; the title has the final counts."""
    end_s = float(signals.t_s[-1])
    curves: list[Curve] = []
    for name, (t_s, counts) in signals.health.items():
        known = np.isfinite(counts)
        if not known.any():
            continue
        t_s, counts = t_s[known], counts[known]
        if name not in UNCHARTED_COUNTERS and not name.endswith("_s"):
            before = np.flatnonzero(t_s < 0)[-1:]  # counts at the first sample
            k = np.r_[before, np.flatnonzero((t_s >= 0) & (t_s <= end_s))]
            line = np.clip(t_s[k], 0, end_s), counts[k]
            if len(k) == 0 or line[0][-1] < end_s:
                line = np.append(line[0], end_s), np.append(line[1], counts[-1])
            if len(line[0]) == 1:
                line = np.array([0.0, end_s]), np.repeat(line[1], 2)
            color = JOINTS[len(curves) % len(JOINTS)]
            curves.append(Curve(key=name, color=color, line=line, width=2.0))
    faults = [f"{c.key} {c.line[1][-1]:g}" for c in curves if c.line[1][-1]]
    title = f"fault counters: {', '.join(faults)}"
    return Plot(path=("health",), title=title, curves=tuple(curves)) if faults else None


def clamp_time(t_s: float, end_s: float) -> float:
    """A time clamped to the samples, 0 to `end_s`."""
    return min(max(t_s, 0.0), end_s)


def spectrum_drawings(signals: Signals, settings: Settings | None) -> list[Chart]:
    """Spectra of position and effort of all joints over the span of the settings, with cut-off frequencies."""
    robot, fs = signals.robot, signals.sample_rate_hz
    start, stop = (settings.start, settings.stop) if settings else (0, len(signals.q))
    bandwidth = [(robot.bandwidth_hz, "bandwidth")] if signals.motion_hz is None else []
    lowpass = [(settings.cutoff_hz, "low-pass")] if settings and settings.cutoff_hz is not None else []
    decimation = [(0.4 * fs / settings.decimation, "decimation")] if settings and settings.decimation > 1 else []
    drawings = []
    for key, x, units, marks in (
        ("position", signals.q, [joint.position_unit for joint in robot.joints], [*bandwidth, *lowpass]),
        ("effort", signals.effort, robot.effort_units, [*bandwidth, *decimation]),
    ):
        names = [f"{joint.name} [{unit}/√Hz]" for joint, unit in zip(robot.joints, units, strict=True)]
        spectra = [_spectrum(x[start:stop, j], fs) for j in range(robot.n)]
        lines = [(name, f, a) for name, (f, a) in zip(names, spectra, strict=True) if len(f)]
        if lines:
            drawings.append(_log_log(("spectrum", key), f"{key} measured: amplitude over frequency [Hz]", lines, marks))
    return drawings


def _spectrum(x: Array, sample_rate_hz: float) -> tuple[Array, Array]:
    """Frequencies in Hz and amplitude density of x (N,) by Welch's method, averaged in 40 bands per decade."""
    if len(x) < MIN_SPECTRUM_SAMPLES:
        return np.zeros(0), np.zeros(0)
    length = int(min(len(x) // 2, 20 * sample_rate_hz))
    f, power = np.fft.rfftfreq(length, 1 / sample_rate_hz)[1:], _welch(x, length, sample_rate_hz)[1:]
    band = np.floor(40 * np.log10(f / f[0])).astype(int)
    count = np.bincount(band)
    used = count > 0
    mean_f, mean_power = (np.bincount(band, z)[used] / count[used] for z in (f, power))
    seen = mean_power > 0
    return mean_f[seen], np.sqrt(mean_power[seen])


def _welch(x: Array, length: int, sample_rate_hz: float) -> Array:
    """Power density of x (N,) by segments overlapping by half, each without its line and by a Hann window (Welch 1967).

    As `scipy.signal.welch`, whose import takes longer than all pictures.
    """
    t, window = np.arange(length) - 0.5 * (length - 1), np.hanning(length + 1)[:-1]
    starts, power = range(0, len(x) - length + 1, length - length // 2), np.zeros(length // 2 + 1)
    for start in starts:
        part = x[start : start + length]
        power += np.abs(np.fft.rfft(window * (part - part.mean() - t * (t @ part) / (t @ t)))) ** 2
    power[1 : (length + 1) // 2] *= 2  # one side stands for both
    return power / (len(starts) * sample_rate_hz * (window @ window))


def _log_log(
    path: tuple[str, ...], title: str, curves: Sequence[tuple[str, Array, Array]], marks: Sequence[tuple[float, str]]
) -> Chart:
    """Curves (name, x, y) on logarithmic axes, with vertical marks (x, name)."""
    chart, (left, top, right, bottom) = Chart(path=path, title=title, size=(600.0, 380.0)), (60.0, 12.0, 590.0, 345.0)
    all_x, all_y = (np.concatenate([c[i] for c in curves]) for i in (1, 2))
    highest = math.ceil(log10(all_y.max()))
    lowest = math.floor(max(log10(all_y.min()), log10(all_y.max()) - 12))
    across = Scale(left=left, right=right, low=all_x.min(), high=all_x.max(), by=log10)
    up = Scale(left=bottom, right=top, low=10.0**lowest, high=10.0**highest, by=log10)
    decades = range(math.ceil(log10(all_x.min())), math.floor(log10(all_x.max())) + 1)
    chart.ticks_across(across, {10.0**d: f"{10.0**d:g}" for d in decades}, (top, bottom), bottom + 5)
    chart.ticks_up(up, {10.0**d: f"1e{d:+d}" for d in range(lowest, highest + 1)}, (left, right), 30.0)
    for k, (x, name) in enumerate(marks):
        if all_x.min() < x < all_x.max():
            chart.line(across(x), top, across(x), bottom, GREY, 1.25)
            chart.label(across(x), bottom - 50 + 22 * k, f"{name} {x:g} Hz")
    for j, (name, f, amplitude) in enumerate(curves):
        color = JOINTS[j % len(JOINTS)]
        chart.strokes.append(([(across(x), up(y)) for x, y in zip(f, amplitude, strict=True)], color, 0.75))
        chart.label(right - 60, top + 18 * j, name, color)
    return chart


def _moving_residual(fit: Fit, j: int) -> Array:
    """Residual of joint j in rows where the joint moves; in all rows if it never moves."""
    rho = (fit.tau - fit.tau_predicted)[:, j]
    return moving if len(moving := rho[are_moving(fit.speed)[:, j]]) else rho


def _robust_sigma(rho: Array) -> float:
    """Standard deviation from the median of |rho|, which is robust against outliers."""
    return float(SIGMA_PER_MEDIAN * np.median(np.abs(rho))) or float(np.sqrt(np.mean(rho**2)))


def residual_bars(signals: Signals, fit: Fit, j: int) -> list[Bars]:
    """Autocorrelation and distribution of joint j's residual, to compare with white noise; none if it is zero.

    The distribution is of moving rows: friction at rest is not modelled, and few such rows would hide the others.
    """
    rho, name = (fit.tau - fit.tau_predicted)[:, j], signals.robot.joints[j].name
    T = len(rho)
    if not rho.any():
        return []
    period_s, bound = fit.settings.decimation / signals.sample_rate_hz, 2.0 / math.sqrt(T)
    lags = np.arange(1.0, min(MAX_LAGS, T - 1) + 1)
    r = np.array([autocorrelation(rho, int(k)) or 0.0 for k in lags])
    shown = _moving_residual(fit, j)
    s = _robust_sigma(shown)
    edge = MAX_RESIDUAL_SIGMAS * s
    counts, edges = np.histogram(shown, bins=31, range=(-edge, edge))
    width, x = float(edges[1] - edges[0]), np.linspace(-edge, edge, 301)[:-1]
    normal = len(shown) * width / (s * math.sqrt(2 * math.pi)) * np.exp(-0.5 * (x / s) ** 2)
    return [
        Bars(
            path=("residual", name, "autocorrelation"),
            title=f"autocorrelation {name} [s]",
            front=((lags - 0.3) * period_s, 0.6 * period_s, r),
            back=(np.zeros(2), (len(lags) + 0.5) * period_s, np.array([bound, -bound])),
            names=("residual", "bounds of white noise"),
            legend=j == 0,
        ),
        Bars(
            path=("residual", name, "distribution"),
            title=f"distribution {name} [{signals.robot.effort_units[j]}]",
            front=(np.asarray(edges[:-1], dtype=float), width, counts.astype(float)),
            back=(x, float(x[1] - x[0]), normal),
            names=("rows in motion", "normal distribution"),
            legend=j == 0,
        ),
    ]


def numbers_of_plots(signals: Signals, fit: Fit | None) -> Section:
    """Figures of each joint: peak effort, tracking error, and standard deviation and correlation of the residual."""
    robot, heads = signals.robot, ["peak effort"]
    cells: list[list[Cell]] = [[Number(float(x), ".3g") for x in np.abs(signals.effort).max(axis=0)]]
    if signals.q_ref is not None:
        heads.append("reference − measured, rms, rad or m")
        pairs = zip(signals.q_ref.T, signals.q.T, strict=True)
        cells.append([Number(float(np.sqrt(np.mean((q_ref - q) ** 2))), ".2g") for q_ref, q in pairs])
    if fit is not None:
        rows = [_moving_residual(fit, j) for j in range(robot.n)]
        sigmas = [_robust_sigma(rho) for rho in rows]
        heads += ["residual σ", f"rows beyond {MAX_RESIDUAL_SIGMAS:g} σ", "residual lag-1"]
        cells.append([Number(sigma, ".2g") for sigma in sigmas])
        beyond = zip(rows, sigmas, strict=True)
        cells.append([Number(int((np.abs(rho) > MAX_RESIDUAL_SIGMAS * sigma).sum()), "d") for rho, sigma in beyond])
        cells.append([Number(e.autocorrelation, ".2f") for e in fit.errors[:-1]])
    names = [joint.name for joint in robot.joints]
    table = Table(
        columns=columns("joint", "unit", numbers=tuple(heads)),
        rows=tuple(zip(names, robot.effort_units, *cells, strict=True)),
    )
    return Section(title="figures of the plots", table=table)


def legend(signals: Signals, settings: Settings | None, fit: Fit | None) -> Section:
    """The curves of a recording and its fit: how they are computed from the samples, and which samples are drawn."""
    N, fs, lines = len(signals.q), signals.sample_rate_hz, list[str]()
    step, stride = bucket_size(N), model_stride(signals, settings) if settings else 1
    simulated = fit is not None and fit.replica is not None and fit.replica.motion is not None
    if fit is not None:
        lines.append("IDM, orange: torque of the inverse model with these parameters and the filtered motion.")
    if simulated:
        lines.append("DDM and simulated, light blue: the robot with these parameters, simulated in closed loop.")
    if fit is not None:
        lines.append(
            "Residual, vermillion: measured minus modelled torque of the decimated rows, both through the same filter, as "
            "fitted; its autocorrelation over the lag, in grey the bounds ±2/√N of white noise; its distribution in moving "
            "rows within four sigma (sigma: 1.48 times the median of its absolute value), in grey the normal distribution."
        )
    if simulated or (fit is not None and signals.q_ref is not None):
        lines.append(
            "Position plots of the first page: reference and simulated position, each minus the measured one; the page motion "
            "has the positions."
        )
    lines.append(
        "Measured, grey: the whole recording, unfiltered; dq and ddq are central differences of the raw position, hidden "
        "if their noise is large: a click in the legend shows them."
    )
    if settings is not None and settings.cutoff_hz is not None:
        lines.append("Filtered, orange: the measured motion through the low-pass, over the span to fit.")
    if step == 1:
        lines.append("Curves show every sample.")
    else:
        lines.append(f"Measured curves show the minimum and maximum of every {step} samples.")
    if stride > 1:
        filtered = "Filtered curves and IDM" if fit is not None else "Filtered curves"
        lines.append(f"{filtered} show one of every {stride} samples, {fs / stride:g} per second.")
    lines.append(f"The robot is drawn in {fs / pose_stride(N, fs):.3g} poses per second.")
    return Section(title="curves", lines=tuple(lines))
