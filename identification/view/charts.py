"""Charts that are not over time, drawn on a sheet: parameters with their deviations, passes of the iteration, spectra."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from ..data import Signals
from ..methods import Fit, Pass
from ..regression import Settings
from ..report import Values, differences
from ..study import Run
from .panels import BLUE, GREEN, GREY, JOINTS, LIGHT, ORANGE, PURPLE, RED, Color, Drawing

Vector = NDArray[np.float64]

BESIDE = (PURPLE, GREEN)  # colors of the sets a fit is compared with, in turn
FAR = 6.0  # deviations at which a difference runs off its chart
SHEET = (1430.0, 960.0)  # of a large chart: what it has of a screen of 1920 by 1080
SPECTRUM_SAMPLES = 16  # fewer have no spectrum to show
TRUSTED = 3.0  # deviations that a difference should stay within


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sheet:
    """A drawing being made."""

    strokes: list[tuple[Any, Color, float]] = field(default_factory=list)
    dots: list[tuple[float, float, Color]] = field(default_factory=list)
    labels: list[tuple[float, float, str, Color]] = field(default_factory=list)

    def line(self, x0: float, y0: float, x1: float, y1: float, color: Color = GREY, radius: float = 0.25) -> None:
        self.strokes.append((((x0, y0), (x1, y1)), color, radius))

    def drawing(self, path: tuple[str, ...], title: str, size: tuple[float, float]) -> Drawing:
        return Drawing(path=path, title=title, size=size, strokes=self.strokes, dots=self.dots, labels=self.labels)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Scale:
    """Where a number goes between two edges of the sheet, by way of a monotonic function; beyond them it stays there."""

    left: float
    right: float
    low: float
    high: float
    by: Callable[[float], float] = float

    def __call__(self, value: float) -> float:
        low, high = self.by(self.low), self.by(self.high)
        return self.left + (self.right - self.left) * min(1.0, max(0.0, (self.by(value) - low) / (high - low)))


def parameter_drawing(own: Values, others: Sequence[Values]) -> Drawing:
    """Every parameter's value with two deviations, others beside it, in one or two columns."""
    names = list(own.parameters)
    columns = 1 if len(names) <= 20 else 2
    rows, pitch = -(-len(names) // columns), 17.0 if len(names) > 12 else 24.0
    width, height, sheet = 540.0 / columns, 30 + pitch * rows, _Sheet()
    scale_of, ticks = _value_scale([own, *others], names, 3 if columns == 1 else 2)
    for c in range(columns):
        place = scale_of(width * c + 55, width * (c + 1) - 20)
        _value_axis(sheet, place, ticks, 22, height)
    for i, name in enumerate(names):
        c, row = divmod(i, rows)
        place = scale_of(width * c + 55, width * (c + 1) - 20)
        y = 34 + pitch * row
        sheet.labels.append((width * c + 27, y - 9, name, _color(own, name)))
        _value(sheet, place, own, others, name, y, pitch)
    beside = "".join(f", {_color_name(BESIDE[k])} {values.label}" for k, values in enumerate(others))
    return sheet.drawing(
        ("parameters",), f"{own.label} ± 2σ: orange essential, thin σ HAC{beside}", (540.0, height + 10)
    )


def trust_drawing(own: Values, others: Sequence[Values]) -> Drawing:
    """Beside each value its deviation in percent of it and, in deviations, how far the others are from it."""
    names = list(own.parameters)
    columns = 1 if len(names) <= 20 else 2
    rows = -(-len(names) // columns)
    width, pitch = SHEET[0] / columns, min(60.0, max(24.0, (SHEET[1] - 80) / rows))
    height, sheet = 70 + pitch * rows, _Sheet()
    scale_of, ticks = _value_scale([own, *others], names, 2)
    apart = [{d.name: d.off_sigma for d in differences(own, values)} for values in others]
    parts = (0.46, 0.72) if others else (0.55, 1.0)  # where in a column the charts end
    for c in range(columns):
        left = width * c
        value = scale_of(left + 90, left + parts[0] * width - 20)
        percent = _Scale(
            left=left + parts[0] * width + 15, right=left + parts[1] * width - 15, low=0.01, high=100.0, by=_log10
        )
        sheet.labels.append((0.5 * (value.left + value.right), 2, "value ± 2σ, SI units", LIGHT))
        _value_axis(sheet, value, ticks, 52, height)
        sheet.labels.append((0.5 * (percent.left + percent.right), 2, "σ in % of the value", LIGHT))
        for tick in (0.01, 0.1, 1.0, 10.0, 100.0):
            sheet.line(percent(tick), 52, percent(tick), height)
            sheet.labels.append((percent(tick), 28, f"{tick:g}", GREY))
        far = _Scale(left=left + parts[1] * width + 20, right=left + width - 30, low=-FAR, high=FAR)
        if others:
            told = " and ".join(values.label for values in others)
            sheet.labels.append((0.5 * (far.left + far.right), 2, f"{own.label} less {told}, in σ", LIGHT))
            for tick in (-FAR, -TRUSTED, 0.0, TRUSTED, FAR):
                sheet.line(far(tick), 52, far(tick), height, GREY, 0.75 if abs(tick) == TRUSTED else 0.25)
                sheet.labels.append((far(tick), 28, f"{tick:+g}" if tick else "0", GREY))
        for row, name in enumerate(names[c * rows : (c + 1) * rows]):
            y, p = 66 + pitch * row, own.parameters[name]
            sheet.labels.append((left + 45, y - 9, name, _color(own, name)))
            _value(sheet, value, own, others, name, y, pitch)
            size = abs(p.value)
            for sigma, radius in ((p.sigma_hac, 0.6), (p.sigma, 2.5)):
                if sigma is not None:
                    share = 100 * sigma / size if size > 0 else 100.0
                    sheet.line(percent.left, y, percent(max(share, 0.01)), y, _color(own, name), radius)
            for k, off in enumerate(apart):
                if (x := off.get(name)) is not None:
                    level = y + (k - 0.5 * (len(apart) - 1)) * 0.3 * pitch
                    sheet.line(far(0.0), level, far(x), level, BESIDE[k], 1.0)
                    sheet.dots.append((far(x), level, BESIDE[k] if abs(x) <= TRUSTED else RED))
    beside = "".join(f", {_color_name(BESIDE[k])} {values.label}" for k, values in enumerate(others))
    title = f"{own.label}: orange essential, grey not; thin line σ HAC{beside}" + (", red beyond 3 σ" if others else "")
    return sheet.drawing(("trust",), title, (SHEET[0], height + 10))


def _value_scale(
    sets: Sequence[Values], names: Sequence[str], decades: int
) -> tuple[Callable[[float, float], _Scale], list[float]]:
    """An axis linear about zero and logarithmic beyond, to be put between two edges, and its ticks."""
    shown = [values.parameters[name] for values in sets for name in names if name in values.parameters]
    reach = max(abs(p.value) + 2 * max(p.sigma, p.spread) for p in shown)
    top = math.ceil(math.log10(reach)) if reach > 0 else 0
    typical = float(np.median([2 * p.sigma for p in shown if p.sigma > 0] or [10.0 ** (top - 5)]))
    least = max(top - 5, min(top - 1, math.floor(math.log10(max(typical, 10.0 ** (top - 5))))))
    linear = 2 * 10.0**least

    def scale(left: float, right: float) -> _Scale:
        return _Scale(left=left, right=right, low=-(10.0**top), high=10.0**top, by=lambda x: math.asinh(x / linear))

    steps = range(top, least, -max(1, math.ceil((top - least) / decades)))
    return scale, [0.0, *(sign * 10.0**d for d in steps for sign in (-1, 1))]


def _value_axis(sheet: _Sheet, place: _Scale, ticks: Sequence[float], top: float, bottom: float) -> None:
    for tick in ticks:
        sheet.line(place(tick), top, place(tick), bottom, GREY, 0.25 if tick else 0.75)
        sheet.labels.append((place(tick), top - 20, f"{tick:g}", GREY))


def _value(
    sheet: _Sheet, place: _Scale, own: Values, others: Sequence[Values], name: str, y: float, pitch: float
) -> None:
    """A parameter's dot with its deviations, and the others' beside it: above and below, a short upright line if exact."""
    p, color = own.parameters[name], _color(own, name)
    sheet.dots.append((place(p.value), y, color))
    for sigma, radius in ((p.sigma_hac or 0.0, 0.5), (p.sigma, 1.5)):
        sheet.line(place(p.value - 2 * sigma), y, place(p.value + 2 * sigma), y, color, radius)
    for k, values in enumerate(others):
        if (other := values.parameters.get(name)) is None:
            continue
        x, level = place(other.value), y + 0.3 * pitch
        if other.sigma == 0:
            sheet.line(x, y - 0.42 * pitch, x, y + 0.42 * pitch, BESIDE[k], 1.0)
        else:
            sheet.dots.append((x, level, BESIDE[k]))
            spread = 2 * other.sigma
            sheet.line(place(other.value - spread), level, place(other.value + spread), level, BESIDE[k], 0.75)


def _color(own: Values, name: str) -> Color:
    return ORANGE if own.parameters[name].essential else GREY


def _color_name(color: Color) -> str:
    return {PURPLE: "purple", GREEN: "green"}[color]


def _log10(x: float) -> float:
    return math.log10(max(x, 1e-300))


def passes_drawing(fit: Fit) -> Drawing:
    """Did the iteration settle: residual, largest change, condition and tracking, pass by pass."""
    assert fit.iv is not None
    passes, sheet = fit.iv.passes, _Sheet()
    width, each, left, right = 470.0, 0.24 * SHEET[1], 40.0, 450.0
    last = len(passes)
    across = _Scale(left=left + 30, right=right - 30, low=0.5, high=last + 0.5)
    strips: list[tuple[str, Callable[[Pass], float | None], bool, Color]] = [
        ("residual norm, weighted", lambda p: p.residual_norm, False, RED),
        ("largest change of a parameter, in its σ", lambda p: p.change_sigma, True, ORANGE),
        ("condition of Z'W, columns of norm one", lambda p: p.condition, False, LIGHT),
        ("simulated position off the measured, %", lambda p: p.tracking_percent, False, BLUE),
    ]
    for s, (title, number, logarithmic, color) in enumerate(strips):
        top, bottom = 40 + each * s, each * (s + 1) - 25
        sheet.labels.append((0.5 * (left + right), top - 36, title, color))
        sheet.line(left, bottom, right, bottom, GREY, 0.5)
        points = [(k, x) for k, p in enumerate(passes, 1) if (x := number(p)) is not None and math.isfinite(x)]
        if not points:
            continue
        low, high = min(x for _, x in points), max(x for _, x in points)
        if logarithmic:
            low, high = max(min(low, 0.5), 1e-3), max(high, 1.0)
            up = _Scale(left=bottom - 10, right=top + 22, low=low, high=high, by=_log10)
            sheet.line(left, up(0.5), right, up(0.5), GREY, 0.75)
            sheet.labels.append((left - 18, up(0.5) - 10, "σ/2", GREY))
        else:
            margin = max(0.5 * (high - low), 0.02 * abs(high), 1e-12)
            up = _Scale(left=bottom - 10, right=top + 22, low=low - margin, high=high + margin)
        line = [(across(k), up(x)) for k, x in points]
        if len(line) > 1:
            sheet.strokes.append((line, color, 0.75))
        for (x, y), (_, value) in zip(line, points, strict=True):
            sheet.dots.append((x, y, color))
            sheet.labels.append((x, y - 26, f"{value:.3g}" if value < 1e4 else f"{value:.1e}", color))
    for k, p in enumerate(passes, 1):
        told = f"{k}" if p.instruments == "simulated" else f"{k}: {p.instruments}"
        sheet.labels.append((across(k), each * len(strips) - 10, told, GREEN if p.settled else GREY))
    settled = f"settled in pass {last}" if passes[-1].settled else f"not settled after {last} passes"
    return sheet.drawing(("passes",), f"passes of IV: {fit.status}, {settled}", (width, each * len(strips) + 30))


def study_drawing(runs: Sequence[Run]) -> Drawing:
    """Error of every run of a study over its cut-off: least squares, and instrumental variables by how they ended."""
    sheet, (width, height) = _Sheet(), SHEET
    cutoffs = sorted({run.cutoff for run in runs}, key=lambda c: c or math.inf)
    errors = [100 * e for run in runs for e in (run.error_ls, run.error_iv) if math.isfinite(e) and e > 0]
    low, high = 10 ** math.floor(_log10(min(errors, default=1.0))), 10 ** math.ceil(_log10(max(errors, default=100.0)))
    up = _Scale(left=height - 80, right=60, low=low, high=high, by=_log10)
    for power in range(round(_log10(low)), round(_log10(high)) + 1):
        y = up(10.0**power)
        sheet.line(70, y, width - 20, y)
        sheet.labels.append((40, y - 10, f"{10.0**power:g} %", GREY))
    for column, cutoff in enumerate(cutoffs):
        here = [run for run in runs if run.cutoff == cutoff]
        across = _Scale(left=90, right=width - 30, low=0, high=len(cutoffs))
        told = f"{cutoff:g} x bandwidth" if cutoff else "no filter"
        sheet.labels.append((across(column + 0.5), height - 70, told, LIGHT))
        for k, run in enumerate(here):
            spread = 0.35 * (k + 0.5) / len(here)
            ended = ORANGE if run.status == "converged" else RED
            if math.isfinite(run.error_ls):
                sheet.dots.append((across(column + 0.1 + spread), up(100 * run.error_ls), PURPLE))
            if math.isfinite(run.error_iv):
                sheet.dots.append((across(column + 0.55 + spread), up(100 * run.error_iv), ended))
    title = f"|beta - true| / |true| of {len(runs)} runs: purple least squares, orange IV converged, red IV not"
    return sheet.drawing(("study",), title, SHEET)


def spectrum_drawings(signals: Signals, plan: Settings | None) -> list[Drawing]:
    """Spectra of position and effort of all joints over the span of the plan, with its cut-offs."""
    robot, fs = signals.robot, signals.sample_rate_hz
    start, stop = (plan.start, plan.stop) if plan else (0, len(signals.q))
    bandwidth = (robot.controller.bandwidth_hz, "bandwidth")
    lowpass = [(plan.cutoff_hz, "low-pass")] if plan and plan.cutoff_hz is not None else []
    decimation = [(0.4 * fs / plan.decimation, "decimation")] if plan and plan.decimation > 1 else []
    drawings = []
    for key, x, units, marks in (
        ("position", signals.q, [joint.position_unit for joint in robot.joints], [bandwidth, *lowpass]),
        ("effort", signals.effort, robot.effort_units, [bandwidth, *decimation]),
    ):
        names = [f"{joint.name} [{unit}/√Hz]" for joint, unit in zip(robot.joints, units, strict=True)]
        spectra = [_spectrum(x[start:stop, j], fs) for j in range(robot.n)]
        lines = [(name, f, a) for name, (f, a) in zip(names, spectra, strict=True) if len(f)]
        if lines:
            drawings.append(_log_log(("spectrum", key), f"{key} measured: amplitude over frequency [Hz]", lines, marks))
    return drawings


def _spectrum(x: Vector, sample_rate_hz: float) -> tuple[Vector, Vector]:
    """Frequencies in Hz and amplitude density of x (N,) by Welch's method, averaged within 40 bands a decade."""
    if len(x) < SPECTRUM_SAMPLES:
        return np.zeros(0), np.zeros(0)
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
    sheet = np.array([900.0, 560.0])
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
            labels.append((float(strokes[-1][0][0, 0]), frame[1, 1] - 60 + 26 * k, f"{name} {x:g} Hz", GREY))
    for j, (name, f, amplitude) in enumerate(curves):
        strokes.append((place(np.log10(f), np.log10(amplitude)), JOINTS[j % len(JOINTS)], 0.75))
        labels.append((frame[1, 0] - 70, frame[0, 1] + 26 * j, name, JOINTS[j % len(JOINTS)]))
    return Drawing(path=path, title=title, size=(sheet[0], sheet[1]), strokes=strokes, dots=[], labels=labels)
