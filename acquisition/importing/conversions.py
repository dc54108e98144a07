"""Recordings from frames: those of other recordings, including truncated ones, and of CAN logs.

Each frame of a log is used once, in the order of the times. Loggers with a queue per direction
write lines out of order, with right times: these are sorted. If a time counter wraps or the clock
is set back, SYNC itself continues below the time that it had reached: from there on times are
shifted.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Ints
from ..bus import SUFFIXES, read_log
from ..errors import Location, listed, one_line
from ..files import GrowingBytes, atomic_write, by_rows, field_of, kept, taken
from ..recording import (
    FRAME,
    NO_SAMPLES,
    OPTIONAL,
    SENT,
    Block,
    Decoded,
    Header,
    Recording,
    RecordingWriter,
    Rows,
    Traffic,
    decode,
    overview,
    read_recording,
    resolve_mapped,
    rewritten,
)
from ..robot import Bus, BusFile, Payload, Robot, check_recorded_positions, resolve
from ..session import write_decoded
from .captures import is_capture
from .ethercat import MAPPING_NOTE, import_capture
from .stamps import ONE_CLOCK, steps_back
from .time_base import ImportSummary

# Time counters of loggers wrap after so many ns.
_WRAPS = {60 * 10**9: "a minute", 2**32 * 1000: "2^32 µs", 86_400 * 10**9: "a day"}
_MAX_WRAP_NS = 10**9  # largest time between the frames before and after a wrap
# A clock that steps back by more, or by a larger share of the time so far, begins another session.
_MAX_SET_NS, _MAX_SET_SHARE = 60 * 10**9, 0.8
_MAX_ECHO = 0.25  # largest time between the two records of one frame, in periods


def summary_lines(found: ImportSummary) -> list[str]:
    """Return lines on an import: robot, samples and rate, efforts, and what was chosen."""
    recording = read_recording(found.out)
    about = overview(recording)
    fields = () if recording.samples is None else recording.samples.dtype.names or ()
    parts = [
        f"{found.out}: {about['robot']}",
        f"{about['samples']} samples at {about['sample_rate_hz']:g} Hz",
        *(
            [f"effort in {', '.join(dict.fromkeys(found.effort_units))}"]
            if found.effort_units
            else []
        ),
        *(f"with {name.replace('_', ' ')}" for name in ("reference", *OPTIONAL) if name in fields),
    ]
    more = {
        "topic": found.topic,
        "times": found.times,
        "rows": about["rows"],
        "reference": recording.metadata.get("reference", ""),
    }
    lines = [", ".join(parts), *(f"{name}: {text}" for name, text in more.items() if text)]
    return [one_line(line) for line in lines]


def import_recording(
    path: Path, out: Path, robot: Robot | None = None, place: str = ""
) -> ImportSummary:
    """Write a recording again, with samples decoded from its frames.

    If the recording is truncated, everything before the truncation is written. Without `robot`,
    samples of a truncated recording are copied if there are no frames, or if these do not decode.

    Parameters
    ----------
    path : the recording.
    out : the recording to write, with the same frames and events, whole or not at all.
    robot : a corrected description.
    place : its name in errors.

    Raises
    ------
    BadInputError : there are no frames, or they do not decode with these drives.
    """
    recording = read_recording(path)
    if recording.cut and robot is None:
        return _repair(recording, path, out)
    robot, place = robot or recording.robot, place or f"{path}: robot.toml"
    notes = {**recording.metadata, "decoded_from": recording.sha256}
    if recording.capture:
        bus = resolve(robot, place)
        header = replace(recording.header, notes=notes, **_bus_header(robot, bus))
        return import_capture(BytesIO(recording.capture), header, bus, Location(str(path)), out)
    Location(str(path)).require(
        recording.frames,
        text="the recording contains no frames, and it is not truncated",
        advice="Choose a recording of drives, or a truncated one",
    )
    frames = max(recording.frames.values(), key=len)
    decoded, end_ns = _decode_checked(frames, robot, str(path), place), int(frames["time_ns"][-1])
    header = replace(recording.header, notes=notes, **_bus_header(robot, decoded.bus))
    # The recorded warnings are those of an earlier decoding, so they are not copied.
    with rewritten(recording, header, out, without="warning") as writer:
        decoded.write(writer, end_ns)
    return ImportSummary(out=out, warnings=decoded.warnings)


def _repair(recording: Recording, path: Path, out: Path) -> ImportSummary:
    """Write what was read of a truncated recording."""
    samples = recording.samples
    Location(str(path)).require(
        samples is not None or recording.frames or recording.capture,
        text="the recording is truncated before its first sample or frame",
    )
    header = replace(
        recording.header, notes={**recording.metadata, "recovered_from": recording.sha256}
    )
    warnings: tuple[str, ...] = ()
    with rewritten(recording, header, out) as writer:
        if recording.frames:
            frames = max(recording.frames.values(), key=len)
            end_ns = int(frames["time_ns"][-1])
            found = write_decoded(writer, frames, recording.robot, end_ns, str(path))
            if not found.no_samples:
                return ImportSummary(out=out, warnings=found.warnings)
            warnings = (f"{NO_SAMPLES}{found.no_samples}",)
            if samples is not None:
                text = f"{found.no_samples}; the {len(samples)} samples before the end are copied"
                writer.event(end_ns, "warning", text)
                warnings = (text,)
        if samples is not None:
            writer.samples(samples)
    return ImportSummary(out=out, warnings=warnings)


def is_log(path: Path) -> bool:
    """Test for a CAN log by its suffix, or for an EtherCAT capture by its first bytes."""
    return path.suffix.lower() in SUFFIXES or is_capture(path)


def import_log(
    log: Path,
    out: Path,
    robot: Robot,
    place: str,
    payload: Payload | None = None,
    mapping: Sequence[str] = (),
) -> ImportSummary:
    """Write a recording from another tool's CAN log, or from an EtherCAT capture.

    Parameters
    ----------
    log : candump, ASC, BLF or TRC. If it has several interfaces, the frames of `bus.channel` are
        used, such as "can0", or "1" for CAN 1 of Vector's and PCAN's files.
    out : the recording to write, whole or not at all.
    robot : the robot, whose drives decode the frames.
    place : name of its description in errors.
    payload : what the robot carried.
    mapping : mapping of the slaves of an EtherCAT capture that does not contain it.

    Raises
    ------
    BadInputError : the log cannot be read, none of its frames belong to this interface, its times
        begin again, or the frames do not decode.
    """
    if is_capture(log):
        bus = resolve(robot, place)
        header = Header(
            source=f"EtherCAT capture {log.name}",
            payload=payload,
            notes={MAPPING_NOTE: " ".join(mapping)},
            **_bus_header(robot, bus),
        )
        with log.open("rb") as file:
            return import_capture(file, header, bus, Location(str(log)), out)
    # For a robot without a bus, this raises the error.
    described = robot.bus or resolve(robot, place).file
    frames, left_out = _select_interface(log, described.channel)
    frames, told = _in_order(frames, described, str(log))
    decoded = _decode_checked(frames, robot, str(log), place, left_out + told)
    header = Header(
        source=f"log {log.name}",
        payload=payload,
        notes={"left_out": "; ".join(left_out)} if left_out else {},
        **_bus_header(robot, decoded.bus),
    )
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        writer.frames("log", frames)
        decoded.write(writer, int(frames["time_ns"][-1]))
    return ImportSummary(out=out, warnings=decoded.warnings)


def _select_interface(path: Path, channel: str) -> tuple[Block, tuple[str, ...]]:
    """Return the frames of one bus in a log, and a warning about the other buses.

    Two buses would give two samples for each SYNC.
    """
    frames, others = read_log(path)
    names = {name: f"CAN {name}" if name.isdecimal() else name for name in frames}
    counts = {
        **{name: f"{len(some)} of {names[name]}" for name, some in frames.items()},
        **{what: f"{count} {what}" for what, count in others.items()},
    }
    Location(str(path)).require(
        names,
        text=f"the log contains no frames of classic CAN"
        f"{f' ({listed([*counts.values()])})' if counts else ''}",
    )
    Location(str(path)).require(
        len(names) == 1 or channel in names,
        text=f"the log contains frames of several channels: {listed([*counts.values()])}",
        advice=f"Set bus.channel in robot.toml to one of {listed([*map(repr, names)])}",
    )
    used = channel if len(names) > 1 else next(iter(names))
    told = f"only the frames of {names[used]} are imported; " if len(names) > 1 else ""
    left_out = [text for what, text in counts.items() if what != used]
    return frames[used], (f"{told}left out: {listed(left_out)}",) * bool(left_out)


def _in_order(frames: Block, bus: BusFile, place: str) -> tuple[Block, tuple[str, ...]]:
    """Sort rows of `FRAME` (m,) by time, without echoes; also return warnings, one line each.

    Rows of equal times keep their order. Wraps and steps back of the clock are removed from the
    times.

    Raises
    ------
    BadInputError : the times begin again, as those of two sessions in one file do.
    """
    time_ns, warnings, rows = field_of(frames, "time_ns"), list[str](), frames
    if (np.diff(time_ns) < 0).any():
        time_ns = kept(time_ns)
        warnings += _go_on(time_ns, Traffic(frames).rows_of(bus.sync_can_id), Location(place))
        if back := int(np.count_nonzero(np.diff(time_ns) < 0)):
            warnings.append(
                f"{back} frames were out of order: all frames are sorted by their times"
            )
        order = np.argsort(time_ns, kind="stable")
        rows = by_rows(lambda some: frames[some], order)
        rows["time_ns"] = time_ns[order]
    echoes = _echoes(rows, bus)
    if len(echoes):
        warnings.append(
            f"{len(echoes)} frames are recorded as sent and again as received: they count once"
        )
        rows = taken(rows, np.delete(np.arange(len(rows)), echoes))
    return rows, tuple(warnings)


def _go_on(time_ns: Ints, syncs: Rows, place: Location) -> Iterator[str]:
    """Shift times (m,) in place where they wrap or the clock was set back.

    The times of the rows `syncs` show whether the clock was set back. The function yields what was
    done.
    """
    size = np.diff(time_ns)
    jumps = np.flatnonzero(np.abs(size) > min(_WRAPS) - _MAX_WRAP_NS)
    size = size[jumps]
    for wrap_ns, text in _WRAPS.items():
        wraps = np.abs(np.abs(size) - wrap_ns) < _MAX_WRAP_NS
        if wraps.any() and time_ns.max() < wrap_ns + _MAX_WRAP_NS:
            time_ns -= wrap_ns * np.repeat(
                np.append(0, np.cumsum(np.sign(size[wraps]))),
                np.diff(jumps[wraps] + 1, prepend=0, append=len(time_ns)),
            )
            yield f"the time counter wrapped after {text}: later times are shifted forward"
    for k, by_ns, since_ns in steps_back(time_ns[syncs]):
        row = syncs[k] + 1 + int(np.argmin(np.diff(time_ns[syncs[k] : syncs[k + 1] + 1])))
        step = f"back by {by_ns * 1e-9:.3g} s at {since_ns * 1e-9:.4g} s"
        place.require(
            by_ns <= min(_MAX_SET_NS, _MAX_SET_SHARE * since_ns),
            text=f"times step {step}, at frame {row + 1}",
            advice=ONE_CLOCK,
        )
        time_ns[row:] += by_ns
        yield f"the clock was set {step}: later times are shifted forward"


def _echoes(frames: Block, bus: BusFile) -> Ints:
    """Find received rows that repeat a sent row, as echoes and requests do.

    The two rows are within a quarter of a period of each other, and equal in all else.
    """
    sent = frames["flags"] & SENT > 0
    rows = np.flatnonzero(
        np.isin(frames["can_id"], np.intersect1d(frames["can_id"][sent], frames["can_id"][~sent]))
    )
    some = frames[rows]
    some["time_ns"] = 0
    some["flags"] |= SENT
    # A stable sort keeps equal frames in the order of time.
    order = np.argsort(some.view(f"V{FRAME.itemsize}"), kind="stable")
    rows, some = rows[order], some[order]
    again = (
        (np.diff(frames["time_ns"][rows]) < _MAX_ECHO * 1e9 * bus.sync_period_s)
        & (some[1:] == some[:-1])
        & (sent[rows[1:]] != sent[rows[:-1]])
    )
    pairs = np.stack([rows[:-1], rows[1:]])[:, again]
    return np.unique(pairs[~sent[pairs]])


def _decode_checked(
    frames: Block, robot: Robot, name: str, place: str, told: tuple[str, ...] = ()
) -> Decoded:
    """Decode samples from frames, and refuse impossible positions.

    The warnings about the frames, `told`, come before those about samples and positions.
    """
    frames, bus = resolve_mapped(frames, robot, place)
    decoded = decode(frames, robot, bus, name)
    positions = GrowingBytes()
    for block in decoded.blocks():
        positions.write(block["position"].tobytes())
    found = check_recorded_positions(
        robot,
        decoded.stamps * np.float64(1e-9),
        np.frombuffer(positions.whole()).reshape(-1, robot.n),
        name,
    )
    return replace(decoded, warnings=(*told, *decoded.warnings, *found))


def _bus_header(robot: Robot, bus: Bus) -> dict[str, Any]:
    """Return the fields of a header that describe the drives."""
    return {
        "robot": robot,
        "sample_rate_hz": 1.0 / bus.file.sync_period_s,
        "effort_provenance": bus.provenance,
        "effort_timing": bus.file.effort_timing,
    }
