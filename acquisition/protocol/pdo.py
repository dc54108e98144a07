"""Process data objects (CiA 301, 7.2.2): mapping, configuration and bus load."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from ..errors import Place
from .objects import BITS, ObjectEntry

NOT_VALID = 1 << 31
MAX_PDO_BITS, MAX_PDOS = 64, 0x200
ON_SYNC = 1  # transmission type: at every SYNC
# Communication and mapping parameters by direction: from the drive, to the drive.
PARAMETERS = {"tpdo": (0x1800, 0x1A00), "rpdo": (0x1400, 0x1600)}
USUAL_CAN_ID = {"tpdo": 0x180, "rpdo": 0x200}  # of the first; 0x100 more for each of the next three
# Identifiers of PDOs: below lie NMT, SYNC, emergencies and time, above SDO and heartbeats.
LOWEST_CAN_ID, HIGHEST_CAN_ID = 0x181, 0x57F
_IDENTIFIER = 0x3FFFFFFF  # of a COB-ID with bit 29, which tells that it has 29 bits


@dataclass(frozen=True, kw_only=True)
class Pdo:
    """A PDO: its number from 1, its identifier, the entries in it in order."""

    number: int
    can_id: int
    entries: tuple[ObjectEntry, ...]

    @property
    def bits(self) -> int:
        """Bits of all entries."""
        return sum(entry.bits for entry in self.entries)

    @property
    def length(self) -> int:
        """Bytes of data."""
        return self.bits // 8

    def offset(self, index: int, sub: int) -> int | None:
        """First byte of an object in the frame, None where it is not in it."""
        at = 0
        for entry in self.entries:
            if (entry.index, entry.sub) == (index, sub):
                return at
            at += entry.bits // 8
        return None

    def pack(self, values: Mapping[tuple[int, int], int]) -> bytes:
        """The frame's data from values by (index, sub-index); two's complement."""
        return b"".join((values[e.index, e.sub] % (1 << e.bits)).to_bytes(e.bits // 8, "little") for e in self.entries)

    def unpack(self, data: bytes) -> dict[tuple[int, int], int]:
        """Values by (index, sub-index). Raises `AcquisitionError` when the frame is too short."""
        if len(data) < self.length:
            Place(f"PDO 0x{self.can_id:03X}").refuse(text=f"{len(data)} bytes", expected=str(self.length))
        found, at = {}, 0
        for e in self.entries:
            size = e.bits // 8
            found[e.index, e.sub] = int.from_bytes(data[at : at + size], "little", signed=e.type[0] == "I")
            at += size
        return found


def usual_can_id(direction: str, number: int, node: int) -> int | None:
    """Identifier of CiA 301's predefined connection set; it has four PDOs each way."""
    return USUAL_CAN_ID[direction] + 0x100 * (number - 1) + node if number <= 4 else None


def configuration(direction: str, pdo: Pdo) -> Iterator[tuple[int, int, int, int]]:
    """Writes that configure a PDO in PRE-OPERATIONAL, in CiA 301's order: index, sub-index, value, size in bytes."""
    communication, mapping = (first + pdo.number - 1 for first in PARAMETERS[direction])
    yield communication, 1, pdo.can_id | NOT_VALID, 4
    yield communication, 2, ON_SYNC, 1
    yield mapping, 0, 0, 1
    for k, entry in enumerate(pdo.entries, 1):
        yield mapping, k, entry.mapping, 4
    yield mapping, 0, len(pdo.entries), 1
    yield communication, 1, pdo.can_id, 4


def pdos_of(
    direction: str, values: Mapping[tuple[int, int], int], types: Mapping[tuple[int, int], str], place: str
) -> tuple[Pdo, ...]:
    """PDOs that the `values` of a dictionary's parameters describe; `types` by object.

    PDOs that are switched off, or have the identifier 0, are left out. Raises `AcquisitionError`, naming `place`, for an
    object of unknown type.
    """
    communication, mapping = PARAMETERS[direction]
    found = []
    for index in sorted({i for i, _ in values if communication <= i < communication + MAX_PDOS}):
        can_id, number = values.get((index, 1)), index - communication + 1
        count = values.get((mapping + number - 1, 0), 0)
        if can_id is None or can_id & NOT_VALID or not can_id & _IDENTIFIER or not count:
            continue
        entries = []
        for k in range(1, count + 1):
            word = values.get((mapping + number - 1, k))
            if not word:
                continue
            key = (word >> 16, word >> 8 & 0xFF)
            kind = types.get(key, f"U{word & 0xFF}")
            if BITS.get(kind) != word & 0xFF:
                problem = f"{direction} {number}: {key[0]:04X}:{key[1]} of {word & 0xFF} bits"
                Place(place).refuse(text=problem, expected="whole bytes of its own type")
            entries.append(ObjectEntry(index=key[0], sub=key[1], type=kind))
        found.append(Pdo(number=number, can_id=can_id & _IDENTIFIER, entries=tuple(entries)))
    return tuple(found)


def frame_bits(length: int) -> int:
    """Bits of a data frame of `length` bytes with an 11-bit identifier, gap and the worst case of bit stuffing."""
    return 47 + 8 * length + (34 + 8 * length - 1) // 4


def bus_load(pdos: Iterable[Pdo], *, bitrate: int, sync_period_s: float) -> float:
    """Share of the bus that SYNC and one frame of each PDO take in every period; above 1 they do not fit."""
    bits = frame_bits(0) + sum(frame_bits(pdo.length) for pdo in pdos)
    return bits / (bitrate * sync_period_s)
