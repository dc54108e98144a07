"""A recording, its fit, or two fits as a Rerun file that opens with its own layout. The pages of each.

What is shown is plain data of `panels`. `show` writes one of these into the file and returns the view of it,
and the layout is built of such views only: none can be without data.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rerun.blueprint as rrb

from ..arrays import Array
from ..data import Signals
from ..design import Excitation
from ..errors import IdentificationError
from ..methods import (
    Fit,
    fit_document,
    fitted_parameters,
    least_squares_parameters,
    recording_document,
    true_parameters,
    trust_document,
)
from ..regression import Overrides, Settings, make_settings
from ..report import Document, ParameterSet, comparison_document, comparison_section, to_markdown
from ..study import Drift, Run
from .charts import deviation_drawing, parameter_drawing, passes_drawing, study_drawing, trust_drawing
from .curves import column_plots, motion_plots, observed, position_plots, torque_plots
from .design_panels import excitation_page, fleet_pages, friction_page
from .panels import Chart, Note, Plot, report_note
from .rerun_panels import Show, shown_text, write_pages
from .robot_drawing import robot_scene
from .signal_panels import (
    event_log,
    extra_plots,
    fit_legend,
    health_plot,
    numbers_of_plots,
    recording_legend,
    residual_bars,
    span_lanes,
    spectrum_drawings,
)


def write_fit_rrd(path: Path, signals: Signals, fit: Fit, *, truth: Array | None = None) -> None:
    """Write a fit as a Rerun file that opens with its own layout (`rerun fit.rrd`).

    A fit by instruments is shown with its least squares. Times are seconds from the recording's first sample, on the
    timeline `time`. Measured curves span the recording, filtered and predicted ones what the fit used of it. Entities are
    `q/<joint>/measured`, `measured_filtered`, `reference`, `simulated`, and so for `dq` and `ddq`;
    `error/<joint>/reference`, `simulated`: these positions minus the measured one, in the unit of the plot's title;
    `torque/<joint>/measured`, `model_idm`, `model_ddm`, `residual`; `robot`, `parameters`, `trust`, `passes`,
    `friction`, `residual`, `spectrum`, `session`, `events`, `health`, `extra/<object>/<motor>`, `report`.

    Raises `AcquisitionError`: where the file cannot be written.
    """
    # A viewer holds one layout per application, and a layout is of its data: each fit is an application of its own.
    compared = truth.tobytes() if truth is not None else b""
    identity = f"{signals.sha256} {fit.method} {fit.settings} {fit.estimate.names} {fit.estimate.beta.tobytes()!r} {compared!r}"
    name = f"{signals.recording}, {fit.method.upper()}"
    write_pages(path, signals.robot.name, identity, name, lambda show: _fit_pages(show, signals, fit, truth))


def write_friction_rrd(path: Path, before: Fit, after: Fit, document: Document) -> None:
    """Write the fits with the usual and with the recommended friction terms as a Rerun file.

    Entities are `friction/<joint>/usual`, `friction/<joint>/recommended`, and `report`.

    Raises `AcquisitionError`: where the file `path` cannot be written.
    """
    robot = before.problem.signals.robot.name
    recording = ", ".join(one.problem.signals.recording for one in before.recordings)
    fits = {"usual": before, "recommended": after}

    def pages(show: Show) -> list[Any]:
        page, note = friction_page(show, fits), show(report_note(document))
        return [rrb.Horizontal(page, note, column_shares=[5, 2], name="friction")]

    identity = " ".join(repr(fit.estimate.beta.tobytes()) for fit in fits.values())
    write_pages(path, robot, f"{recording} {identity}", f"{recording}, friction", pages)


def write_recording_rrd(path: Path, signals: Signals, overrides: Overrides) -> None:
    """Write a recording that has not been fitted as a Rerun file, with the panels of a fit that need none.

    Entities as in `write_fit_rrd`.

    Raises `AcquisitionError`: where the file cannot be written.
    """
    refusal, settings = None, None
    try:
        settings = make_settings(signals, overrides)
    except IdentificationError as error:
        refusal = str(error)
    write_pages(
        path,
        signals.robot.name,
        f"{signals.sha256} {settings}",
        signals.recording,
        lambda show: _recording_pages(show, signals, settings, refusal),
    )


def write_comparison_rrd(path: Path, own: ParameterSet, other: ParameterSet) -> None:
    """Write two sets of parameters as a Rerun file: entities `trust` and `report`.

    Raises `AcquisitionError`: where the file `path` cannot be written. Raises `IdentificationError`: where the sets do
    not belong together, as `report.differences` has it.
    """
    document, name = comparison_document(own, other), f"{own.label} and {other.label}"
    drawing = deviation_drawing(own, [other])
    write_pages(
        path, name, repr((own, other)), name, lambda show: _drawing_page(show, drawing, document, "parameters", (3, 1))
    )


def write_study_rrd(path: Path, robot: str, runs: Sequence[Run], true: Array, document: Document) -> None:
    """Write a study as a Rerun file: entities `study`, every run's error and their medians, and `report`.

    Raises `AcquisitionError`: where the file cannot be written.
    """
    drawing, identity = (
        study_drawing(runs, true),
        repr([(run.number, run.iv and run.iv.error, run.ls and run.ls.error) for run in runs]),
    )
    write_pages(
        path,
        f"{robot} study",
        identity,
        f"{robot}, study",
        lambda show: _drawing_page(show, drawing, document, "study", (3, 2)),
    )


def write_excitation_rrd(path: Path, excitation: Excitation, document: Document) -> None:
    """Write a period of a reference with its limits, and the expected intervals, as one page of a Rerun file.

    Entities are `q/<joint>`, `dq/<joint>` and, where it is known, `torque/<joint>`, each with `reference`, `low` and `high`;
    `robot`, `intervals`, `report`.

    Raises `AcquisitionError`: where the file cannot be written.
    """
    robot, identity = excitation.robot.name, f"{excitation.settings} {excitation.sigma.tobytes()!r}"
    name = f"{robot}, excitation"
    write_pages(path, f"{robot} excitation", identity, name, lambda show: excitation_page(show, excitation, document))


def write_fleet_rrd(path: Path, series: Sequence[Drift], document: Document) -> None:
    """Write the drift of a fleet as a Rerun file, a page per robot: entities `drift/<robot>/<number>`, and `report`.

    Times are those from the first recording charted, on the timeline `time`.

    Raises `AcquisitionError`: where the file cannot be written.
    """
    names = ", ".join(drift.name for drift in series)
    identity = repr([(row.sha256, row.parameters) for drift in series for row in drift.rows])
    write_pages(path, f"fleet {names}", identity, "fleet", lambda show: fleet_pages(show, series, document))


def _fit_pages(show: Show, signals: Signals, fit: Fit, truth: Array | None) -> list[Any]:
    """A page with the answer, then pages with the evidence."""
    n, seen = signals.robot.n, observed(signals, fit.settings, fit)
    own = fitted_parameters(fit)
    others = [least_squares_parameters(fit)] if fit.iv else []
    others += [true_parameters(fit.base, truth)] if truth is not None else []
    parameters = parameter_drawing(own, others)
    height = parameters.size[1] + 40
    compared = (comparison_section(own, other) for other in others)
    sections = (numbers_of_plots(signals, fit, seen), *compared, fit_legend(signals, fit))
    report = report_note(fit_document(signals, fit, everything=True).followed_by(*sections))
    side = rrb.Vertical(show(parameters), show(report), row_shares=[height, max(350.0, 1000.0 - height)])
    curves = position_plots(signals, fit, seen), torque_plots(signals, fit, seen)
    deviations = [show(deviation_drawing(own, others)), *([show(passes_drawing(fit))] if fit.iv else [])]
    judged = show(Note(path=("verdict",), title="verdict", text=to_markdown(trust_document(fit))))
    tests = trust_drawing(fit.trust)
    views = [show(tests), judged] if tests else [judged]
    trust = rrb.Horizontal(*views, name="trust")
    bars = [b for j in range(n) for b in residual_bars(signals, fit, seen, j)]
    columns = min(len(bars) // 2, 3 if n <= 6 else 4)
    residual = [rrb.Grid(*map(show, bars[k::2]), grid_columns=columns) for k in (0, 1) if bars]
    return [
        _answer(show, signals, fit, *curves, side),
        trust,
        rrb.Horizontal(*deviations, column_shares=[3, 1][: len(deviations)], name="parameters"),
        *([rrb.Vertical(*residual, name="residual")] if residual else []),
        friction_page(show, {"": fit}),
        *_signal_pages(show, signals, fit.settings, fitted=True),
        _motion_page(signals, [[show(p) for p in motion_plots(signals, fit, seen, j)] for j in range(n)]),
    ]


def _recording_pages(show: Show, signals: Signals, settings: Settings | None, refusal: str | None) -> list[Any]:
    n, seen = signals.robot.n, observed(signals, settings, None)
    sections = numbers_of_plots(signals, None, seen), recording_legend(signals, settings)
    report = report_note(recording_document(signals, settings, refusal).followed_by(*sections))
    curves = position_plots(signals, None, seen), torque_plots(signals, None, seen)
    return [
        _answer(show, signals, None, *curves, show(report)),
        *_signal_pages(show, signals, settings, fitted=False),
        _motion_page(signals, [[show(p) for p in motion_plots(signals, None, seen, j)] for j in range(n)]),
    ]


def _drawing_page(show: Show, drawing: Chart, document: Document, name: str, shares: tuple[int, int]) -> list[Any]:
    """One page: a drawing and its report."""
    return [rrb.Horizontal(show(drawing), show(report_note(document)), column_shares=list(shares), name=name)]


def _answer(
    show: Show, signals: Signals, fit: Fit | None, tracking: Sequence[Plot], torque: Sequence[Plot], side: Any
) -> Any:
    """The first page: did the robot follow, beside it the robot; is the torque explained; at the side what came out."""
    n = signals.robot.n
    columns = 1 if n == 1 else 2 if n == 2 else 3 if n <= 6 else 4
    follow = rrb.Horizontal(
        rrb.Grid(*map(show, tracking), grid_columns=columns),
        show(robot_scene(signals, fit)),
        column_shares=[2 if n <= 4 else 3, 1],
    )
    explained = rrb.Grid(*map(show, torque), grid_columns=1 if n == 1 else 2 if n == 2 else columns)
    name = "overview" if fit else "recording"
    return rrb.Horizontal(rrb.Vertical(follow, explained, row_shares=[4, 5]), side, column_shares=[5, 2], name=name)


def _signal_pages(show: Show, signals: Signals, settings: Settings | None, *, fitted: bool) -> list[Any]:
    """How good was the signal: spectra, optional columns, phases, the counters, events; extra objects of drives."""
    spectra = [show(drawing) for drawing in spectrum_drawings(signals, settings)]
    lanes = span_lanes(signals, settings, fitted=fitted)
    below = [show(panel) for panel in (health_plot(signals), event_log(signals)) if panel is not None]
    rows = [(rrb.Horizontal(*spectra), 5.0)] if spectra else []
    columns = [show(plot) for plot in column_plots(signals)]
    rows += [(rrb.Horizontal(*columns), 3.0)] if columns else []
    rows += [(show(lanes), 0.6 + 0.4 * len(lanes.lanes))] if lanes else []
    rows += [(rrb.Horizontal(*below), 2.0)] if below else []
    pages = []
    if rows:
        views, shares = zip(*rows, strict=True)
        pages.append(rrb.Vertical(*views, row_shares=list(shares), name="signal"))
    if extras := [show(plot) for plot in extra_plots(signals)]:
        pages.append(rrb.Grid(*extras, grid_columns=1 if len(extras) < 4 else 2, name="extra objects"))
    return pages


def _motion_page(signals: Signals, rows: list[list[Any]]) -> Any:
    joints = [
        rrb.Vertical(*views, name=shown_text(j.name)) for j, views in zip(signals.robot.joints, rows, strict=True)
    ]
    return rrb.Tabs(*joints, name="motion") if len(joints) > 1 else rrb.Vertical(*rows[0], name="motion")
