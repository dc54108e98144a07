"""Reports of a recording before a fit, and of a fit on other recordings.

Before a fit the report has settings and ranges, afterwards torque errors. The module also has the
sections that the report of a fit has too, and those of its drive gains and payloads.
"""

import math
from collections.abc import Iterable, Sequence
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

GAIN = "{0.motor} {0.value:.4g} ± {0.half_width:.2g} {0.unit}"


def recording_document(
    signals: Signals, settings: Settings | None, refusal: str | None
) -> Document:
    """Make the report of a recording without a fit."""
    robot, reference = signals.robot, "with" if signals.q_ref is not None else "without"
    told = OnRecording(**with_settings(signals, settings))
    lines = (
        *([f"This recording cannot be fitted: {refusal}"] if refusal else []),
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
        title=f"{fit} on {', '.join(x for x, _ in each)}: torque error "
        f"{percent(errors[-1].relative_error_percent)} in motion",
        sections=(
            Section(
                lines=(
                    ("Torque error", error_text(errors)),
                    *((x, error_text(one.errors)) for x, one in each if len(each) > 1),
                    *(("Physically consistent", error_text(x)) for x in [consistent] if x),
                    rows_line(errors, recordings[0].problem.settings.cutoff_hz),
                ),
                warnings=warnings,
            ),
            *_ahead_section(recordings),
            replace(errors_section(errors), short=None),
            *(
                replace(errors_section(x), title="Physically consistent: torque error", short=None)
                for x in [consistent]
                if x
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
            title="Position error of the direct model after a measured state, % of the distance "
            "moved",
            table=Table(
                columns=columns("joint", numbers=tuple(f"after {x:g} s" for x in HORIZONS_S)),
                rows=tuple(rows),
            ),
        )
    ]


def recordings_section(fit: FitFile) -> Section:
    """Make the section of errors by recording.

    It also has held-out errors, and the test of per-recording parameters.
    """
    each = fit.recordings or []
    lines = [
        f"{one.recording} cannot be predicted from the others: "
        + (
            f"they do not determine {', '.join(one.undetermined)}."
            if one.undetermined
            else "it has no torque."
        )
        for one in each
        if one.undetermined or one.relative_error_percent is None
    ]
    if own := fit.own_parameters:
        lines.append(
            f"Per-recording parameters {', '.join(own.names)} against shared ones: F test p = "
            f"{Number(own.p_value, '.2g').text} "
            f"(corrected for correlation p = {Number(own.p_effective, '.2g').text})."
        )
    row_hz = (fit.sample_rate_hz or 0.0) / (fit.decimation or 1)
    return Section(
        title="Torque error by recording",
        table=Table(
            columns=columns(
                "recording", numbers=("Hz", "from, s", "to, s", "fitted, %", "held out, %")
            ),
            rows=tuple(
                (
                    one.recording,
                    Number(one.sample_rate_hz, "g"),
                    *(Number(x / one.sample_rate_hz, ".3f") for x in one.samples),
                    Number(one.relative_error_percent, ".4f"),
                    Number(one.held_out_error_percent, ".4f"),
                )
                for one in each
            ),
        ),
        lines=(
            *lines,
            "Held out: predicted by a fit of the other recordings, over the same rows.",
            f"Common to all: {row_hz:g} rows per second, "
            + (f"low-pass {fit.cutoff_hz:g} Hz." if fit.cutoff_hz else "no low-pass."),
            *(line for one in each for line in recording_lines(one)),
        ),
        short=Section(lines=tuple(lines)),
    )


def percent(value: float | None) -> str:
    """Return a percentage of a report as text."""
    return f"{Number(value, '.3g', most=1000).text} %"


def error_text(errors: tuple[TorqueResidual, ...]) -> str:
    """Return the torque error of all joints together, in motion and at standstill."""
    rest = errors[-1].standing_relative_error_percent
    return f"{percent(errors[-1].relative_error_percent)} in motion" + (
        "" if rest is None else f", {percent(rest)} at standstill (static friction is not modelled)"
    )


def rows_line(errors: tuple[TorqueResidual, ...], cutoff_hz: float | None) -> str:
    """Return the rows of the torque errors, and their low-pass."""
    e = errors[-1]
    return (
        f"{e.moving_rows} of {e.moving_rows + e.standing_rows} rows are in motion. Torque errors "
        f"have {f'a low-pass of {cutoff_hz:.3g} Hz' if cutoff_hz else 'no low-pass'}."
    )


def half_width_percents(parameters: Iterable[Parameter]) -> dict[str, float]:
    """Return the half-width in percent of each essential parameter."""
    return {p.name: p.half_percent for p in parameters if p.essential}


def main_figures(fit: FitFile) -> tuple[tuple[str, str], ...]:
    """Return the figures to read first: torque errors, and half-widths of essential parameters."""
    percents, fitted = half_width_percents(fit.parameters), fit.fitted_error_percent
    worst = max(percents, key=percents.__getitem__, default="")
    same = "" if fitted is None else f" (fitted {fitted:.3g} %)"
    median = float(np.median([*percents.values()])) if percents else None
    figures = (
        ("torque error in motion", fit.moving_relative_error_percent, ".3g"),
        (f"cross-validated{same}", known(fit.held_out_error_percent), ".3g"),
        ("cross-validated with a priori links", known(fit.prior_held_out_error_percent), ".3g"),
        (f"median 95 % half-width of {len(percents)} well-determined parameters", median, ".2g"),
        (f"largest 95 % half-width ({worst})", percents.get(worst), ".2g"),
    )
    return tuple((what, f"{value:{form}} %") for what, value, form in figures if value is not None)


def errors_section(errors: tuple[TorqueResidual, ...]) -> Section:
    """Make the section of relative torque errors by joint; all joints together come last."""
    each = [f"{e.name} {Number(e.relative_error_percent, '.2g').text} %" for e in errors[:-1]]
    return Section(
        title="Torque error by joint",
        table=Table(
            columns=columns(
                "joint",
                "unit",
                numbers=(
                    "torque error in motion, %",
                    "rows in motion",
                    "rows at standstill",
                    "residual autocorrelation (lag 1)",
                ),
            ),
            rows=tuple(
                (
                    e.name,
                    e.unit or "",
                    Number(e.relative_error_percent, ".4f"),
                    Number(e.moving_rows, "d"),
                    Number(e.standing_rows, "d"),
                    Number(e.autocorrelation, ".2f"),
                )
                for e in errors
            ),
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
        f"; interpolated, as samples are up to {of.off_grid_periods:.2g} periods off a uniform grid"
        if of.off_grid_periods > ON_GRID
        else ""
    )
    whole = f" of {of.recorded_samples / fs:.3f} s" if of.recorded_samples else ""
    return (
        f"{of.provenance.recording if of.provenance else ''}: {fs:g} Hz, {cutoff}, decimated by "
        f"{of.decimation}{notes}",
        f"{used}: {of.span}, from {start / fs:.3f} s to {stop / fs:.3f} s{whole}",
        *of.inputs,
    )


def recording_lines(of: OnRecording | RecordingOfFit) -> tuple[str, ...]:
    """Return the final counters of the recorder, the payload if any, and the digest of the file."""
    source = of if isinstance(of, RecordingOfFit) else of.provenance
    digest = "" if source is None else f"SHA-256 of {source.recording}: {source.sha256}"
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
    heads = columns(
        "motor", numbers=("in robot.toml", "identified", "95 % half-width", "relative %")
    )
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
    return [
        Section(
            title="Drive gains",
            table=Table(columns=heads + columns("unit", ""), rows=rows),
            lines=(
                f"Smallest Cragg–Donald eigenvalue: {known(fit.cragg_donald) or 0.0:.3g}. It shows "
                "how well the payload separates drive gains and arm.",
            ),
            short=Section(lines=(("Drive gains", ", ".join(map(GAIN.format, fit.gains))),)),
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
    short = (
        [
            "the recordings do not separate its mass from the arm",
            "→ Record without it too, or specify its mass.",
        ]
        if mass.from_prior and not weighed
        else [f"mass {m:.4g} kg"]
    )
    return Section(
        title=title,
        table=Table(
            columns=columns("", numbers=("value", "95 % half-width"))
            + columns("unit", "mostly from"),
            rows=rows,
        ),
        lines=(
            f"Given: {one.described}. Values are in the frame of {joint}, inertias about its "
            "origin.",
        ),
        short=Section(lines=((title, *short),)),
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
