"""Recordings from frames: of other recordings, also cut ones, and of CAN logs."""

from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ..bus import SUFFIXES, read_log
from ..errors import Place, listed
from ..files import GrowingBytes, atomic_write
from ..recording import (
    NO_SAMPLES,
    Block,
    Decoded,
    Header,
    Recording,
    RecordingWriter,
    decode,
    read_recording,
    resolve_mapped,
    rewritten,
)
from ..robot import Bus, Payload, Robot, check_recorded_positions, resolve
from ..session import write_decoded
from .captures import is_capture
from .ethercat import MAPPING_NOTE, import_capture
from .log_times import in_order
from .time_base import ImportSummary


def import_recording(
    path: Path, out: Path, robot: Robot | None = None, place: str = ""
) -> ImportSummary:
    """Write a recording again: samples decoded from its frames, and everything before the
    cut if it was cut off.

    Without `robot`, a corrected description with the name `place` in errors, samples of a cut
    recording are copied if there are no frames, or if these do not decode. `out`, with the same
    frames and events, is written whole or not at all. Raises `BadInputError`: there are no frames,
    or they do not decode with these drives.
    """
    recording = read_recording(path)
    if recording.cut and robot is None:
        return _repair(recording, path, out)
    robot, place = robot or recording.robot, place or f"{path}: robot.toml"
    notes = {**recording.metadata, "decoded_from": recording.sha256}
    if recording.capture:
        bus = resolve(robot, place)
        header = replace(recording.header, notes=notes, **_bus_header(robot, bus))
        return import_capture(BytesIO(recording.capture), header, bus, Place(str(path)), out)
    Place(str(path)).require(
        recording.frames,
        text="holds no frames and is not cut off",
        expected="a recording of drives",
    )
    frames = max(recording.frames.values(), key=len)
    decoded, end_ns = _decode_checked(frames, robot, str(path), place), int(frames["time_ns"][-1])
    header = replace(recording.header, notes=notes, **_bus_header(robot, decoded.bus))
    # Warnings are those of the decoding before.
    with rewritten(recording, header, out, without="warning") as writer:
        decoded.write(writer, end_ns)
    return ImportSummary(out=out, warnings=decoded.warnings)


def _repair(recording: Recording, path: Path, out: Path) -> ImportSummary:
    """Write what was read of a recording that was cut off."""
    samples = recording.samples
    if samples is None and not recording.frames and not recording.capture:
        Place(str(path)).refuse(
            text="holds no samples and no frames before its cut: nothing can be repaired"
        )
    notes = {**recording.metadata, "recovered_from": recording.sha256}
    warnings: tuple[str, ...] = ()
    with rewritten(recording, replace(recording.header, notes=notes), out) as writer:
        if recording.frames:
            frames = max(recording.frames.values(), key=len)
            end_ns = int(frames["time_ns"][-1])
            found = write_decoded(writer, frames, recording.robot, end_ns, str(path))
            if not found.no_samples:
                return ImportSummary(out=out, warnings=found.warnings)
            warnings = (f"{NO_SAMPLES}{found.no_samples}",)
            if samples is not None:
                text = f"{found.no_samples}; the {len(samples)} samples before the cut are copied"
                writer.event(end_ns, "warning", text)
                warnings = (text,)
        if samples is not None:
            writer.samples(samples)
    return ImportSummary(out=out, warnings=warnings)


def is_log(path: Path) -> bool:
    """Whether the suffix of a file is that of a CAN log, or it begins as an EtherCAT capture."""
    return path.suffix.lower() in SUFFIXES or is_capture(path)


def import_log(
    log: Path,
    out: Path,
    robot: Robot,
    place: str,
    payload: Payload | None = None,
    mapping: Sequence[str] = (),
) -> ImportSummary:
    """Write the recording `out`, whole or not at all, from another tool's CAN log, or an EtherCAT
    capture with this `mapping`.

    `log`: candump, ASC, BLF or TRC; if it has several interfaces, the frames of `bus.channel` are
    used, such as "can0", or "1" for CAN 1 of Vector's and PCAN's files. The drives of `robot`,
    whose description has the name `place` in errors, decode the frames; `payload` is what it
    carried. Raises `BadInputError`: the log cannot be read, none of its frames are of the described
    interface, its times begin again, or the frames do not decode.
    """
    if is_capture(log):
        bus, notes = resolve(robot, place), {MAPPING_NOTE: " ".join(mapping)}
        header = Header(
            source=f"EtherCAT capture {log.name}",
            payload=payload,
            notes=notes,
            **_bus_header(robot, bus),
        )
        with log.open("rb") as file:
            return import_capture(file, header, bus, Place(str(log)), out)
    described = robot.bus or resolve(robot, place).file  # refuses a robot without a bus
    frames, left_out = _select_interface(log, described.channel)
    frames, told = in_order(frames, described, str(log))
    decoded = _decode_checked(frames, robot, str(log), place)
    decoded = replace(decoded, warnings=left_out + told + decoded.warnings)
    notes = {"left_out": "; ".join(left_out)} if left_out else {}
    header = Header(
        source=f"log {log.name}", payload=payload, notes=notes, **_bus_header(robot, decoded.bus)
    )
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        writer.frames("log", frames)
        decoded.write(writer, int(frames["time_ns"][-1]))
    return ImportSummary(out=out, warnings=decoded.warnings)


def _select_interface(path: Path, channel: str) -> tuple[Block, tuple[str, ...]]:
    """The frames of one bus in a log, and a warning about those left out: two buses would give two
    samples for each SYNC.
    """
    frames, others = read_log(path)
    names = {name: f"CAN {name}" if name.isdecimal() else name for name in frames}
    counts = {
        **{name: f"{len(some)} of {names[name]}" for name, some in frames.items()},
        **{what: f"{count} {what}" for what, count in others.items()},
    }
    Place(str(path)).require(
        names,
        text=f"holds no CAN frames{f' ({listed([*counts.values()])})' if counts else ''}",
        expected="some of classic CAN",
    )
    Place(str(path)).require(
        len(names) == 1 or channel in names,
        text=f"frames: {listed([*counts.values()])}",
        expected=f"one of {listed([*map(repr, names)])} as bus.channel in robot.toml",
    )
    taken = channel if len(names) > 1 else next(iter(names))
    told = f"frames of {names[taken]} are used; " if len(names) > 1 else ""
    left_out = [text for what, text in counts.items() if what != taken]
    return frames[taken], (f"{told}left out: {listed(left_out)}",) * bool(left_out)


def _decode_checked(frames: Block, robot: Robot, name: str, place: str) -> Decoded:
    frames, bus = resolve_mapped(frames, robot, place)
    decoded = decode(frames, robot, bus, name)
    positions = GrowingBytes()
    for block in decoded.blocks():
        positions.write(block["position"].tobytes())
    q = np.frombuffer(positions.whole()).reshape(-1, robot.n)
    found = check_recorded_positions(robot, decoded.stamps * np.float64(1e-9), q, name)
    return replace(decoded, warnings=decoded.warnings + found)


def _bus_header(robot: Robot, bus: Bus) -> dict[str, Any]:
    """The fields of a header that describe the drives."""
    return {
        "robot": robot,
        "sample_rate_hz": 1.0 / bus.file.sync_period_s,
        "effort_provenance": bus.provenance,
        "effort_timing": bus.file.effort_timing,
    }
