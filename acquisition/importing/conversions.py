"""Conversions of recordings and logs: decode again, export to CSV and ROS 2 bags, import CAN logs."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Array
from ..bus import SUFFIXES, Frame, block_of, read_log
from ..errors import AcquisitionError, Place
from ..files import atomic_write, write_columns
from ..recording import (
    UNCERTAIN,
    Block,
    Decoded,
    Header,
    Recording,
    RecordingWriter,
    decode,
    gaps,
    in_parts,
    read_recording,
    recover,
    rewrite,
    written_by_master,
)
from ..robot import Robot, check_recorded_positions, extra_columns, resolve
from ..session import Recorded, write_decoded
from .bag_writer import new_bag
from .samples import Imported

TOPICS, DESCRIPTION = {"position": "/joint_states", "reference": "/joint_states/reference"}, "/robot_description"


def decode_recording(path: Path, out: Path, robot: Robot | None, place: str) -> Imported:
    """Decode the frames of a recording again, into a new recording.

    Parameters
    ----------
    path : the recording.
    out : the new one, with the same frames and events; written whole or not at all.
    robot : a corrected description; None: that of the recording.
    place : the name of the description in errors.

    Raises
    ------
    AcquisitionError
        There are no frames, or they do not decode with these drives.
    """
    recording = read_recording(path)
    robot = robot or recording.robot
    if not recording.frames:
        Place(str(path)).refuse(text="holds no CAN frames", expected="a recording of drives")
    frames = max(recording.frames.values(), key=len)
    decoded, of_bus = _decoded(frames, robot, str(path), place)
    decoded = replace(decoded, warnings=(*decoded.warnings, *_fallen(recording, decoded)))
    notes = {**recording.metadata, "decoded_from": recording.sha256}
    header, end_ns = replace(recording.header, notes=notes, **of_bus), int(frames["time_ns"][-1])
    # Warnings are those of the decoding before.
    rewrite(recording, header, out, lambda writer: decoded.write(writer, end_ns), without="warning")
    return _imported(header, decoded, out)


def row_doubts(recording: Recording) -> str:
    """What the frames of a recording of an older version say of its samples; empty where all of them stand."""
    if not recording.frames or recording.samples is None or not _is_older(recording):
        return ""
    frames = max(recording.frames.values(), key=len)
    try:
        decoded, _ = _decoded(frames, recording.robot, "its frames", "its robot.toml")
    except AcquisitionError as error:
        return f"all {len(recording.samples)} fall: {error}"
    return "; ".join(_fallen(recording, decoded))


def _fallen(recording: Recording, decoded: Decoded) -> list[str]:
    """How many samples of an older version do not stand: their joints are not proven to be of one instant."""
    if recording.samples is None or not _is_older(recording):
        return []
    stamps = recording.samples["stamp_ns"]
    count = int(np.count_nonzero(~np.isin(stamps, decoded.stamps)))
    text = f"{count} of {len(stamps)} rows of an older version fall: their joints may differ in their instants"
    return [text] if count else []


def _is_older(recording: Recording) -> bool:
    """Whether a version made the samples that did not count uncertain ones."""
    return not any(UNCERTAIN in health.counters for health in recording.health)


def recover_recording(path: Path, out: Path) -> tuple[Recording, Recorded]:
    """As `recover`, with samples decoded from the frames if there are any; what was read, and what samples there are."""
    found: list[Recorded] = []

    def write(recording: Recording, writer: RecordingWriter) -> None:
        frames = max(recording.frames.values(), key=len)
        found.append(write_decoded(writer, frames, recording.robot, int(frames["time_ns"][-1]), str(path)))

    recording = recover(path, out, write)
    samples = 0 if recording.samples is None else len(recording.samples)
    return recording, found[0] if found else Recorded(frames=0, samples=samples, warnings=())


def is_log(path: Path) -> bool:
    """Whether a file is a CAN log, by its suffix."""
    return path.suffix.lower() in SUFFIXES


def import_log(log: Path, out: Path, robot: Robot, place: str) -> Imported:
    """Write the recording `out` from a CAN log of another tool.

    Parameters
    ----------
    log : candump, ASC, BLF or TRC. If it has several interfaces, the frames of `bus.channel` are used.
    out : written whole or not at all.
    robot : its drives decode the frames.
    place : the name of the description in errors.

    Raises
    ------
    AcquisitionError
        The log cannot be read, none of its frames are of the described interface, or they do not decode.
    """
    frames, left_out = _of_one_interface(log, robot)
    frames["time_ns"] = np.maximum.accumulate(frames["time_ns"])
    decoded, of_bus = _decoded(frames, robot, str(log), place)
    decoded = replace(decoded, warnings=left_out + decoded.warnings)
    notes = {"left_out": "; ".join(left_out)} if left_out else {}
    header = Header(source=f"log {log.name}", notes=notes, **of_bus)
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        writer.frames("log", frames)
        decoded.write(writer, int(frames["time_ns"][-1]))
    return _imported(header, decoded, out)


def _of_one_interface(log: Path, robot: Robot) -> tuple[Block, tuple[str, ...]]:
    """The frames of a log, and what is left out. Frames of two buses together would give two samples for every SYNC."""
    found: list[tuple[str | None, Frame]] = []
    fd = 0
    for interface, frame in read_log(log):
        if frame is None:
            fd += 1
        else:
            found.append((interface, frame))
    if not found:
        Place(str(log)).refuse(text=f"holds no CAN frames ({fd} of CAN FD)", expected="some of classic CAN")
    counts = Counter(interface for interface, _ in found)
    named = [interface for interface in counts if interface is not None]
    wanted = {None, *named}  # error frames may have no interface: with one bus in the log they are of that one
    if len(named) > 1:
        wanted = {robot.bus.channel if robot.bus is not None else ""}
    left_out = [f"{count} of interface {name or '(not named)'}" for name, count in counts.items() if name not in wanted]
    if not wanted & set(counts):
        expected = "one interface: filter the log, or name one of them as bus.channel in robot.toml"
        Place(str(log)).refuse(text=f"frames: {', '.join(left_out)}", expected=expected)
    left_out += [f"{fd} of CAN FD"] if fd else []
    frames = block_of([frame for interface, frame in found if interface in wanted])
    return frames, (f"frames left out: {', '.join(left_out)}",) if left_out else ()


def export_csv(path: Path, out: Path, warn: Callable[[str], None] = lambda text: None) -> int:
    """Write the joint samples of a recording as CSV, whole or not at all; returns their number.

    Columns: `time_s` from the first sample, then position, effort and what else was recorded of each joint in SI, and the extra
    objects of the drives; the unit is in the name of the column.
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

    All samples are in /joint_states: position, velocity as it was recorded or the derivative of the position by central
    differences, effort where it is in N m or N. The reference is in /joint_states/reference. /robot_description is the URDF,
    if the robot has one.
    """
    samples, robot = _samples(path, warn)
    names, fields, nothing = [joint.name for joint in robot.joints], samples.dtype.names or (), np.zeros(0)
    t_s = (samples["stamp_ns"] - samples["stamp_ns"][0]) * np.float64(1e-9)
    counts, first = Counter[str](), 0
    with new_bag(out) as bag:
        if robot.urdf is not None:
            bag.text(DESCRIPTION, int(samples["stamp_ns"][0]), robot.urdf)
            counts[DESCRIPTION] += 1
        for part in in_parts(samples):
            around = slice(max(0, first - 1), first + len(part) + 1)
            speeds = {
                field: _derivative(samples[field][around], t_s[around])[first - around.start :]
                for field in ("position", "reference")
                if field in fields
            }
            if "velocity" in fields:
                speeds["position"] = part["velocity"]
            for k, row in enumerate(part):
                for field, speed in speeds.items():
                    # N m or N by definition of the message.
                    effort = row["effort"] if field == "position" and robot.gain_known else nothing
                    bag.joint_state(TOPICS[field], int(row["stamp_ns"]), names, (row[field], speed[k], effort))
            counts.update({TOPICS[field]: len(part) for field in speeds})
            first += len(part)
    return counts


def _derivative(q: Array, t_s: Array) -> Array:
    return np.asarray(np.gradient(q, t_s, axis=0)) if len(q) > 1 else np.zeros_like(q)


def _samples(path: Path, warn: Callable[[str], None]) -> tuple[Block, Robot]:
    """Samples and robot; `warn` is given the number of missing samples."""
    recording = read_recording(path)
    if recording.samples is None:
        expected = "some; `robot-acquire decode` makes them of frames"
        Place(str(path)).refuse(text=recording.no_samples, expected=expected)
    missing = [gap.missing for gap in gaps(recording.samples, recording.sample_rate_hz) if not gap.late]
    if missing:
        warn(f"{sum(missing)} samples are missing in {len(missing)} gaps")
    return recording.samples, recording.robot


def _unit(robot: Robot, field: str, joint: int) -> str:
    """Unit of a field of a joint's samples, as the name of a column has it."""
    if field == "feedforward":
        return robot.motors[joint].recorded_unit
    if field in ("effort", "known_torque"):
        return robot.effort_units[joint]
    unit = robot.joints[joint].position_unit
    return f"{unit}_s" if field == "velocity" else unit


def _decoded(frames: Block, robot: Robot, name: str, place: str) -> tuple[Decoded, dict[str, Any]]:
    """Samples of frames, checked, and what a header says of them."""
    bus = resolve(robot, place, written_by_master(frames))
    decoded = decode(frames, robot, bus, name)
    q = np.concatenate([block["position"].copy() for block in decoded.blocks()])  # a view would keep its whole block
    warnings = check_recorded_positions(robot, decoded.stamps * np.float64(1e-9), q, name)
    of_bus = {
        "robot": robot,
        "sample_rate_hz": 1.0 / bus.file.sync_period_s,
        "effort_provenance": bus.provenance,
        "effort_timing": bus.file.effort_timing,
    }
    return replace(decoded, warnings=decoded.warnings + warnings), of_bus


def _imported(header: Header, decoded: Decoded, out: Path) -> Imported:
    return Imported(
        out=out,
        robot=header.robot.name,
        samples=len(decoded.stamps),
        sample_rate_hz=header.sample_rate_hz,
        has_reference=decoded.targets is not None,
        warnings=decoded.warnings,
    )
