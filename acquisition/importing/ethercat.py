"""Imports a capture of an EtherCAT bus in operation: frames → joint samples at the times of cycles. Nothing is ever sent."""

from collections.abc import Iterator, Sequence
from io import BytesIO
from itertools import chain
from mmap import mmap
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..arrays import Ints
from ..errors import Place
from ..files import atomic_write
from ..recording import Block, Header, RawRows, Recording, RecordingWriter, in_parts, joint_samples
from ..robot import Bus, Payload, Robot, check_recorded_efforts, check_recorded_positions, resolve
from .captures import PCAP_HEAD, packets, pcap_records
from .joining import MAX_OFF, MIN_SHARE, Bools
from .process_data import Decoder, parse_mapping
from .time_base import ImportSummary

MAX_PERIOD_ERROR, MAX_CLOCK_ERROR = 0.05, 2e-4  # of the described period; clocks differ by less than the second
_HELD = 256  # rows that later ones may make certain
_CHECKED = 500_000  # rows whose positions are checked at once
MAPPING_NOTE = "ethercat_mapping"  # of the metadata


def cycle_steps(time_ns: Ints, period_ns: float) -> tuple[Ints, Bools]:
    """Cycles from each row to the next (m - 1,), and the rows (m,) whose cycle is certain.

    Steps near whole periods are counted. Between other steps rows were stamped late: they are consecutive if they are as many
    as the periods from the last certain row to the next, else they are left out, as rows between two gaps are.
    """
    steps = np.diff(time_ns) / period_ns
    count = np.rint(steps)
    off = (np.abs(steps - count) > MAX_OFF) | (count < 1)
    beside = np.concatenate([off[1:], [False]]) | np.concatenate([[False], off[:-1]])
    off |= beside & (count > 1)
    proven, certain = np.abs(steps - 1) <= MAX_OFF, np.ones(len(time_ns), np.bool_)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], off, [False]]).astype(np.int8))).reshape(-1, 2)
    for first, last in edges:
        whole, rows = round((time_ns[last] - time_ns[first]) / period_ns), last - first
        count[first:last], proven[first:last] = 1, whole == rows
        if whole != rows:
            certain[last] = whole > 0  # rows before it are beside no proven step
            count[first:last], count[last - 1] = 0, whole
    certain &= np.concatenate([[False], proven]) | np.concatenate([proven, [False]])
    return count.astype(np.int64), certain


class _Samples:
    """Rows of a decoder → joint samples at the times of whole periods."""

    def __init__(self, decoder: Decoder, bus: Bus, place: Place) -> None:
        self._bus, self._place = bus, place
        self._rows, counts = np.frombuffer(decoder.rows.whole(), decoder.row), decoder.counters
        n = len(self._rows)
        if n < 4:
            decoder.refuse_no_rows()
        self._counter = max(counter for counter, k in counts.items() if k >= 0.01 * n)
        clocks, knowns = (
            sum(int((part[name] > 0).sum()) for part in in_parts(self._rows)) for name in ("clock_ns", "known")
        )
        self._time = "clock_ns" if clocks > MIN_SHARE * n else "time_ns"
        self.has_reference = knowns > MIN_SHARE * n
        self.period_ns = self._period()
        self._gaps, self._missing, self._uncertain = 0, 0, -int(self.has_reference)  # the first row has none before it

    def _good(self) -> Iterator[Block]:
        """Rows with the full working counter and a time."""
        for part in in_parts(self._rows):
            yield part[(part["counter"] == self._counter) & (part[self._time] >= 0)]

    def _period(self) -> float:
        """Between two cycles, ns: by the median of steps over more and more rows."""
        time_ns, nominal = next(self._good())[self._time], float(self._bus.period_ns)
        if len(time_ns) < 2:
            self._place.refuse(text="packets have no times", expected="Enhanced Packet Blocks, or distributed clocks")
        period = float(np.median(np.diff(time_ns)))
        for ahead in (32, 1024):
            if period > 0 and len(time_ns) > ahead:
                steps = time_ns[ahead:] - time_ns[:-ahead]
                period = float(np.median(steps / np.maximum(np.rint(steps / period), 1)))
        if abs(period / nominal - 1) > MAX_PERIOD_ERROR:
            self._place.refuse(
                text=f"a cycle takes {period * 1e-6:.4g} ms; bus.sync_period_s = {nominal * 1e-9:g} in robot.toml",
                expected=f"{period * 1e-9:.3g} there",
            )
        return nominal if abs(period / nominal - 1) < MAX_CLOCK_ERROR else period

    def raw(self) -> Iterator[RawRows]:
        """The rows whose cycle is certain; with a reference those whose target is too: that of the cycle before."""
        rows, number, start_ns, first = np.zeros(0, self._rows.dtype), 0, -1, 0
        for part in chain(self._good(), [None]):
            rows = rows if part is None else np.concatenate([rows, part])
            time_ns = rows[self._time]
            steps = np.diff(time_ns)
            if len(steps) and steps.min() < 0:
                expected = "growing times: one capture, whose clock was not set"
                self._place.refuse(text=f"time runs back by {-1e-9 * steps.min():.3g} s", expected=expected)
            plain = np.abs(steps / self.period_ns - 1) < MAX_OFF
            ends = np.flatnonzero(plain[:-1] & plain[1:])[:-_HELD] if part is not None else [len(rows) - 1]
            if not len(ends):
                continue
            end = int(ends[-1]) + 1
            count, certain = cycle_steps(time_ns, self.period_ns)
            numbers = number + np.concatenate([[0], np.cumsum(count)])
            if start_ns < 0:
                start_ns = max(0, int(np.median(time_ns - np.rint(numbers * self.period_ns).astype(np.int64))))
            follows = np.concatenate([[False], (count == 1) & certain[:-1] & rows["known"][:-1]])
            certain &= follows | (not self.has_reference)
            chosen = first + np.flatnonzero(certain[first:end])
            self._gaps += int((count[: end - first] > 1).sum())
            self._missing += int((count[: end - first] - 1).clip(0).sum())
            self._uncertain += end - first - len(chosen)
            if len(chosen):
                yield RawRows(
                    stamp_ns=start_ns + np.rint(numbers[chosen] * self.period_ns).astype(np.int64),
                    position=list(rows["position"][chosen].T.astype(np.int64)),
                    effort=list(rows["effort"][chosen].T.astype(np.int64)),
                    target=list(rows["target"][chosen - 1].T.astype(np.int64)) if self.has_reference else (),
                )
            rows, number, first = rows[end - 1 :], int(numbers[end - 1]), 1

    def times(self, doubled: int) -> str:
        """A report on the times of the rows, in one line."""
        clock = "distributed clocks" if self._time == "clock_ns" else "stamps of the capture"
        gaps = f"{self._gaps} gaps, {self._missing} rows missing" if self._gaps else "no gaps"
        return f"{clock}: {1e-6 * self.period_ns:.9g} ms from cycle to cycle, {gaps}, {doubled or 'no'} doubled rows"

    def warnings(self) -> Iterator[str]:
        """Rows that were left out, and a reference that is not there."""
        if self._uncertain > 0:
            yield f"{self._uncertain} rows beside lost or late frames are left out: their cycle or target is not certain"
        if not self.has_reference:
            yield "no reference: the targets are not mapped, or not in frames on their way out"


def import_capture(
    path: Path, out: Path, robot: Robot, place: str, mapping: Sequence[str] = (), payload: Payload | None = None
) -> ImportSummary:
    """Write the recording `out` from a capture (pcap, pcapng) of an EtherCAT bus in operation.

    Parameters
    ----------
    robot : its drives, by their EtherCAT stations.
    place : the name of the description in errors.
    mapping : by slave the inputs in their order, `0x6041:16,0x6064:32`, where the capture begins after the mapping.
    payload : what the robot carried.

    Returns
    -------
    One row for each cycle with full working counters: rad or m, and N m or N (A or V if no drive gain is known), at the
    joints, at the times of whole periods; `reference` is the target of the cycle before. Frames are kept in the recording.

    Raises
    ------
    AcquisitionError
        The file is no capture, or it has no process data that come back, no mapping, or another period.
    """
    notes = {MAPPING_NOTE: " ".join(mapping)}
    header = _header(robot, place, source=f"EtherCAT capture {path.name}", payload=payload, notes=notes)
    try:
        with path.open("rb") as file:
            return _import(file, out, header, place, Place(str(path)))
    except OSError as error:
        Place(str(path)).refuse(text=f"cannot be read: {error.strerror or error}")


def import_captured(recording: Recording, path: Path, out: Path, robot: Robot | None, place: str) -> ImportSummary:
    """Decode the frames of a recording at `path` again, with a corrected description if `robot` is one."""
    robot, place = robot or recording.robot, place or f"{path}: robot.toml"
    notes = {**recording.metadata, "decoded_from": recording.sha256}  # with the payload
    header = _header(robot, place, source=recording.metadata.get("source", ""), notes=notes)
    file = BytesIO(recording.capture) if isinstance(recording.capture, bytes) else recording.capture
    return _import(file, out, header, place, Place(str(path)))


def _header(robot: Robot, place: str, **about: Any) -> Header:
    bus = resolve(robot, place)
    rate_hz, timing = 1.0 / bus.file.sync_period_s, bus.file.effort_timing
    return Header(robot=robot, sample_rate_hz=rate_hz, effort_provenance=bus.provenance, effort_timing=timing, **about)


def _import(file: BinaryIO | mmap, out: Path, header: Header, place: str, at: Place) -> ImportSummary:
    robot, bus, warnings = header.robot, resolve(header.robot, place), list[str]()
    mapping = parse_mapping(header.notes.get(MAPPING_NOTE, "").split())
    decoder, head = Decoder(bus, mapping, at), PCAP_HEAD
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        for given in packets(file, at, warnings):
            kept = decoder.add(given)
            if len(kept):
                writer.captured(head + pcap_records(given, kept), max(0, int(given.time_ns[kept[0]])))
                head = b""
        decoder.refuse_contradiction()
        samples = _Samples(decoder, bus, at)
        count, last_ns, unchecked = 0, 0, list[Block]()
        for block in joint_samples(samples.raw(), robot, bus):
            writer.samples(block)
            count, last_ns = count + len(block), int(block["stamp_ns"][-1])
            unchecked.append(block)
            if sum(map(len, unchecked)) > _CHECKED:
                warnings += _check(robot, unchecked, str(at))
                unchecked = []
        if count < 2:
            decoder.refuse_no_rows()
        warnings += [
            *(_check(robot, unchecked, str(at)) if unchecked else ()),
            *decoder.warnings(),
            *samples.warnings(),
        ]
        warnings = list(dict.fromkeys(warnings))
        for text in warnings:
            writer.event(last_ns, "warning", text)
    return ImportSummary(
        out=out,
        robot=robot.name,
        samples=count,
        sample_rate_hz=header.sample_rate_hz,
        has_reference=samples.has_reference,
        effort_units=robot.effort_units,
        times=samples.times(decoder.doubled),
        warnings=tuple(warnings),
    )


def _check(robot: Robot, blocks: Sequence[Block], place: str) -> tuple[str, ...]:
    t_s, q, effort = (np.concatenate([block[name] for block in blocks]) for name in ("stamp_ns", "position", "effort"))
    positions = check_recorded_positions(robot, (t_s - t_s[0]) * np.float64(1e-9), q, place)
    return (*positions, *check_recorded_efforts(robot, effort))
