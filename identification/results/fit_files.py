"""The JSON files of a fit and of a validation."""

from collections.abc import Sequence
from typing import Any

import msgspec
from msgspec import UNSET

from acquisition.robot import Robot

from .. import report
from ..control import FoundLaw
from .evidence import Evidence
from .gain_results import smallest_cragg_donald
from .horizon import HORIZONS_S
from .on_recording import FitOnRecording, errors_on, validated
from .parameters import fitted_parameters
from .recorded import on_recording, remarks
from .recording_report import first_ahead


def fit_file(fit: Evidence) -> report.FitFile:
    """The JSON file of a fit; a number that does not exist (no standing rows, say) is null."""
    robot, each = fit.problem.signals.robot, fit.recordings if len(fit.recordings) > 1 else ()
    return report.FitFile(
        **on_recording(fit.problem, fit.errors, fit.warnings),
        recordings=[_recording(one, one.errors[-1]) for one in each] or UNSET,
        method=fit.method,
        method_reason=fit.solution.method_reason,
        status=fit.status,
        notes=list(fit.notes),
        gains=list(fit.gains) or UNSET,
        cragg_donald=smallest_cragg_donald(fit.data) if fit.gains else UNSET,
        payloads=list(fit.payloads) or UNSET,
        law=_law(law, robot) if (law := fit.law) else UNSET,
        consistent=fit.consistent_set or UNSET,
        standard_parameters=list(fit.standard_parameters) or UNSET,
        description={
            name: robot.files[name].decode("utf-8", errors="replace")
            for name in ("robot.toml", "robot.urdf")
            if name in robot.files
        },
        **_trust_keys(fit),
        **_estimate_keys(fit),
        **(_iv_keys(fit) if fit.passes else {}),
    )


def _trust_keys(fit: Evidence) -> dict[str, Any]:
    """The keys of the tests, and of what they looked at."""
    lines, signals = fit.trust.lines, fit.problem.signals
    return {
        "verdict": fit.trust.verdict,
        "trust": list(lines),
        "assumed": list(fit.trust.assumed),
        "doubts": [
            report.PhysicalWarning(text=line.text, severe=line.level == "do not use")
            for line in lines
            if line.test == "physical" and line.level != "ok"
        ],
        # that of the first recording; others of several may have their own
        "lag": next(
            (
                report.LagFile(
                    value_s=lag.value_s,
                    half_width_s=lag.half_width_s,
                    source=lag.source,
                    prior=report.KnownLagFile(
                        value_s=known.value_s, sd_s=known.sd_s, source=known.source
                    ),
                    effort_timing=signals.effort_timing,
                    effort_object=signals.effort_object,
                )
                for lag in fit.data.lags
                for known in [lag.prior or lag]
                if signals.recording in lag.recordings
            ),
            UNSET,
        ),
        "held_out_error_percent": fit.held_out_error_percent,
        "prior_source": fit.data.prior_source or UNSET,
        "prior_held_out_error_percent": fit.data.prior_error_percent if fit.data.prior else UNSET,
        "least_squares_error_percent": _error_by_ls(fit)
        if fit.status in report.NO_FIXED_POINT
        else UNSET,
    }


def _estimate_keys(fit: Evidence) -> dict[str, Any]:
    """The keys of the parameters, and of the rows that they are from."""
    e, full = fit.estimate, fit.full
    return {
        "parameters": list(fitted_parameters(fit).parameters.values()),
        "covariance": report.Covariance(
            names=list(e.names), values=fit.intervals.covariance.tolist()
        ),
        "left_out": [
            report.LeftOut(name=name, sigma=float(sigma))
            for name, sigma in zip(full.names, full.sigma, strict=True)
            if name not in e.names
        ],
        "essential": msgspec.structs.replace(fit.essential, names=fit.essential_names),
        "unclear": [name for name in fit.essential.names if name not in fit.essential_names],
        "own_parameters": fit.own or UNSET,
        "condition_number": e.condition_number,
        "condition_number_scaled": e.condition_number_scaled,
        "rows": round(e.rows),
        "recorded_rows": fit.data.observed.share.size,
    }


def _law(law: FoundLaw, robot: Robot) -> report.LawFile:
    gains = [
        list(zip(*pair, strict=True))
        for pair in zip(law.gains.tolist(), law.gains_half.tolist(), strict=True)
    ]
    return report.LawFile(
        structure=law.law.structure,
        reason=law.reason,
        controller=law.law.keys if law.reason is None else None,
        motors=[
            report.MotorLaw(
                motor=motor.name,
                gains={
                    letter: row[j] for letter, row in zip(("Kp", "Kd", "Ki"), gains, strict=True)
                },
                delay_s=float(law.delay_s[j]),
                delay_half_width_s=float(law.delay_half_s[j]),
                residual_percent=float(law.residual_percent[j]),
                clear=bool(law.clear[j]),
            )
            for j, motor in enumerate(robot.motors)
        ],
    )


def validation_file(
    recordings: Sequence[FitOnRecording],
    fit: str,
    errors: tuple[report.TorqueResidual, ...],
    warnings: tuple[str, ...],
    consistent: tuple[report.TorqueResidual, ...] = (),
) -> report.ValidationFile:
    """The JSON file of a validation; arguments as of `validation_document`."""
    each = recordings if len(recordings) > 1 else ()
    ahead = first_ahead(recordings)
    return report.ValidationFile(
        **on_recording(recordings[0].problem, errors, warnings),
        fit=fit,
        recordings=[_recording(one, one.errors[-1]) for one in each] or UNSET,
        ahead={
            f"{time_s:g}": report.Ahead(error=error.tolist(), way=way.tolist())
            for time_s, error, way in zip(HORIZONS_S, *ahead, strict=True)
        }
        if ahead is not None
        else {},
        consistent_errors=list(consistent) or UNSET,
    )


def _recording(one: FitOnRecording, whole: report.TorqueResidual) -> report.RecordingOfFit:
    signals, settings, held_out = one.signals, one.problem.settings, one.held_out
    return report.RecordingOfFit(
        recording=signals.recording,
        sha256=signals.sha256,
        sample_rate_hz=signals.sample_rate_hz,
        decimation=settings.decimation,
        samples=(settings.start, settings.stop),
        relative_error_percent=whole.relative_error_percent,
        moving_relative_error_percent=whole.moving_relative_error_percent,
        held_out_error_percent=held_out.error_percent if held_out else None,
        undetermined=list(held_out.undetermined) if held_out else [],
        remarks=remarks(signals),
    )


def _error_by_ls(fit: Evidence) -> float | None:
    """The torque error of least squares, percent."""
    each = [
        validated(one.problem, one.values(fit.least_squares.estimate)) for one in fit.recordings
    ]
    return errors_on(each)[-1].relative_error_percent


def _iv_keys(fit: Evidence) -> dict[str, Any]:
    """The keys of the instrumental variable method."""
    return {
        "reason": fit.solution.reason,
        "pass_returned": fit.solution.returned,
        "start": fit.solution.start,
        "reference": fit.reference,
        "controller": fit.controller,
        "iterations": [
            report.PassFile(
                instruments=p.kind,
                reason=p.reason,
                residual_norm=p.estimate.residual_norm,
                largest_change_sigma=p.change_sigma,
                largest_change_percent=p.change_percent,
                changed_most=p.changed,
                gains=p.gains.tolist(),
                tracking_error_percent=p.tracking_percent,
                condition_number_ztw=p.estimate.condition_number_scaled,
                settled=p.settled,
            )
            for p in fit.passes
        ],
        "instrument_tests": {
            "strength": fit.solution.strength,
            "first_stage_F": fit.data.first_stage_F,
        },
        "contrast_half_widths": fit.contrast[0],
        "contrast_parameter": fit.contrast[1],
        "least_squares": list(fitted_parameters(fit, by_ls=True).parameters.values()),
        "rows_used_percent": fit.rows_used_percent,
        "saturated_percent": fit.saturated_percent,
        "direct_model": list(fit.direct),
    }
