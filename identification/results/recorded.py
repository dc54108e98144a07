"""What the JSON files of fits and validations say of a recording and its settings."""

import platform
from typing import Any

import msgspec
import numpy as np

from .. import report
from ..data import Signals
from ..regression import Problem, Settings, forward_backward_3db_hz


def on_recording(
    problem: Problem, errors: tuple[report.TorqueResidual, ...] = (), warnings: tuple[str, ...] = ()
) -> dict[str, Any]:
    """The keys of `report.OnRecording` of a recording with its settings, and torque errors, which
    are told behind filters of their own.
    """
    signals, settings, behind = problem.signals, problem.settings, problem.for_errors.settings
    keys = with_settings(signals, settings) | {
        "warnings": list(warnings),
        "error_cutoff_hz": behind.cutoff_hz,
        "error_decimation": behind.decimation,
    }
    if not errors:
        return keys
    *joints, whole = errors
    return keys | {
        "relative_error_percent": whole.relative_error_percent,
        "moving_relative_error_percent": whole.moving_relative_error_percent,
        "standing_relative_error_percent": whole.standing_relative_error_percent,
        "joints": joints,
        "all_joints": whole,
    }


def with_settings(signals: Signals, settings: Settings | None) -> dict[str, Any]:
    """The keys of a recording, and of its settings if there are any."""
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
    cutoff_hz = settings.cutoff_hz
    return keys | {
        "cutoff_hz": cutoff_hz,
        "cutoff_forward_backward_3db_hz": forward_backward_3db_hz(cutoff_hz, fs)
        if cutoff_hz
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
    """Known torque and feed-forward, and their use."""
    lines, robot = [], signals.robot
    for values, units, text in (
        (
            signals.known_torque,
            robot.effort_units,
            "known torque, added to that of the drives and to the simulated robot",
        ),
        (
            signals.feedforward,
            [motor.recorded_unit for motor in robot.motors],
            "feed-forward, added to the output of the simulated controller",
        ),
    ):
        if values is not None:
            sizes = zip(robot.joints, np.sqrt(np.mean(values**2, axis=0)), units, strict=True)
            lines.append(
                f"{text}: rms "
                + ", ".join(f"{joint.name} {size:.3g} {unit}" for joint, size, unit in sizes)
            )
    return lines


def remarks(signals: Signals) -> list[str]:
    """The final counters of the recorder, and the payload, if any."""
    known = {name: counts[np.isfinite(counts)] for name, (_, counts) in signals.health.items()}
    last = [f"{name} {counts[-1]:.6g}" for name, counts in known.items() if len(counts)]
    found = [f"recorder: {', '.join(last)}"] if last else []
    if (payload := signals.payload) is not None:
        carried = payload.describe(signals.robot.joints[-1].name)
        found.append(f"payload of {signals.recording}: {carried}")
    return found
