"""What a capture shows of the EtherCAT slaves: stations, sync managers, FMMUs, and the objects that they map (CoE)."""

import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TypeAlias

_READS, _WRITES, _ALL = (1, 4), (2, 5), 8  # by position or station; BWR
POSITIONED, LRD, LWR, LRW = (1, 2), 10, 11, 12
_STATION, FMMUS, MANAGERS, _END, _MAILBOX = 0x10, 0x600, 0x800, 0x880, 0x1000  # registers
_FMMU = struct.Struct("<IHBBHBBB")
_COE = 3
Key: TypeAlias = tuple[int, int]  # index and sub-index
Entries: TypeAlias = Sequence[tuple[Key, int]]  # objects and their bits, in their order
Way: TypeAlias = tuple[int, int, int]  # sync manager, object with its PDOs, bit of an FMMU's type
INPUTS: Way = (3, 0x1C13, 1)
OUTPUTS: Way = (2, 0x1C12, 2)


class Slaves:
    """Registers and CoE objects that were written or read, collected from datagrams of one direction."""

    def __init__(self) -> None:
        self._registers: dict[tuple[str, int], bytearray] = {}  # by ("position", -k) or ("station", number)
        self._writes: dict[tuple[int, int], bytes] = {}  # by station and register
        self._objects: dict[tuple[str, int], dict[Key, int]] = {}
        self._segments: dict[tuple[str, int], tuple[int, int, bool, int, bytes]] = {}
        self._stations: dict[int, int] = {}  # by position, as in the datagram

    def add(self, command: int, address: int, data: bytes) -> bool:
        """Whether a datagram changed what process data mean."""
        slave, register = address & 0xFFFF, address >> 16
        if command == _ALL:
            return sum(self._write(key, register, data) for key in self._registers) > 0
        key = ("position", slave - (slave >> 15 << 16)) if command in POSITIONED else ("station", slave)
        if register >= _MAILBOX:
            managers = self._registers.get(key, bytes(_END))[MANAGERS:]
            boxes = [int.from_bytes(managers[k : k + 2], "little") for k in (0, 8)]
            return (register in boxes or not any(boxes)) and self._mailbox(key, data)
        if command in _READS:
            return False
        if register == _STATION and command == 2 and len(data) == 2:
            before, self._stations[key[1]] = self._stations.get(key[1]), int.from_bytes(data, "little")
            return before != self._stations[key[1]]
        return self._write(key, register, data)

    def _write(self, key: tuple[str, int], register: int, data: bytes) -> bool:
        if not FMMUS <= register < _END:
            return False
        if key[0] == "station":
            self._writes[key[1], register] = data
        registers = self._registers.setdefault(key, bytearray(_END))
        written = slice(register, min(register + len(data), _END))
        before = registers[written]
        registers[written] = data[: len(before)]
        return before != registers[written]

    def _mailbox(self, key: tuple[str, int], data: bytes) -> bool:
        """A request to write an object, or an answer with its value."""
        if len(data) < 12 or data[5] & 15 != _COE or data[7] >> 4 not in (2, 3):
            return False
        answer, sdo = data[7] >> 4 == 3, data[8 : 6 + int.from_bytes(data[:2], "little")]
        if len(sdo) < 4:
            return False
        command, index, sub = sdo[0], int.from_bytes(sdo[1:3], "little"), sdo[3]
        if command >> 5 == 1 + answer and command & 2:
            size = 4 - (command >> 2 & 3) if command & 1 else 4
            return self._store(key, index, sub, bool(command & 16), sdo[4 : 4 + size])
        if command >> 5 == 1 + answer and len(sdo) >= 8:
            size, content = int.from_bytes(sdo[4:8], "little"), sdo[8:]
            if len(content) >= size:
                return self._store(key, index, sub, bool(command & 16), content[:size])
            self._segments[key] = (index, sub, bool(command & 16), 16, content)
        elif command >> 5 == 0 and key in self._segments:
            index, sub, whole, toggle, content = self._segments[key]
            if command & 16 != toggle:
                unused = command >> 1 & 7 if len(sdo) == 8 else 0
                self._segments[key] = (index, sub, whole, command & 16, content + sdo[1 : len(sdo) - unused])
                if command & 1:
                    return self._store(key, index, sub, whole, self._segments.pop(key)[-1])
        elif command == 0x80 and answer:
            return self._objects.get(key, {}).pop((index, sub), None) is not None and _maps(index)
        return False

    def _store(self, key: tuple[str, int], index: int, sub: int, whole: bool, data: bytes) -> bool:
        """Store a value; `whole`: all of an array, whose sub-index 0 has two bytes."""
        size = 2 if index in (INPUTS[1], OUTPUTS[1]) else 4
        values = {(index, sub): data}
        if whole and _maps(index):
            values = {(index, 0): data[:2]} if sub == 0 else {}
            entries = data[2 if sub == 0 else 0 :]
            values |= {(index, k + 1): entries[size * k : size * k + size] for k in range(len(entries) // size)}
        objects = self._objects.setdefault(key, {})
        before = dict(objects)
        objects |= {name: int.from_bytes(value, "little") for name, value in values.items()}
        return _maps(index) and before != objects

    def known(self) -> dict[int, tuple[bytes, Mapping[Key, int]]]:
        """Registers and objects by station, in the order of the bus; stations of unknown places follow."""
        found: dict[int, tuple[bytes, Mapping[Key, int]]] = {}
        for position in sorted(self._stations, reverse=True):
            number = self._stations[position]
            keys = (("position", position), ("station", number))
            registers = next((self._registers[key] for key in reversed(keys) if key in self._registers), bytes(_END))
            found[number] = (bytes(registers), {k: v for key in keys for k, v in self._objects.get(key, {}).items()})
        for kind, number in sorted({*self._registers, *self._objects}):
            if kind == "station" and number not in found:
                key = (kind, number)
                found[number] = (bytes(self._registers.get(key, bytes(_END))), self._objects.get(key, {}))
        return found

    def contradicts(self, other: "Slaves") -> int | None:
        """A station for which the datagrams of the other direction have other contents or another place; None without one."""
        ours, theirs = self.known(), other.known()
        both = [station for station in ours if station in theirs]
        for station, place in zip(both, (station for station in theirs if station in ours), strict=True):
            values, writes = theirs[station][1], other._writes
            same = all(values.get(key, value) == value for key, value in ours[station][1].items() if _maps(key[0]))
            same &= all(writes.get(at, data) == data for at, data in self._writes.items() if at[0] == station)
            if station != place or not same:
                return station
        return None


def _maps(index: int) -> bool:
    return index in (INPUTS[1], OUTPUTS[1]) or 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00


def fmmus(registers: bytes, way: int) -> Iterator[tuple[int, int, int]]:
    """Logical address, physical address and bytes of the active FMMUs of a way: 1 inputs, 2 outputs."""
    for at in range(FMMUS, FMMUS + 256, 16):
        logical, size, first, last, physical, bit, kind, active = _FMMU.unpack_from(registers, at)
        if active & 1 and kind & way and (first, last, bit) == (0, 7, 0):
            yield logical, physical, size


def spans(entries: Entries) -> dict[Key, tuple[int, int]]:
    """First byte and bytes of the objects among (key, bits) in a row; gaps and what is not in whole bytes is left out."""
    found, bit = {}, 0
    for key, bits in entries:
        if key[0] and bits and bit % 8 == bits % 8 == 0:
            found[key] = (bit // 8, bits // 8)
        bit += bits
    return found


def entries_of(objects: Mapping[Key, int], way: Way) -> Entries | None:
    """The objects that a slave maps, and their bits; None without a whole mapping."""
    pdos = [objects.get((way[1], k + 1), 0) for k in range(objects.get((way[1], 0), 0))]
    words = [objects.get((pdo, k + 1), 0) for pdo in pdos for k in range(objects.get((pdo, 0), 0))]
    if not words or not all(words) or not all((pdo, 0) in objects for pdo in pdos):
        return None
    return [((word >> 16, word >> 8 & 0xFF), word & 0xFF) for word in words]


def located(registers: bytes, entries: Entries, way: Way) -> dict[Key, tuple[int, int]]:
    """Logical address and bytes of each object of a slave. Raises `ValueError` if its sync manager has another length."""
    manager, assigned, bit = way
    start, size = struct.unpack_from("<HH", registers, MANAGERS + 8 * manager)
    bits = sum(bits for _, bits in entries)
    if bits != 8 * size:
        raise ValueError(f"{assigned:04X} maps {bits} bits, sync manager {manager} has {8 * size}")
    return {
        key: (logical + start + at - physical, length)
        for key, (at, length) in spans(entries).items()
        for logical, physical, mapped in fmmus(registers, bit)
        if physical <= start + at and start + at + length <= physical + mapped
    }


def counter_of(slaves: Iterable[bytes], command: int, address: int, length: int) -> int:
    """The working counter of a datagram that all slaves answered, by their registers."""
    ways = {LRD: {1: 1}, LWR: {2: 1}, LRW: {1: 1, 2: 2}}[command]
    return sum(
        count
        for registers in slaves
        for way, count in ways.items()
        if any(start < address + length and address < start + size for start, _, size in fmmus(registers, way))
    )
