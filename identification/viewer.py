"""A fit as a Rerun file: is the torque explained, what was the motion, which parameters came out, is the residual noise.

What is shown is first plain data (`Plot`, `Bars`, `Drawing`). `_show` writes one of these into the file and returns the
panel that shows it, and the layout is built of such panels only: none can be without data.
"""

import hashlib
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from acquisition.whole_file import whole_file

from .dynamics import Dynamics
from .filtering import motion_between
from .idim import Fit
from .regression import predicted_torque, torque_of_recording
from .report import fit_json, plan_lines
from .signals import Signals

Vector = NDArray[np.float64]
Color = tuple[int, int, int]
Line = tuple[Vector, Vector]  # t_s (k,), values (k,)
Steps = tuple[Vector, float, Vector]  # left edges (k,), width, heights (k,)

GREY, BLUE, ORANGE, RED, GREEN = (140, 140, 140), (60, 140, 245), (255, 140, 0), (225, 60, 60), (50, 170, 90)
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


def write_fit_rrd(path: Path, signals: Signals, fit: Fit) -> None:
    """Write a fit as a Rerun file that opens with its own layout (`rerun fit.rrd`).

    Times are seconds from the recording's first sample, on the timeline `time`. Measured curves span the recording,
    filtered and predicted ones what the fit used of it. Entities are `torque/<joint>/measured`, `predicted`, `residual`;
    `q/<joint>/measured`, `measured_filtered`, `reference`, and so for `dq` and `ddq`; `residual`, `parameters`, `report`.
    Raises `AcquisitionError`, one line, when the file cannot be written; nothing is left behind then.
    """
    # A viewer holds one layout per application, and titles here carry results: each fit is an application of its own.
    told = f"{signals.sha256} {fit.method} {fit.plan} {fit.estimate.names} {fit.estimate.beta.tobytes()!r}"
    recording = rr.RecordingStream(f"{signals.robot.name} {hashlib.sha256(told.encode()).hexdigest()[:8]}")
    stream = recording.binary_stream()  # in memory: a failing disk then shows as an OSError where the file is written
    try:
        recording.send_recording_name(f"{signals.recording}, {fit.method.upper()}")
        recording.send_blueprint(_layout(recording, signals, fit))
    finally:
        content = stream.read()  # after a failure too: rerun warns of what it drops
        recording.disconnect()
    with whole_file(path) as partial:
        partial.write_bytes(content)


def _layout(recording: Any, signals: Signals, fit: Fit) -> Any:
    """All panels: a page with the answer, then pages with the evidence."""
    joints, seen = signals.robot.joints, _observed(signals, fit)
    n, parameters = len(joints), parameter_drawing(fit)

    def views(panels: Sequence[Plot | Bars | Drawing]) -> list[Any]:
        return [_show(recording, panel) for panel in panels]

    torque = rrb.Grid(
        *views([torque_plot(signals, fit, seen, j) for j in range(n)]), grid_columns=1 if n <= 3 else min(4, -(-n // 2))
    )
    motion = [rrb.Horizontal(*views(motion_plots(signals, fit, seen, j)), name=joints[j].name) for j in range(n)]
    recording.log("report", rr.TextDocument(fit_markdown(signals, fit), media_type="text/markdown"), static=True)
    height = parameters.size[1] + 40
    answer = rrb.Horizontal(
        rrb.Vertical(torque, rrb.Tabs(*motion) if n > 1 else motion[0], row_shares=[3, 2]),
        rrb.Vertical(
            *views([parameters]),
            rrb.TextDocumentView(origin="report", name="report"),
            row_shares=[height, max(350.0, 1000.0 - height)],
        ),
        column_shares=[5, 2],
        name="torque and motion",
    )
    bars = [b for j in range(n) for b in residual_bars(signals, fit, seen, j)]
    by_kind = [*bars[::2], *bars[1::2]]
    evidence = [rrb.Grid(*views(by_kind), grid_columns=len(bars) // 2, name="residual")] if bars else []
    return rrb.Blueprint(
        rrb.Tabs(answer, *evidence, active_tab=0),
        rrb.TimePanel(state="collapsed", timeline="time"),
        collapse_panels=True,
        auto_views=False,
        auto_layout=False,
    )


def _show(recording: Any, panel: Plot | Bars | Drawing) -> Any:
    """Write a panel's data as entities under its path; return the view of them."""
    origin = rr.new_entity_path(list(panel.path))

    def log(key: str, what: Any) -> None:
        recording.log(f"{origin}/{key}", what, static=True)

    match panel:
        case Plot():
            for c in panel.curves:
                style = {"names": c.name or c.key, "colors": c.color, "widths": c.width, "visible_series": c.visible}
                # Rerun's own rule averages what falls on one pixel, and so loses peaks.
                log(c.key, rr.SeriesLines(**style, aggregation_policy="MinMax"))
                time = rr.TimeColumn("time", duration=np.rint(1e9 * c.line[0]).astype("timedelta64[ns]"))
                columns = rr.Scalars.columns(scalars=c.line[1])
                recording.send_columns(f"{origin}/{c.key}", indexes=[time], columns=columns)
            legend = rrb.PlotLegend(corner=_emptiest_corner(panel.curves))
            axis = rrb.TimeAxis(link="LinkToGlobal")
            return rrb.TimeSeriesView(origin=origin, name=panel.title, axis_x=axis, plot_legend=legend)
        case Bars():
            for key, (left, width, heights), color in (("back", panel.back, (*GREY, 120)), ("front", panel.front, RED)):
                log(key, rr.BarChart(heights, abscissa=left, widths=np.full(len(left), width), color=color))
            return rrb.BarChartView(origin=origin, name=panel.title, plot_legend=rrb.PlotLegend(visible=False))
        case Drawing():
            xy, texts, colors = zip(*(((x, y), text, color) for x, y, text, color in panel.labels), strict=True)
            none = rr.Radius.ui_points(0.1)
            log("labels", rr.Points2D(xy, labels=texts, colors=colors, radii=none, show_labels=True))
            strips, colors, radii = zip(*panel.strokes, strict=True)
            log("strokes", rr.LineStrips2D(strips, colors=colors, radii=rr.Radius.ui_points(radii)))
            xy, colors = zip(*(((x, y), color) for x, y, color in panel.dots), strict=True)
            log("dots", rr.Points2D(xy, colors=colors, radii=rr.Radius.ui_points(3.0), draw_order=50.0))
            bounds = rrb.VisualBounds2D(x_range=[0, panel.size[0]], y_range=[0, panel.size[1]])
            return rrb.Spatial2DView(origin=origin, name=panel.title, visual_bounds=bounds)


def _emptiest_corner(curves: Sequence[Curve]) -> str:
    """Where a legend hides least of the curves."""
    t, x = (np.concatenate([c.line[i] for c in curves if c.visible]) for i in (0, 1))
    right, left = t > t.min() + 0.72 * np.ptp(t), t < t.min() + 0.28 * np.ptp(t)
    top, bottom = x > x.min() + 0.65 * np.ptp(x), x < x.min() + 0.35 * np.ptp(x)
    corners = {
        "RightTop": right & top,
        "RightBottom": right & bottom,
        "LeftTop": left & top,
        "LeftBottom": left & bottom,
    }
    return min(corners, key=lambda corner: int(corners[corner].sum()))


@dataclass(frozen=True, kw_only=True, eq=False)
class Observed:
    """What curves show, for each joint by quantity (q, dq, ddq, tau), thinned; `modelled` is filtered, its tau predicted.

    rows_t_s (rows,), residual (rows, n): the decimated rows that the estimator saw, all of them.
    """

    measured: dict[str, list[Line]]
    modelled: dict[str, list[Line]]
    rows_t_s: Vector
    residual: Vector


def _observed(signals: Signals, fit: Fit) -> Observed:
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


def fit_markdown(signals: Signals, fit: Fit) -> str:
    """The report as Markdown: errors, warnings, settings, parameters, what is drawn."""
    told, step = fit_json(signals, fit), thinning(signals)
    parameters, kept = told["parameters"], told["essential"]
    regrouped = [p for p in parameters if p["expression"] != p["name"]]

    def number(x: float | None, form: str) -> str:
        return "-" if x is None else format(x, form)

    percent = ("relative_error_percent", "moving_relative_error_percent", "standing_relative_error_percent")
    lines = [
        f"# {signals.robot.name}: {number(told[percent[0]], '.1f')} % relative torque error",
        *(f"- **warning: {warning}**" for warning in fit.warnings),
        f"- {fit.method.upper()}, {fit.status}: {len(parameters)} parameters, {len(kept['names'])} of them essential",
        *(f"- {line}" for line in plan_lines(signals, fit.plan)),
        f"- cond(W) {told['condition_number']:.4g}, scaled {told['condition_number_scaled']:.4g}; {told['rows']} rows",
        "\n## Relative torque error, %",
        "| joint | unit | all rows | moving | standing |\n|---|---|--:|--:|--:|",
        *(
            f"| {e['name']} | {e['unit']} | {' | '.join(number(e[p], '.2f') for p in percent)} |"
            for e in told["joints"]
        ),
        "\n## Parameters",
        "| name | value | σ | % | σ HAC | unit | |\n|---|--:|--:|--:|--:|---|---|",
        *(
            f"| {p['name']} | {p['value']:.4g} | {p['sigma']:.2g} | {number(p['sigma_percent'], '.3g')} | "
            f"{number(p['sigma_hac'], '.2g')} | {p['unit']} | {'essential' if p['essential'] else ''} |"
            for p in parameters
        ),
        "\nσ assumes white residuals; σ HAC (Newey, West) holds for correlated ones too.",
        *(["\n## What they stand for"] if regrouped else []),
        *(f"- {p['name']} = {p['expression']}" for p in regrouped),
        "\n## What is drawn",
        "- Measured: the recording as it is, all of it; dq and ddq are central differences of the raw position, and off "
        "where noise would drown the rest: a click in the legend shows them.",
        "- Filtered and predicted: the span fitted; predicted is the model along the filtered motion, undecimated.",
        "- Residual: of the decimated rows, measured and modelled torque through the same filter, as fitted; its "
        "autocorrelation over the lag, in grey the bounds ±2/√N of white noise; its distribution as numbers of rows, in grey "
        "the normal one.",
        "- Curves show every sample."
        if step == 1
        else f"- Of every {step} samples curves show the lowest and the highest.",
        f"\n`{signals.recording}` sha256 `{signals.sha256}`",
    ]
    return "\n".join(lines) + "\n"
