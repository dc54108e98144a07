"""PDO and SDO of CiA 301 as bytes, without I/O: mapping, configuration, size, expedited transfers.

The SDO functions serve the requests of this master, the answers of simulated drives, and the
traffic of another master. Every object read or written has at most four bytes, except for the texts
that a scan reads in segments.
"""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from ..errors import Location, NoAnswerError, SdoAbortedError
from .objects import BITS, ObjectEntry

NOT_VALID, NO_REMOTE = 1 << 31, 1 << 30  # bits of a COB-ID: off; no remote requests
_CODES = {"I8": "b", "I16": "h", "I32": "i", "U8": "B", "U16": "H", "U32": "I"}
MAX_PDO_BITS, MAX_PDOS = 64, 0x200
ON_SYNC = 1  # transmission type: at every SYNC
Key: TypeAlias = tuple[int, int]  # index and sub-index
Values: TypeAlias = Mapping[Key, int | str]  # numbers, or why a number is not known
# Communication and mapping parameters by direction: from the drive, to the drive.
PARAMETERS = {"tpdo": (0x1800, 0x1A00), "rpdo": (0x1400, 0x1600)}
# Identifier of the first PDO in the predefined connection set. That of each of the next three is
# 0x100 higher.
USUAL_CAN_ID = {"tpdo": 0x180, "rpdo": 0x200}
# Identifiers of PDOs. Those of NMT, SYNC, emergencies and time are lower, those of SDO and
# heartbeats are higher.
LOWEST_CAN_ID, HIGHEST_CAN_ID = 0x181, 0x57F
_IDENTIFIER = 0x3FFFFFFF  # of a COB-ID with bit 29, which marks 29-bit identifiers


@dataclass(frozen=True, kw_only=True)
class Pdo:
    """A PDO.

    Attributes:
        number: number of the PDO, from 1.
        can_id: identifier.
        entries: objects in their order in the frame.
    """

    number: int
    can_id: int
    entries: tuple[ObjectEntry, ...]

    @property
    def bits(self) -> int:
        """Size of all entries, bits."""
        return sum(entry.bits for entry in self.entries)

    @property
    def length(self) -> int:
        """Size of the data, bytes."""
        return self.bits // 8

    def offset(self, index: int, sub: int) -> int:
        """Return the position of an object in the frame, bytes."""
        keys = [entry.key for entry in self.entries]
        return sum(entry.bits for entry in self.entries[: keys.index((index, sub))]) // 8

    def pack(self, values: Mapping[tuple[int, int], int]) -> bytes:
        """Return the data of the frame from values by index and sub-index."""
        return b"".join(
            (values[e.index, e.sub] % (1 << e.bits)).to_bytes(e.bits // 8, "little")
            for e in self.entries
        )

    def unpack(self, data: bytes) -> dict[tuple[int, int], int]:
        """Return values by index and sub-index.

        Raises
        ------
        BadInputError : the frame is too short.
        """
        if len(data) < self.length:
            Location(f"PDO 0x{self.can_id:03X}").refuse(
                text=f"the frame has {len(data)} bytes", expected=f"at least {self.length}"
            )
        return dict(
            zip(
                (e.key for e in self.entries),
                struct.unpack_from("<" + "".join(_CODES[e.type] for e in self.entries), data),
                strict=True,
            )
        )


def usual_can_id(direction: str, number: int, node: int) -> int | None:
    """Return the identifier of a PDO in the predefined connection set of CiA 301.

    It is None for a `number` higher than 4.
    """
    return USUAL_CAN_ID[direction] + 0x100 * (number - 1) + node if number <= 4 else None


def configuration(
    direction: str, pdo: Pdo, no_remote: int = 0
) -> Iterator[tuple[int, int, int, int]]:
    """Yield the writes that configure a PDO in PRE-OPERATIONAL, in the order of CiA 301.

    Parameters
    ----------
    direction : `tpdo` or `rpdo`.
    pdo : the PDO.
    no_remote : bit 30 of the drive's COB-ID. Drives without remote requests do not clear it.

    Returns
    -------
    Index, sub-index, value, and size in bytes of each write.
    """
    communication, mapping = (first + pdo.number - 1 for first in PARAMETERS[direction])
    yield communication, 1, pdo.can_id | no_remote | NOT_VALID, 4
    yield communication, 2, ON_SYNC, 1
    yield mapping, 0, 0, 1
    for k, entry in enumerate(pdo.entries, 1):
        yield mapping, k, entry.mapping, 4
    yield mapping, 0, len(pdo.entries), 1
    yield communication, 1, pdo.can_id | no_remote, 4


def pdos_of(
    direction: str,
    values: Values,
    types: Mapping[Key, str],
    place: str,
) -> tuple[Pdo, ...]:
    """Return the PDOs that the parameters in `values` describe.

    Disabled PDOs, identifier 0, and PDOs with an unknown identifier or number of entries are left
    out.

    Parameters
    ----------
    direction : `tpdo` or `rpdo`.
    values : values of objects, or why they are not known.
    types : types of objects.
    place : name of the source in errors.

    Raises
    ------
    BadInputError : an entry is not known, or does not have the size of its object. Then the objects
        after it would be at other bytes.
    """
    communication, mapping = PARAMETERS[direction]
    found = []
    for index in sorted({i for i, _ in values if communication <= i < communication + MAX_PDOS}):
        can_id, number = values.get((index, 1)), index - communication + 1
        count = values.get((mapping + number - 1, 0), 0)
        if (
            not (count and isinstance(count, int) and isinstance(can_id, int))
            or can_id & NOT_VALID
            or not can_id & _IDENTIFIER
        ):
            continue
        entries = []
        for at, word in words_of(values, mapping + number - 1):
            if isinstance(word, str):
                Location(place).refuse(
                    text=f"{direction} {number}: {at} {word}",
                    advice=f"Provide all {count} entries, or describe the PDOs in robot.toml "
                    "(mapping = 'table')",
                )
            key = (word >> 16, word >> 8 & 0xFF)
            kind = types.get(key, f"U{word & 0xFF}")
            Location(place).require(
                BITS.get(kind) == word & 0xFF,
                text=f"{direction} {number}: {at} maps {word & 0xFF} bits of {key[0]:04X}:{key[1]}",
                expected="whole bytes, as many as the object has",
            )
            entries.append(ObjectEntry(index=key[0], sub=key[1], type=kind))
        found.append(Pdo(number=number, can_id=can_id & _IDENTIFIER, entries=tuple(entries)))
    return tuple(found)


def words_of(values: Values, index: int) -> list[tuple[str, int | str]]:
    """Return names and values of the sub-indices of an object.

    There are as many as its sub-index 0 gives. Values of 0 map nothing, and are left out.
    """
    count = values.get((index, 0))
    subs = range(1, (count & 0xFF) + 1) if isinstance(count, int) else range(1)
    return [
        (f"{index:04X}:{sub}", word)
        for sub in subs
        if (word := values.get((index, sub), "is not known"))
    ]


def contradicted(direction: str, pdo: Pdo, values: Values) -> list[tuple[Key, int]]:
    """Return the mapping parameters in `values` that differ from `pdo`.

    Only those of the PDO with the same identifier are compared.
    """
    communication, mapping = PARAMETERS[direction]
    stated = (len(pdo.entries), *(entry.mapping for entry in pdo.entries))
    keys = [
        (index - communication + mapping, k)
        for (index, sub), value in values.items()
        if communication <= index < communication + MAX_PDOS and sub == 1
        if isinstance(value, int) and value & (NOT_VALID | _IDENTIFIER) == pdo.can_id
        for k in range(len(stated))
    ]
    return [
        (key, n) for key in keys if isinstance(n := values.get(key), int) and n != stated[key[1]]
    ]


def frame_bits(length: int) -> int:
    """Return the size on the bus of a frame with `length` bytes of data, bits.

    It has an 11-bit identifier. The gap and the worst case of bit stuffing are included.
    """
    return 47 + 8 * length + (34 + 8 * length - 1) // 4


REQUEST, ANSWER = 0x600, 0x580  # identifiers, plus the node id

ABORTS = {  # codes by meaning
    "toggle bit not alternated": 0x05030000,
    "timed out": 0x05040000,
    "command specifier not known": 0x05040001,
    "access not supported": 0x06010000,
    "read of a write-only object": 0x06010001,
    "write to a read-only object": 0x06010002,
    "object does not exist": 0x06020000,
    "object cannot be mapped to a PDO": 0x06040041,
    "PDO would be too long": 0x06040042,
    "length does not match": 0x06070010,
    "sub-index does not exist": 0x06090011,
    "value out of range": 0x06090030,
    "general error": 0x08000000,
    "not possible in this state": 0x08000022,
}


@dataclass(frozen=True, kw_only=True)
class Transfer:
    """The content of an SDO frame.

    Attributes:
        kind: read, write, value, written, abort or other.
        index: index of the object.
        sub: sub-index.
        data: value or abort code; of four bytes if the frame gives no size.
        stated: True if the frame gives a size.
    """

    kind: str
    index: int = 0
    sub: int = 0
    data: bytes = b""
    stated: bool = True

    @property
    def number(self) -> int:
        """The data as an unsigned number."""
        return int.from_bytes(self.data, "little")


def read_request(index: int, sub: int) -> bytes:
    """Return a request to read an object."""
    return _frame(0x40, index, sub, b"")


def write_request(index: int, sub: int, value: int, size: int) -> bytes:
    """Return a request to write an object of `size` bytes."""
    return _frame(
        0x23 | (4 - size) << 2, index, sub, (value % (1 << 8 * size)).to_bytes(size, "little")
    )


def value_answer(index: int, sub: int, value: int, size: int) -> bytes:
    """Return an answer with the value of an object."""
    return _frame(
        0x43 | (4 - size) << 2, index, sub, (value % (1 << 8 * size)).to_bytes(size, "little")
    )


def written_answer(index: int, sub: int) -> bytes:
    """Return an answer to a write."""
    return _frame(0x60, index, sub, b"")


def abort_answer(index: int, sub: int, meaning: str) -> bytes:
    """Return an abort of a transfer. `meaning` is a key of `ABORTS`."""
    return _frame(0x80, index, sub, ABORTS[meaning].to_bytes(4, "little"))


def request_of(data: bytes) -> Transfer:
    """Decode the frame of a client. Its kind is `other` if it is not an expedited transfer."""
    return _read(data, {1: "write", 2: "read", 4: "abort"})


def answer_of(data: bytes) -> Transfer:
    """Decode the frame of a server. Its kind is `other` if it is not an expedited transfer."""
    return _read(data, {2: "value", 3: "written", 4: "abort"})


def check_answer(answer: Transfer, wanted: str, node: int, place: str) -> int:
    """Return the number in an answer.

    Parameters
    ----------
    answer : the answer.
    wanted : its expected kind.
    node : node id, for errors.
    place : name of the object in errors.

    Raises
    ------
    SdoAbortedError : the answer is an abort.
    NoAnswerError : the answer is of another kind.
    """
    if answer.kind == "abort":
        raise SdoAbortedError(
            next((words for words, code in ABORTS.items() if code == answer.number), "abort"),
            node=node,
            index=answer.index,
            code=answer.number,
            place=place,
        )
    if answer.kind != wanted:
        raise NoAnswerError(
            f"the drive answered {answer.kind!r} instead of {wanted!r}", node=node, place=place
        )
    return answer.number


# Objects that decide what a device maps: parameters of PDOs, their storage and their defaults. For
# the latter, sub-index 1 is for all parameters and 2 for those of communication.
STORE, RESTORE = 0x1010, 0x1011
SDO_OBJECTS = (STORE, RESTORE, *range(0x1400, 0x1C00))


@dataclass(kw_only=True)
class Confirmed:
    """Values of a device, as its answers to another client show (CiA 301, 7.2.4).

    A write counts when it is answered, and until the next start of the device unless it was stored.

    Attributes:
        silent: True if the answers of the device are not in the log; then writes count at once.
        values: values by index and sub-index, or why a value is not known.
        refused: last write that the device refused, as text.
        stored: values that the device has stored.
    """

    silent: bool = False
    values: dict[Key, int | str] = field(default_factory=dict)
    refused: str = ""
    stored: dict[Key, int | str] = field(default_factory=dict)
    # Values written without an answer so far, and the values before. There may be two of an object,
    # because a duplicate frame has two answers.
    _open: dict[Key, list[tuple[int | str, int | str]]] = field(default_factory=dict)

    def take(self, service: int, sdo: bytes) -> bool:
        """Take the data of a request (600h), of an answer (580h), or of a frame that shows a start.

        The result is True if values differ from then on.
        """
        if service == REQUEST:
            return self._asked(request_of(sdo))
        return self._answered(answer_of(sdo)) if service == ANSWER else self._started()

    def _asked(self, request: Transfer) -> bool:
        """Note the value that a request writes, which is not known before its answer."""
        if request.kind not in ("write", "other"):
            return False
        key = (request.index, request.sub)
        written = request.number if request.kind == "write" else "was written in several frames"
        self._open.setdefault(key, []).append((written, self.values.get(key, "was not seen")))
        self.values[key] = "was written, but no answer was seen"
        return self.silent and self._answered(replace(request, kind="written"))

    def _answered(self, answer: Transfer) -> bool:
        key, unseen = (answer.index, answer.sub), "was written, but the write was not seen"
        now = self.values.get(key, "was not seen")
        written, before = (self._open.get(key) or [(unseen, now)]).pop()
        if answer.kind == "abort":
            refusal = f"was refused by the drive (0x{answer.number:08X})"
            self.refused = f"{key[0]:04X}:{key[1]} {refusal}"
            now = before if isinstance(before, int) else refusal
        self.values[key] = {"written": written, "value": answer.number}.get(answer.kind, now)
        if answer.kind == "written" and key[0] in (STORE, RESTORE) and key[1] in (1, 2):
            self.stored = dict(self.values) if key[0] == STORE else {}
        # A value that is read for the first time was there before, so nothing has changed.
        return (
            (answer.kind == "written" or isinstance(before, int))
            and self.values[key] != before
            and key[0] not in (STORE, RESTORE)
        )

    def _started(self) -> bool:
        before, lost = self.values, "was lost at a start of the drive"
        self.values = {key: self.stored.get(key, lost) for key in before}
        return before != self.values


def _frame(command: int, index: int, sub: int, data: bytes) -> bytes:
    return bytes((command, index & 0xFF, index >> 8, sub)) + data.ljust(4, b"\0")


def _read(data: bytes, kinds: dict[int, str]) -> Transfer:
    if len(data) != 8:
        return Transfer(kind="other")
    kind = kinds.get(data[0] >> 5, "other")
    index, sub = int.from_bytes(data[1:3], "little"), data[3]
    if kind in ("write", "value"):
        if not data[0] & 2:
            return Transfer(kind="other", index=index, sub=sub)
        stated = bool(data[0] & 1)
        end = 8 - (data[0] >> 2 & 3) if stated else 8
        return Transfer(kind=kind, index=index, sub=sub, data=data[4:end], stated=stated)
    return Transfer(kind=kind, index=index, sub=sub, data=data[4:] if kind == "abort" else b"")
