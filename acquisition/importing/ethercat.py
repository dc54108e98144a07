"""Imports a capture of an EtherCAT bus: cyclic process data of CiA 402 drives (CoE) → joint samples. Nothing is ever sent."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import chain
from mmap import mmap
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import Ints
from ..errors import AcquisitionError, Place, listed
from ..files import GrowingBytes, atomic_write
from ..protocol import ObjectEntry
from ..recording import Block, Header, RawRows, Recording, RecordingWriter, in_parts, joint_samples, minimum_ahead
from ..robot import Bus, Payload, Robot, check_recorded_efforts, check_recorded_positions, resolve
from .captures import CONTEXT, PCAP_HEAD, Datagrams, Packets, datagrams, packets, pcap_records
from .slaves import FMMUS, INPUTS, LRD, LRW, LWR, MANAGERS, OUTPUTS, Slaves, entries_of, fmmus, located, spans
from .time_base import ImportSummary, TimeReport

MAX_OFF = 0.25  # of a period: a step that is no further from whole periods counts them
MAX_PERIOD_ERROR, MAX_CLOCK_ERROR = 0.05, 2e-4  # of the described period; clocks differ by less than the second
_ORDER = 15  # rows before and after a stamp that must not contradict it
_HELD = 256  # rows that later ones may make certain
_CHECKED = 500_000  # rows whose positions are checked at once
_CLOCK, _CLOCK_COMMANDS = 0x910, (13, 14)  # system time of the distributed clocks, ARMW and FRMW
_MIN_SHARE = 0.5  # of the rows: with fewer there is no reference, and no clock but the capture's
MAPPING = "--mapping 0x6041:16,0x6064:32,0x6077:16, once per slave in the order of the bus: all its inputs, and 0:BITS for gaps"

MAPPING_NOTE = "ethercat_mapping"  # of the metadata
NAMES = {LRD: "LRD", LWR: "LWR", LRW: "LRW"}

Bools = NDArray[np.bool_]
Located: TypeAlias = Mapping[tuple[int, int], tuple[int, int]]  # logical address and bytes by index and sub-index
Mapped = Sequence[Sequence[tuple[tuple[int, int], int]]]  # by slave the objects, with their bits


def parse_mapping(texts: Sequence[str]) -> Mapped:
    """Objects and bits of `--mapping`, by slave."""
    found = []
    for text in texts:
        try:
            words = [word.split(":") for word in text.split(",")]
            entries = [
                ((int(w[0], 16), int(w[1]) if len(w) == 3 else 0), int(w[-1])) for w in words if len(w) in (2, 3)
            ]
            if len(entries) < len(words) or not all(0 < bits < 2**14 for _, bits in entries):
                raise ValueError
        except ValueError:
            raise AcquisitionError(
                key="--mapping", value=text, expected="such as 0x6041:16,0x6064:32,0x6077:16"
            ) from None
        found.append(entries)
    return found


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """Logical addresses of the position, effort and target (None without one) of each drive."""

    position: tuple[int, ...]
    effort: tuple[int, ...]
    target: tuple[int, ...] | None
    slaves: tuple[bytes, ...] = ()  # registers of all slaves, empty with `--mapping` alone

    def counter(self, command: int, address: int, length: int) -> int | None:
        """The working counter of a datagram that all slaves answered; None if it is not known."""

        def hit(registers: bytes, way: int) -> bool:
            return any(start < address + length and address < start + size for start, _, size in fmmus(registers, way))

        reads = sum(hit(registers, 1) for registers in self.slaves) if command != LWR else 0
        writes = sum(hit(registers, 2) for registers in self.slaves) if command != LRD else 0
        return reads + writes * (2 if command == LRW else 1) if self.slaves else None


class _Decoder:
    """Process data → rows of the drives' integers, in file order."""

    def __init__(self, robot: Robot, bus: Bus, mapping: Mapped, place: Place) -> None:
        self._bus, self._mapping, self._place = bus, mapping, place
        self._slaves = {True: Slaves(), False: Slaves()}  # by datagrams that came back, and that went out
        self._layout: _Layout | None = None
        self._seen: dict[tuple[int, int, int], int] = {}  # process data by command, address and length
        self._passed, self._held, self._since = 0, 0, -1  # packets
        self._clock: int | None = None  # low 32 bits of the distributed clocks minus the capture's first stamp
        self.frames = self.returned = self.doubled = self.cut = self.left = self.short = 0
        n = len(bus.drives)
        self.row = np.dtype(
            [("time_ns", "<i8"), ("clock_ns", "<i8"), ("counter", "<u2"), ("known", "?")]
            + [(name, "<i4", (n,)) for name in ("position", "effort", "target")]  # type: ignore[arg-type]
        )
        self.rows, self.counters = GrowingBytes(), dict[int, int]()
        self.why, self.error = "", None

    def add(self, given: Packets) -> Ints:
        """Add packets; those that were given before are the context of the others. The numbers of the new ones of EtherCAT."""
        found, count = datagrams(given), len(given.begin)
        self.cut += found.cut
        self._configure(found.where(found.packet >= given.fresh))
        process = found.where(np.isin(found.command, (LRD, LWR, LRW)) & (found.packet + self._passed > self._since))
        begin, end = (
            given.fresh - self._held,
            count if given.last else max(given.fresh - self._held, count - CONTEXT // 2),
        )
        if len(process.packet):
            self._decode(process, found, given, begin, end)
        self._held = count - end
        self._passed += count - min(CONTEXT, count)
        ours = np.unique(found.packet)
        return ours[ours >= given.fresh]

    def _configure(self, found: Datagrams) -> None:
        register, back = found.address >> 16, found.counter > 0
        mailbox = register >= 0x1000
        written = np.isin(found.command, (2, 5, 8)) & (
            mailbox | (register == 0x10) | ((register >= 0x600) & (register < 0x880))
        )
        for k in np.flatnonzero(written | (np.isin(found.command, (1, 4)) & mailbox & back)):
            at, length = int(found.at[k]), int(found.length[k])
            changed = self._slaves[bool(back[k])].add(
                int(found.command[k]), int(found.address[k]), found.data[at : at + length].tobytes()
            )
            if changed and back[k]:
                self._layout, self._since = None, self._passed + int(found.packet[k])
                self.left += len(self.rows) // self.row.itemsize
                self.rows, self.counters = GrowingBytes(), {}

    def _decode(self, process: Datagrams, found: Datagrams, given: Packets, begin: int, end: int) -> None:
        key, which, counts = np.unique(
            process.command << 43 | process.address << 11 | process.length, return_inverse=True, return_counts=True
        )
        parts = [(int(k >> 43), int(k >> 11 & 0xFFFFFFFF), int(k & 0x7FF)) for k in key]
        for part, n in zip(parts, counts, strict=True):
            if len(self._seen) < 1000 or part in self._seen:
                self._seen[part] = self._seen.get(part, 0) + int(n)
        marks = 0.1 < process.marked.mean() < 0.9  # else the source address does not tell the direction
        back = (process.counter > 0) & (process.marked | (not marks))
        self.frames += int((process.packet >= given.fresh).sum())
        self.returned += int((back & (process.packet >= given.fresh)).sum())
        if self._layout is None:
            try:
                self._layout = self._find_layout(parts)
            except AcquisitionError as error:  # the master may not have written all of it yet
                self.error = error
        layout = self._layout
        if layout is None:
            return

        def part_of(address: int, size: int, commands: tuple[int, ...]) -> int | None:
            held = [
                k for k, (c, a, n) in enumerate(parts) if c in commands and a <= address and address + size <= a + n
            ]
            return max(held, key=lambda k: int(counts[k]), default=None)

        period = self._bus.period_ns
        places = [
            (name, i, address, entry, part_of(address, entry.bits // 8, (LRD, LRW)))
            for name, addresses in (("position", layout.position), ("effort", layout.effort))
            for i, (address, drive) in enumerate(zip(addresses, self._bus.drives, strict=True))
            for entry in [drive.position if name == "position" else drive.effort.entry]
        ]
        if any(place[-1] is None for place in places):
            return
        needed = list(dict.fromkeys(place[-1] for place in places))
        read: dict[int | None, Datagrams] = {}
        for k in needed:
            one = process.where((which == k) & back)
            doubled = _doubled(one, given.time_ns, period)
            self.doubled += int((doubled & (one.packet >= begin) & (one.packet < end)).sum()) if k == needed[0] else 0
            one = one.where(~doubled)
            read[k] = one.where(_in_order(given.time_ns[one.packet]))
        main = read[needed[0]]
        rows = np.zeros(len(main.packet), self.row)
        rows["time_ns"], rows["counter"] = given.time_ns[main.packet], main.counter
        good = (main.packet >= begin) & (main.packet < end)
        whole = np.ones(len(rows), np.bool_)
        for k in needed:
            index, joined = _join(main.packet, read[k].packet, given.time_ns, period)
            one, full = read[k].where(index), layout.counter(*parts[k])
            good &= joined
            whole &= (one.counter == full) | (full is None)
            for name, i, address, entry, part in places:
                if part == k:
                    rows[name][:, i] = _integers(one, address - parts[k][1], entry)
        if layout.target is not None:
            self._add_targets(rows, main, process, which, back, part_of, parts)
        self._add_clock(rows, main, found)
        self.short += int((good & ~whole).sum())
        rows = rows[good & whole]
        for counter, n in zip(*np.unique(rows["counter"], return_counts=True), strict=True):
            self.counters[int(counter)] = self.counters.get(int(counter), 0) + int(n)
        self.rows.extend(rows.tobytes())

    def _add_targets(
        self, rows: Block, main: Datagrams, process: Datagrams, which: Ints, back: Bools, part_of: Any, parts: Any
    ) -> None:
        """The target that went out in the cycle of each row: since the row before came back, and only one."""
        rows["known"] = True
        before = np.concatenate([[-1], main.packet[:-1]])
        for i, (address, drive) in enumerate(zip(self._layout.target, self._bus.drives, strict=True)):
            k = part_of(address, 4, (LWR, LRW))
            if k is None:
                rows["known"] = False
                return
            sent = (which == k) & ~back
            if not sent.any():  # what came back has the target too, except where inputs lie over it
                sent = (which == k) & (parts[k][0] == LWR) & np.isin(process.packet, main.packet)
            sent = process.where(sent)
            values = _integers(sent, address - parts[k][1], drive.target)
            first, after = (np.searchsorted(sent.packet, x, "right") for x in (before, main.packet))
            one = after > first
            first, last = np.where(one, first, 0), np.where(one, after - 1, 0)
            if len(values):
                rows["target"][:, i] = values[last]
                one &= values[first] == values[last]
            rows["known"] &= one

    def _add_clock(self, rows: Block, main: Datagrams, found: Datagrams) -> None:
        """The distributed clocks' time where the frame of a row has it, beside the capture's, which gives its upper half."""
        clock = found.where(
            np.isin(found.command, _CLOCK_COMMANDS)
            & (found.address >> 16 == _CLOCK)
            & (found.length >= 4)
            & (found.counter > 0)
        )
        if not len(clock.packet) or not len(rows):
            return
        index = np.minimum(np.searchsorted(clock.packet, main.packet), len(clock.packet) - 1)
        low = _integers(clock.where(index), 0, ObjectEntry(index=0, sub=0, type="U32"))
        here = clock.packet[index] == main.packet
        if (clock.length >= 8).all():
            high = _integers(clock.where(index), 4, ObjectEntry(index=0, sub=0, type="I32"))
            rows["clock_ns"] = np.where(here, high << 32 | low, -1)
            return
        self._clock = int(low[0] - rows["time_ns"][0]) if self._clock is None else self._clock
        ahead = (low - rows["time_ns"] - self._clock + 2**31) % 2**32 - 2**31
        rows["clock_ns"] = np.where(here, rows["time_ns"] + ahead, -1)

    def _find_layout(self, parts: Sequence[tuple[int, int, int]]) -> _Layout | None:
        """Where the drives' objects are, by the mapping in the capture or the stated one; None if it is not known yet."""
        known, objects = self._slaves[True].known(), dict[int, tuple[Located, Located]]()
        registers = tuple(registers for registers, _ in known.values() if any(registers[FMMUS:MANAGERS]))
        if self._mapping and not registers:
            bits = [sum(bits for _, bits in slave) for slave in self._mapping]
            base = next((address for command, address, n in parts if command != LWR and 8 * n == sum(bits)), None)
            if base is None:
                return None
            for k, slave in enumerate(self._mapping):
                found = {key: (base + at, n) for key, (at, n) in spans([((0, 0), sum(bits[:k])), *slave]).items()}
                objects[k] = found, found
            return self._by_drive(objects, ())
        stated = dict(zip(known, self._mapping, strict=False))
        for station, (register, values) in known.items():
            at = Place(f"{self._place}: station {station}")
            ways = ((INPUTS, stated.get(station) or entries_of(values, INPUTS)), (OUTPUTS, entries_of(values, OUTPUTS)))
            reads, writes = (located(register, entries, way, at) if entries else {} for way, entries in ways)
            objects[station] = reads, writes
        return self._by_drive(objects, registers)

    def _by_drive(self, objects: Mapping[int, tuple[Located, Located]], registers: tuple[bytes, ...]) -> _Layout | None:
        found: dict[str, list[int | None]] = {"position": [], "effort": [], "target": []}
        named = {file.station for file in self._bus.file.drive}
        free = [station for station, (reads, _) in objects.items() if reads and station not in named]
        for drive, file in zip(self._bus.drives, self._bus.file.drive, strict=True):
            able = [station for station in free if drive.position.key in objects[station][0]]
            station = file.station if file.station is not None else next(iter(able), None)
            if station not in objects or not objects[station][0]:
                self.why = (
                    f"{drive.name}: no mapping of {'a further slave' if station is None else f'station {station}'}"
                )
                return None
            if file.station is None:
                free = free[free.index(station) + 1 :]
            for name, entry, way in (
                ("position", drive.position, 0),
                ("effort", drive.effort.entry, 0),
                ("target", drive.target, 1),
            ):
                address, size = objects[station][way].get(entry.key, (None, 0))
                if name != "target" and 8 * size != entry.bits:
                    Place(f"{self._place}: station {station}").refuse(
                        text=f"{drive.name}: {entry} of {entry.bits} bits is not among its inputs",
                        expected=f"one of {listed([f'{i:04X}:{sub}' for i, sub in objects[station][0]])}",
                    )
                found[name].append(address)
        known = [None if None in x else tuple(x) for x in found.values()]
        return _Layout(position=known[0], effort=known[1], target=known[2], slaves=registers)

    def refuse_contradiction(self) -> None:
        """Refuse a mapping that went out with other contents than it came back with."""
        self._slaves[True].refuse_contradiction(self._slaves[False], self._place)

    def warnings(self, samples: "_Samples") -> Iterator[str]:
        """What was left out, and what is not there."""
        if self.cut:
            yield f"{self.cut} frames are cut by the capture's snap length: their whole datagrams are read"
        if self.left:
            yield f"{self.left} rows before the last change of the mapping are left out"
        if self.short:
            yield f"{self.short} cycles with a working counter below the full one are left out"
        if samples.uncertain:
            yield f"{samples.uncertain} rows beside lost or late frames are left out: their cycle or target is not certain"
        if not samples.has_reference:
            yield "no reference: targets (607A) are not in frames on their way out, or not in the mapping"

    def refuse_no_rows(self) -> NoReturn:
        """Say what is missing in the capture."""
        if self.error is not None and self._layout is None:
            raise self.error
        shown = listed(
            [
                f"{NAMES[c]} of {n} bytes at 0x{a:X}"
                for (c, a, n), _ in sorted(self._seen.items(), key=lambda x: -x[1])[:4]
            ]
        )
        if not self._seen:
            self._place.refuse(text="holds no process data of EtherCAT", expected="LRD, LWR or LRW: a bus in operation")
        if not self.returned:
            expected = (
                "also those that come back from the slaves: capture both directions on the master's own interface"
            )
            self._place.refuse(text=f"all {self.frames} process data have working counter 0", expected=expected)
        if self._layout is None:
            text = self.why or "the capture begins after the mapping was written"
            self._place.refuse(
                text=f"{text}; it has {shown}", expected=f"a capture from the start of the bus, or {MAPPING}"
            )
        self._place.refuse(
            text=f"no row of all drives with full working counters; it has {shown}", expected="a bus in operation"
        )


def _doubled(found: Datagrams, time_ns: Ints, period: int) -> Bools:
    """Datagrams that repeat the one before within half a period, index and all."""
    again = np.zeros(len(found.packet), np.bool_)
    if len(again):
        rows, number = found.rows(), found.data[found.at - 9]
        same = (
            (rows[1:] == rows[:-1]).all(axis=1)
            & (number[1:] == number[:-1])
            & (found.counter[1:] == found.counter[:-1])
        )
        again[1:] = same & (np.abs(np.diff(time_ns[found.packet])) < period // 2)
    return again


def _in_order(time_ns: Ints) -> Bools:
    """Stamps that no other of the 15 before and after contradicts."""
    return (time_ns <= minimum_ahead(time_ns, _ORDER)) & (time_ns >= -minimum_ahead(-time_ns[::-1], _ORDER)[::-1])


def _join(packet: Ints, other: Ints, time_ns: Ints, period: int) -> tuple[Ints, Bools]:
    """For each packet the other one of its cycle, and whether that is certain.

    It is the same packet, or the nearest in time if both came regularly, before and after.
    """
    if not len(other):
        return np.zeros(len(packet), np.int64), np.zeros(len(packet), np.bool_)
    index = np.minimum(np.searchsorted(other, packet), len(other) - 1)
    same = other[index] == packet
    if same.mean() > _MIN_SHARE:
        return index, same
    t, u = time_ns[packet], time_ns[other]
    index = np.clip(np.searchsorted(u, t), 1, max(1, len(u) - 1))
    index = np.minimum(index - (t - u[index - 1] < u[np.minimum(index, len(u) - 1)] - t), len(u) - 1)
    near = np.abs(u[index] - t) < MAX_OFF * period
    return index, near & _regular(t, period) & _regular(u, period)[index]


def _regular(time_ns: Ints, period: int) -> Bools:
    steps = np.abs(np.diff(time_ns) - period) < MAX_OFF * period
    return np.concatenate([[False], steps]) & np.concatenate([steps, [False]])


def _integers(found: Datagrams, offset: int, entry: ObjectEntry) -> Ints:
    size = entry.bits // 8
    raw = found.data[(found.at + offset)[:, None] + np.arange(size)]
    return raw.reshape(-1).view(f"<{entry.type[0].lower()}{size}").astype(np.int64)


def cycle_steps(time_ns: Ints, period_ns: float) -> tuple[Ints, Bools]:
    """Cycles from each row to the next (m - 1,), and the rows (m,) whose cycle is certain.

    Steps near whole periods are counted. Between other steps rows were stamped late: they are consecutive if they are as many
    as the periods from the last certain row to the next, else they are left out.
    """
    steps = np.diff(time_ns) / period_ns
    count = np.rint(steps)
    off = (np.abs(steps - count) > MAX_OFF) | (count < 1)
    beside = np.concatenate([off[1:], [False]]) | np.concatenate([[False], off[:-1]])
    off |= beside & (count > 1)
    certain = np.ones(len(time_ns), np.bool_)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], off, [False]]).astype(np.int8))).reshape(-1, 2)
    for first, last in edges:
        whole, rows = round((time_ns[last] - time_ns[first]) / period_ns), last - first
        count[first:last] = 1
        if whole != rows:
            certain[first + 1 : last + (whole < 1)] = False
            count[first:last], count[last - 1] = 0, whole
    return count.astype(np.int64), certain


class _Samples:
    """Rows of the decoder → blocks of samples at the times of whole periods, a report on the times, and warnings."""

    def __init__(self, decoder: _Decoder, robot: Robot, bus: Bus, place: Place) -> None:
        self._robot, self._bus, self._place = robot, bus, place
        self._rows = np.frombuffer(decoder.rows.whole(), decoder.row)
        n = len(self._rows)
        decoder.refuse_contradiction()
        if n < 4:
            decoder.refuse_no_rows()
        counts = {counter: k for counter, k in decoder.counters.items() if k >= 0.01 * n}
        self._counter = max(counts)
        clocks = [int((part["clock_ns"] > 0).sum()) for part in in_parts(self._rows)]
        knowns = [int(part["known"].sum()) for part in in_parts(self._rows)]
        self._time = "clock_ns" if sum(clocks) > _MIN_SHARE * n else "time_ns"
        self.has_reference = sum(knowns) > _MIN_SHARE * n
        self.period_ns = self._period()
        self._steps = {"shortest": np.inf, "longest": 0.0, "squares": 0.0, "regular": 0}
        self._gaps = self._missing = 0
        self.uncertain = -int(self.has_reference)  # the first row has no cycle before it

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
            start_ns = int(time_ns[0]) if start_ns < 0 and len(rows) else start_ns
            plain = np.abs(steps / self.period_ns - 1) < MAX_OFF
            ends = np.flatnonzero(plain[:-1] & plain[1:])[:-_HELD] if part is not None else [len(rows) - 1]
            if not len(ends):
                continue
            end = int(ends[-1]) + 1
            count, certain = cycle_steps(time_ns, self.period_ns)
            numbers = number + np.concatenate([[0], np.cumsum(count)])
            follows = np.concatenate([[False], (count == 1) & certain[:-1] & rows["known"][:-1]])
            certain &= follows | (not self.has_reference)
            chosen = first + np.flatnonzero(certain[first:end])
            self._count(steps[: end - first], count[: end - first], end - first - len(chosen))
            if len(chosen):
                yield RawRows(
                    stamp_ns=start_ns + np.rint(numbers[chosen] * self.period_ns).astype(np.int64),
                    position=rows["position"][chosen].T.astype(np.int64),
                    effort=rows["effort"][chosen].T.astype(np.int64),
                    target=[*rows["target"][chosen - 1].T.astype(np.int64)] if self.has_reference else (),
                )
            rows, number, first = rows[end - 1 :], int(numbers[end - 1]), 1

    def _count(self, steps: Ints, count: Ints, left: int) -> None:
        """Add to the report; `left`: rows left out."""
        regular, found = steps[np.abs(steps / self.period_ns - 1) < 0.5], self._steps
        found["regular"] += len(regular)
        found["squares"] += float(((regular - self.period_ns) ** 2).sum())
        found["shortest"] = min(found["shortest"], steps.min(initial=2**62))
        found["longest"] = max(found["longest"], steps.max(initial=0))
        self._gaps += int((count > 1).sum())
        self._missing += int((count - 1)[count > 1].sum())
        self.uncertain += left

    def report(self, rows: int, doubled: int) -> TimeReport:
        """On the times of the rows."""
        found = self._steps
        return TimeReport(
            rows=rows,
            doubled=doubled,
            period_s=self.period_ns * 1e-9,
            shortest_s=found["shortest"] * 1e-9,
            longest_s=found["longest"] * 1e-9,
            jitter_s=float(np.sqrt(found["squares"] / max(1, found["regular"]))) * 1e-9,
            gaps=self._gaps,
            missing=self._missing,
            clock="distributed clocks" if self._time == "clock_ns" else "stamps",
        )


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
    decoder = _Decoder(robot, bus, mapping, at)
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        first = True
        for given in packets(file, at, warnings):
            kept = decoder.add(given)
            if len(kept):
                stamp_ns = max(0, int(given.time_ns[kept[0]]))
                writer.captured(PCAP_HEAD * first + pcap_records(given, kept), stamp_ns)
                first = False
        samples = _Samples(decoder, robot, bus, at)
        count, last_ns, checked = 0, 0, list[Block]()
        for block in chain(joint_samples(samples.raw(), robot, bus), [None]):
            if block is not None:
                writer.samples(block)
                checked.append(block)
                count, last_ns = count + len(block), int(block["stamp_ns"][-1])
            if checked and (block is None or sum(map(len, checked)) > _CHECKED):
                warnings += _check(robot, checked, str(at))
                checked = []
        if count < 2:
            decoder.refuse_no_rows()
        report = samples.report(count, decoder.doubled)
        warnings = list(dict.fromkeys([*warnings, *decoder.warnings(samples)]))
        for text in warnings:
            writer.event(last_ns, "warning", text)
    return ImportSummary(
        out=out,
        robot=robot.name,
        samples=count,
        sample_rate_hz=header.sample_rate_hz,
        has_reference=samples.has_reference,
        effort_units=robot.effort_units,
        times=report.text,
        warnings=tuple(warnings),
    )


def _check(robot: Robot, blocks: Sequence[Block], place: str) -> tuple[str, ...]:
    stamps, q, effort = (
        np.concatenate([block[name] for block in blocks]) for name in ("stamp_ns", "position", "effort")
    )
    return check_recorded_positions(robot, (stamps - stamps[0]) * 1e-9, q, place) + check_recorded_efforts(
        robot, effort
    )
