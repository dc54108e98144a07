"""Packets of pcap and pcapng files, and the EtherCAT datagrams in them,
some thousands at a time.
"""

import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Ints
from ..errors import Place
from ..recording import Block

_BLOCKS = b"\x0a\x0d\x0d\x0a"  # pcapng
_RECORDS = {
    struct.pack(f"{x}I", magic): (x, ns)
    for x in "<>"
    for magic, ns in ((0xA1B2C3D4, 1000), (0xA1B23C4D, 1))
}
_INTERFACE, _ENHANCED, _RESOLUTION = 1, 6, 9  # types of blocks, option of an interface
_ETHERNET = 1  # link type
PCAP_HEAD = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 2**18, _ETHERNET)
_AT_ONCE = 2**21  # bytes
_MAX_PACKET, _MAX_BLOCK = 2**18, 2**24  # bytes: more is damage
_VLAN, _IP, _ETHERCAT, _UDP, _PORT = (0x8100, 0x88A8), 0x0800, 0x88A4, 17, 34980
_HEAD = np.dtype(
    [("command", "u1"), ("index", "u1"), ("address", "<u4"), ("length", "<u2"), ("event", "<u2")]
)
_MARGIN = 128  # bytes: no header is further from the first byte of a packet
_FOUND = np.dtype([("packet", "<i8"), ("at", "<i8"), *_HEAD.descr, ("counter", "<u2")])


class Packets(NamedTuple):
    """Packets in their order: bytes; time in ns, first byte and length (n,)."""

    data: NDArray[np.uint8]
    time_ns: Ints
    begin: Ints
    length: Ints

    def records(self, chosen: Ints) -> bytes:
        """Some packets as records of pcap with nanoseconds, little-endian, without its head."""
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
    """Whether a file begins as pcap or pcapng do."""
    with suppress(OSError), path.open("rb") as file:
        return (head := file.read(4)) == _BLOCKS or head in _RECORDS
    return False


def packets(
    file: BinaryIO, place: Place, warnings: list[str], max_back_ns: int
) -> Iterator[Packets]:
    """The packets of Ethernet in an open file, in the order of their times where these step back by
    at most so much; a file that is cut or damaged is read up to there, with a warning.
    """
    data, at, before = file.read(24), 0, 0
    order, ns = _RECORDS.get(data[:4], ("<", 0))
    interfaces: list[int] = []  # ticks per second, 0 of others than Ethernet
    place.require(
        len(data) >= 24 and (ns or data[:4] == _BLOCKS),
        text="is no capture",
        expected="pcap or pcapng",
    )
    if ns:
        link, at = struct.unpack(f"{order}I", data[20:])[0] & 0xFFFF, 24
        place.require(
            link == _ETHERNET,
            text=f"link type {link}",
            expected="1 (Ethernet): capture on the interface, not on 'any'",
        )
    problem, later = "", np.zeros((0, 3), np.int64)  # packets that others may come before
    while not problem:
        new, found = file.read(_AT_ONCE), list[tuple[int, int, int]]()
        used = int(later[:, 1].min(initial=at))
        before, data, at = before + used, data[used:] + new, at - used
        later[:, 1] -= used
        problem = "" if new else "cut within a packet"
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
            if wrong:
                problem = "damaged"
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
            warnings.append(f"{problem} at byte {before + at}: what is before it is read")
        now, later = _in_order(
            np.append(later, np.array(found, np.int64).reshape(-1, 3), 0), max_back_ns
        )
        yield Packets(
            np.frombuffer(data + bytes(_MARGIN), np.uint8),
            *(np.append(now, later, 0) if problem else now).T,
        )


def _in_order(found: Ints, most_ns: int) -> tuple[Ints, Ints]:
    """Packets (n, 3), time first, in the order of their times where these step back by at most so
    much; those at the end that packets not yet read may come before are the second ones.
    """
    time_ns = found[:, 0]
    session = np.cumsum(np.diff(time_ns, prepend=time_ns[:1]) < -most_ns)
    order = np.lexsort((time_ns, session))
    last = (session == session[-1:]) & (time_ns > time_ns[order[-1:]] - most_ns)
    return found[order[~last[order]]], found[order[last[order]]]


def _ticks(interface: bytes, order: str) -> int:
    """Ticks per second of a pcapng interface; 0 if it is not of Ethernet."""
    link, option, ticks = struct.unpack_from(f"{order}H", interface)[0], 8, 10**6
    while option + 5 <= len(interface):
        code, size = struct.unpack_from(f"{order}HH", interface, option)
        if code == _RESOLUTION:
            power = interface[option + 4]
            ticks = 2 ** (power & 127) if power & 128 else 10 ** min(power, 18)
        option += 4 + size + -size % 4
    return ticks if link == _ETHERNET else 0


def gather(data: NDArray[np.uint8], at: Ints, kind: str | np.dtype[Any]) -> NDArray[Any]:
    """Values (m,) of a type that begin at bytes `at` (m,) of the data."""
    kind = np.dtype(kind)
    return np.asarray(data[at[:, None] + np.arange(kind.itemsize)].view(kind)[:, 0])


def datagrams(given: Packets) -> Block:
    """All whole datagrams of EtherCAT frames, in VLANs and UDP too, in file order; `at`: the
    first byte of their data.
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
