"""Exports recordings as CSV and as ROS 2 bags."""

import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Array
from ..errors import AcquisitionError, Place
from ..files import write_columns
from ..recording import JOINT_STATE, TEXT, Block, RosMessages, gaps, in_parts, read_recording
from ..robot import Robot, extra_columns

TOPICS, DESCRIPTION = {"position": "/joint_states", "reference": "/joint_states/reference"}, "/robot_description"
_BAG_VERSION = 8  # of rosbag2's metadata; the oldest one that the package rosbags writes


def export_csv(path: Path, out: Path, warn: Callable[[str], None] = lambda text: None) -> int:
    """Write the joint samples of a recording as CSV, whole or not at all; returns their number.

    Columns: `time_s` from the first sample, then position, effort and all else recorded of each joint in SI, then the extra
    objects of the drives. The column name contains the unit.
    """
    samples, robot = _samples(path, warn)
    fields = [field for field in samples.dtype.names or () if field not in ("stamp_ns", "extra")]
    names = [
        "time_s",
        *(f"{j.name}_{field}_{_unit(robot, field, i)}" for field in fields for i, j in enumerate(robot.joints)),
    ]
    if "extra" in (samples.dtype.names or ()):
        fields.append("extra")
        names += [f"{c.motor} {c.name} {c.unit}" for c in extra_columns(robot)]
    start_ns = samples["stamp_ns"][0]
    columns = (
        np.column_stack([(part["stamp_ns"] - start_ns) * 1e-9, *(part[field] for field in fields)])
        for part in in_parts(samples)
    )
    write_columns(out, ["_".join(name.split()) for name in names], columns)
    return len(samples)


def export_bag(path: Path, out: Path, warn: Callable[[str], None] = lambda text: None) -> Mapping[str, int]:
    """Write the joint samples of a recording as a ROS 2 bag, a new folder; returns the number of messages by topic.

    /joint_states has all samples: position, velocity as recorded or the derivative of the position by central differences,
    effort if it is in N m or N. /joint_states/reference is the reference, /robot_description the URDF if there is one.
    """
    samples, robot = _samples(path, warn)
    names, fields, nothing = [joint.name for joint in robot.joints], samples.dtype.names or (), np.zeros(0)
    t_s = (samples["stamp_ns"] - samples["stamp_ns"][0]) * np.float64(1e-9)
    counts, first, messages = Counter[str](), 0, RosMessages()
    with _new_bag(out) as bag:
        if robot.urdf is not None:
            channel = bag.add_connection(DESCRIPTION, TEXT, typestore=messages.store, offered_qos_profiles=[_latched()])
            bag.write(channel, int(samples["stamp_ns"][0]), messages.text(robot.urdf))
            counts[DESCRIPTION] += 1
        channels = {
            field: bag.add_connection(topic, JOINT_STATE, typestore=messages.store)
            for field, topic in TOPICS.items()
            if field in fields
        }
        for part in in_parts(samples):
            around = slice(max(0, first - 1), first + len(part) + 1)  # central differences need a neighbour
            speeds: dict[str, Array] = {
                field: _derivative(samples[field][around], t_s[around])[first - around.start :] for field in channels
            }
            if "velocity" in fields:
                speeds["position"] = part["velocity"]
            for k, row in enumerate(part):
                for field, speed in speeds.items():
                    # N m or N by definition of the message.
                    effort = row["effort"] if field == "position" and robot.gain_known else nothing
                    stamp_ns = int(row["stamp_ns"])
                    state = messages.joint_state(stamp_ns, names, row[field], speed[k], effort)
                    bag.write(channels[field], stamp_ns, state)
            counts.update({TOPICS[field]: len(part) for field in speeds})
            first += len(part)
    return counts


def _derivative(q: Array, t_s: Array) -> Array:
    return np.asarray(np.gradient(q, t_s, axis=0)) if len(q) > 1 else np.zeros_like(q)


def _samples(path: Path, warn: Callable[[str], None]) -> tuple[Block, Robot]:
    """Samples and robot; calls `warn` if samples are missing."""
    recording = read_recording(path)
    if recording.samples is None:
        expected = "some; `robot-acquire import` makes them from frames"
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


@contextmanager
def _new_bag(folder: Path) -> Iterator[Any]:
    """Write a ROS 2 bag, a folder with an .mcap of CDR channels, whole or not at all."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    if not folder.name or os.path.lexists(folder):
        raise AcquisitionError("already exists", place=str(folder), expected="the name of a new folder")
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir()
        # The file inside gets the name of its folder, so the folder is written under its final name.
        writer = Writer(partial / folder.name, version=_BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
        writer.open()
        try:
            yield writer
        except BaseException:
            writer.abort()
            raise
        writer.close()
        (partial / folder.name).rename(folder)
    except OSError as error:
        raise AcquisitionError(f"cannot be written: {error.strerror or error}", place=str(folder)) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _latched() -> Any:
    """Quality of service of a topic that stores its last message for late subscribers."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        never,
        never,
        QosLiveliness.AUTOMATIC,
        never,
        False,
    )
