"""The pages of a result: which panels it has, in which order. The renderers, Rerun and HTML, show these lists."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..arrays import Array
from ..data import Signals
from ..design import Excitation, friction_of_joints
from ..errors import IdentificationError
from ..methods import (
    Fit,
    Validated,
    fit_document,
    fitted_parameters,
    least_squares_parameters,
    recording_document,
    true_parameters,
    trust_document,
)
from ..regression import Overrides, Settings, make_settings, with_bandwidth
from ..report import Document, ParameterSet, comparison_section
from ..study import Drift, Run
from .charts import deviation_drawing, intervals_drawing, parameter_drawing, study_drawing
from .curves import (
    column_plots,
    drift_plots,
    excitation_plots,
    lines_of,
    motion_plots,
    position_plots,
    row_plots,
    torque_plots,
)
from .fit_charts import friction_drawing, gains_drawing, passes_drawing, trust_drawing
from .panels import Note, Page, Panel, Picture
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


def draw_fit(signals: Signals, fit: Fit, *, truth: Array | None = None) -> Picture:
    """A fit on one of its recordings. A fit by IV is shown together with its least squares.

    Times are seconds from the recording's first sample, on the timeline `time`. Measured curves cover the recording, filtered
    and predicted ones the fitted span. Entities are `q/<joint>/measured`, `measured_filtered`, `reference`, `simulated`, and so
    for `dq` and `ddq`; `error/<joint>/reference`, `simulated`: these positions minus the measured one, in the unit of the
    plot's title; `torque/<joint>/measured`, `model_idm`, `model_ddm`; `residual/<joint>/time`, `autocorrelation`,
    `distribution`; `robot`, `parameters`, `deviations`, `tests`, `passes`, `friction`, `spectrum`, `session`, `events`,
    `health`, `report`.
    """
    own = fitted_parameters(fit)
    others = [least_squares_parameters(fit)] if fit.iv else []
    others += [true_parameters(fit.base, truth)] if truth is not None else []
    compared = (comparison_section(own, other) for other in others)
    sections = (numbers_of_plots(signals, fit), *compared, legend(signals, fit.settings, fit))
    document = fit_document(signals, fit).followed_by(*sections)
    verdict = Note(path=("verdict",), title="verdict", document=trust_document(fit))
    overview, *of_signals = _signal_pages(signals, fit.settings, fit, [parameter_drawing(own, others)], document)
    tests: dict[str, Sequence[Panel]] = {"tests": [trust_drawing(fit.trust)], "verdict": [verdict]}
    parameters: dict[str, Sequence[Panel]] = {
        "deviations": [deviation_drawing(own, others)],
        "passes": [passes_drawing(fit)] if fit.iv else [],
    }
    parameters["gains"] = [gains_drawing(fit.gains)] if fit.gains else []
    bars = [residual_bars(signals, fit, j) for j in range(signals.robot.n)]
    residual: dict[str, Sequence[Panel]] = {
        "time": row_plots(signals.robot, fit.t_s, fit.tau, fit.tau_predicted, "")[1]
    }
    residual |= {kind: [b[k] for b in bars if b] for k, kind in enumerate(("autocorrelation", "distribution"))}
    return Picture(
        name=f"{signals.robot.name}, {signals.recording}, {fit.method.upper()}",
        document=document,
        pages=(
            overview,
            Page(name="trust", groups=tests),
            Page(name="parameters", groups=parameters),
            Page(name="residual", groups=residual, layout="rows"),
            _friction_page({"": fit}),
            *of_signals,
        ),
        sha256={one.problem.signals.recording: one.problem.signals.sha256 for one in fit.recordings},
    )


def draw_friction(before: Fit, after: Fit, document: Document) -> Picture:
    """The fits with the usual and with the recommended friction terms.

    Entities are `friction/<joint>/usual`, `friction/<joint>/recommended`, and `report`.
    """
    recording = ", ".join(one.problem.signals.recording for one in before.recordings)
    fits = {"usual": before, "recommended": after}
    return Picture(
        name=f"{before.problem.signals.robot.name}, {recording}, friction",
        document=document,
        pages=(_friction_page(fits, document),),
        sha256={one.problem.signals.recording: one.problem.signals.sha256 for one in before.recordings},
    )


def draw_validation(validated: Sequence[Validated], document: Document, sha256: Mapping[str, str]) -> Picture:
    """Recordings that a fit is applied to, a page each: measured and modelled torque of the rows, and their difference."""
    pages = []
    for one in validated:
        t_s = one.signals.t_s[one.settings.start : one.settings.stop : one.settings.decimation][: len(one.tau)]
        torque, residual = row_plots(one.signals.robot, t_s, one.tau, one.tau_predicted, one.signals.recording)
        pages.append(Page(name=one.signals.recording, groups={"torque": torque, "residual": residual}))
    digests = {**sha256, **{one.signals.recording: one.signals.sha256 for one in validated}}
    title = f"{validated[0].signals.robot.name} validation"
    return Picture(name=title, document=document, pages=tuple(pages), sha256=digests)


def draw_recording(signals: Signals, overrides: Overrides) -> Picture:
    """A recording, with the panels that need no fit; entities as in `draw_fit`."""
    refusal, settings, signals = None, None, with_bandwidth(signals)
    try:
        settings = make_settings(signals, overrides)
    except IdentificationError as error:
        refusal = str(error)
    sections = numbers_of_plots(signals, None), legend(signals, settings, None)
    document = recording_document(signals, settings, refusal).followed_by(*sections)
    return Picture(
        name=f"{signals.robot.name}, {signals.recording}",
        document=document,
        pages=tuple(_signal_pages(signals, settings, None, [], document)),
        sha256={signals.recording: signals.sha256},
    )


def draw_comparison(own: ParameterSet, other: ParameterSet, document: Document, sha256: Mapping[str, str]) -> Picture:
    """Two sets of parameters: entities `deviations` and `report`.

    Raises `IdentificationError`: the sets do not belong together (`report.differences`).
    """
    name, groups = f"{own.label} and {other.label}", {"deviations": [deviation_drawing(own, [other])]}
    page = Page(name="parameters", groups=_with_report(document, groups))
    return Picture(name=name, document=document, pages=(page,), sha256=sha256)


def draw_study(robot: str, runs: Sequence[Run], document: Document) -> Picture:
    """A study: entities `study` (errors of all runs and their medians) and `report`."""
    page = Page(name="study", groups=_with_report(document, {"study": [study_drawing(runs)]}))
    return Picture(
        name=f"{robot}, study",
        document=document,
        pages=(page,),
        sha256={},
    )


def draw_excitation(excitation: Excitation, document: Document) -> Picture:
    """One period of a reference with its limits, and the expected intervals.

    Entities are `q/<joint>`, `dq/<joint>` and, if known, `torque/<joint>`, each with `reference`, `low` and `high`;
    `robot`, `intervals`, `report`.
    """
    robot, joints = excitation.robot.name, excitation.robot.joints
    motion = {f"joint {joint.name}": plots for joint, plots in zip(joints, excitation_plots(excitation), strict=True)}
    side: dict[str, Sequence[Panel]] = {
        "robot": [excitation_scene(excitation)],
        "intervals": [intervals_drawing(excitation)],
    }
    page = Page(name="excitation", groups=_with_report(document, side | motion), layout="excitation")
    return Picture(
        name=f"{robot}, excitation",
        document=document,
        pages=(page,),
        sha256={},
    )


def draw_fleet(series: Sequence[Drift], document: Document) -> Picture:
    """The drift of a fleet, a page per robot: entities `drift/<robot>/<number>`, and `report`.

    Times are those of the recordings, on the timeline `date`.
    """
    pages = [
        Page(name=one.name, groups=_with_report(document, {"drift": drift_plots(one)}), layout="drift")
        for one in series
    ]
    return Picture(
        name=f"fleet {', '.join(drift.name for drift in series)}",
        document=document,
        pages=tuple(pages) or (Page(name="report", groups=_with_report(document, {})),),
        sha256={row.file: row.sha256 for drift in series for row in drift.rows},
        timeline="date" if series else "time",
    )


def _with_report(document: Document, groups: Mapping[str, Sequence[Panel]]) -> Mapping[str, Sequence[Panel]]:
    return {**groups, "report": [Note(path=("report",), title="report", document=document)]}


def _made(*panels: Panel | None) -> list[Panel]:
    return [panel for panel in panels if panel is not None]


def _signal_pages(
    signals: Signals, settings: Settings | None, fit: Fit | None, parameters: Sequence[Panel], document: Document
) -> list[Page]:
    """The pages of a recording with or without a fit: overview, signal quality, motion."""
    lines = lines_of(signals, settings, fit)
    overview: dict[str, Sequence[Panel]] = {
        "position": position_plots(signals, fit, lines),
        "robot": [robot_scene(signals, fit)],
        "torque": torque_plots(signals, fit, lines),
        "parameters": parameters,
    }
    signal: dict[str, Sequence[Panel]] = {
        "spectrum": spectrum_drawings(signals, settings),
        "column": column_plots(signals),
        "session": _made(span_lanes(signals, settings, fitted=fit is not None)),
        "events": _made(health_plot(signals), event_log(signals)),
    }
    joints = enumerate(signals.robot.joints)
    motion = {joint.name: motion_plots(signals, fit, lines, j) for j, joint in joints}
    return [
        Page(name="overview" if fit else "recording", groups=_with_report(document, overview), layout="overview"),
        Page(name="signal", groups=signal, layout="signal"),
        Page(name="motion", groups=motion, layout="tabs"),
    ]


def _friction_page(fits: Mapping[str, Fit], document: Document | None = None) -> Page:
    """Friction of each joint over its speed, for one fit or several fits side by side."""
    of_fits = [[friction_drawing(one, of=name) for one in friction_of_joints(fit)] for name, fit in fits.items()]
    drawings: list[Panel] = [drawing for of_joint in zip(*of_fits, strict=True) for drawing in of_joint]
    groups: Mapping[str, Sequence[Panel]] = {"friction": drawings}
    return Page(name="friction", groups=_with_report(document, groups) if document else groups)


def join_pictures(pictures: Sequence[Picture]) -> Picture:
    """One picture of a fit to several recordings: all pages of the first, then the signals of the others."""
    first, *others = pictures
    of_others = [
        replace(
            page, name=f"{page.name}: {one.name}", groups={k: x for k, x in page.groups.items() if k != "parameters"}
        )
        for one in others
        for page in one.pages
        if page.name in ("overview", "residual", "signal", "motion")
    ]
    return replace(first, pages=(*first.pages, *of_others))
