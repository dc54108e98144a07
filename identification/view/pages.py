"""The pages of a result: which panels it has, in which order.

The renderers, Rerun and HTML, show these lists.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from .. import results
from ..arrays import Array
from ..data import Signals
from ..design import Excitation
from ..errors import RobotIdimError
from ..regression import Overrides, Settings, make_settings, with_bandwidth
from ..report import Document, FitFile, ParameterSet, Section, comparison_section, differences
from ..results import FitOnRecording
from ..study import Run, VariedFit
from . import charts, curves
from .panels import Page, Panel, Picture, Plot
from .recording_panels import event_logs, friction_charts, health_plots, spectrum_charts
from .robot_drawing import excitation_scene, robot_scene


def draw_fit(fit: FitFile, one: FitOnRecording | None, truth: Array | None = None) -> Picture:
    """Draw a fit on one of its recordings, or without its curves if `one` is None.

    A fit by IV is shown together with its least squares. `truth`: known values of the base
    parameters. Times are seconds from the recording's first sample, on the timeline `time`.
    Measured curves cover the recording, filtered and predicted ones the fitted time range.

    Entities are `q/<joint>/measured`, `measured_filtered`, `reference`, `simulated`, and so for
    `dq` and `ddq`; `error/<joint>/reference`, `simulated`: these positions minus the measured one,
    in the unit of the plot's title; `torque/<joint>/measured`, `model`, `residual`;
    `residual/<joint>`, `deviations`, `tests`, `robot`, `column/<quantity>`, `events`, `health`,
    `report`.
    """
    label = {"iv": "IV", "wls": "LS", "ols": "OLS"}.get(fit.method or "", "fit")
    own = ParameterSet.of_file(fit, label)
    others = [
        *(
            [ParameterSet(label="LS", parameters={p.name: p for p in fit.least_squares})]
            if fit.least_squares
            else []
        ),
        *([] if truth is None or not one else [results.true_parameters(one.problem.base, truth)]),
    ]
    document = results.fit_document(fit).followed_by(
        *(replace(comparison_section(own, other), short=Section()) for other in others)
    )
    trust = Page(name="tests", groups={"tests": charts.trust_charts(fit.trust or ())})
    charted = Page(name="intervals", groups={"deviations": charts.deviation_charts(own, others)})
    assert fit.provenance is not None
    if one is None:
        return Picture(
            name=f"{fit.provenance.robot}, {fit.provenance.recording}, {label}",
            document=document,
            pages=(charted, trust),
            sha256={fit.provenance.recording: fit.provenance.sha256},
            beside=_intervals(own, others, document),
        )
    signals = one.signals
    torque, residual = curves.row_plots(one).values()
    friction = _friction_page({"": fit}, {"": [one]})
    overview, *of_signals = _signal_pages(
        signals, one.problem.settings, one, torque if residual else []
    )
    each = [error.relative_error_percent or 0.0 for error in one.errors[:-1]]
    return Picture(
        name=f"{signals.robot.name}, {signals.recording}, {str(fit.method).upper()}",
        first=torque[each.index(max(each))],
        # The friction of a single joint stands beside its torque.
        front=Page(
            name=f"Torque and residual: {signals.recording}",
            groups={"torque": (*torque, *friction.groups["friction"])[: max(2, len(torque))]},
        ),
        beside=_intervals(own, others, document),
        document=document,
        pages=(
            overview,
            trust,
            charted,
            Page(name="residual", groups={"residual": residual}),
            friction,
            *of_signals,
        ),
        sha256={signals.recording: signals.sha256},
    )


def draw_friction(before: results.Evidence, after: results.Evidence, document: Document) -> Picture:
    """Draw the fits with the usual and with the selected friction terms."""
    recording = ", ".join(one.signals.recording for one in before.recordings)
    return Picture(
        name=f"{before.problem.signals.robot.name}, {recording}, friction",
        document=document,
        pages=(
            _friction_page(
                {"usual": results.fit_file(before), "recommended": results.fit_file(after)},
                {"usual": before.recordings, "recommended": after.recordings},
            ),
        ),
        sha256={one.signals.recording: one.signals.sha256 for one in before.recordings},
    )


def draw_validation(
    validated: Sequence[FitOnRecording], document: Document, sha256: Mapping[str, str]
) -> Picture:
    """Draw recordings that a fit is applied to, a view each.

    A view has the measured torque, the predicted torque, and the residual of the rows.
    """
    return Picture(
        name=f"{validated[0].signals.robot.name} validation",
        document=document,
        pages=tuple(
            Page(name=one.signals.recording, groups=curves.row_plots(one)) for one in validated
        ),
        sha256={**sha256, **{one.signals.recording: one.signals.sha256 for one in validated}},
    )


def draw_recording(signals: Signals, overrides: Overrides) -> Picture:
    """Draw a recording, with the panels that need no fit; entities as in `draw_fit`."""
    refusal, settings, signals = None, None, with_bandwidth(signals)
    try:
        settings = make_settings(signals, overrides)
    except RobotIdimError as error:
        refusal = str(error)
    return Picture(
        name=f"{signals.robot.name}, {signals.recording}",
        document=results.recording_document(signals, settings, refusal),
        pages=tuple(_signal_pages(signals, settings, None, [])),
        sha256={signals.recording: signals.sha256},
    )


def draw_comparison(
    own: ParameterSet,
    other: ParameterSet,
    document: Document,
    sha256: Mapping[str, str],
    fits: Sequence[FitOnRecording] = (),
) -> Picture:
    """Draw two sets of parameters that belong together, as `report.differences` requires.

    Common parameters are in the order of their differences. With both `fits` on their recordings
    the torques are beside them; entities are `torque/<joint>/measured <label>`, `model <label>`,
    `residual/<joint>/residual <label>`.
    """
    both = {
        row.name: (row.a, row.b)
        for row in sorted(differences(own, other), key=lambda row: -abs(row.off_sigma or 0.0))
        if row.a and row.b
    }
    first, second = (
        replace(x, parameters={name: pair[k] for name, pair in both.items()})
        for k, x in enumerate((own, other))
    )
    deviations = charts.deviation_charts(first, [second])
    torques = curves.compared_plots(fits, (own.label, other.label))
    return Picture(
        name=f"{own.label} and {other.label}",
        document=document,
        # A page of a report has room for all charts, a screen for one.
        front=Page(name="comparison", groups={"parameters": deviations, **torques}),
        pages=(
            Page(name="comparison", groups={"parameters": deviations[:1], **torques}),
            Page(name="parameters", groups={"parameters": deviations[1:]}),
        ),
        sha256={**sha256, **{one.signals.recording: one.signals.sha256 for one in fits}},
    )


def draw_study(robot: str, runs: Sequence[Run], document: Document) -> Picture:
    """Draw the errors of all runs of a study."""
    return Picture(
        name=f"{robot}, study",
        document=document,
        pages=(Page(name="study", groups={"study": [charts.study_chart(runs)]}),),
        sha256={},
    )


def draw_sensitivity(
    sha256: Mapping[str, str], fits: Sequence[VariedFit], document: Document
) -> Picture:
    """Draw the essential parameters in all variants; `sha256` by recording."""
    return Picture(
        name=f"{', '.join(sha256)}, sensitivity",
        document=document,
        pages=(Page(name="sensitivity", groups={"charts": charts.sensitivity_charts(fits)}),),
        sha256=sha256,
        first=charts.noise_chart(fits),
    )


def draw_excitation(excitation: Excitation, document: Document) -> Picture:
    """Draw one period of a reference with its limits, and the expected intervals.

    Entities are `q/<joint>`, `dq/<joint>` and, if known, `torque/<joint>`, each with `reference`,
    `low` and `high`; `robot`, `report`.
    """
    return Picture(
        name=f"{excitation.robot.name}, excitation",
        document=document,
        pages=(
            Page(
                name="excitation",
                groups={
                    **curves.excitation_plots(excitation),
                    "robot": [excitation_scene(excitation)],
                },
            ),
            Page(name="intervals", groups={"intervals": charts.interval_charts(excitation)}),
        ),
        sha256={},
    )


def _intervals(
    own: ParameterSet, others: Sequence[ParameterSet], document: Document
) -> Mapping[str, Panel]:
    """Chart the parameters of a short report's table, by the title of its section."""
    return {
        section.title: chart
        for section in document.short.sections
        if section.table and section.table.rows and section.table.columns[0][0] == "parameter"
        for listed in [{str(x): own.parameters[str(x)] for x, *_ in section.table.rows}]
        for chart in charts.deviation_charts(replace(own, parameters=listed), others)
    }


def _signal_pages(
    signals: Signals,
    settings: Settings | None,
    fit: FitOnRecording | None,
    torques: Sequence[Plot],
) -> list[Page]:
    """Return the views of a recording with or without a fit and the torques of its rows.

    The views are overview, signal quality, and motion.
    """
    lines = curves.lines_of(signals, settings, fit)
    torque = [
        replace(plot, curves=(*plot.curves, *(torques[j].curves[1:] if torques else ())))
        for j in range(signals.robot.n)
        for plot in [curves.plot(signals, lines, "torque", j)]
    ]
    return [
        Page(
            name="overview" if fit else "recording",
            groups={
                "torque": torque,
                "position": curves.position_plots(signals, lines),
                "robot": [robot_scene(signals, fit)],
            },
        ),
        Page(
            name="signal",
            groups={
                "spectrum": spectrum_charts(signals, settings),
                "column": curves.column_plots(signals),
                "health": health_plots(signals),
                "events": event_logs(signals),
            },
        ),
        Page(
            name="motion",
            groups={
                joint.name: curves.motion_plots(signals, lines, j)
                for j, joint in enumerate(signals.robot.joints)
            },
            tabs=True,
        ),
    ]


def _friction_page(
    fits: Mapping[str, FitFile], recordings: Mapping[str, Sequence[FitOnRecording]]
) -> Page:
    """Return the view of each joint's friction over its speed.

    It is of one fit, or of several side by side.
    """
    of_fits = [friction_charts(fit, recordings[name], name) for name, fit in fits.items()]
    return Page(
        name="friction",
        groups={"friction": of_fits[0]}
        if len(fits) == 1
        else {of_joint[0].path[1]: of_joint for of_joint in zip(*of_fits, strict=True)},
    )


def join_pictures(pictures: Sequence[Picture]) -> Picture:
    """Join the views of a fit to several recordings.

    All views of the first recording come first, then torque and signals of the others.
    """
    first, *others = pictures
    return replace(
        first,
        pages=(
            *first.pages,
            *(one.front for one in others if one.front),
            *[
                replace(page, name=f"{page.name}: {one.name}")
                for one in others
                for page in one.pages
                if page.name in ("overview", "signal", "motion")
            ],
        ),
    )
