"""What a capture shows of the EtherCAT slaves: stations, sync managers, FMMUs, and the
objects that they map (CoE).
"""

import struct
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeAlias

from ..errors import BadInputError
from ..protocol import ANSWER, REQUEST, Confirmed, Key, Values, words_of

APWR, FPRD, BWR, WRITES = 2, 4, 8, (2, 5, 8)  # commands
LRD, LWR, LRW = 10, 11, 12
_STATION, _FMMUS, _MANAGERS, _END, MAILBOX = 0x10, 0x600, 0x800, 0x880, 0x1000  # registers
_FMMU = struct.Struct("<IHBBHBBB3x")
_MAIL = struct.Struct("<5xBH8s")  # type; CoE service; SDO
_COE, _SERVICES = 3, (2, 3)  # CoE: requests, and aborts; answers
Entries: TypeAlias = Sequence[tuple[Key, int]]  # objects and their bits, in their order
Located: TypeAlias = Mapping[Key, tuple[int, int]]  # logical address and bytes by object
Way: TypeAlias = tuple[int, int, int]  # sync manager, object with its PDOs, bit of an FMMU's type
INPUTS: Way = (3, 0x1C13, 1)
OUTPUTS: Way = (2, 0x1C12, 2)
_MAPPING = (INPUTS[1], OUTPUTS[1], *range(0x1600, 0x1800), *range(0x1A00, 0x1C00))


def parse_mapping(texts: Sequence[str]) -> list[Entries]:
    """Objects with their bits of each slave in `--mapping`."""
    found = list[Entries]()
    for text in texts:
        try:
            found.append(
                [
                    ((int(index, 16), int("".join(sub) or 0)), int(bits))
                    for index, *sub, bits in (word.split(":") for word in text.split(","))
                ]
            )
        except ValueError:
            found.append([])
        if not found[-1] or not all(0 < bits < 2**14 for _, bits in found[-1]):
            raise BadInputError(
                key="--mapping", value=text, expected="such as 0x6041:16,0x6064:32,0x6077:16"
            )
    return found


class Slaves:
    """What datagrams of one direction wrote: stations in the order of the bus; by station
    registers, mapping objects as `written`, and as `confirmed` by answers, if any is `answered`.
    """

    def __init__(self) -> None:
        self._places: dict[int, int] = {}
        self.registers: dict[int, bytearray] = {}
        self.written = defaultdict[int, Confirmed](lambda: Confirmed(silent=True))
        self.confirmed = defaultdict[int, Confirmed](Confirmed)
        self.answered, self.problem = False, ""

    @property
    def mapped(self) -> list[bytes]:
        """Registers of the slaves with FMMUs."""
        return [bytes(x) for x in self.registers.values() if any(x[_FMMUS:_MANAGERS])]

    def full_counter(self, command: int, address: int, length: int) -> int:
        """The working counter of a datagram that all slaves answered."""
        return sum(
            count
            for registers in self.mapped
            for way, count in {LRD: [(1, 1)], LWR: [(2, 1)], LRW: [(1, 1), (2, 2)]}[command]
            if any(
                start < address + length and address < start + size
                for start, _, size in _fmmus(registers, way)
            )
        )

    @property
    def stations(self) -> list[int]:
        """Those whose places are known, in the order of the bus; then the others."""
        placed = (self._places[k] for k in sorted(self._places, reverse=True))
        return list(dict.fromkeys([*placed, *sorted(self.registers)]))

    def take(self, command: int, address: int, data: bytes) -> bool:
        """Whether a datagram changed what process data mean."""
        slave, register = address & 0xFFFF, address >> 16
        before = self._state(slave)
        if command == APWR and register == _STATION and len(data) == 2:
            self._places[slave - (slave >> 15 << 16)] = int.from_bytes(data, "little")
        elif _FMMUS <= register < _END:
            for station in list(self.registers) if command == BWR else [slave]:
                memory = self.registers.setdefault(station, bytearray(_END))
                memory[register : register + len(data)] = data[: _END - register]
        elif register >= MAILBOX and len(data) >= _MAIL.size:
            kind, service, sdo = _MAIL.unpack_from(data)
            index = int.from_bytes(sdo[1:3], "little")
            if kind & 15 == _COE and service >> 12 in _SERVICES and index in _MAPPING:
                return self._take_sdo(slave, sdo, ANSWER if command == FPRD else REQUEST)
        return before != self._state(slave)

    def _take_sdo(self, station: int, sdo: bytes, service: int) -> bool:
        first = service == ANSWER and not self.answered
        self.answered |= first
        rewritten = service == REQUEST and self.written[station].take(service, sdo)
        confirmed = self.confirmed[station].take(service, sdo)
        # With the first answer what was written so far does not count any more.
        return confirmed or (first and bool(self.written)) or (rewritten and not self.answered)

    def _entries(self, station: int, way: Way) -> Entries:
        """The objects that a slave maps, and their bits; none without a whole mapping, with the
        `problem` where it has one.
        """
        objects = (self.confirmed if self.answered else self.written)[station].values
        words = [
            found
            for at, pdo in words_of(objects, way[1])
            for found in (words_of(objects, pdo) if isinstance(pdo, int) else [(at, pdo)])
        ]
        unknown = [f"{at} {word}" for at, word in words if isinstance(word, str)]
        if unknown and (way[1], 0) in objects:
            self.problem = self.problem or f": station {station}: {unknown[0]}"
        return [
            ((word >> 16, word >> 8 & 0xFF), word & 0xFF)
            for _, word in words
            if isinstance(word, int) and not unknown
        ]

    def _state(self, station: int) -> tuple[bytes, Values]:
        return bytes(self.registers.get(station, b"")), dict(self.written[station].values)

    def contradicts(self, other: "Slaves") -> int | None:
        """A station of which the other direction has other contents or another
        place; None without one.
        """
        ours, theirs = (
            [x for x in a.stations if x in b.registers] for a, b in ((self, other), (other, self))
        )
        return next(
            (
                x
                for x, y in zip(ours, theirs, strict=False)
                if x != y or self._state(x) != other._state(x)
            ),
            None,
        )

    def located(self, stated: Sequence[Entries]) -> dict[int, tuple[Located, Located]]:
        """Inputs and outputs by station; `stated` inputs of slaves without a mapping.

        Raises `ValueError`: lengths differ.
        """
        further, found = iter(stated), dict[int, tuple[Located, Located]]()
        self.problem = ""
        for station in self.stations:
            registers = bytes(self.registers.get(station, bytes(_END)))
            inputs = self._entries(station, INPUTS) or (
                next(further, []) if any(registers[_FMMUS:_MANAGERS]) else []
            )
            outputs = _places(station, registers, self._entries(station, OUTPUTS), OUTPUTS)
            found[station] = _places(station, registers, inputs, INPUTS), outputs
        return found


def _fmmus(registers: bytes, way: int) -> Iterator[tuple[int, int, int]]:
    """Logical address, physical address and bytes of the active FMMUs of a
    way: 1 inputs, 2 outputs.
    """
    for logical, size, first, last, physical, bit, kind, active in _FMMU.iter_unpack(
        registers[_FMMUS : _FMMUS + 256]
    ):
        if active & 1 and kind & way and (first, last, bit) == (0, 7, 0):
            yield logical, physical, size


def spans(entries: Entries) -> Iterator[tuple[Key, int, int]]:
    """Object, first byte and bytes of each of a row of entries; gaps and what is not in
    whole bytes are left out.
    """
    bit = 0
    for key, bits in entries:
        if key[0] and bits and bit % 8 == bits % 8 == 0:
            yield key, bit // 8, bits // 8
        bit += bits


def _places(station: int, registers: bytes, entries: Entries, way: Way) -> Located:
    start, size = struct.unpack_from("<HH", registers, _MANAGERS + 8 * way[0])
    bits = sum(bits for _, bits in entries)
    if entries and bits != 8 * size:
        raise ValueError(
            f"station {station}: {way[1]:04X} maps {bits} bits, sync manager {way[0]} has "
            f"{8 * size}"
        )
    return {
        key: (logical + start + at - physical, length)
        for key, at, length in spans(entries)
        for logical, physical, mapped in _fmmus(registers, way[2])
        if physical <= start + at and start + at + length <= physical + mapped
    }
