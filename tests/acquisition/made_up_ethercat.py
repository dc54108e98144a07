"""Captures of a made-up EtherCAT bus of CiA 402 drives. Shares no code with the package."""

import struct
from collections.abc import Iterable
from dataclasses import dataclass, field

APWR, FPRD, FPWR, LRD, LWR, LRW, ARMW, FRMW = 2, 4, 5, 10, 11, 12, 13, 14
INPUTS = [(0x6041, 16), (0x6061, 8), (0, 8), (0x6064, 32), (0x6077, 16)]
OUTPUTS = [(0x6040, 16), (0x607A, 32), (0x6060, 8), (0, 8)]
# of cycle 0, by the capture and by distributed clocks
BEGIN_NS, CLOCK_NS = 1_790_000_000 * 10**9, 10**18
MASTER, BACK_NS = bytes.fromhex("c8decadedeff"), 15_000
Packet = tuple[int, bytes]  # time in ns, frame


@dataclass(kw_only=True)
class Bus:
    """`image`: lrd_lwr, lrw, overlap (LRW with outputs under the inputs) or frames (LRD of each
    drive, LWR: a frame each).
    """

    drives: int = 2
    period_ns: int = 1_000_000
    image: str = "lrd_lwr"
    wrap: str = ""  # vlan or udp
    clock: int = 0  # bytes of the distributed clocks' time that each cycle reads
    transfer: bool = True  # of the mapping, by SDO
    couplers: int = 0  # slaves without process data before the drives
    answers: bool = True  # to SDO, which the master reads out of the mailbox
    silent: range = range(0)  # cycles in which the last drive does not answer
    stations: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.stations = self.stations or [1001 + k for k in range(self.couplers + self.drives)]

    # What is true in cycle k of drive i.
    def position(self, k: int, i: int) -> int:
        return (i + 1) * 100_000 + 37 * k + (k * k) % 11

    def effort(self, k: int, i: int) -> int:
        return (k * 7 + 13 * i) % 601 - 300

    def target(self, k: int, i: int) -> int:
        return self.position(k, i) + 500 + i

    def addresses(self, i: int) -> tuple[int, int]:
        """Logical addresses of the inputs and the outputs of drive i."""
        if self.image == "lrw":
            return 0x10000 + 8 * self.drives + 10 * i, 0x10000 + 8 * i
        return 0x10000 + 16 * i, 0x10000 + 16 * i

    def inputs(self, k: int, i: int) -> bytes:
        return struct.pack("<HBxih", 0x1237, 8, self.position(k, i), self.effort(k, i))

    def outputs(self, k: int, i: int) -> bytes:
        return struct.pack("<HiBx", 15, self.target(k, i), 8)

    def frame(self, out: bool, datagrams: list[tuple[int, int, bytes, int]], index: int) -> bytes:
        """Command, address, data and counter of each datagram in a frame."""
        body = b""
        for k, (command, address, data, counter) in enumerate(datagrams):
            more = 0x8000 if k + 1 < len(datagrams) else 0
            body += struct.pack("<BBIHH", command, index % 256, address, len(data) | more, 0) + data
            body += struct.pack("<H", counter)
        content = struct.pack("<H", len(body) | 0x1000) + body
        source = MASTER if out else bytes([MASTER[0] | 2]) + MASTER[1:]
        kind = b"\x88\xa4"
        if self.wrap == "vlan":
            kind = b"\x81\x00\x00\x07" + kind
        if self.wrap == "udp":
            kind = b"\x08\x00" + struct.pack(
                ">BBHHHBBH8x", 0x45, 0, 28 + len(content), 0, 0, 64, 17, 0
            )
            kind += struct.pack(">HHHH", 34980, 34980, 8 + len(content), 0)
        return (b"\xff" * 6 + source + kind + content).ljust(60, b"\0")

    def writes(self) -> Iterable[tuple[int, int, bytes]]:
        """Command, address and data of the datagrams that configure the bus."""
        for k, station in enumerate(self.stations):
            yield APWR, (-k & 0xFFFF) | 0x10 << 16, struct.pack("<H", station)
        for k, station in enumerate(self.stations):
            mailboxes = struct.pack(
                "<HHBBBBHHBBBB", 0x1000, 128, 0x26, 0, 1, 0, 0x1080, 128, 0x22, 0, 1, 0
            )
            yield FPWR, station | 0x800 << 16, mailboxes
            if k < self.couplers:
                continue
            for sdo in self.sdos() if self.transfer else ():
                mail = struct.pack("<HHBBH", len(sdo) + 2, 0, 0, 0x13, 2 << 12) + sdo
                yield FPWR, station | 0x1000 << 16, mail.ljust(128, b"\0")
            read, written = self.addresses(k - self.couplers)
            yield FPWR, station | 0x810 << 16, struct.pack("<HHBBBB", 0x1100, 8, 0x64, 0, 1, 0)
            yield FPWR, station | 0x818 << 16, struct.pack("<HHBBBB", 0x1180, 10, 0x20, 0, 1, 0)
            yield (
                FPWR,
                station | 0x600 << 16,
                struct.pack("<IHBBHBBB3x", written, 8, 0, 7, 0x1100, 0, 2, 1),
            )
            yield (
                FPWR,
                station | 0x610 << 16,
                struct.pack("<IHBBHBBB3x", read, 10, 0, 7, 0x1180, 0, 1, 1),
            )

    def sdos(self) -> Iterable[bytes]:
        """Bodies of the transfers that write the mapping."""
        for assigned, pdo, entries in ((0x1C12, 0x1600, OUTPUTS), (0x1C13, 0x1A00, INPUTS)):
            words = [index << 16 | bits for index, bits in entries]
            for index, size, values in ((pdo, 4, words), (assigned, 2, [pdo])):
                yield struct.pack("<BHBI", 0x2F, index, 0, 0)
                for k, value in enumerate(values):
                    yield struct.pack("<BHBI", 0x2B if size == 2 else 0x23, index, k + 1, value)
                yield struct.pack("<BHBI", 0x2F, index, 0, len(values))

    def answer(self, station: int, sdo: bytes) -> bytes | None:
        """Of a slave to a write by SDO; None: it is not in the capture."""
        return b"\x60" + sdo[1:4] + bytes(4) if self.answers else None

    def datagrams(self) -> Iterable[tuple[int, int, bytes, bytes]]:
        """Command, address and data, out and back, of those that configure the bus."""
        for command, address, data in self.writes():
            yield command, address, data, data
            station, sdo = address & 0xFFFF, data[8:16]
            answer = self.answer(station, sdo) if address >> 16 == 0x1000 else None
            if answer is not None:
                abort = answer[0] == 0x80  # which CoE calls a request
                mail = struct.pack("<HHBBH", 10, 0, 0, 0x13, (2 if abort else 3) << 12) + answer
                yield FPRD, station | 0x1080 << 16, bytes(128), mail.ljust(128, b"\0")

    def start(self) -> list[Packet]:
        """The configuration, out and back."""
        packets, time_ns = [], BEGIN_NS - 10**9
        for index, (command, address, data, got) in enumerate(self.datagrams()):
            back = address
            if command == APWR:
                back = address & ~0xFFFF | ((address & 0xFFFF) + len(self.stations)) & 0xFFFF
            packets.append((time_ns, self.frame(True, [(command, address, data, 0)], index)))
            packets.append((time_ns + BACK_NS, self.frame(False, [(command, back, got, 1)], index)))
            time_ns += 100_000
        return packets

    def cycle(self, k: int) -> list[tuple[int, bytes, bytes]]:
        """Offset in ns in cycle k of each frame, out and back."""
        n, base = self.drives, 0x10000
        answers = n - (k in self.silent)
        reads = b"".join(
            (self.inputs(k, i) if i < answers else bytes(10)) + bytes(6) for i in range(n)
        )
        writes = b"".join(self.outputs(k, i) + bytes(8) for i in range(n))
        empty = bytes(len(reads))
        if self.image == "lrd_lwr":
            frames = [[(LRD, base, empty, reads, answers), (LWR, base, writes, writes, n)]]
        elif self.image == "lrw":
            out = b"".join(self.outputs(k, i) for i in range(n))
            given = b"".join(self.inputs(k, i) for i in range(n))
            frames = [[(LRW, base, out + bytes(10 * n), out + given, 3 * n)]]
        elif self.image == "overlap":
            frames = [[(LRW, base, writes, reads, 3 * n)]]
        else:
            frames = [[(LRD, base + 16 * i, bytes(10), self.inputs(k, i), 1)] for i in range(n)]
            frames.append([(LWR, base, writes, writes, n)])
        if self.clock:
            time = (CLOCK_NS + k * self.period_ns) % (1 << 8 * self.clock)
            data = time.to_bytes(self.clock, "little")
            first = (
                (FRMW, self.stations[0] | 0x910 << 16) if self.clock == 4 else (ARMW, 0x910 << 16)
            )
            frames[0].insert(0, (*first, bytes(self.clock), data, len(self.stations)))
        return [
            (
                20_000 * j,
                self.frame(
                    True, [(c, a, sent, 0) for c, a, sent, _, _ in frame], len(frames) * k + j
                ),
                self.frame(
                    False,
                    [(c, a, got, counter) for c, a, _, got, counter in frame],
                    len(frames) * k + j,
                ),
            )
            for j, frame in enumerate(frames)
        ]

    def process_bytes(self, frame: bytes) -> set[int]:
        """Which bytes of a frame are process data."""
        at, found = 16 + {"": 0, "vlan": 4, "udp": 28}[self.wrap], set[int]()
        while True:
            command, _, _, length, _ = struct.unpack_from("<BBIHH", frame, at)
            if command in (LRD, LWR, LRW):
                found |= set(range(at + 10, at + 10 + (length & 0x7FF)))
            at += 12 + (length & 0x7FF)
            if not length & 0x8000:
                return found

    def time_ns(self, k: int) -> int:
        return BEGIN_NS + k * self.period_ns

    def packets(self, cycles: int, *, start: bool = True) -> list[Packet]:
        """The whole capture."""
        found = self.start() if start else []
        for k in range(cycles):
            frames = self.cycle(k)
            found += [(self.time_ns(k) + at, out) for at, out, _ in frames]
            found += [
                (self.time_ns(k) + BACK_NS + len(frames) * 20_000 + at, back)
                for at, _, back in frames
            ]
        return found


def pcap(packets: list[Packet], *, order: str = "<", tick_ns: int = 1, snap: int = 2**16) -> bytes:
    magic = 0xA1B23C4D if tick_ns == 1 else 0xA1B2C3D4
    head = struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, snap, 1)
    return head + b"".join(record(packet, order, tick_ns, snap) for packet in packets)


def record(packet: Packet, order: str = "<", tick_ns: int = 1, snap: int = 2**16) -> bytes:
    time_ns, frame = packet
    head = struct.pack(
        f"{order}IIII",
        time_ns // 10**9,
        time_ns % 10**9 // tick_ns,
        min(snap, len(frame)),
        len(frame),
    )
    return head + frame[:snap]


def pcapng(packets: list[Packet], *, order: str = "<", resolution: int | None = 9) -> bytes:
    """`resolution`: option if_tsresol, None without it (microseconds)."""

    def block(kind: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        size = struct.pack(f"{order}I", len(body) + 12)
        return struct.pack(f"{order}I", kind) + size + body + size

    ticks = (
        10**6
        if resolution is None
        else 2 ** (resolution & 127)
        if resolution & 128
        else 10**resolution
    )
    option = b"" if resolution is None else struct.pack(f"{order}HHB3xHH", 9, 1, resolution, 0, 0)
    found = block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1))
    found += block(1, struct.pack(f"{order}HHI", 1, 0, 2**16) + option)
    for k, (time_ns, frame) in enumerate(packets):
        time = time_ns * ticks // 10**9
        head = struct.pack(f"{order}5I", 0, time >> 32, time & 0xFFFFFFFF, len(frame), len(frame))
        comment = struct.pack(f"{order}HH4sHH", 1, 4, b"note", 0, 0) if k % 7 == 0 else b""
        found += block(6, head + frame + bytes(-len(frame) % 4) + comment)
    return found
