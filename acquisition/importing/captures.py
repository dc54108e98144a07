"""Packets of pcap and pcapng files, and the EtherCAT datagrams in them, some thousands at a time."""

import struct
from collections.abc import Iterator
from mmap import mmap
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import Ints
from ..errors import Place

_BLOCKS = b"\x0a\x0d\x0d\x0a"  # pcapng
_RECORDS = {
    struct.pack(f"{order}I", magic): (order, ticks)
    for order in "<>"
    for magic, ticks in ((0xA1B2C3D4, 10**6), (0xA1B23C4D, 10**9))
}
_SECTION, _INTERFACE, _SIMPLE, _ENHANCED = 0x0A0D0D0A, 1, 3, 6  # types of blocks
_RESOLUTION = 9  # option of an interface
_ETHERNET = 1  # link type
PCAP_HEAD = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 2**18, _ETHERNET)
CONTEXT = 64  # packets that are given again with the next ones
_AT_ONCE = 2**21  # bytes
_MAX_PACKET, _MAX_BLOCK = 2**18, 2**24  # bytes: more is damage
_VLAN, _IP, _ETHERCAT, _UDP, _PORT = (0x8100, 0x88A8), 0x0800, 0x88A4, 17, 34980
_HEAD, _TAIL = 10, 2  # bytes of a datagram before and after its data
_MARGIN = 128  # bytes: no header is further from the first byte of a packet

Found: TypeAlias = list[tuple[int, int, int]]  # time in ns, -1 without one; first byte and length of each packet


class Packets(NamedTuple):
    """Packets in file order: bytes; time in ns, first byte and length (n,); those before `fresh` were given before."""

    data: bytes
    time_ns: Ints
    begin: Ints
    length: Ints
    fresh: int
    last: bool


class Datagrams(NamedTuple):
    """Datagrams in file order, (m,) each: number of the packet, first byte of the data, and what is before and after it.

    `marked`: the source address is locally administered, as the first slave makes it; `cut`: frames that are not whole.
    """

    data: NDArray[np.uint8]
    packet: Ints
    at: Ints
    command: Ints
    address: Ints
    length: Ints
    counter: Ints
    marked: NDArray[np.bool_]
    cut: int

    def where(self, chosen: NDArray[np.bool_] | Ints) -> "Datagrams":
        """Some of the datagrams."""
        return self._replace(**{name: getattr(self, name)[chosen] for name in self._fields[1:-1]})

    def rows(self) -> NDArray[np.uint8]:
        """The data (m, length) of datagrams of one length."""
        return self.data[self.at[:, None] + np.arange(self.length[0] if len(self.length) else 0)]


def is_capture(path: Path) -> bool:
    """Whether a file begins as pcap or pcapng do."""
    try:
        with path.open("rb") as file:
            return (head := file.read(4)) == _BLOCKS or head in _RECORDS
    except OSError:
        return False


def packets(file: BinaryIO | mmap, place: Place, warnings: list[str]) -> Iterator[Packets]:
    """The packets of an open file; one that is cut or damaged is read up to there, with a warning."""
    walk = _Walk(file, place)
    data, end, at, context = b"", 0, file.tell(), Found()
    while True:
        new = file.read(_AT_ONCE)
        data += new
        found, end = walk.blocks(data, end) if walk.ticks is None else walk.records(data, end)
        last = not new or bool(walk.damage)
        if last and end < len(data):
            warnings.append(f"{walk.damage or 'cut within a packet'} at byte {at + end}: what is before it is read")
        given = np.array([*context, *found], np.int64).reshape(-1, 3)
        time_ns, begin, length = given.T
        yield Packets(data, time_ns, begin, length, len(context), last)
        if last:
            break
        context = [*context, *found][-CONTEXT:]
        first = context[0][1] if context else end
        data, end, at = data[first:], end - first, at + first
        context = [(time, begin - first, length) for time, begin, length in context]
    if walk.others:
        warnings.append(f"{walk.others} packets of other interfaces than Ethernet are left out")


class _Walk:
    """Finds whole packets; `damage` says why it stopped, `others` counts packets that are not of Ethernet."""

    def __init__(self, file: BinaryIO | mmap, place: Place) -> None:
        self.damage, self.others, self.ticks = "", 0, None
        self._order, self._interfaces = "<", list[tuple[bool, int]]()  # of Ethernet, ticks per second
        magic = file.read(4)
        if magic == _BLOCKS:
            file.seek(-4, 1)
            return
        head = file.read(20)
        if magic not in _RECORDS or len(head) < 20:
            place.refuse(text="is no capture", expected="pcap or pcapng")
        self._order, self.ticks = _RECORDS[magic]
        link = struct.unpack(f"{self._order}I", head[16:])[0] & 0xFFFF
        if link != _ETHERNET:
            place.refuse(text=f"link type {link}", expected="1 (Ethernet): capture on the interface, not on 'any'")

    def records(self, data: bytes, at: int) -> tuple[Found, int]:
        """The packets of pcap from byte `at`, and the byte after them."""
        assert self.ticks is not None
        found, end, ticks, ns = Found(), len(data) - 16, self.ticks, 10**9 // self.ticks
        unpack = struct.Struct(f"{self._order}IIII").unpack_from
        while at <= end:
            seconds, part, length, whole = unpack(data, at)
            if length > _MAX_PACKET or length > whole or part >= ticks:
                self.damage = "damaged"
                break
            if at + length > end:
                break
            found.append((seconds * 1_000_000_000 + part * ns, at + 16, length))
            at += 16 + length
        return found, at

    def blocks(self, data: bytes, at: int) -> tuple[Found, int]:
        """The packets of pcapng from byte `at`, and the byte after the last whole block."""
        found = Found()
        while at + 12 <= len(data):
            if data[at : at + 4] == _BLOCKS:
                self._order, self._interfaces = ">" if data[at + 8 : at + 12] == b"\x1a\x2b\x3c\x4d" else "<", []
            kind, size = struct.unpack_from(f"{self._order}II", data, at)
            if size < 12 or size % 4 or size > _MAX_BLOCK:
                self.damage = "damaged"
                break
            if at + size > len(data):
                break
            if struct.unpack_from(f"{self._order}I", data, at + size - 4)[0] != size:
                self.damage = "damaged"
                break
            self._block(kind, data[at + 8 : at + size - 4], at + 8, found)
            at += size
        return found, at

    def _block(self, kind: int, body: bytes, at: int, found: Found) -> None:
        if kind == _INTERFACE and len(body) >= 8:
            link, option, ticks = struct.unpack_from(f"{self._order}H", body)[0], 8, 10**6
            while option + 5 <= len(body):
                code, size = struct.unpack_from(f"{self._order}HH", body, option)
                if code == _RESOLUTION:
                    power = body[option + 4]
                    ticks = 2 ** (power & 127) if power & 128 else 10 ** min(power, 18)
                option += 4 + size + -size % 4
            self._interfaces.append((link == _ETHERNET, ticks))
        elif kind == _ENHANCED and len(body) >= 20:
            interface, high, low, length, _ = struct.unpack_from(f"{self._order}5I", body)
            ethernet, ticks = self._interfaces[interface] if interface < len(self._interfaces) else (False, 1)
            time_ns = (high << 32 | low) * 10**9 // ticks
            if ethernet and length <= len(body) - 20 and time_ns < 2**62:
                found.append((time_ns, at + 20, length))
            self.others += not ethernet
        elif kind == _SIMPLE and len(body) >= 4 and self._interfaces and self._interfaces[0][0]:
            found.append((-1, at + 4, min(len(body) - 4, struct.unpack_from(f"{self._order}I", body)[0])))


def pcap_records(given: Packets, chosen: Ints) -> bytes:
    """Some packets as records of pcap with nanoseconds, little-endian, without its head."""
    time_ns, length = np.maximum(given.time_ns[chosen], 0), given.length[chosen]
    heads = np.stack([time_ns // 10**9, time_ns % 10**9, length, length], axis=1).astype("<u4").tobytes()
    begin, data = given.begin[chosen], given.data
    ends = zip(range(0, len(heads), 16), begin.tolist(), (begin + length).tolist(), strict=True)
    return b"".join([part for k, first, end in ends for part in (heads[k : k + 16], data[first:end])])


def datagrams(given: Packets) -> Datagrams:
    """All whole datagrams of EtherCAT frames, also behind VLAN tags and in UDP."""
    data = np.frombuffer(given.data + bytes(_MARGIN), np.uint8)
    end, at = given.begin + given.length, given.begin + 12
    for _ in range(2):
        at = at + 4 * np.isin(_big(data, at), _VLAN)
    kind, ip = _big(data, at), at + 2
    udp = ip + 4 * (data[ip] & 15)
    in_udp = (kind == _IP) & (data[ip] >> 4 == 4) & (data[ip + 9] == _UDP)
    in_udp &= (_big(data, udp) == _PORT) | (_big(data, udp + 2) == _PORT)
    frame = np.where(in_udp, udp + 8, ip)
    header = _little(data, frame)
    packet = np.flatnonzero(((kind == _ETHERCAT) | in_udp) & (header >> 12 == 1) & (frame + 2 <= end))
    stop = frame + 2 + (header & 0x7FF)
    cut = int((stop > end)[packet[packet >= given.fresh]].sum())
    end, at = np.minimum(end, stop), frame[packet] + 2
    found: list[list[Ints]] = []
    while len(packet):
        packet, at = (x[at + _HEAD + _TAIL <= end[packet]] for x in (packet, at))
        word = _little(data, at + 6)
        after = at + _HEAD + (word & 0x7FF)
        packet, at, word, after = (x[after + _TAIL <= end[packet]] for x in (packet, at, word, after))
        address = _little(data, at + 2) | _little(data, at + 4) << 16
        command, counter = data[at].astype(np.int64), _little(data, after)
        found.append([packet, at + _HEAD, command, address, word & 0x7FF, counter])
        more = word & 0x8000 != 0
        packet, at = packet[more], after[more] + _TAIL
    columns = [np.concatenate(x) for x in zip(*found, strict=True)] if found else [np.zeros(0, np.int64)] * 6
    order = np.argsort(columns[0], kind="stable")
    packet, at, command, address, length, counter = (x[order] for x in columns)
    return Datagrams(data, packet, at, command, address, length, counter, data[given.begin[packet] + 6] & 2 != 0, cut)


def _little(data: NDArray[np.uint8], at: Ints) -> Ints:
    return data[at].astype(np.int64) | data[at + 1].astype(np.int64) << 8


def _big(data: NDArray[np.uint8], at: Ints) -> Ints:
    return data[at].astype(np.int64) << 8 | data[at + 1]
