"""Cyclic process data in EtherCAT frames → rows of the integers of the drives, in file order."""

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, NoReturn, TypeAlias

import numpy as np

from ..arrays import Bools, Ints
from ..errors import Location, listed
from ..files import GrowingBytes, field_of, release_pages
from ..protocol import ObjectEntry
from ..recording import Block, in_parts, minimum_ahead
from ..robot import Bus
from .captures import (
    FPRD,
    LRD,
    LRW,
    LWR,
    MAILBOX,
    WRITES,
    Entries,
    Located,
    Packets,
    Slaves,
    datagrams,
    gather,
    spans,
)
from .stamps import ONE_CLOCK, steps_back

# Datagrams nearer than this share of a period belong together.
MAX_OFF = 0.25
# The rows of a segment, and the rows before and after it on which it may depend.
AT_ONCE, MARGIN = 2**17, 2**10
# Packets may be out of order by so many periods; a longer step back is one of the clock.
MAX_BACK = 5
# The register of the system time of distributed clocks, and the commands ARMW and FRMW.
_CLOCK, _CLOCK_COMMANDS = 0x910, (13, 14)
_ORDER = 15  # a timestamp must fit so many before and after it
_MIN_SHARE = 0.01  # of the rows; a working counter in fewer is damage
_NAMES = {LRD: "LRD", LWR: "LWR", LRW: "LRW"}
_MAPPING = (
    "Capture from the start of the bus, or give all inputs of each slave in bus order, such as "
    "0x6041:16,0x6064:32,0x6077:16, with gaps as 0:BITS"
)

# The byte in a part and the type, by quantity and drive.
Fields: TypeAlias = dict[tuple[str, int], tuple[int, str]]


class Part(NamedTuple):
    """Datagrams of one logical address, on their way out or `back`."""

    command: int
    address: int
    size: int
    back: bool


class ProcessData:
    """Collector of the slaves' configuration, and of the drives' integers in process data."""

    def __init__(self, bus: Bus, mapping: Sequence[Entries], place: Location) -> None:
        self._bus, self._mapping, self._place = bus, mapping, place
        # The slaves are found by datagrams that came back (True), and by those that went out.
        self._slaves = {True: Slaves(), False: Slaves()}
        self._fields: dict[Part, Fields] = {}
        self._columns: dict[Part, GrowingBytes] = {}
        self._seen: dict[Part, int] = {}
        self._packets, self._since, self._why = 0, -1, ""
        self.short = self.doubled = 0

    def add(self, given: Packets) -> Ints:
        """Add packets; return the numbers of those of EtherCAT."""
        found = datagrams(given)
        for one in found[
            np.isin(found["command"], WRITES)
            | (found["command"] == FPRD) & (found["address"] >> 16 >= MAILBOX)
        ]:
            content = given.data[one["at"] : one["at"] + one["length"]].tobytes()
            back = bool(one["counter"])
            if self._slaves[back].take(int(one["command"]), int(one["address"]), content) and back:
                # Rows before a change are dropped, because their meaning was another one.
                self._since = self._packets + int(one["packet"])
                self._fields, self._columns, self._seen = {}, {}, {}
        process = found[
            np.isin(found["command"], (LRD, LWR, LRW))
            & (found["packet"] + self._packets > self._since)
        ]
        key = (
            process["command"].astype(np.int64) << 44
            | process["address"].astype(np.int64) << 12
            | process["length"].astype(np.int64) << 1
            | (process["counter"] > 0)
        )
        parts = {
            Part(int(k >> 44), int(k >> 12 & 0xFFFFFFFF), int(k >> 1 & 0x7FF), bool(k & 1)): (
                process[key == k]
            )
            for k in np.unique(key)
        }
        self._seen |= {part: self._seen.get(part, 0) + len(rows) for part, rows in parts.items()}
        if not self._fields:
            self._fields = self._find_fields()
            self._columns = {part: GrowingBytes() for part in self._fields}
        clock = found[
            np.isin(found["command"], _CLOCK_COMMANDS)
            & (found["address"] >> 16 == _CLOCK)
            & (found["counter"] > 0)
            & (found["length"] >= 4)
        ]
        for part in set(self._fields) & set(parts):
            self._columns[part].write(self._extract(part, parts[part], given, clock).tobytes())
        self._packets += len(given.begin)
        return np.unique(found["packet"])

    def _row(self, part: Part) -> np.dtype[np.void]:
        return np.dtype(
            [
                *((name, "<i8") for name in ("packet", "time_ns", "clock_ns")),
                ("counter", "<u2"),
                ("index", "u1"),
                *((f"{name}{i}", kind) for (name, i), (_, kind) in self._fields[part].items()),
            ]
        )

    def _extract(self, part: Part, found: Block, given: Packets, clock: Block) -> Block:
        """Extract rows of the datagrams of a part.

        A 32-bit time of a clock is below 2**32. The time is -1 if there is none.
        """
        rows = np.empty(len(found), self._row(part))
        rows["packet"] = found["packet"] + self._packets
        rows["time_ns"] = given.time_ns[found["packet"]]
        rows["counter"], rows["index"], rows["clock_ns"] = found["counter"], found["index"], -1
        for (name, i), (at, kind) in self._fields[part].items():
            rows[f"{name}{i}"] = gather(given.data, found["at"] + at, kind)
        if len(clock):
            one = clock[np.searchsorted(clock["packet"], found["packet"]).clip(max=len(clock) - 1)]
            low, high = (
                gather(given.data, one["at"] + at, "<u4").astype(np.int64) for at in (0, 4)
            )
            time_ns = low | np.where(one["length"] >= 8, high & 0x7FFFFFFF, 0) << 32
            rows["clock_ns"] = np.where(one["packet"] == found["packet"], time_ns, -1)
        return rows

    def _find_fields(self) -> dict[Part, Fields]:
        """Find the drives' objects in process data.

        The objects of a drive are in its `station`, or in the next slave with its position. The
        result is empty if they are not yet known.
        """
        self._why = "no mapping of inputs was captured"
        try:
            objects = self._objects()
        # The master may not have written the whole mapping yet.
        except ValueError as error:
            self._why = str(error)
            return {}
        inputs, outputs = dict[Part, Fields](), dict[Part, Fields]()
        for i, (drive, station) in enumerate(
            zip(self._bus.drives, self._stations(objects), strict=False)
        ):
            for name, entry in (("position", drive.position), ("effort", drive.effort.entry)):
                at = objects[station][0].get(entry.key, (0, 0))
                names = [f"{index:04X}:{sub}" for index, sub in objects[station][0]]
                self._place.require(
                    8 * at[1] == entry.bits,
                    text=f"station {station} ({drive.name}) has no input {entry} of "
                    f"{entry.bits} bits",
                    advice=f"Name one of its inputs in robot.toml: {listed(names)}",
                )
                self._add_field(inputs, (name, i), entry, at, (LRD, LRW))
            at = objects[station][1].get(drive.target.key, (0, 0))
            self._add_field(outputs, ("target", i), drive.target, at, (LWR, LRW))
        whole, has_targets = (
            sum(map(len, fields.values())) >= count * len(self._bus.drives)
            for fields, count in ((inputs, 2), (outputs, 1))
        )
        return {} if not whole else inputs | outputs if has_targets else inputs

    def _stations(self, objects: Mapping[int, tuple[Located, Located]]) -> Iterator[int]:
        """Yield the slave of each drive, up to one whose inputs are unknown."""
        named = {file.station for file in self._bus.file.drive}
        free = [
            station for station, (inputs, _) in objects.items() if inputs and station not in named
        ]
        for drive in self._bus.drives:
            able = (station for station in free if drive.position.key in objects[station][0])
            station = next(able, -1) if drive.file.station is None else drive.file.station
            if not objects.get(station, ({}, {}))[0]:
                where = "a further slave" if station == -1 else f"station {station}"
                if free:
                    self._why = f"the mapping of {where} for {drive.name} was not captured"
                return
            free = free[free.index(station) + 1 :] if station in free else free
            yield station

    def _add_field(
        self,
        fields: dict[Part, Fields],
        key: tuple[str, int],
        entry: ObjectEntry,
        at: tuple[int, int],
        commands: tuple[int, int],
    ) -> None:
        """Add the place of an object in the datagrams that were seen most.

        `at` is the address of the object, and its number of bytes.
        """
        (address, size), back = at, LRD in commands
        parts = [
            part
            for part in self._seen
            if part.command in commands
            and part.back == back
            and part.address <= address
            and address + size <= part.address + part.size
        ]
        if size and parts:
            part = max(parts, key=self._seen.__getitem__)
            fields.setdefault(part, {})[key] = (
                address - part.address,
                f"<{entry.type[0].lower()}{size}",
            )

    def _objects(self) -> dict[int, tuple[Located, Located]]:
        slaves = self._slaves[True]
        if not self._mapping or slaves.mapped:
            return slaves.located(self._mapping)
        if station := next(filter(None, (file.station for file in self._bus.file.drive)), None):
            raise ValueError(
                f"robot.toml gives station {station}, but the capture contains no addresses"
            )
        bits = [sum(bits for _, bits in slave) for slave in self._mapping]
        fits = (x for x in self._seen if x.command != LWR and 8 * x.size == sum(bits))
        if (part := next(fits, None)) is None:
            raise ValueError(f"no datagram has the {sum(bits)} bits of the given mapping")
        placed = [spans([((0, 0), sum(bits[:k])), *slave]) for k, slave in enumerate(self._mapping)]
        return {
            -k: ({key: (part.address + at, n) for key, at, n in slave}, {})
            for k, slave in enumerate(placed, 2)
        }

    @property
    def unanswered(self) -> bool:
        """True if the mapping is what the master wrote, in a capture without any answer."""
        return bool(self._slaves[True].written) and not self._slaves[True].answered

    def rows(self) -> tuple[Block, bool]:
        """Return rows of the cycles with full counters, and whether most have a clock's time.

        The clock's time is that by distributed clocks. A row has timestamp, time by distributed
        clocks (-1: none), position, effort and target (n,); `known` if the target is the one that
        was sent in the cycle. If most rows have a time by distributed clocks, the others are left
        out. Segments of `AT_ONCE` rows are joined, for long captures.
        """
        station = self._slaves[True].contradicts(self._slaves[False])
        self._place.require(
            station is None,
            text=f"the configuration of station {station} that came back differs from the one "
            "that was sent",
            advice="Import an undamaged capture of one start of the bus",
        )
        inputs = [part for part in self._fields if part.back]
        if not inputs or not all(self._columns[part].tell() for part in inputs):
            self.refuse_no_rows()
        parts = {
            part: np.frombuffer(self._columns[part].whole(), self._row(part))
            for part in self._fields
        }
        full, main = {part: self._full(part, parts[part]) for part in inputs}, parts[inputs[0]]
        clock = sum(int((some["clock_ns"] >= 0).sum()) for some in in_parts(main)) > len(main) / 2
        # After a step back of the clock, only distributed clocks show when later rows came.
        for _, by_ns, since_ns in () if clock else steps_back(field_of(main, "time_ns")):
            self._place.require(
                by_ns <= MAX_BACK * self._bus.period_ns,
                text=f"times step back by {by_ns * 1e-9:.3g} s at {since_ns * 1e-9:.4g} s",
                advice=ONE_CLOCK,
            )
        joined, begin = GrowingBytes(), 0
        for first in range(0, len(main), AT_ONCE):
            end = int(main[min(first + AT_ONCE, len(main)) - 1]["packet"]) + 1
            near = dict[Part, Block]()
            # A bisection reads only few of the other rows.
            for part, rows in parts.items():
                low, high = (
                    bisect_left(rows, packet, key=lambda row: int(row["packet"]))
                    for packet in (begin, end)
                )
                near[part] = rows[max(0, low - MARGIN) : high + MARGIN]
            found = self._joined(near, full, begin, end)
            begin = end
            joined.write((found[found["clock_ns"] >= 0] if clock else found).tobytes())
            for rows in parts.values():
                release_pages(rows)
        return np.frombuffer(joined.whole(), found.dtype), clock

    def _joined(
        self, parts: Mapping[Part, Block], full: Mapping[Part, int], first: int, end: int
    ) -> Block:
        """Join rows of the packets from `first` to before `end`, from rows of parts near them."""
        (main, doubled), period = self._undoubled(parts[next(iter(full))]), self._bus.period_ns
        self.doubled += int(((doubled >= first) & (doubled < end)).sum())
        rows = np.zeros(
            len(main),
            [
                ("stamp_ns", "<i8"),
                ("clock_ns", "<i8"),
                ("known", "?"),
                *((x, "<i8", (len(self._bus.drives),)) for x in ("position", "effort", "target")),
            ],
        )
        rows["stamp_ns"], rows["clock_ns"], rows["known"] = (
            main["time_ns"],
            main["clock_ns"],
            len(full) < len(parts),
        )
        good = (main["packet"] >= first) & (main["packet"] < end)
        whole = good.copy()
        for part, near in parts.items():
            other, _ = self._undoubled(near)
            index, certain = (_join if part.back else _sent)(main, other, period)
            if part.back:
                good &= certain
                whole &= other["counter"][index] == full[part] if len(other) else False
            else:
                rows["known"] &= certain
            for name, i in self._fields[part] if len(other) else ():
                rows[name][:, i] = other[f"{name}{i}"][index]
        self.short += int((good & ~whole).sum())
        return rows[good & whole]

    def _full(self, part: Part, rows: Block) -> int:
        """Return the full working counter: by FMMUs, or the highest that is not damage."""
        if self._slaves[True].mapped:
            return self._slaves[True].full_counter(part.command, part.address, part.size)
        count = sum(np.bincount(some["counter"], minlength=2**16) for some in in_parts(rows))
        return int(np.flatnonzero(count > _MIN_SHARE * len(rows))[-1])

    def _undoubled(self, rows: Block) -> tuple[Block, Ints]:
        """Remove rows out of order and repeated rows; also return the packets of the latter.

        The timestamp of a row out of order does not fit those of others. A repeated row repeats the
        row before within half a period.
        """
        time_ns = rows["time_ns"]
        again = np.abs(np.diff(time_ns)) < self._bus.period_ns // 2
        for name in rows.dtype.names[3:] if rows.dtype.names else ():
            again &= rows[name][1:] == rows[name][:-1]
        in_order = (time_ns <= minimum_ahead(time_ns, _ORDER)) & (
            time_ns >= -minimum_ahead(-time_ns[::-1], _ORDER)[::-1]
        )
        in_order[1:] &= ~again
        return rows[in_order], rows["packet"][1:][again]

    def refuse_no_rows(self) -> NoReturn:
        """Raise an error about what is missing in the capture."""
        shown = listed(
            [
                f"{_NAMES[part.command]} of {part.size} bytes at 0x{part.address:X}"
                for part in sorted(self._seen, key=lambda part: -self._seen[part])[:4]
            ]
        )
        self._place.require(
            any(part.back for part in self._seen),
            text=f"no process data came back from the slaves; the capture has {shown}",
            advice="Capture both directions at the master while the bus is operational",
        )
        self._place.require(
            self._fields,
            text=f"{self._why}{self._slaves[True].problem}; the capture has {shown}",
            advice=_MAPPING,
            arguments=("mapping",),
        )
        self._place.refuse(
            text=f"no cycle has full working counters for all drives; the capture has {shown}",
            advice="Capture while the bus is operational",
        )


def _join(main: Block, other: Block, period: int) -> tuple[Ints, Bools]:
    """Find for each row the other one of its cycle.

    Also return whether that is certain: both are in one packet, or near each other and regular.
    """
    if not (len(main) and len(other)):
        return np.zeros(len(main), np.int64), np.zeros(len(main), np.bool_)
    index = np.searchsorted(other["packet"], main["packet"]).clip(max=len(other) - 1)
    same = other["packet"][index] == main["packet"]
    if same.mean() > 0.5:
        return index, same
    t, u = main["time_ns"], other["time_ns"]
    index = np.searchsorted(u, t - round(MAX_OFF * period)).clip(max=len(u) - 1)
    return index, (
        (np.abs(u[index] - t) < MAX_OFF * period) & _regular(t, period) & _regular(u, period)[index]
    )


def _regular(time_ns: Ints, period: int) -> Bools:
    steps = np.abs(np.diff(time_ns) - period) < MAX_OFF * period
    return np.asarray(np.append(False, steps) & np.append(steps, False))


def _sent(main: Block, sent: Block, period: int) -> tuple[Ints, Bools]:
    """Find for each row what was sent last before it.

    Also return whether that is of this cycle: it was sent after the row before, as long ago as
    usual.
    """
    index = np.searchsorted(sent["packet"], main["packet"], "right") - 1
    if not (len(main) and len(sent)):
        return index, np.zeros(len(main), np.bool_)
    delay = main["time_ns"] - sent["time_ns"][index]
    return index, (
        (np.abs(delay - np.median(delay)) < 2 * MAX_OFF * period)
        & (index >= 0)
        & (sent["packet"][index] > np.concatenate([[-1], main["packet"][:-1]]))
    )
