"""Reports of a recording: settings and ranges before a fit; torque errors of a fit on other
recordings. Sections that the report of a fit has too, and those of its drive gains and payloads.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..data import ON_GRID, Signals
from ..regression import Settings
from ..report import (
    Document,
    FitFile,
    Number,
    OnRecording,
    Parameter,
    PayloadOfFit,
    RecordingOfFit,
    Row,
    Section,
    StandardParameter,
    Table,
    TorqueResidual,
    columns,
    known,
)
from .evidence import HORIZONS_S, FitOnRecording, first_ahead
from .fit_files import with_settings


def recording_document(
    signals: Signals, settings: Settings | None, refusal: str | None
) -> Document:
    """Make the report of a recording without a fit."""
    robot, reference = signals.robot, "with" if signals.q_ref is not None else "without"
    told = OnRecording(**with_settings(signals, settings))
    lines = (
        *([f"cannot be fitted: {refusal}"] if refusal else []),
        f"{len(signals.q)} samples at {signals.sample_rate_hz:g} Hz, {signals.t_s[-1]:.3f} s, "
        f"{reference} reference",
        *(settings_lines(told, used="a fit would use") if settings else []),
        *recording_lines(told),
    )
    return Document(
        title=f"{robot.name}: recorded, not fitted",
        sections=(
            Section(lines=lines, warnings=tuple(settings.warnings) if settings else ()),
            Section(
                title="Ranges",
                table=Table(
                    columns=columns("joint", "unit", numbers=("position from", "to"))
                    + columns("unit", numbers=("effort from", "to")),
                    rows=tuple(
                        (
                            joint.name,
                            joint.position_unit,
                            *_ends(signals.q[:, j]),
                            robot.effort_units[j],
                            *_ends(signals.effort[:, j]),
                        )
                        for j, joint in enumerate(robot.joints)
                    ),
                ),
            ),
        ),
    )


def validation_document(
    recordings: Sequence[FitOnRecording],
    fit: str,
    errors: tuple[TorqueResidual, ...],
    warnings: tuple[str, ...],
    consistent: tuple[TorqueResidual, ...] = (),
) -> Document:
    """Make the report on the torque errors of a fit on recordings that it was not fitted to."""
    each = [(one.signals.recording, one) for one in recordings]
    return Document(
        title=f"{fit} on {', '.join(x for x, _ in each)}: {headline(errors)} torque error",
        sections=(
            Section(
                lines=(
                    error_line(errors, recordings[0].problem.settings.cutoff_hz),
                    *(f"{x}: {headline(one.errors)}" for x, one in each if len(each) > 1),
                    *(f"Physically consistent: {headline(x)}" for x in [consistent] if x),
                ),
                warnings=warnings,
            ),
            *_ahead_section(recordings),
            replace(errors_section(errors), short=None),
            *(
                [
                    replace(
                        errors_section(consistent),
                        title="Torque error of the physically consistent set, %",
                        short=None,
                    )
                ]
                if consistent
                else []
            ),
            Section(
                title="Settings",
                lines=tuple(
                    line
                    for one in recordings
                    for told in [OnRecording(**with_settings(one.signals, one.problem.settings))]
                    for line in (*settings_lines(told, used="evaluated on"), *recording_lines(told))
                ),
            ),
        ),
    )


def _ahead_section(recordings: Sequence[FitOnRecording]) -> list[Section]:
    """Make the section of errors of the positions that the direct model predicts, by joint."""
    if (found := first_ahead(recordings)) is None:
        return []
    joints, (error, way) = recordings[0].signals.robot.joints, found
    # A joint at rest has not moved, so its error cannot be compared with a distance.
    percents = 100 * error / np.where(way > 0.01 * way.max(axis=1, keepdims=True), way, np.nan)
    rows: list[Row] = [
        (joint.name, *(Number(x, ".3g") for x in of_joint))
        for joint, of_joint in zip(joints, percents.T.tolist(), strict=True)
    ]
    return [
        Section(
            title="Position error of the direct model, open loop from measured states, % of the "
            "way "
            "moved",
            table=Table(
                columns=columns("joint", numbers=tuple(f"after {x:g} s" for x in HORIZONS_S)),
                rows=tuple(rows),
            ),
        )
    ]


def recordings_section(fit: FitFile) -> Section:
    """Make the section of errors by recording, held-out errors, and the test of per-recording
    parameters.
    """
    each = fit.recordings or []
    rows: tuple[Row, ...] = tuple(
        (
            one.recording,
            Number(one.sample_rate_hz, "g"),
            *(Number(x / one.sample_rate_hz, ".3f") for x in one.samples),
            Number(one.relative_error_percent, ".4f"),
            Number(one.held_out_error_percent, ".4f"),
        )
        for one in each
    )
    lines = [
        f"{one.recording} cannot be predicted by the others: "
        + (
            f"{', '.join(one.undetermined)} not well determined"
            if one.undetermined
            else "it has no torque"
        )
        for one in each
        if one.undetermined or one.relative_error_percent is None
    ]
    if own := fit.own_parameters:
        lines.append(
            f"per-recording parameters {', '.join(own.names)} against shared ones: F test p = "
            f"{Number(own.p_value, '.2g').text} "
            f"(corrected for correlation p = {Number(own.p_effective, '.2g').text})"
        )
    row_hz = (fit.sample_rate_hz or 0.0) / (fit.decimation or 1)
    cutoff = "no low-pass" if fit.cutoff_hz is None else f"low-pass {fit.cutoff_hz:g} Hz"
    return Section(
        title="Recordings: torque error, %",
        table=Table(
            columns=columns("recording", numbers=("Hz", "from, s", "to, s", "fitted", "held out")),
            rows=rows,
        ),
        lines=(
            *lines,
            "Held out: predicted by a fit of the other recordings, over the same rows",
            f"Common to all: {cutoff}, {row_hz:g} rows per second",
            *(line for one in each for line in recording_lines(one)),
        ),
        short=Section(lines=tuple(lines)),
    )


def headline(errors: tuple[TorqueResidual, ...]) -> str:
    """Return the main figure of a report."""
    return f"{Number(errors[-1].relative_error_percent, '.3g', most=1000).text} %"


def error_line(errors: tuple[TorqueResidual, ...], cutoff_hz: float | None) -> str:
    """Return the relative torque error of all joints together, with its rows and low-pass."""
    e = errors[-1]
    return (
        f"Torque error: {headline(errors)} in motion ({e.moving_rows} of "
        f"{e.moving_rows + e.standing_rows} rows, "
        + (f"low-pass {cutoff_hz:.3g} Hz)" if cutoff_hz else "no low-pass)")
    )


def half_width_percents(parameters: Iterable[Parameter]) -> dict[str, float]:
    """Return the half-width in percent of each essential parameter."""
    return {p.name: p.half_percent for p in parameters if p.essential}


def main_figures(
    error: float | None,
    held_out: float | None,
    more: Mapping[str, float | None],
    percents: Mapping[str, float],
) -> tuple[tuple[str, str], ...]:
    """Return the figures to read first: torque errors, and half-widths of essential parameters
    (`percents`).
    """
    errors = {"torque error": error, "held out": held_out, **more}
    shown = {what: f"{value:.2g} %" for what, value in errors.items() if value is not None}
    if percents:
        worst = max(percents, key=percents.__getitem__)
        shown |= {
            f"median 95 % half-width of {len(percents)} well-determined parameters": (
                f"{np.median([*percents.values()]):.2g} %"
            ),
            f"largest 95 % half-width ({worst})": f"{percents[worst]:.2g} %",
        }
    return tuple(shown.items())


def errors_section(errors: tuple[TorqueResidual, ...]) -> Section:
    """Make the section of relative torque errors by joint; all joints together come last."""
    each = [f"{e.name} {Number(e.relative_error_percent, '.2g').text} %" for e in errors[:-1]]
    rows = tuple(
        (
            e.name,
            e.unit or "",
            Number(e.relative_error_percent, ".4f"),
            Number(e.moving_rows, "d"),
            Number(e.standing_rows, "d"),
            Number(e.autocorrelation, ".2f"),
        )
        for e in errors
    )
    return Section(
        title="Torque error by joint, %",
        table=Table(
            columns=columns(
                "joint",
                "unit",
                numbers=(
                    "torque error",
                    "rows in motion",
                    "rows at standstill",
                    "residual autocorrelation (lag 1)",
                ),
            ),
            rows=rows,
            total=True,
        ),
        # A line above already has the error of all joints together.
        short=Section(
            lines=(f"Torque error in motion by joint: {', '.join(each)}",) if len(each) > 1 else ()
        ),
    )


def settings_lines(of: OnRecording, *, used: str) -> tuple[str, ...]:
    """Return the settings in words; `used` says what is done with the time range."""
    fs, (start, stop) = of.sample_rate_hz or 1.0, of.samples or (0, 0)
    cutoff = (
        "no low-pass"
        if of.cutoff_hz is None
        else f"low-pass {of.cutoff_hz:g} Hz (-3 dB one way; forward and backward -3 dB at "
        f"{of.cutoff_forward_backward_3db_hz:.1f} Hz)"
    )
    notes = (" with MATLAB's edge rule" if of.edges == "matlab" else "") + (
        f"; samples up to {of.off_grid_periods:.2g} periods off a uniform grid: interpolated"
        if of.off_grid_periods > ON_GRID
        else ""
    )
    whole = f" of {of.recorded_samples / fs:.3f} s" if of.recorded_samples else ""
    return (
        f"{of.provenance.recording if of.provenance else ''}: {fs:g} Hz, {cutoff}, decimated by "
        f"{of.decimation}{notes}",
        f"{used}: {of.span}, {start / fs:.3f} s to {stop / fs:.3f} s{whole}",
        *of.inputs,
    )


def recording_lines(of: OnRecording | RecordingOfFit) -> tuple[str, ...]:
    """Return the final counters of the recorder, the payload if any, and the digest of the file."""
    source = of if isinstance(of, RecordingOfFit) else of.provenance
    digest = "" if source is None else f"{source.recording} has sha256 {source.sha256}"
    return (*of.remarks, digest)


def _ends(x: Array) -> tuple[Number, Number]:
    return Number(float(x.min()), ".4g"), Number(float(x.max()), ".4g")


def gain_sections(fit: FitFile) -> list[Section]:
    """Make the section of identified drive gains beside those given in the description.

    It includes how well they are separated from the arm: the smallest eigenvalue of the
    Cragg–Donald statistic.
    """
    if not fit.gains:
        return []
    heads = columns("motor", numbers=("given", "identified", "95 % half-width", "relative %"))
    rows = tuple(
        (
            one.motor,
            Number(one.described, ".4g"),
            Number(one.value, ".4g"),
            Number(one.half_width, ".2g"),
            Number(
                100 * one.half_width / abs(one.value) if one.value else math.inf, ".2f", most=1000
            ),
            one.unit,
            "" if one.determined else "not well determined",
        )
        for one in fit.gains
    )
    values = [f"{one.motor} {one.value:.4g} ± {one.half_width:.2g} {one.unit}" for one in fit.gains]
    return [
        Section(
            title="Drive gains",
            table=Table(columns=heads + columns("unit", ""), rows=rows),
            lines=(
                f"Smallest Cragg–Donald eigenvalue {known(fit.cragg_donald) or 0.0:.3g}, which "
                f"shows how "
                "well the payload separates gains and arm",
            ),
            short=Section(lines=(f"Drive gains: {', '.join(values)}",)),
        )
    ]


def payload_sections(fit: FitFile) -> list[Section]:
    """Make the section of payloads as the nearest rigid bodies with positive mass density."""
    return [_payload_section(one, fit.joints[-1].name) for one in fit.payloads or ()]


def _payload_section(one: PayloadOfFit, joint: str) -> Section:
    (*inertias, x, y, z, mass), title = one.parameters, f"Payload of {one.recording}"
    m, width, weighed = mass.value, mass.half_width or 0.0, "mass" in one.given
    centre = zip(("centre of mass x", "y", "z"), (x, y, z), strict=True)
    rows = (
        _row(
            "mass",
            m,
            one.mass_half_width_kg or math.nan if weighed else width,
            mass,
            known=weighed,
        ),
        *(
            _row(
                name,
                of.value / m,
                # The centre is a quotient by the mass, so the uncertainty of the mass is included.
                float(np.hypot((of.half_width or 0.0) / m, of.value / m**2 * width)),
                of,
                "m",
                known="center" in one.given,
            )
            for name, of in centre
        ),
        *(_row(of.name, of.value, of.half_width or 0.0, of) for of in inertias),
    )
    short = f"{title}: mass {m:.4g} kg"
    if mass.from_prior and not weighed:
        short = (
            f"{title}: it has no scale, because it cannot be separated from the arm. Record "
            f"without "
            "it too, or give its mass"
        )
    return Section(
        title=title,
        table=Table(
            columns=columns("", numbers=("value", "95 % half-width"))
            + columns("unit", "mostly from"),
            rows=rows,
        ),
        lines=(
            f"Given: {one.described}; values in the frame of {joint}, inertia about its origin",
        ),
        short=Section(lines=(short,)),
    )


def _row(
    name: str,
    value: float,
    half: float,
    of: StandardParameter,
    unit: str = "",
    *,
    known: bool = False,
) -> Row:
    source = "given" if known else "a priori" if of.from_prior else "recording"
    return name, Number(value, ".4g"), Number(half, ".2g"), unit or of.unit, source
