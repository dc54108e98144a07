"""A fit as a Rerun file: is the torque explained, what was the motion, which parameters came out, is the residual noise.

What is shown is plain data of `panels`. `_show` writes one of these into the file and returns the
panel that shows it, and the layout is built of such panels only: none can be without data.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from acquisition.whole_file import whole_file

from .fit import Fit
from .panels import (
    GREY,
    RED,
    Bars,
    Curve,
    Drawing,
    Plot,
    motion_plots,
    observed,
    parameter_drawing,
    residual_bars,
    spectrum_drawings,
    thinning,
    torque_plot,
)
from .report import fit_json, plan_lines
from .signals import Signals


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
    joints, seen = signals.robot.joints, observed(signals, fit)
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
    spectra = views(spectrum_drawings(signals, fit))
    if spectra:
        evidence.append(rrb.Horizontal(*spectra, name="spectra"))
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
            if panel.dots:
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
