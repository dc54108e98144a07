"""The reports of a recording: settings and ranges before a fit, the torque errors of a fit on another recording."""

import numpy as np
from numpy.typing import NDArray

from ..data import ON_GRID, Signals
from ..estimation import TorqueError
from ..regression import Settings, forward_backward_3db_hz
from .document import Document, Number, Section, Table, columns


def recording_document(signals: Signals, settings: Settings | None, refusal: str | None) -> Document:
    """What is known of a recording before a fit.

    Parameters
    ----------
    signals : the recording.
    settings : what a fit would do with it; None where it cannot be fitted.
    refusal : why it cannot be fitted; None where it can.
    """
    robot, reference = signals.robot, "with" if signals.q_ref is not None else "without"
    lines = (
        *([f"cannot be fitted: {refusal}"] if refusal else []),
        f"{len(signals.q)} samples at {signals.sample_rate_hz:g} Hz, {signals.t_s[-1]:.3f} s, {reference} reference",
        *(settings_lines(signals, settings, used="a fit would use") if settings else []),
        *recording_lines(signals),
    )
    ranges = Table(
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
    )
    return Document(
        title=f"{robot.name}: recorded, not fitted",
        sections=(
            Section(lines=lines, warnings=tuple(settings.warnings) if settings else ()),
            Section(title="ranges", table=ranges),
        ),
    )


def validation_document(
    signals: Signals, settings: Settings, fit: str, errors: tuple[TorqueError, ...], warnings: tuple[str, ...]
) -> Document:
    """The torque errors of a fit on a recording that it was not made from.

    Parameters
    ----------
    signals, settings : the recording, and what was done with it.
    fit : name of the file of the parameters.
    errors, warnings : as `methods.validate` gives them, and what was noticed.
    """
    return Document(
        title=f"{fit} on {signals.recording}: {headline(errors)}",
        sections=(
            Section(lines=(error_line(errors),), warnings=warnings),
            errors_section(errors, signals.robot.effort_units),
            Section(
                title="settings",
                lines=(*settings_lines(signals, settings, used="evaluated on"), *recording_lines(signals)),
            ),
        ),
    )


def headline(errors: tuple[TorqueError, ...]) -> str:
    """The one number of a report: standing friction is not in the model, so rows that move are what it is judged by."""
    return f"{_percent(errors[-1].moving_relative_error_percent)} % torque error of moving rows"


def error_line(errors: tuple[TorqueError, ...]) -> str:
    """The relative torque error of all joints together, by kind of row."""
    whole = errors[-1]
    moving, standing = (
        _percent(x) for x in (whole.moving_relative_error_percent, whole.standing_relative_error_percent)
    )
    return (
        f"relative torque error: {moving} % of moving rows, {standing} % of standing rows, "
        f"{_percent(whole.relative_error_percent)} % of all rows"
    )


def errors_section(errors: tuple[TorqueError, ...], units: tuple[str, ...]) -> Section:
    """Relative torque errors by joint: whole, moving, standing; all joints together last."""
    numbers = ("all rows", "moving", "standing", "rows moving", "rows standing", "residual lag-1")
    return Section(
        title="relative torque error, %",
        table=Table(
            columns=columns("joint", "unit", numbers=numbers),
            rows=tuple(
                (
                    error.name,
                    unit,
                    Number(error.relative_error_percent, ".4f"),
                    Number(error.moving_relative_error_percent, ".4f"),
                    Number(error.standing_relative_error_percent, ".4f"),
                    Number(error.moving_rows, "d"),
                    Number(error.standing_rows, "d"),
                    Number(error.autocorrelation, ".2f"),
                )
                for error, unit in zip(errors, (*units, ""), strict=True)
            ),
            total=True,
        ),
    )


def settings_lines(signals: Signals, settings: Settings, *, used: str) -> tuple[str, ...]:
    """The settings in words; `used` says what is done with the span."""
    fs = signals.sample_rate_hz
    if settings.cutoff_hz is None:
        cutoff = "no low-pass"
    else:
        both = forward_backward_3db_hz(settings.cutoff_hz, fs)
        cutoff = f"low-pass {settings.cutoff_hz:g} Hz (-3 dB one way; forward and backward -3 dB at {both:.1f} Hz)"
    timing = (
        f"; samples up to {signals.off_grid:.2g} periods off a uniform grid: interpolated"
        if signals.off_grid > ON_GRID
        else ""
    )
    return (
        f"{signals.recording}: {fs:g} Hz, {cutoff}, decimated by {settings.decimation}"
        + (" with MATLAB's edge rule" if settings.edges == "matlab" else "")
        + timing,
        f"{used}: {settings.span}, {settings.start / fs:.3f} s to {settings.stop / fs:.3f} s of {len(signals.q) / fs:.3f} s",
        *_known_lines(signals),
    )


def _known_lines(signals: Signals) -> list[str]:
    """What is known besides position and effort, and what is done with it."""
    lines, joints, units = [], signals.robot.joints, signals.robot.effort_units
    for values, text in (
        (signals.known_torque, "known torque, added to that of the drives and to the simulated robot"),
        (signals.feedforward, "feed-forward, added to the output of the simulated controller"),
    ):
        if values is not None:
            own = [m.recorded_unit for m in signals.robot.motors] if values is signals.feedforward else units
            sizes = zip(joints, np.sqrt(np.mean(values**2, axis=0)), own, strict=True)
            lines.append(f"{text}: rms " + ", ".join(f"{joint.name} {size:.3g} {unit}" for joint, size, unit in sizes))
    return lines


def recording_lines(signals: Signals) -> tuple[str, ...]:
    """What the recorder's counters came to, where it kept any, and the file's digest."""
    known = {name: counts[np.isfinite(counts)] for name, (_, counts) in signals.health.items()}
    last = [f"{name} {counts[-1]:.6g}" for name, counts in known.items() if len(counts)]
    counted = [f"recorder: {', '.join(last)}"] if last else []
    return (*counted, f"{signals.recording} has sha256 {signals.sha256}")


def _percent(x: float | None) -> str:
    return Number(x, ".3g", most=1000).text


def _ends(x: NDArray[np.float64]) -> tuple[Number, Number]:
    return Number(float(x.min()), ".4g"), Number(float(x.max()), ".4g")
