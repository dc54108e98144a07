"""Exports recordings as CSV."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..errors import Place
from ..files import write_columns
from ..recording import Block, gaps, in_parts, read_recording
from ..robot import Robot


def export_csv(path: Path, out: Path, warn: Callable[[str], None] = lambda text: None) -> int:
    """Write the joint samples of a recording as CSV in SI, units in the names, whole or not at all; returns their number."""
    samples, robot = _samples(path, warn)
    fields = [field for field in samples.dtype.names or () if field != "stamp_ns"]
    joints = list(enumerate(robot.joints))
    names = ["time_s", *(f"{j.name}_{field}_{_unit(robot, field, i)}" for field in fields for i, j in joints)]
    start_ns = samples["stamp_ns"][0]
    columns = (
        np.column_stack([(part["stamp_ns"] - start_ns) * 1e-9, *(part[field] for field in fields)])
        for part in in_parts(samples)
    )
    write_columns(out, ["_".join(name.split()) for name in names], columns)
    return len(samples)


def _samples(path: Path, warn: Callable[[str], None]) -> tuple[Block, Robot]:
    """Samples and robot; calls `warn` if samples are missing."""
    recording = read_recording(path)
    if recording.samples is None:
        expected = "some; `robot-acquire import`, with a corrected --robot, makes them from frames that are not lost"
        Place(str(path)).refuse(text=recording.no_samples, expected=expected)
    missing = [gap.missing for gap in gaps(recording.samples, recording.sample_rate_hz) if not gap.late]
    if missing:
        warn(f"{sum(missing)} samples are missing in {len(missing)} gaps")
    return recording.samples, recording.robot


def _unit(robot: Robot, field: str, joint: int) -> str:
    """Unit of a field of a joint's samples, for the name of a column."""
    if field == "feedforward":
        return robot.motors[joint].recorded_unit
    if field in ("effort", "known_torque"):
        return robot.effort_units[joint]
    unit = robot.joints[joint].position_unit
    return f"{unit}_s" if field == "velocity" else unit
