"""Cyclic process data in EtherCAT frames → rows of the integers of CiA 402 drives (CoE), in file order."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, NoReturn, TypeAlias

import numpy as np

from ..arrays import Ints
from ..errors import AcquisitionError, Place, listed
from ..files import GrowingBytes
from ..protocol import ObjectEntry
from ..recording import Block
from ..robot import Bus
from .captures import CONTEXT, Datagrams, Packets, datagrams
from .joining import MAX_OFF, Bools, doubled, in_order, integers, join
from .slaves import (
    FMMUS,
    INPUTS,
    LRD,
    LRW,
    LWR,
    MANAGERS,
    OUTPUTS,
    Entries,
    Key,
    Slaves,
    counter_of,
    entries_of,
    located,
    spans,
)

_CLOCK, _CLOCK_COMMANDS = 0x910, (13, 14)  # system time of the distributed clocks; ARMW and FRMW
_WORDS = [ObjectEntry(index=0, sub=0, type=kind) for kind in ("U32", "I32")]  # low and high half of that time
_NAMES = {LRD: "LRD", LWR: "LWR", LRW: "LRW"}
_MAPPING = (
    "--mapping 0x6041:16,0x6064:32,0x6077:16, once per slave in the order of the bus: all its inputs, gaps as 0:BITS; "
    "STATION=0x6041:16,... where robot.toml names stations"
)

Part: TypeAlias = tuple[int, int, int]  # command, logical address, bytes
Stated: TypeAlias = tuple[int | None, Entries]  # station and inputs of a slave
Located: TypeAlias = Mapping[Key, tuple[int, int]]  # logical address and bytes by object


class Field(NamedTuple):
    """An object of a drive in the logical address space, and the column of rows that it goes to."""

    name: str
    drive: int
    address: int
    entry: ObjectEntry


class Layout(NamedTuple):
    """What samples are made of, no targets if not all are known; stations of the drives; registers of all slaves."""

    inputs: list[Field]
    targets: list[Field]
    stations: list[int]
    registers: list[bytes]


def parse_mapping(texts: Sequence[str]) -> list[Stated]:
    """Station, or None, and objects with their bits, of each slave in `--mapping`."""
    found = list[Stated]()
    for text in texts:
        station, _, objects = text.rpartition("=")
        words = [word.split(":") for word in objects.split(",")]
        try:
            entries = [((int(w[0], 16), int(w[1]) if len(w) > 2 else 0), int(w[-1])) for w in words if 2 <= len(w) <= 3]
            found.append((int(station) if station else None, entries))
        except ValueError:
            entries = []
        if len(entries) < len(words) or not all(0 < bits < 2**14 for _, bits in entries):
            raise AcquisitionError(key="--mapping", value=text, expected="such as 0x6041:16,0x6064:32,0x6077:16")
    return found


class Decoder:
    """Collects `rows` from packets, `good` ones by their working `counters`; `spoilt` counts what was left out, by reason."""

    def __init__(self, bus: Bus, mapping: Sequence[Stated], place: Place) -> None:
        self._bus, self._mapping, self._place = bus, mapping, place
        self._slaves = {True: Slaves(), False: Slaves()}  # by datagrams that came back, and that went out
        self._layout: Layout | None = None
        self._seen: dict[Part, int] = {}
        self._packets = self._held = self._returned = self._cut = self._short = self._early = self.doubled = 0
        self._since, self._clock_ns, self._why = -1, -1, ""
        n = len(bus.drives)
        columns = [(name, "<i4", (n,)) for name in ("position", "effort", "target")]
        self.row = np.dtype([("time_ns", "<i8"), ("clock_ns", "<i8"), ("counter", "<u2"), ("known", "?"), *columns])
        self.rows, self.counters = GrowingBytes(), dict[int, int]()

    def add(self, given: Packets) -> Ints:
        """Add packets; those that were given before are the context of the others. The numbers of the new ones of EtherCAT."""
        found, count, begin = datagrams(given), len(given.begin), given.fresh - self._held
        self._cut += found.cut
        self._configure(found.where(found.packet >= given.fresh))
        process = found.where(np.isin(found.command, (LRD, LWR, LRW)) & (found.packet + self._packets > self._since))
        end = count if given.last else max(begin, count - CONTEXT // 2)
        if len(process.packet):
            self._decode(process, found, given, begin, end)
        self._held = count - end
        self._packets += count - min(CONTEXT, count)
        return np.unique(found.packet[found.packet >= given.fresh])

    def _configure(self, found: Datagrams) -> None:
        """Read what configures the slaves; rows before a change are dropped."""
        register, back = found.address >> 16, found.counter > 0
        written = (register == 0x10) | (register >= FMMUS) & (register < 0x880) | (register >= 0x1000)
        read = np.isin(found.command, (1, 4)) & (register >= 0x1000) & back
        for k in np.flatnonzero(read | (np.isin(found.command, (2, 5, 8)) & written)):
            data = found.data[found.at[k] : found.at[k] + found.length[k]].tobytes()
            changed = self._slaves[bool(back[k])].add(int(found.command[k]), int(found.address[k]), data)
            if changed and back[k]:
                self._layout, self._since = None, self._packets + int(found.packet[k])
                self._early += len(self.rows) // self.row.itemsize
                self.rows, self.counters = GrowingBytes(), {}

    def _decode(self, process: Datagrams, found: Datagrams, given: Packets, begin: int, end: int) -> None:
        key = process.command << 43 | process.address << 11 | process.length
        keys, which, counts = np.unique(key, return_inverse=True, return_counts=True)
        parts = [(int(k >> 43), int(k >> 11 & 0xFFFFFFFF), int(k & 0x7FF)) for k in keys]
        for part, n in zip(parts, counts, strict=True):
            if part in self._seen or len(self._seen) < 1000:
                self._seen[part] = self._seen.get(part, 0) + int(n)
        marks = 0.1 < process.marked.mean() < 0.9  # else the source address does not tell the direction
        back = (process.counter > 0) & (process.marked | (not marks))
        self._returned += int(np.count_nonzero(back))
        if self._layout is None and (layout := self._find_layout(parts)) is not None:
            self._layout = layout
        if self._layout is None:
            return

        def part_of(field: Field, *commands: int) -> int:
            """The datagrams that a field is in; -1 for none."""
            last = field.address + field.entry.bits // 8
            held = [k for k, (c, a, n) in enumerate(parts) if c in commands and a <= field.address and last <= a + n]
            return max(held, key=lambda k: int(counts[k]), default=-1)

        places = [(field, part_of(field, LRD, LRW)) for field in self._layout.inputs]
        needed, period = list(dict.fromkeys(k for _, k in places)), self._bus.period_ns
        if -1 in needed:
            return
        read: dict[int, Datagrams] = {}
        for k in needed:
            one = process.where((which == k) & back)
            again = doubled(one, given.time_ns, period)
            self.doubled += int(again[(one.packet >= begin) & (one.packet < end)].sum()) if k == needed[0] else 0
            one = one.where(~again)
            read[k] = one.where(in_order(given.time_ns[one.packet]))
        main = read[needed[0]]
        rows, whole = np.zeros(len(main.packet), self.row), np.ones(len(main.packet), np.bool_)
        rows["time_ns"], rows["counter"] = given.time_ns[main.packet], main.counter
        good = (main.packet >= begin) & (main.packet < end)
        for k in needed:
            index, joined = join(main.packet, read[k].packet, given.time_ns, period)
            one = read[k].where(index)
            good &= joined
            if self._layout.registers:
                whole &= one.counter == counter_of(self._layout.registers, *parts[k])
            for field, where in places:
                if where == k and len(one.at):
                    rows[field.name][:, field.drive] = integers(one, field.address - parts[k][1], field.entry)
        rows["known"] = bool(self._layout.targets)
        for field in self._layout.targets:
            k = part_of(field, LWR, LRW)
            sent = (which == k) & ~back
            if k >= 0 and parts[k][0] == LWR and not sent.any():  # what comes back has the targets too
                sent = (which == k) & np.isin(process.packet, main.packet)
            rows["known"] &= self._add_target(rows, main.packet, process.where(sent), field, parts[k][1], given.time_ns)
        clock = np.isin(found.command, _CLOCK_COMMANDS) & (found.address >> 16 == _CLOCK)
        self._add_clock(rows, main.packet, found.where(clock & (found.length >= 4) & (found.counter > 0)))
        self._short += int((good & ~whole).sum())
        rows = rows[good & whole]
        for counter, n in zip(*np.unique(rows["counter"], return_counts=True), strict=True):
            self.counters[int(counter)] = self.counters.get(int(counter), 0) + int(n)
        self.rows.extend(rows.tobytes())

    def _add_target(self, rows: Block, packet: Ints, sent: Datagrams, field: Field, base: int, time_ns: Ints) -> Bools:
        """Set the target of the cycle of each row: the only one since the row before came back; where there is such a one."""
        if not len(sent.at):
            return np.zeros(len(rows), np.bool_)
        values, before = integers(sent, field.address - base, field.entry), np.concatenate([[-1], packet[:-1]])
        first, after = (np.searchsorted(sent.packet, x, "right") for x in (before, packet))
        last = np.maximum(after - 1, 0)
        rows["target"][:, field.drive] = values[last]
        delay = time_ns[packet] - time_ns[sent.packet[last]]
        usual = (
            np.abs(delay - np.median(delay)) < 2 * MAX_OFF * self._bus.period_ns
        )  # else it may be that of a lost row
        return np.asarray((after > first) & usual & (values[np.minimum(first, last)] == values[last]))

    def _add_clock(self, rows: Block, packet: Ints, clock: Datagrams) -> None:
        """The distributed clocks' time in the frame of a row, -1 without; of 32 bits, those above are by the capture."""
        if not len(clock.packet):
            return
        index = np.minimum(np.searchsorted(clock.packet, packet), len(clock.packet) - 1)
        here, long = clock.packet[index] == packet, bool((clock.length >= 8).all())
        low, high = (integers(clock.where(index), 4 * k, _WORDS[k]) for k in (0, int(long)))
        if self._clock_ns < 0 and len(rows):
            self._clock_ns = int(low[0] - rows["time_ns"][0]) % 2**32
        near = rows["time_ns"] + (low - rows["time_ns"] - self._clock_ns + 2**31) % 2**32 - 2**31
        rows["clock_ns"] = np.where(here, high << 32 | low if long else near, -1)

    def _find_layout(self, parts: Sequence[Part]) -> Layout | None:
        """Where the drives' objects are, by the mapping in the capture or the stated one; None if it is not known yet."""
        known, objects = self._slaves[True].known(), dict[int, tuple[Located, Located]]()
        registers = [registers for registers, _ in known.values() if any(registers[FMMUS:MANAGERS])]
        self._why = ""
        if self._mapping and not registers:
            bits = [sum(bits for _, bits in slave) for _, slave in self._mapping]
            base = next((address for command, address, n in parts if command != LWR and 8 * n == sum(bits)), None)
            for k, (station, slave) in enumerate(self._mapping if base is not None else ()):
                found = {
                    key: ((base or 0) + at, n) for key, (at, n) in spans([((0, 0), sum(bits[:k])), *slave]).items()
                }
                objects[-k if station is None else station] = found, found
            self._why = f"--mapping has {sum(bits)} bits" if base is None else ""
        else:
            slaves = (station for station, (register, _) in known.items() if any(register[FMMUS:MANAGERS]))
            stated = {
                at if named is None else named: slave for at, (named, slave) in zip(slaves, self._mapping, strict=False)
            }
            for station, (register, values) in known.items():
                ways = [
                    (INPUTS, stated.get(station) or entries_of(values, INPUTS)),
                    (OUTPUTS, entries_of(values, OUTPUTS)),
                ]
                try:
                    reads, writes = (located(register, entries, way) if entries else {} for way, entries in ways)
                except ValueError as error:  # the master may not have written all of it yet
                    self._why = f"station {station}: {error}"
                    return None
                objects[station] = reads, writes
        return self._layout_of(objects, registers)

    def _layout_of(self, objects: Mapping[int, tuple[Located, Located]], registers: list[bytes]) -> Layout | None:
        """Inputs and targets of the drives, each in its station or the next slave that has its position."""
        inputs, targets, stations = list[Field](), list[Field](), list[int]()
        named = {file.station for file in self._bus.file.drive}
        free = [station for station, (reads, _) in objects.items() if reads and station not in named]
        for i, (drive, file) in enumerate(zip(self._bus.drives, self._bus.file.drive, strict=True)):
            able = (station for station in free if drive.position.key in objects[station][0])
            station = next(able, None) if file.station is None else file.station
            if station is None or not objects.get(station, ({}, {}))[0]:
                where = "a further slave" if station is None else f"station {station}"
                if any(reads for reads, _ in objects.values()):
                    self._why = f"no mapping of {where} for {drive.name} is in it"
                return None
            free = free[free.index(station) + 1 :] if station in free else free
            stations.append(station)
            reads, writes = objects[station]
            for name, entry in (("position", drive.position), ("effort", drive.effort.entry)):
                address, size = reads.get(entry.key, (0, 0))
                if 8 * size != entry.bits:
                    at, names = Place(f"{self._place}: station {station}"), [f"{i:04X}:{sub}" for i, sub in reads]
                    text = f"{drive.name}: {entry} of {entry.bits} bits is not among its inputs"
                    at.refuse(text=text, expected=f"one of {listed(names)} in robot.toml")
                inputs.append(Field(name, i, address, drive.position if name == "position" else entry))
            if drive.target.key in writes:
                targets.append(Field("target", i, writes[drive.target.key][0], drive.target))
        return Layout(inputs, targets if len(targets) == len(self._bus.drives) else [], stations, registers)

    def refuse_contradiction(self) -> None:
        """Refuse a mapping that went out with other contents than it came back with."""
        station = self._slaves[True].contradicts(self._slaves[False])
        if station is not None:
            text = f"the configuration of station {station} that came back is not the one that went out"
            self._place.refuse(text=text, expected="an undamaged capture of one start of the bus")

    def refuse_no_rows(self) -> NoReturn:
        """Say what is missing in the capture."""
        most = sorted(self._seen, key=lambda part: -self._seen[part])[:4]
        shown = listed([f"{_NAMES[command]} of {n} bytes at 0x{address:X}" for command, address, n in most])
        if not self._seen:
            self._place.refuse(text="holds no process data of EtherCAT", expected="a bus in operation: LRD, LWR, LRW")
        if not self._returned:
            text = f"no process data come back from the slaves; it has {shown} with working counter 0"
            self._place.refuse(text=text, expected="both directions: capture on the master's own interface")
        if self._layout is None:
            text = f"{self._why or 'no mapping of inputs is in it'}; it has {shown}"
            self._place.refuse(text=text, expected=f"a capture from the start of the bus, or {_MAPPING}")
        text = f"no row of all drives with full working counters in {shown}"
        self._place.refuse(text=text, expected="a bus in operation")

    def warnings(self) -> Iterator[str]:
        """What was left out, and rated values that the master read and robot.toml does not say."""
        reasons = {
            "frames are cut by the capture's snap length: their whole datagrams are read": self._cut,
            "rows before the last change of the mapping are left out": self._early,
            "cycles with a working counter below the full one are left out": self._short,
        }
        yield from (f"{count} {reason}" for reason, count in reasons.items() if count)
        known, stations = self._slaves[True].known(), () if self._layout is None else self._layout.stations
        for drive, station in zip(self._bus.drives, stations, strict=False):
            for index, rated in drive.rated.items():
                found = known[station][1].get((index, 0), rated) if station in known else rated
                if found != rated:
                    yield f"{drive.name}: its {index:04X} is {found} in the capture: expected {rated} as robot.toml says"
