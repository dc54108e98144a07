"""Expedited SDO transfers (CiA 301, 7.2.4) as bytes, without I/O: requests, answers, abort codes.

The same few functions serve our requests, the simulated drives' answers, and the reading of another master's traffic.
Longer transfers are not needed: every object that is read or written here has four bytes at most.
"""

from dataclasses import dataclass

from ..errors import AcquisitionError

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
    """What a frame says: `kind` is one of read, write, value, written, abort, other; `data` is the value or abort code."""

    kind: str
    index: int = 0
    sub: int = 0
    data: bytes = b""

    @property
    def number(self) -> int:
        """The data as an unsigned number."""
        return int.from_bytes(self.data, "little")


def read_request(index: int, sub: int) -> bytes:
    """Ask for an object."""
    return _frame(0x40, index, sub, b"")


def write_request(index: int, sub: int, value: int, size: int) -> bytes:
    """Set an object of `size` bytes; negative values in two's complement."""
    return _frame(0x23 | (4 - size) << 2, index, sub, (value % (1 << 8 * size)).to_bytes(size, "little"))


def value_answer(index: int, sub: int, value: int, size: int) -> bytes:
    """The value asked for."""
    return _frame(0x43 | (4 - size) << 2, index, sub, (value % (1 << 8 * size)).to_bytes(size, "little"))


def written_answer(index: int, sub: int) -> bytes:
    """The write was done."""
    return _frame(0x60, index, sub, b"")


def abort_answer(index: int, sub: int, meaning: str) -> bytes:
    """The transfer cannot be done: one of `ABORTS`."""
    return _frame(0x80, index, sub, ABORTS[meaning].to_bytes(4, "little"))


def request_of(data: bytes) -> Transfer:
    """What a client's frame says; kind `other` for what is not an expedited transfer."""
    return _read(data, {1: "write", 2: "read", 4: "abort"})


def answer_of(data: bytes) -> Transfer:
    """What a server's frame says; kind `other` for what is not an expedited transfer."""
    return _read(data, {2: "value", 3: "written", 4: "abort"})


def check_answer(answer: Transfer, wanted: str, place: str) -> int:
    """The number in an answer of the kind `wanted`. Raises `AcquisitionError` for an abort, naming `place`."""
    if answer.kind == "abort":
        meaning = next((words for words, code in ABORTS.items() if code == answer.number), "abort")
        raise AcquisitionError(f"refused by the drive: {meaning} (0x{answer.number:08X})", place=place)
    if answer.kind != wanted:
        raise AcquisitionError(f"the drive answered {answer.kind}", place=place, expected=wanted)
    return answer.number


def _frame(command: int, index: int, sub: int, data: bytes) -> bytes:
    return bytes((command, index & 0xFF, index >> 8, sub)) + data.ljust(4, b"\0")


def _read(data: bytes, kinds: dict[int, str]) -> Transfer:
    kind = kinds.get(data[0] >> 5, "other") if len(data) == 8 else "other"
    if kind == "other" or (kind in ("write", "value") and not data[0] & 2):
        return Transfer(kind="other")
    index, sub = int.from_bytes(data[1:3], "little"), data[3]
    if kind in ("write", "value"):
        size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
        return Transfer(kind=kind, index=index, sub=sub, data=data[4 : 4 + size])
    return Transfer(kind=kind, index=index, sub=sub, data=data[4:] if kind == "abort" else b"")
