"""Recordings out of frames: decoded again, recovered, and out of CAN logs."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..bus import SUFFIXES, Frame, block_of, read_log
from ..errors import AcquisitionError, Place
from ..files import atomic_write
from ..recording import (
    UNCERTAIN,
    Block,
    Decoded,
    Header,
    Recording,
    RecordingWriter,
    decode,
    read_recording,
    rewrite,
    written_by_master,
)
from ..robot import Robot, check_recorded_positions, resolve
from ..session import RecordedSummary, write_decoded
from .time_base import ImportSummary


def decode_recording(path: Path, out: Path, robot: Robot | None, place: str) -> ImportSummary:
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
    decoded = _decode_checked(frames, robot, str(path), place)
    decoded = replace(decoded, warnings=(*decoded.warnings, *_refused_row_warnings(recording, decoded)))
    notes = {**recording.metadata, "decoded_from": recording.sha256}
    header, end_ns = replace(recording.header, notes=notes, **_bus_header(decoded)), int(frames["time_ns"][-1])
    # Warnings are those of the decoding before.
    rewrite(recording, header, out, lambda writer: decoded.write(writer, end_ns), without="warning")
    return _summarize(decoded, out)


def row_warnings(recording: Recording) -> str:
    """What the frames of a recording of an older version say of its samples; empty where all of them stand."""
    if not recording.frames or recording.samples is None or not _is_older(recording):
        return ""
    frames = max(recording.frames.values(), key=len)
    try:
        decoded = _decode_checked(frames, recording.robot, "its frames", "its robot.toml")
    except AcquisitionError as error:
        return f"all {len(recording.samples)} fall: {error}"
    return "; ".join(_refused_row_warnings(recording, decoded))


def _refused_row_warnings(recording: Recording, decoded: Decoded) -> list[str]:
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


def recover_recording(path: Path, out: Path) -> tuple[Recording, RecordedSummary]:
    """Write a whole recording of everything before the cut of one without its end; samples are decoded from its frames, if any.

    Returns what was read, and what samples there are. An `AcquisitionError` as of `read_recording`; also if the file is not
    cut, or `out` cannot be written.
    """
    recording = read_recording(path)
    if not recording.cut:
        Place(str(path)).refuse(text="has its proper end: nothing to recover")
    found = RecordedSummary(frames=0, samples=0 if recording.samples is None else len(recording.samples), warnings=())

    def write(writer: RecordingWriter) -> None:
        nonlocal found
        if recording.frames:
            frames = max(recording.frames.values(), key=len)
            found = write_decoded(writer, frames, recording.robot, int(frames["time_ns"][-1]), str(path))
        elif recording.samples is not None:
            writer.samples(recording.samples)

    notes = {**recording.metadata, "recovered_from": recording.sha256}
    rewrite(recording, replace(recording.header, notes=notes), out, write)
    return recording, found


def is_log(path: Path) -> bool:
    """Whether a file is a CAN log, by its suffix."""
    return path.suffix.lower() in SUFFIXES


def import_log(log: Path, out: Path, robot: Robot, place: str) -> ImportSummary:
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
    frames, left_out = _select_interface(log, robot)
    frames["time_ns"] = np.maximum.accumulate(frames["time_ns"])
    decoded = _decode_checked(frames, robot, str(log), place)
    decoded = replace(decoded, warnings=left_out + decoded.warnings)
    notes = {"left_out": "; ".join(left_out)} if left_out else {}
    header = Header(source=f"log {log.name}", notes=notes, **_bus_header(decoded))
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        writer.frames("log", frames)
        decoded.write(writer, int(frames["time_ns"][-1]))
    return _summarize(decoded, out)


def _select_interface(log: Path, robot: Robot) -> tuple[Block, tuple[str, ...]]:
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


def _decode_checked(frames: Block, robot: Robot, name: str, place: str) -> Decoded:
    """Samples of frames, checked."""
    decoded = decode(frames, robot, resolve(robot, place, written_by_master(frames)), name)
    q = np.concatenate([block["position"].copy() for block in decoded.blocks()])  # a view would keep its whole block
    warnings = check_recorded_positions(robot, decoded.stamps * np.float64(1e-9), q, name)
    return replace(decoded, warnings=decoded.warnings + warnings)


def _bus_header(decoded: Decoded) -> dict[str, Any]:
    """What a header says of the drives."""
    file = decoded.bus.file
    return {
        "robot": decoded.robot,
        "sample_rate_hz": 1.0 / file.sync_period_s,
        "effort_provenance": decoded.bus.provenance,
        "effort_timing": file.effort_timing,
    }


def _summarize(decoded: Decoded, out: Path) -> ImportSummary:
    return ImportSummary(
        out=out,
        robot=decoded.robot.name,
        samples=len(decoded.stamps),
        sample_rate_hz=1.0 / decoded.bus.file.sync_period_s,
        has_reference=decoded.targets is not None,
        warnings=decoded.warnings,
    )
