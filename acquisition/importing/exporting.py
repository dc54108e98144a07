"""Joint samples of a recording for other tools: CSV, ROS 2 bags."""

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import AcquisitionError
from ..files import atomic_write
from ..recording import Block, read_recording
from ..robot import Robot, extra_columns
from ..ros import BagWriter, link_frames, quaternions, urdf_of

VIEWED_HZ = 100.0  # transforms are for viewers: at most so many
STATES, REFERENCE, DESCRIPTION, TRANSFORMS = "/joint_states", "/joint_states/reference", "/robot_description", "/tf"


def export_csv(path: Path, out: Path) -> int:
    """Write the joint samples of a recording as CSV.

    Parameters
    ----------
    path : the recording.
    out : `time_s` from the first sample, then position, effort and what else was recorded of each joint in SI, and the extra
        objects of the drives; the unit is in the name of the column. Written whole or not at all.

    Returns
    -------
    The number of samples.

    Raises
    ------
    AcquisitionError
        The recording has no samples, or a file cannot be read or written.
    """
    samples, robot = _samples(path)
    columns = [(samples["stamp_ns"] - samples["stamp_ns"][0]) * 1e-9]
    names = ["time_s"]
    fields = samples.dtype.names or ()
    for field in (field for field in fields if field not in ("stamp_ns", "extra")):
        for i, joint in enumerate(robot.joints):
            unit = _unit(robot, field, i)
            names.append(f"{joint.name}_{field}_{unit.replace(' ', '_')}")
            columns.append(samples[field][:, i])
    if "extra" in fields:
        for k, column in enumerate(extra_columns(robot)):
            names.append("_".join(" ".join((column.motor, column.name, column.unit)).split()))
            columns.append(samples["extra"][:, k])
    with atomic_write(out) as partial:
        np.savetxt(partial, np.column_stack(columns), delimiter=",", header=",".join(names), comments="", fmt="%.17g")
    return len(samples)


def export_bag(path: Path, out: Path) -> Mapping[str, int]:
    """Write the joint samples of a recording as a ROS 2 bag.

    All samples are in /joint_states: position, velocity as it was recorded or the derivative of the position by central
    differences, effort where it is in N m or N. The reference is in /joint_states/reference. /robot_description is the URDF,
    or one made of the DH rows; /tf has the transform of each link from the one before, at most 100 a second.

    Parameters
    ----------
    path : the recording.
    out : a new folder; written whole or not at all.

    Returns
    -------
    The number of messages by topic.

    Raises
    ------
    AcquisitionError
        The recording has no samples, the folder exists, or a file cannot be read or written.
    """
    samples, robot = _samples(path)
    names, fields, nothing = [joint.name for joint in robot.joints], samples.dtype.names or (), np.zeros(0)
    stamps, q = samples["stamp_ns"], samples["position"]
    t_s = (stamps - stamps[0]) * np.float64(1e-9)
    measured = samples["velocity"] if "velocity" in fields else _derivative(q, t_s)
    reference = samples["reference"] if "reference" in fields else None
    reference_speed = None if reference is None else _derivative(reference, t_s)
    frames = link_frames(robot, str(path))
    rate_hz = 0.0 if len(t_s) < 2 else 1 / float(np.median(np.diff(t_s)))
    step, counts = max(1, math.ceil(rate_hz / VIEWED_HZ - 1e-9)), Counter[str]()
    shift, turn = frames.transforms(q[::step])
    turn = quaternions(turn)
    with BagWriter(out) as bag:
        bag.text(DESCRIPTION, int(stamps[0]), urdf_of(robot))
        counts[DESCRIPTION] += 1
        for k, stamp in enumerate(stamps):
            effort = samples["effort"][k] if robot.gain_known else nothing  # N m or N by definition of the message
            bag.joint_state(STATES, int(stamp), names, (q[k], measured[k], effort))
            counts[STATES] += 1
            if reference is not None and reference_speed is not None:
                bag.joint_state(REFERENCE, int(stamp), names, (reference[k], reference_speed[k], nothing))
                counts[REFERENCE] += 1
            if k % step == 0:
                bag.transforms(TRANSFORMS, int(stamp), frames.names, shift[k // step], turn[k // step])
                counts[TRANSFORMS] += 1
    return counts


def _derivative(q: Array, t_s: Array) -> Array:
    return np.asarray(np.gradient(q, t_s, axis=0)) if len(q) > 1 else np.zeros_like(q)


def _samples(path: Path) -> tuple[Block, Robot]:
    recording = read_recording(path)
    if recording.samples is None:
        raise AcquisitionError(
            "holds no joint samples", place=str(path), expected="some; `robot-acquire decode` makes them of frames"
        )
    return recording.samples, recording.robot


def _unit(robot: Robot, field: str, joint: int) -> str:
    """Unit of a field of a joint's samples, as the name of a column has it."""
    if field == "feedforward":
        return robot.motors[joint].recorded_unit
    if field in ("effort", "known_torque"):
        return robot.effort_units[joint]
    unit = robot.joints[joint].position_unit
    return f"{unit}_s" if field == "velocity" else unit
