"""Conversions of recordings and logs: decode again, export to CSV and ROS 2 bags, import CAN logs."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..bus import SUFFIXES, Frame, block_of, read_log
from ..errors import AcquisitionError
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
    written_by_master,
)
from ..robot import Bus, Robot, check_recorded_positions, extra_columns, resolve
from ..session import Recorded, write_decoded
from .bag_writer import new_bag

STATES, REFERENCE, DESCRIPTION = "/joint_states", "/joint_states/reference", "/robot_description"


@dataclass(frozen=True, kw_only=True)
class Converted:
    """What was written."""

    robot: str
    samples: int
    sample_rate_hz: float
    has_reference: bool
    warnings: tuple[str, ...]


def decode_recording(path: Path, out: Path, robot: Robot | None, place: str) -> Converted:
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
        raise AcquisitionError("holds no CAN frames", place=str(path), expected="a recording of drives")
    channel, frames = max(recording.frames.items(), key=lambda item: len(item[1]))
    decoded, bus = _decoded(frames, robot, str(path), place)
    decoded = replace(decoded, warnings=(*decoded.warnings, *_fallen(recording, decoded)))
    header = replace(
        recording.header,
        robot=robot,
        sample_rate_hz=1.0 / bus.file.sync_period_s,
        effort_provenance=bus.provenance,
        effort_timing=bus.file.effort_timing,
        notes={**recording.metadata, "decoded_from": recording.sha256},
    )
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        for name, block in recording.frames.items():
            writer.frames(name, block)
        for event in recording.events:
            if event.kind != "warning":  # those of the decoding before
                writer.event(event.stamp_ns, event.kind, event.text)
        for health in recording.health:
            writer.health(health.stamp_ns, health.counters)
        decoded.write(writer, int(frames["time_ns"][-1]))
    return _converted(robot, decoded, channel)


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
    count = int(np.count_nonzero(~np.isin(recording.samples["stamp_ns"], decoded.rows.stamps)))
    text = (
        f"{count} of {len(recording.samples)} rows of an older version fall: their joints may differ in their instants"
    )
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


def import_log(log: Path, out: Path, robot: Robot, place: str) -> Converted:
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
    decoded, bus = _decoded(frames, robot, str(log), place)
    decoded = replace(decoded, warnings=left_out + decoded.warnings)
    header = Header(
        robot=robot,
        source=f"log {log.name}",
        sample_rate_hz=1.0 / bus.file.sync_period_s,
        effort_provenance=bus.provenance,
        effort_timing=bus.file.effort_timing,
        notes={"left_out": "; ".join(left_out)} if left_out else {},
    )
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        writer.frames("log", frames)
        decoded.write(writer, int(frames["time_ns"][-1]))
    return _converted(robot, decoded, "log")


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
        raise AcquisitionError(f"holds no CAN frames ({fd} of CAN FD)", place=str(log), expected="some of classic CAN")
    counts = Counter(interface for interface, _ in found)
    named = [interface for interface in counts if interface is not None]
    wanted = {None, *named}  # error frames may have no interface: with one bus in the log they are of that one
    if len(named) > 1:
        wanted = {robot.bus.channel if robot.bus is not None else ""}
    left_out = [f"{count} of interface {name or '(not named)'}" for name, count in counts.items() if name not in wanted]
    if not wanted & set(counts):
        expected = "one interface: filter the log, or name one of them as bus.channel in robot.toml"
        raise AcquisitionError(f"frames: {', '.join(left_out)}", place=str(log), expected=expected)
    left_out += [f"{fd} of CAN FD"] if fd else []
    frames = block_of([frame for interface, frame in found if interface in wanted])
    return frames, (f"frames left out: {', '.join(left_out)}",) if left_out else ()


def export_csv(path: Path, out: Path, warn: Callable[[str], None] = lambda text: None) -> int:
    """Write the joint samples of a recording as CSV, whole or not at all; returns their number.

    Columns: `time_s` from the first sample, then position, effort and what else was recorded of each joint in SI, and the extra
    objects of the drives; the unit is in the name of the column.
    """
    samples, robot = _samples(path, warn)
    names = ["time_s"]
    fields = [field for field in samples.dtype.names or () if field not in ("stamp_ns", "extra")]
    for field in fields:
        for i, joint in enumerate(robot.joints):
            unit = _unit(robot, field, i)
            names.append(f"{joint.name}_{field}_{unit.replace(' ', '_')}")
    if "extra" in (samples.dtype.names or ()):
        fields.append("extra")
        names += ["_".join(" ".join((c.motor, c.name, c.unit)).split()) for c in extra_columns(robot)]
    start_ns = samples["stamp_ns"][0]
    write_columns(
        out,
        names,
        (
            np.column_stack([(part["stamp_ns"] - start_ns) * 1e-9, *(part[field] for field in fields)])
            for part in in_parts(samples)
        ),
    )
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
                stamp = int(row["stamp_ns"])
                effort = row["effort"] if robot.gain_known else nothing  # N m or N by definition of the message
                bag.joint_state(STATES, stamp, names, (row["position"], speeds["position"][k], effort))
                if "reference" in fields:
                    bag.joint_state(REFERENCE, stamp, names, (row["reference"], speeds["reference"][k], nothing))
            counts[STATES] += len(part)
            if "reference" in fields:
                counts[REFERENCE] += len(part)
            first += len(part)
    return counts


def _derivative(q: Array, t_s: Array) -> Array:
    return np.asarray(np.gradient(q, t_s, axis=0)) if len(q) > 1 else np.zeros_like(q)


def _samples(path: Path, warn: Callable[[str], None]) -> tuple[Block, Robot]:
    """Samples and robot; `warn` is given the number of missing samples."""
    recording = read_recording(path)
    if recording.samples is None:
        expected = "some; `robot-acquire decode` makes them of frames"
        raise AcquisitionError(recording.no_samples, place=str(path), expected=expected)
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


def _decoded(frames: Block, robot: Robot, name: str, place: str) -> tuple[Decoded, Bus]:
    bus = resolve(robot, place, written_by_master(frames))
    decoded = decode(frames, robot, bus, name)
    q = np.concatenate([block["position"] for block in decoded.rows.blocks()])
    warnings = check_recorded_positions(robot, decoded.rows.stamps * np.float64(1e-9), q, name)
    return replace(decoded, warnings=decoded.warnings + warnings), bus


def _converted(robot: Robot, decoded: Decoded, channel: str) -> Converted:
    return Converted(
        robot=robot.name,
        samples=len(decoded.rows.stamps),
        sample_rate_hz=1.0 / robot.bus.sync_period_s if robot.bus else 0.0,
        has_reference=decoded.rows.targets is not None,
        warnings=decoded.warnings,
    )
