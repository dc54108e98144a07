"""The JSON files of a fit and of a validation: what both say of a recording, and their own keys."""

import platform
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET

from acquisition.robot import Robot

from .. import report
from ..control import FoundLaw
from ..data import Signals
from ..regression import Settings, forward_backward_3db_hz
from .evidence import HORIZONS_S, Evidence, FitOnRecording, errors_on, first_ahead, validated
from .make_fit import smallest_cragg_donald
from .parameters import fitted_parameters


def fit_file(fit: Evidence, corrected: Sequence[str] = ()) -> report.FitFile:
    """Make the JSON file of a fit; `corrected` says what was changed in its description.

    A number that does not exist (without rows at standstill, say) is null.
    """
    robot = fit.problem.signals.robot
    return report.FitFile(
        **on_recordings(fit.recordings, fit.errors, fit.warnings),
        method=fit.method,
        method_reason=fit.solution.method_reason,
        status=fit.status,
        notes=list(fit.notes),
        gains=list(fit.gains) or UNSET,
        cragg_donald=smallest_cragg_donald(fit.data) if fit.gains else UNSET,
        payloads=list(fit.payloads) or UNSET,
        corrected=list(corrected) or UNSET,
        law=_law(law, robot) if (law := fit.law) else UNSET,
        consistent=fit.consistent_set or UNSET,
        standard_parameters=list(fit.standard_parameters) or UNSET,
        description={
            name: robot.files[name].decode("utf-8", errors="replace")
            for name in ("robot.toml", "robot.urdf")
            if name in robot.files
        },
        **_trust_keys(fit),
        **(_iv_keys(fit) if fit.passes else {}),
        **_estimate_keys(fit),
    )


def _trust_keys(fit: Evidence) -> dict[str, Any]:
    """Return the keys of the tests, and of their inputs."""
    lines, signals = fit.trust.lines, fit.problem.signals
    by_ls = [
        validated(one.problem, one.values(fit.least_squares.estimate))
        for one in fit.recordings
        if fit.status in report.NO_FIXED_POINT
    ]
    return {
        "verdict": fit.trust.verdict,
        "trust": list(lines),
        "assumed": list(fit.trust.assumed),
        "doubts": [
            report.PhysicalWarning(
                text=f"{line.text}. {line.advice}", severe=line.level == "do not use"
            )
            for line in lines
            if line.test == "physical plausibility" and line.level != "ok"
        ],
        "held_out_error_percent": fit.held_out_error_percent,
        "prior_source": fit.data.prior_source or UNSET,
        "prior_held_out_error_percent": fit.data.prior_error_percent if fit.data.prior else UNSET,
        "least_squares_error_percent": errors_on(by_ls)[-1].relative_error_percent
        if by_ls
        else UNSET,
        # Scripts expect one delay, so this is that of the first recording; others may have their
        # own.
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
    }


def _estimate_keys(fit: Evidence) -> dict[str, Any]:
    """Return the keys of the parameters, and of the rows that they are estimated from."""
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
    """Make the JSON file of a validation; arguments as in `validation_document`."""
    ahead = first_ahead(recordings)
    return report.ValidationFile(
        **on_recordings(recordings, errors, warnings),
        fit=fit,
        ahead={
            f"{time_s:g}": report.Ahead(error=error.tolist(), way=way.tolist())
            for time_s, error, way in zip(HORIZONS_S, *ahead, strict=True)
        }
        if ahead is not None
        else {},
        consistent_errors=list(consistent) or UNSET,
    )


def _recording(one: FitOnRecording) -> report.RecordingOfFit:
    signals, settings, held_out = one.signals, one.problem.settings, one.held_out
    whole = one.errors[-1]
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


def _iv_keys(fit: Evidence) -> dict[str, Any]:
    """Return the keys of the instrumental variable method."""
    return {
        "rows_used_percent": float(100 * fit.data.observed.counts.mean()),
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
        "direct_model": list(fit.direct),
        "saturated_percent": fit.saturated_percent,
        "instrument_tests": {
            "strength": fit.solution.strength,
            "first_stage_F": fit.data.first_stage_F,
        },
        "contrast_half_widths": fit.contrast[0],
        "contrast_parameter": fit.contrast[1],
        "least_squares": list(fitted_parameters(fit, by_ls=True).parameters.values()),
    }


def on_recordings(
    recordings: Sequence[FitOnRecording],
    errors: tuple[report.TorqueResidual, ...],
    warnings: tuple[str, ...],
) -> dict[str, Any]:
    """Return the keys of `report.OnRecording`.

    These are the first recording with its settings, each recording if there are several, and torque
    errors, which have filters of their own.
    """
    (*joints, whole), problem = errors, recordings[0].problem
    return with_settings(problem.signals, problem.settings) | {
        "warnings": list(warnings),
        "recordings": [_recording(one) for one in recordings] if len(recordings) > 1 else UNSET,
        "error_cutoff_hz": problem.for_errors.settings.cutoff_hz,
        "error_decimation": problem.for_errors.settings.decimation,
        "relative_error_percent": whole.relative_error_percent,
        "moving_relative_error_percent": whole.moving_relative_error_percent,
        "standing_relative_error_percent": whole.standing_relative_error_percent,
        "joints": joints,
        "all_joints": whole,
    }


def with_settings(signals: Signals, settings: Settings | None) -> dict[str, Any]:
    """Return the keys of a recording, and of its settings if there are any."""
    fs = signals.sample_rate_hz
    keys = {
        "provenance": report.Provenance(
            recording=signals.recording,
            sha256=signals.sha256,
            robot=signals.robot.name,
            versions={"python": platform.python_version(), **report.versions()},
        ),
        "sample_rate_hz": fs,
        "off_grid_periods": signals.off_grid,
        "recorded_samples": len(signals.t_s),
        "inputs": _inputs(signals),
        "remarks": remarks(signals),
    }
    if settings is None:
        return keys
    return keys | {
        "cutoff_hz": settings.cutoff_hz,
        "cutoff_forward_backward_3db_hz": forward_backward_3db_hz(settings.cutoff_hz, fs)
        if settings.cutoff_hz
        else None,
        "decimation": settings.decimation,
        "edges": settings.edges,
        "low_speed_percent": msgspec.structs.asdict(settings.low_speed),
        "ramp_rows": settings.ramp_rows,
        "torque_lag_s": settings.torque_lag_s,
        "span": settings.span,
        "span_rule": settings.span_rule,
        "samples": (settings.start, settings.stop),
    }


def _inputs(signals: Signals) -> list[str]:
    """Return external torque and feedforward, and how they are used."""
    robot = signals.robot
    given = (
        (
            "known torque, added to that of the drives and to the simulated robot",
            signals.known_torque,
            robot.effort_units,
        ),
        (
            "feed-forward, added to the output of the simulated controller",
            signals.feedforward,
            [motor.recorded_unit for motor in robot.motors],
        ),
    )
    return [
        f"{text}: rms " + ", ".join(f"{joint.name} {size:.3g} {unit}" for joint, size, unit in each)
        for text, values, units in given
        if values is not None
        for each in [zip(robot.joints, np.sqrt(np.mean(values**2, axis=0)), units, strict=True)]
    ]


def remarks(signals: Signals) -> list[str]:
    """Return the final counters of the recorder, and the payload, if any."""
    known = {name: counts[np.isfinite(counts)] for name, (_, counts) in signals.health.items()}
    last = [f"{name} {counts[-1]:.6g}" for name, counts in known.items() if len(counts)]
    payload, recording, joint = signals.payload, signals.recording, signals.robot.joints[-1].name
    return [
        *([f"recorder: {', '.join(last)}"] if last else []),
        *([] if payload is None else [f"payload of {recording}: {payload.describe(joint)}"]),
    ]
