"""What a fit looks like, as plain data: curves over time, bars, drawings. `viewer` turns it into a Rerun file."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from .dynamics import Dynamics
from .filtering import motion_between
from .fit import Fit
from .regression import predicted_torque, torque_of_recording
from .signals import Signals

Vector = NDArray[np.float64]
Color = tuple[int, int, int]
Line = tuple[Vector, Vector]  # t_s (k,), values (k,)
Steps = tuple[Vector, float, Vector]  # left edges (k,), width, heights (k,)

GREY, BLUE, ORANGE, RED, GREEN = (140, 140, 140), (60, 140, 245), (255, 140, 0), (225, 60, 60), (50, 170, 90)
JOINTS = (
    BLUE,
    ORANGE,
    GREEN,
    RED,
    (160, 110, 220),
    (0, 175, 190),
    (200, 160, 40),
    (220, 110, 170),
)  # by joint, in turn
BUCKETS = 5000  # of a long curve, each kept as its lowest and highest sample: more than a screen has columns
DROWNED = 3.0  # a raw derivative whose peak is this many times the filtered one's is off until asked for
LAGS = 60  # of the autocorrelation, in decimated samples
_BLOCK = 200_000  # samples at a time, so that a long recording is not held in every form at once


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A line of a plot; `key` ends its entity's path. Lines are drawn in the order of their keys, the last in front."""

    key: str
    color: Color
    line: Line
    name: str = ""
    width: float = 1.0
    visible: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class Plot:
    """Curves over time."""

    path: tuple[str, ...]
    title: str
    curves: tuple[Curve, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Bars:
    """Bars in front of grey ones, over what their edges measure."""

    path: tuple[str, ...]
    title: str
    front: Steps
    back: Steps


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawing:
    """Strokes (points (k, 2), color, radius), dots and labels on a sheet of `size` pixels, y downwards: any other chart."""

    path: tuple[str, ...]
    title: str
    size: tuple[float, float]
    strokes: Sequence[tuple[Any, Color, float]]
    dots: Sequence[tuple[float, float, Color]]
    labels: Sequence[tuple[float, float, str, Color]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Observed:
    """What curves show, for each joint by quantity (q, dq, ddq, tau), thinned; `modelled` is filtered, its tau predicted.

    rows_t_s (rows,), residual (rows, n): the decimated rows that the estimator saw, all of them.
    """

    measured: dict[str, list[Line]]
    modelled: dict[str, list[Line]]
    rows_t_s: Vector
    residual: Vector


def observed(signals: Signals, fit: Fit) -> Observed:
    """What the plots of a fit show."""
    plan, idm, base, beta = fit.plan, Dynamics(signals.robot), fit.base, fit.beta
    n, fs, step = signals.robot.n, signals.sample_rate_hz, thinning(signals)
    size = max(1, _BLOCK // step) * step

    def thinned(cutoff_hz: float | None, start: int, stop: int, *, model: bool) -> dict[str, list[Line]]:
        pieces: dict[str, list[list[Line]]] = defaultdict(lambda: [[] for _ in range(n)])
        for a in range(start, stop, size):
            b = min(stop, a + size)
            m = motion_between(signals.q, signals.effort, cutoff_hz=cutoff_hz, sample_rate_hz=fs, start=a, stop=b)
            tau = predicted_torque(m, idm, base, beta) if model else m.tau
            for quantity, x in (("q", m.q), ("dq", m.dq), ("ddq", m.ddq), ("tau", tau)):
                for j in range(n):
                    k = extremes(x[:, j], step)
                    pieces[quantity][j].append((signals.t_s[a + k], x[k, j]))
        return {
            quantity: [
                (np.concatenate([t for t, _ in parts]), np.concatenate([x for _, x in parts])) for parts in lines
            ]
            for quantity, lines in pieces.items()
        }

    tau, predicted, _ = torque_of_recording(signals, plan, idm, base, beta)
    return Observed(
        measured=thinned(None, 0, len(signals.q), model=False),
        modelled=thinned(plan.cutoff_hz, plan.start, plan.stop, model=True),
        # Decimation keeps the last sample and every n_d-th before it.
        rows_t_s=signals.t_s[plan.stop - 1 - plan.decimation * np.arange(len(tau))[::-1]],
        residual=tau - predicted,
    )


def thinning(signals: Signals) -> int:
    """Samples per bucket of the curves shown; 1 where all are shown."""
    N = len(signals.q)
    return 1 if N <= 2 * BUCKETS else -(-N // BUCKETS)


def extremes(x: Vector, step: int) -> NDArray[np.intp]:
    """Indices of the lowest and the highest of every `step` samples of x (N,); of all samples where `step` is 1."""
    if step == 1:
        return np.arange(len(x))
    whole = len(x) // step * step
    buckets, first = x[:whole].reshape(-1, step), np.arange(0, whole, step)
    return np.unique(np.r_[first + buckets.argmin(axis=1), first + buckets.argmax(axis=1), whole : len(x)])


def torque_plot(signals: Signals, fit: Fit, seen: Observed, j: int) -> Plot:
    """Is the torque of joint j explained: measured as recorded, predicted along the filtered motion, residual as fitted."""
    name, error = signals.robot.joints[j].name, fit.errors[j].relative_error_percent
    told = "" if error is None else f", relative error {error:.1f} %"
    return Plot(
        path=("torque", name),
        title=f"{name} [{signals.robot.effort_units[j]}]{told}",
        curves=(
            Curve(key="measured", color=GREY, line=seen.measured["tau"][j], width=2.0),
            Curve(key="predicted", color=ORANGE, line=seen.modelled["tau"][j]),
            Curve(key="residual", color=RED, line=(seen.rows_t_s, seen.residual[:, j])),
        ),
    )


def motion_plots(signals: Signals, fit: Fit, seen: Observed, j: int) -> list[Plot]:
    """Position, speed and acceleration of joint j: measured (differences of the raw position), filtered, reference."""
    joint, plots = signals.robot.joints[j], []
    for quantity, per in (("q", ""), ("dq", "/s"), ("ddq", "/s²")):
        raw, filtered = seen.measured[quantity][j], seen.modelled[quantity][j]
        drowns = bool(np.abs(raw[1]).max() > DROWNED * np.abs(filtered[1]).max())
        curves = [Curve(key="measured", color=GREY, line=raw, width=2.0, visible=not drowns)]
        if fit.plan.cutoff_hz is not None:
            # The key puts it after, so in front of, what is measured.
            curves.append(Curve(key="measured_filtered", name="filtered", color=BLUE, line=filtered))
        if quantity == "q" and signals.q_ref is not None:
            k = extremes(signals.q_ref[:, j], thinning(signals))
            curves.append(Curve(key="reference", color=GREEN, line=(signals.t_s[k], signals.q_ref[k, j])))
        title = f"{quantity} {joint.name} [{joint.position_unit}{per}]"
        plots.append(Plot(path=(quantity, joint.name), title=title, curves=tuple(curves)))
    return plots


def residual_bars(signals: Signals, fit: Fit, seen: Observed, j: int) -> list[Bars]:
    """Is the residual of joint j white noise: its autocorrelation, its distribution; none where nothing is left."""
    rho, name = seen.residual[:, j], signals.robot.joints[j].name
    T, s = len(rho), float(np.sqrt(np.mean(rho**2)))
    if s == 0:
        return []
    period_s, bound = fit.plan.decimation / signals.sample_rate_hz, 2.0 / math.sqrt(T)
    lags = np.arange(1.0, min(LAGS, T - 1) + 1)
    r = np.array([rho[int(k) :] @ rho[: -int(k)] for k in lags]) / (rho @ rho)
    edge = min(6.0 * s, float(np.abs(rho).max()))
    counts, edges = np.histogram(rho, bins=31, range=(-edge, edge))
    width, x = float(edges[1] - edges[0]), np.linspace(-edge, edge, 301)[:-1]
    normal = T * width / (s * math.sqrt(2 * math.pi)) * np.exp(-0.5 * (x / s) ** 2)
    return [
        Bars(
            path=("residual", name, "autocorrelation"),
            title=f"{name} autocorrelation [s]",
            front=((lags - 0.3) * period_s, 0.6 * period_s, r),
            back=(np.zeros(2), (len(lags) + 0.5) * period_s, np.array([bound, -bound])),
        ),
        Bars(
            path=("residual", name, "distribution"),
            title=f"{name} residual [{signals.robot.effort_units[j]}]",
            front=(np.asarray(edges[:-1], dtype=float), width, counts.astype(float)),
            back=(x, float(x[1] - x[0]), normal),
        ),
    ]


def parameter_drawing(fit: Fit) -> Drawing:
    """Every parameter's value with its deviations, on an axis that is linear about zero and logarithmic beyond."""
    e, essential = fit.estimate, set(fit.essential.estimate.names)
    hac = np.where(np.isfinite(fit.sigma_hac), fit.sigma_hac, 0.0)
    reach = np.abs(e.beta) + 2 * np.maximum(e.sigma, hac)
    top = math.ceil(math.log10(reach.max())) if reach.max() > 0 else 0
    least = max(top - 5, math.floor(math.log10(max(float(np.median(2 * e.sigma)), 10.0 ** (top - 5)))))
    columns = 1 if len(e.names) <= 20 else 2
    rows, margin, pitch = -(-len(e.names) // columns), 55.0, 17.0 if len(e.names) > 12 else 24.0
    column, height = 540.0 / columns, 30 + pitch * rows

    def place(value: float, c: int) -> float:
        at = math.asinh(value / (2 * 10.0**least)) / math.asinh(10.0 ** (top - least) / 2)
        return float(column * c + margin + (column - margin - 20) * (at + 1) / 2)

    strokes: list[tuple[Any, Color, float]] = []
    labels: list[tuple[float, float, str, Color]] = []
    dots: list[tuple[float, float, Color]] = []
    decades = range(top, min(least, top - 1), -max(1, math.ceil((top - least) / (3 if columns == 1 else 2))))
    for c in range(columns):
        for tick in (0.0, *(sign * 10.0**d for d in decades for sign in (-1, 1))):
            x = place(tick, c)
            strokes.append((((x, 22), (x, height)), GREY, 0.25 if tick else 0.75))
            labels.append((x, 4, f"{tick:g}", GREY))
    for i, (name, value, sigma, robust) in enumerate(zip(e.names, e.beta, e.sigma, hac, strict=True)):
        c, row = divmod(i, rows)
        y, color = 34 + pitch * row, ORANGE if name in essential else GREY
        labels.append((column * c + margin / 2, y - 9, name, color))
        dots.append((place(value, c), y, color))
        for s, radius in ((robust, 0.5), (sigma, 1.5)):
            strokes.append((((place(value - 2 * s, c), y), (place(value + 2 * s, c), y)), color, radius))
    return Drawing(
        path=("parameters",),
        title="parameters ± 2σ: orange essential, thin line σ HAC",
        size=(540.0, height + 10),
        strokes=strokes,
        dots=dots,
        labels=labels,
    )


def spectrum_drawings(signals: Signals, fit: Fit) -> list[Drawing]:
    """Spectra of position and effort of all joints over the span fitted, with the cut-offs of the fit."""
    robot, plan, fs = signals.robot, fit.plan, signals.sample_rate_hz
    bandwidth = (robot.controller.bandwidth_hz, "bandwidth")
    lowpass = [] if plan.cutoff_hz is None else [(plan.cutoff_hz, "low-pass")]
    decimation = [] if plan.decimation == 1 else [(0.4 * fs / plan.decimation, "decimation")]
    drawings = []
    for key, x, units, marks in (
        ("position", signals.q, [joint.position_unit for joint in robot.joints], [bandwidth, *lowpass]),
        ("effort", signals.effort, robot.effort_units, [bandwidth, *decimation]),
    ):
        names = [f"{joint.name} [{unit}/√Hz]" for joint, unit in zip(robot.joints, units, strict=True)]
        spectra = [_spectrum(x[plan.start : plan.stop, j], fs) for j in range(robot.n)]
        lines = [(name, f, a) for name, (f, a) in zip(names, spectra, strict=True) if len(f)]
        if lines:
            drawings.append(_log_log(("spectrum", key), f"{key} measured: amplitude over frequency [Hz]", lines, marks))
    return drawings


def _spectrum(x: Vector, sample_rate_hz: float) -> tuple[Vector, Vector]:
    """Frequencies in Hz and amplitude density of x (N,) by Welch's method, averaged within 40 bands a decade."""
    f, power = signal.welch(x, sample_rate_hz, nperseg=int(min(len(x) // 2, 20 * sample_rate_hz)), detrend="linear")
    f, power = f[1:], power[1:]
    band = np.floor(40 * np.log10(f / f[0])).astype(int)
    count = np.bincount(band)
    used = count > 0
    mean_f, mean_power = (np.bincount(band, z)[used] / count[used] for z in (f, power))
    seen = mean_power > 0
    return mean_f[seen], np.sqrt(mean_power[seen])


def _log_log(
    path: tuple[str, ...],
    title: str,
    curves: Sequence[tuple[str, Vector, Vector]],
    marks: Sequence[tuple[float, str]],
) -> Drawing:
    """Curves (name, x, y) on logarithmic axes, and marks (x, name) across them."""
    sheet = np.array([900.0, 840.0])
    all_x, all_y = (np.log10(np.concatenate([c[i] for c in curves])) for i in (1, 2))
    low = np.array([all_x.min(), math.floor(max(all_y.min(), all_y.max() - 12))])
    high = np.array([all_x.max(), math.ceil(all_y.max())])
    frame = np.array([[70.0, 20.0], [sheet[0] - 20, sheet[1] - 50]])  # left, top; right, bottom

    def place(x: Any, y: Any) -> Vector:
        u = (np.column_stack([x, y]) - low) / np.maximum(high - low, 1e-9)
        u[:, 1] = 1.0 - u[:, 1]
        return np.asarray(frame[0] + np.clip(u, 0, 1) * (frame[1] - frame[0]))

    strokes: list[tuple[Any, Color, float]] = []
    labels: list[tuple[float, float, str, Color]] = []
    for d in range(math.ceil(low[0]), math.floor(high[0]) + 1):
        strokes.append((place([d, d], [low[1], high[1]]), GREY, 0.25))
        labels.append((float(strokes[-1][0][0, 0]), frame[1, 1] + 5, f"{10.0**d:g}", GREY))
    for d in range(int(low[1]), int(high[1]) + 1):
        strokes.append((place([low[0], high[0]], [d, d]), GREY, 0.25))
        labels.append((35.0, float(strokes[-1][0][0, 1]) - 10, f"1e{d:+d}", GREY))
    for k, (x, name) in enumerate(marks):
        at = math.log10(x)
        if low[0] < at < high[0]:
            strokes.append((place([at, at], [low[1], high[1]]), GREY, 1.25))
            labels.append((float(strokes[-1][0][0, 0]), frame[0, 1] + 26 * k, f"{name} {x:g} Hz", GREY))
    for j, (name, f, amplitude) in enumerate(curves):
        strokes.append((place(np.log10(f), np.log10(amplitude)), JOINTS[j % len(JOINTS)], 0.75))
        labels.append((frame[1, 0] - 70, frame[0, 1] + 26 * j, name, JOINTS[j % len(JOINTS)]))
    return Drawing(path=path, title=title, size=(sheet[0], sheet[1]), strokes=strokes, dots=[], labels=labels)
