"""Content of captures: packets, EtherCAT datagrams, and what they reveal about the slaves.

The packets are those of pcap and pcapng files. The EtherCAT datagrams in them are read some
thousands at a time. They reveal the slaves' stations, sync managers, FMMUs and mapped objects
(CoE).
"""

import struct
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import Ints
from ..errors import COMMAND_LINE, Location
from ..protocol import ANSWER, REQUEST, Confirmed, Key, Values, words_of
from ..recording import Block

_BLOCKS = b"\x0a\x0d\x0d\x0a"  # pcapng
_RECORDS = {
    struct.pack(f"{x}I", magic): (x, ns)
    for x in "<>"
    for magic, ns in ((0xA1B2C3D4, 1000), (0xA1B23C4D, 1))
}
_INTERFACE, _ENHANCED, _RESOLUTION = 1, 6, 9  # types of two blocks, and an option of an interface
_ETHERNET = 1  # link type
PCAP_HEAD = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 2**18, _ETHERNET)
_AT_ONCE = 2**21  # bytes
_MAX_PACKET, _MAX_BLOCK = 2**18, 2**24  # bytes; a larger size is damage
_VLAN, _IP, _ETHERCAT, _UDP, _PORT = (0x8100, 0x88A8), 0x0800, 0x88A4, 17, 34980
_HEAD = np.dtype(
    [("command", "u1"), ("index", "u1"), ("address", "<u4"), ("length", "<u2"), ("event", "<u2")]
)
# No header is more bytes away from the first byte of a packet, so reading at it stays in the
# buffer.
_MARGIN = 128
_FOUND = np.dtype([("packet", "<i8"), ("at", "<i8"), *_HEAD.descr, ("counter", "<u2")])

APWR, FPRD, BWR, WRITES = 2, 4, 8, (2, 5, 8)  # commands
LRD, LWR, LRW = 10, 11, 12
_STATION, _FMMUS, _MANAGERS, _END, MAILBOX = 0x10, 0x600, 0x800, 0x880, 0x1000  # registers
_FMMU = struct.Struct("<IHBBHBBB3x")
_MAIL = struct.Struct("<5xBH8s")  # type; CoE service; SDO
_COE, _SERVICES = 3, (2, 3)  # CoE: requests, and aborts; answers
Entries: TypeAlias = Sequence[tuple[Key, int]]  # objects and their bits, in order
Located: TypeAlias = Mapping[Key, tuple[int, int]]  # logical address and bytes by object
Way: TypeAlias = tuple[int, int, int]  # sync manager, object with its PDOs, bit of an FMMU's type
INPUTS: Way = (3, 0x1C13, 1)
OUTPUTS: Way = (2, 0x1C12, 2)
_MAPPING = (INPUTS[1], OUTPUTS[1], *range(0x1600, 0x1800), *range(0x1A00, 0x1C00))


class Packets(NamedTuple):
    """Packets in their order: their bytes; time in ns, first byte and length (n,) of each."""

    data: NDArray[np.uint8]
    time_ns: Ints
    begin: Ints
    length: Ints

    def records(self, chosen: Ints) -> bytes:
        """Format some packets as records of pcap with nanoseconds, little-endian.

        The head of a pcap file is not included.
        """
        time_ns, begin, length = self.time_ns[chosen], self.begin[chosen], self.length[chosen]
        heads = (
            np.stack([time_ns // 10**9, time_ns % 10**9, length, length], axis=1)
            .astype("<u4")
            .tobytes()
        )
        data, ends = (
            self.data.tobytes(),
            zip(begin.tolist(), (begin + length).tolist(), strict=True),
        )
        return b"".join(
            heads[16 * k : 16 * k + 16] + data[first:end] for k, (first, end) in enumerate(ends)
        )


def is_capture(path: Path) -> bool:
    """Test whether a file begins as pcap or pcapng do."""
    with suppress(OSError), path.open("rb") as file:
        return (head := file.read(4)) == _BLOCKS or head in _RECORDS
    return False


def packets(
    file: BinaryIO, place: Location, warnings: list[str], max_back_ns: int
) -> Iterator[Packets]:
    """Yield the Ethernet packets of an open file.

    Packets are sorted by time where times step back by at most `max_back_ns`. A file that is
    truncated or damaged is read up to there, with a warning.

    Parameters
    ----------
    file : the capture.
    place : name of the file in errors.
    warnings : list to which warnings are added.
    max_back_ns : largest step back of the times in ns.
    """
    data, at, before = file.read(24), 0, 0
    order, ns = _RECORDS.get(data[:4], ("<", 0))
    interfaces: list[int] = []  # ticks per second; 0 if it is not Ethernet
    place.require(
        len(data) >= 24 and (ns or data[:4] == _BLOCKS),
        text="the file is not a capture",
        expected="pcap or pcapng",
    )
    if ns:
        link, at = struct.unpack(f"{order}I", data[20:])[0] & 0xFFFF, 24
        place.require(
            link == _ETHERNET,
            text=f"the capture has the link type {link}, not 1 (Ethernet)",
            advice="Capture on the network interface, not on 'any'",
        )
    # Packets not yet read may precede these later ones.
    problem, later = "", np.zeros((0, 3), np.int64)
    while not problem:
        new, found = file.read(_AT_ONCE), list[tuple[int, int, int]]()
        used = int(later[:, 1].min(initial=at))
        before, data, at = before + used, data[used:] + new, at - used
        later[:, 1] -= used
        problem = "" if new else "the file ends within a packet"
        unpack = struct.Struct(f"{order}IIII").unpack_from
        while at + 16 <= len(data):
            if ns:
                seconds, part, length, whole = unpack(data, at)
                size, wrong = 16 + length, length > min(whole, _MAX_PACKET) or part * ns >= 10**9
            else:
                if data[at : at + 4] == _BLOCKS:
                    order, interfaces = ">" if data[at + 8] == 0x1A else "<", []
                    unpack = struct.Struct(f"{order}IIII").unpack_from
                kind, size, which, high = unpack(data, at)
                wrong = size < 12 or size % 4 > 0 or size > _MAX_BLOCK
            problem = "the file is damaged" if wrong else problem
            if wrong or at + size > len(data):
                break
            if ns:
                found.append((seconds * 1_000_000_000 + part * ns, at + 16, length))
            elif kind == _INTERFACE and size >= 20:
                interfaces.append(_ticks(data[at + 8 : at + size - 4], order))
            elif kind == _ENHANCED and size >= 32 and which < len(interfaces) and interfaces[which]:
                low, length = struct.unpack_from(f"{order}II", data, at + 16)
                time_ns = (high << 32 | low) * 10**9 // interfaces[which]
                if length <= size - 32 and time_ns < 2**62:
                    found.append((time_ns, at + 28, length))
            at += size
        if problem and at < len(data):
            warnings.append(f"{problem} at byte {before + at}: only what precedes it is imported")
        now, later = _in_order(
            np.append(later, np.array(found, np.int64).reshape(-1, 3), 0), max_back_ns
        )
        yield Packets(
            np.frombuffer(data + bytes(_MARGIN), np.uint8),
            *(np.append(now, later, 0) if problem else now).T,
        )


def _in_order(found: Ints, most_ns: int) -> tuple[Ints, Ints]:
    """Sort packets (n, 3), time first, where times step back by at most `most_ns`.

    Returns the sorted packets, and those at the end that packets not yet read may precede.
    """
    time_ns = found[:, 0]
    session = np.cumsum(np.diff(time_ns, prepend=time_ns[:1]) < -most_ns)
    order = np.lexsort((time_ns, session))
    last = (session == session[-1:]) & (time_ns > time_ns[order[-1:]] - most_ns)
    return found[order[~last[order]]], found[order[last[order]]]


def _ticks(interface: bytes, order: str) -> int:
    """Return the ticks per second of a pcapng interface; 0 if it is not of Ethernet."""
    link, option, ticks = struct.unpack_from(f"{order}H", interface)[0], 8, 10**6
    while option + 5 <= len(interface):
        code, size = struct.unpack_from(f"{order}HH", interface, option)
        if code == _RESOLUTION:
            power = interface[option + 4]
            ticks = 2 ** (power & 127) if power & 128 else 10 ** min(power, 18)
        option += 4 + size + -size % 4
    return ticks if link == _ETHERNET else 0


def gather(data: NDArray[np.uint8], at: Ints, kind: str | np.dtype[Any]) -> NDArray[Any]:
    """Read values (m,) of a type that begin at bytes `at` (m,) of the data."""
    kind = np.dtype(kind)
    return np.asarray(data[at[:, None] + np.arange(kind.itemsize)].view(kind)[:, 0])


def datagrams(given: Packets) -> Block:
    """Find all whole datagrams of EtherCAT frames, including those in VLANs and UDP, in file order.

    `at` is the first byte of their data.
    """
    data, end, at = given.data, given.begin + given.length, given.begin + 12
    for _ in range(2):
        at = at + 4 * np.isin(gather(data, at, ">u2"), _VLAN)
    kind, ip = gather(data, at, ">u2"), at + 2
    udp = ip + 4 * (data[ip] & 15)
    in_udp = (kind == _IP) & (data[ip + 9] == _UDP) & (gather(data, udp + 2, ">u2") == _PORT)
    frame = np.where(in_udp, udp + 8, ip)
    header = gather(data, frame, "<u2").astype(np.int64)
    packet = np.flatnonzero(
        ((kind == _ETHERCAT) | in_udp) & (header >> 12 == 1) & (frame + 2 <= end)
    )
    end, at = np.minimum(end, frame + 2 + (header & 0x7FF)), frame[packet] + 2
    parts = [np.zeros(0, _FOUND)]
    while len(packet):
        fits = at + _HEAD.itemsize + 2 <= end[packet]
        found = np.zeros(int(fits.sum()), _FOUND)
        found["packet"], found["at"] = packet[fits], at[fits] + _HEAD.itemsize
        copied = ["command", "index", "address", "length"]
        found[copied] = gather(data, at[fits], _HEAD)[copied]
        more, found["length"] = found["length"] & 0x8000 != 0, found["length"] & 0x7FF
        after = found["at"] + found["length"]
        found["counter"] = gather(data, np.minimum(after, len(data) - 2), "<u2")
        fits = after + 2 <= end[found["packet"]]
        parts.append(found[fits])
        packet, at = found["packet"][fits & more], after[fits & more] + 2
    found = np.concatenate(parts)
    return found[np.argsort(found["packet"], kind="stable")]


def parse_mapping(texts: Sequence[str]) -> list[Entries]:
    """Parse the objects with their bits of each slave from texts such as 0x6041:16,0x6064:32."""
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
        COMMAND_LINE.require(
            found[-1] and all(0 < bits < 2**14 for _, bits in found[-1]),
            "mapping",
            text,
            "objects with their bits, such as 0x6041:16,0x6064:32,0x6077:16",
        )
    return found


class Slaves:
    """State of the slaves by the datagrams of one direction.

    Attributes:
        registers: registers by station.
        written: mapping objects as written, by station.
        confirmed: mapping objects as confirmed by answers, by station.
        answered: whether there was an answer.
        problem: reason why a mapping is unknown; empty without one.
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
        """Compute the working counter of a datagram that all slaves answered."""
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
        """Stations whose places are known, in bus order; then the others."""
        return list(
            dict.fromkeys(
                [
                    *(self._places[k] for k in sorted(self._places, reverse=True)),
                    *sorted(self.registers),
                ]
            )
        )

    def take(self, command: int, address: int, data: bytes) -> bool:
        """Process a datagram; return whether it changed the meaning of process data."""
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
            if (
                kind & 15 == _COE
                and service >> 12 in _SERVICES
                and int.from_bytes(sdo[1:3], "little") in _MAPPING
            ):
                return self._take_sdo(slave, sdo, ANSWER if command == FPRD else REQUEST)
        return before != self._state(slave)

    def _take_sdo(self, station: int, sdo: bytes, service: int) -> bool:
        first = service == ANSWER and not self.answered
        self.answered |= first
        rewritten = service == REQUEST and self.written[station].take(service, sdo)
        confirmed = self.confirmed[station].take(service, sdo)
        # From the first answer on, only confirmed objects count, not what was written so far.
        return confirmed or (first and bool(self.written)) or (rewritten and not self.answered)

    def _entries(self, station: int, way: Way) -> Entries:
        """Return the objects that a slave maps, and their bits; none without a whole mapping.

        `problem` gets the reason if it has one.
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
        """Find a station with other contents or another place in the other direction.

        The result is None if there is no such station.
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
        """Locate inputs and outputs by station.

        `stated` gives the inputs of slaves without a mapping.

        Raises
        ------
        ValueError : the lengths differ.
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
    """Yield logical address, physical address and number of bytes of the active FMMUs.

    They are those of a way: 1 for inputs, 2 for outputs.
    """
    for logical, size, first, last, physical, bit, kind, active in _FMMU.iter_unpack(
        registers[_FMMUS : _FMMUS + 256]
    ):
        if active & 1 and kind & way and (first, last, bit) == (0, 7, 0):
            yield logical, physical, size


def spans(entries: Entries) -> Iterator[tuple[Key, int, int]]:
    """Yield object, first byte and number of bytes of consecutive entries.

    Gaps and parts of bytes are left out.
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
            f"station {station}: {way[1]:04X} maps {bits} bits, but sync manager {way[0]} has "
            f"{8 * size}"
        )
    return {
        key: (logical + start + at - physical, length)
        for key, at, length in spans(entries)
        for logical, physical, mapped in _fmmus(registers, way[2])
        if physical <= start + at and start + at + length <= physical + mapped
    }
