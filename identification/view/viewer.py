"""Write Rerun files with their own layout and pages.

The content is the plain data of `panels`. `show` writes a panel into the file and returns its view; the layout contains only
such views, so none is without data.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import rerun.blueprint as rrb

from ..arrays import Array
from ..data import Signals
from ..design import Excitation, friction_of_joints
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
from .charts import (
    deviation_drawing,
    friction_drawing,
    intervals_drawing,
    parameter_drawing,
    passes_drawing,
    study_drawing,
    trust_drawing,
)
from .curves import (
    Lines,
    column_plots,
    drift_plots,
    excitation_plots,
    extra_plots,
    lines_of,
    motion_plots,
    position_plots,
    torque_plots,
)
from .panels import Note
from .rerun_panels import Show, shown_text, write_pages
from .robot_drawing import excitation_scene, robot_scene
from .signal_panels import (
    event_log,
    health_plot,
    legend,
    numbers_of_plots,
    residual_bars,
    span_lanes,
    spectrum_drawings,
)


def write_fit_rrd(path: Path, signals: Signals, fit: Fit, *, truth: Array | None = None) -> None:
    """Write a fit as a Rerun file with its own layout (`rerun fit.rrd`).

    A fit by IV is shown together with its least squares. Times are seconds from the recording's first sample, on the
    timeline `time`. Measured curves cover the recording, filtered and predicted ones the fitted span. Entities are
    `q/<joint>/measured`, `measured_filtered`, `reference`, `simulated`, and so for `dq` and `ddq`;
    `error/<joint>/reference`, `simulated`: these positions minus the measured one, in the unit of the plot's title;
    `torque/<joint>/measured`, `model_idm`, `model_ddm`, `residual`; `robot`, `parameters`, `trust`, `passes`,
    `friction`, `residual`, `spectrum`, `session`, `events`, `health`, `extra/<object>/<motor>`, `report`.

    Raises `AcquisitionError`: the file cannot be written.
    """
    true = truth.tobytes() if truth is not None else b""
    identity = (
        f"{signals.sha256} {fit.method} {fit.settings} {fit.estimate.names} {fit.estimate.beta.tobytes()!r} {true!r}"
    )
    name = f"{signals.recording}, {fit.method.upper()}"
    write_pages(path, signals.robot.name, identity, name, lambda show: _fit_pages(show, signals, fit, truth))


def write_friction_rrd(path: Path, before: Fit, after: Fit, document: Document) -> None:
    """Write the fits with the usual and with the recommended friction terms as a Rerun file.

    Entities are `friction/<joint>/usual`, `friction/<joint>/recommended`, and `report`.

    Raises `AcquisitionError`: the file cannot be written.
    """
    robot = before.problem.signals.robot.name
    recording = ", ".join(one.problem.signals.recording for one in before.recordings)
    fits = {"usual": before, "recommended": after}
    identity = " ".join([recording, *(repr(fit.estimate.beta.tobytes()) for fit in fits.values())])

    def pages(show: Show) -> list[Any]:
        page, report = _friction_page(show, fits), show(_report(document))
        return [rrb.Horizontal(page, report, column_shares=[5, 2], name="friction")]

    write_pages(path, robot, identity, f"{recording}, friction", pages)


def write_recording_rrd(path: Path, signals: Signals, overrides: Overrides) -> None:
    """Write a recording as a Rerun file, with the panels that need no fit.

    Entities as in `write_fit_rrd`.

    Raises `AcquisitionError`: the file cannot be written.
    """
    refusal, settings = None, None
    try:
        settings = make_settings(signals, overrides)
    except IdentificationError as error:
        refusal = str(error)

    def pages(show: Show) -> list[Any]:
        lines = lines_of(signals, settings, None)
        sections = numbers_of_plots(signals, None), legend(signals, settings, None)
        report = show(_report(recording_document(signals, settings, refusal).followed_by(*sections)))
        return _signal_pages(show, signals, settings, None, lines, answer=report)

    write_pages(path, signals.robot.name, f"{signals.sha256} {settings}", signals.recording, pages)


def write_comparison_rrd(path: Path, own: ParameterSet, other: ParameterSet) -> None:
    """Write two sets of parameters as a Rerun file: entities `trust` and `report`.

    Raises `AcquisitionError`: the file cannot be written. Raises `IdentificationError`: the sets do not
    belong together (`report.differences`).
    """
    document, name = comparison_document(own, other), f"{own.label} and {other.label}"
    drawing = deviation_drawing(own, [other])

    def pages(show: Show) -> list[Any]:
        views = show(drawing), show(_report(document))
        return [rrb.Horizontal(*views, column_shares=[3, 1], name="parameters")]

    write_pages(path, name, repr((own, other)), name, pages)


def write_study_rrd(path: Path, robot: str, runs: Sequence[Run], true: Array, document: Document) -> None:
    """Write a study as a Rerun file: entities `study` (errors of all runs and their medians) and `report`.

    Raises `AcquisitionError`: the file cannot be written.
    """
    identity = repr([(run.number, run.iv and run.iv.error, run.ls and run.ls.error) for run in runs])

    def pages(show: Show) -> list[Any]:
        views = show(study_drawing(runs, true)), show(_report(document))
        return [rrb.Horizontal(*views, column_shares=[3, 2], name="study")]

    write_pages(path, f"{robot} study", identity, f"{robot}, study", pages)


def write_excitation_rrd(path: Path, excitation: Excitation, document: Document) -> None:
    """Write one period of a reference with its limits, and the expected intervals, as a Rerun file of one page.

    Entities are `q/<joint>`, `dq/<joint>` and, if known, `torque/<joint>`, each with `reference`, `low` and `high`;
    `robot`, `intervals`, `report`.

    Raises `AcquisitionError`: the file cannot be written.
    """
    robot, identity = excitation.robot.name, f"{excitation.settings} {excitation.sigma.tobytes()!r}"

    def pages(show: Show) -> list[Any]:
        motion = [rrb.Vertical(*map(show, plots)) for plots in excitation_plots(excitation)]
        side = rrb.Vertical(show(intervals_drawing(excitation)), show(_report(document)), row_shares=[3, 2])
        main = rrb.Vertical(show(excitation_scene(excitation)), rrb.Horizontal(*motion), row_shares=[2, 3])
        return [rrb.Horizontal(main, side, column_shares=[5, 2], name="excitation")]

    write_pages(path, f"{robot} excitation", identity, f"{robot}, excitation", pages)


def write_fleet_rrd(path: Path, series: Sequence[Drift], document: Document) -> None:
    """Write the drift of a fleet as a Rerun file, a page per robot: entities `drift/<robot>/<number>`, and `report`.

    Times are relative to the first recording in the chart, on the timeline `time`.

    Raises `AcquisitionError`: the file cannot be written.
    """
    names = ", ".join(drift.name for drift in series)
    identity = repr([(row.sha256, row.parameters) for drift in series for row in drift.rows])

    def pages(show: Show) -> list[Any]:
        report, pages_of_robots = show(_report(document)), []
        for drift in series:
            views = [show(plot) for plot in drift_plots(drift)]
            starts = range(0, len(views), 16)
            tabs = [rrb.Grid(*views[k : k + 16], grid_columns=4, name=f"from {k + 1}") for k in starts]
            charts = rrb.Tabs(*tabs, active_tab=0)
            pages_of_robots.append(rrb.Horizontal(charts, report, column_shares=[5, 2], name=shown_text(drift.name)))
        return pages_of_robots or [rrb.Horizontal(report, name="report")]

    write_pages(path, f"fleet {names}", identity, "fleet", pages)


def _report(document: Document) -> Note:
    return Note(path=("report",), title="report", text=to_markdown(document))


def _fit_pages(show: Show, signals: Signals, fit: Fit, truth: Array | None) -> list[Any]:
    """A page with the result, then pages with the evidence."""
    n, own = signals.robot.n, fitted_parameters(fit)
    others = [least_squares_parameters(fit)] if fit.iv else []
    others += [true_parameters(fit.base, truth)] if truth is not None else []
    parameters = parameter_drawing(own, others)
    height = parameters.size[1] + 40
    compared = (comparison_section(own, other) for other in others)
    sections = (numbers_of_plots(signals, fit), *compared, legend(signals, fit.settings, fit))
    report = _report(fit_document(signals, fit).followed_by(*sections))
    side = rrb.Vertical(show(parameters), show(report), row_shares=[height, max(350.0, 1000.0 - height)])
    deviations = [show(deviation_drawing(own, others)), *([show(passes_drawing(fit))] if fit.iv else [])]
    tests = trust_drawing(fit.trust)
    verdict = Note(path=("verdict",), title="verdict", text=to_markdown(trust_document(fit)))
    trust = [show(panel) for panel in (tests, verdict) if panel is not None]
    bars = [b for j in range(n) for b in residual_bars(signals, fit, j)]
    columns = min(len(bars) // 2, 3 if n <= 6 else 4)
    residual = [rrb.Grid(*map(show, bars[k::2]), grid_columns=columns) for k in (0, 1) if bars]
    lines = lines_of(signals, fit.settings, fit)
    answer, *others_of_signals = _signal_pages(show, signals, fit.settings, fit, lines, answer=side)
    return [
        answer,
        rrb.Horizontal(*trust, name="trust"),
        rrb.Horizontal(*deviations, column_shares=[3, 1][: len(deviations)], name="parameters"),
        *([rrb.Vertical(*residual, name="residual")] if residual else []),
        _friction_page(show, {"": fit}),
        *others_of_signals,
    ]


def _signal_pages(
    show: Show, signals: Signals, settings: Settings | None, fit: Fit | None, lines: Lines, *, answer: Any
) -> list[Any]:
    """The pages of a recording with or without a fit: overview, signal quality, extra objects of drives, motion."""
    n, joints = signals.robot.n, signals.robot.joints
    # The overview: tracking and the robot above, torques below, the result at the side.
    grid = 1 if n == 1 else 2 if n == 2 else 3 if n <= 6 else 4
    follow = rrb.Horizontal(
        rrb.Grid(*map(show, position_plots(signals, fit, lines)), grid_columns=grid),
        show(robot_scene(signals, fit)),
        column_shares=[2 if n <= 4 else 3, 1],
    )
    explained = rrb.Grid(*map(show, torque_plots(signals, fit, lines)), grid_columns=grid)
    both = rrb.Vertical(follow, explained, row_shares=[4, 5])
    pages = [rrb.Horizontal(both, answer, column_shares=[5, 2], name="overview" if fit else "recording")]
    # Rows of the signal page with their shares of the height.
    rows: list[tuple[Any, float]] = []
    if spectra := [show(drawing) for drawing in spectrum_drawings(signals, settings)]:
        rows.append((rrb.Horizontal(*spectra), 5.0))
    if columns := [show(plot) for plot in column_plots(signals)]:
        rows.append((rrb.Horizontal(*columns), 3.0))
    if lanes := span_lanes(signals, settings, fitted=fit is not None):
        rows.append((show(lanes), 0.6 + 0.4 * len(lanes.lanes)))
    if below := [show(panel) for panel in (health_plot(signals), event_log(signals)) if panel is not None]:
        rows.append((rrb.Horizontal(*below), 2.0))
    if rows:
        views, shares = zip(*rows, strict=True)
        pages.append(rrb.Vertical(*views, row_shares=list(shares), name="signal"))
    if extras := [show(plot) for plot in extra_plots(signals)]:
        pages.append(rrb.Grid(*extras, grid_columns=1 if len(extras) < 4 else 2, name="extra objects"))
    motion = [[show(plot) for plot in motion_plots(signals, fit, lines, j)] for j in range(n)]
    tabs = [rrb.Vertical(*plots, name=shown_text(j.name)) for plots, j in zip(motion, joints, strict=True)]
    pages.append(rrb.Tabs(*tabs, name="motion") if n > 1 else rrb.Vertical(*motion[0], name="motion"))
    return pages


def _friction_page(show: Show, fits: Mapping[str, Fit]) -> Any:
    """Friction of each joint over its speed, for one fit or several fits side by side."""
    drawings = [
        [show(friction_drawing(friction, of=name)) for friction in friction_of_joints(fit)]
        for name, fit in fits.items()
    ]
    n = len(drawings[0])
    order = [view for of_joint in zip(*drawings, strict=True) for view in of_joint]
    columns = min(3, n) if len(fits) == 1 else 2 if n < 3 else 4
    return rrb.Grid(*order, grid_columns=columns, name="friction")
