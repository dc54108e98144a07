"""Frames on their way from the kernel, from python-can and from logs into rows,
and what a link lets out.
"""

import socket
import struct
from types import SimpleNamespace

import can
import numpy as np
import pytest
from made_up_buses import bus_text, robot_of

from acquisition.bus import (
    Frame,
    Link,
    Receiver,
    WallClock,
    block_of,
    describe_step,
    links,
    open_bus,
)
from acquisition.errors import BusFaultError, RefusedError
from acquisition.recording import (
    CAN_FD,
    ERROR,
    EXTENDED,
    FRAME,
    REMOTE_REQUEST,
    SENT,
    overview,
    read_recording,
)
from acquisition.robot import BusFile, DriveFile
from acquisition.session import Recorder


def test_frame_row_bytes():
    """The layout that recordings hold: time, identifier, length, flags, data,
    little-endian, without gaps.
    """
    block = block_of([Frame(0x0102030405060708, 0x185, bytes.fromhex("3712FB"), SENT | EXTENDED)])
    assert (
        block.tobytes().hex(" ")
        == "08 07 06 05 04 03 02 01 85 01 00 00 03 03 37 12 fb 00 00 00 00 00"
    )
    assert (SENT, EXTENDED, ERROR, REMOTE_REQUEST, CAN_FD) == (1, 2, 4, 8, 16)
    assert len(block_of([])) == 0
    assert block_of([]).dtype == FRAME


# The kernel's frames (struct can_frame of linux/can.h): identifier and flags,
# length, three bytes, data

MESSAGES = [
    ("85 01 00 00 08 00 00 00 37 12 FB FF FF FF D4 FE", (1, 2), 0,
     (1_000_000_002, 0x185, 8, 0, "3712FBFFFFFFD4FE")),
    ("80 00 00 00 00 00 00 00 AA 00 00 00 00 00 00 00", (3, 0), 4,
     (3_000_000_000, 0x080, 0, SENT, "")),
    ("78 56 34 92 01 00 00 00 01 00 00 00 00 00 00 00", (4, 0), 0,
     (4_000_000_000, 0x12345678, 1, EXTENDED, "01")),
    ("85 01 00 40 08 00 00 00 00 00 00 00 00 00 00 00", (5, 0), 0,
     (5_000_000_000, 0x185, 8, REMOTE_REQUEST, "00" * 8)),
    ("04 00 00 20 08 00 00 00 00 10 00 00 00 00 00 00", (6, 0), 0,
     (6_000_000_000, 4, 8, ERROR, "0010" + "00" * 6)),
    ("FF 0F 00 00 0F 00 00 00 01 02 03 04 05 06 07 08", (7, 0), 0,
     (7_000_000_000, 0x7FF, 8, 0, "0102030405060708")),
]  # fmt: skip


def raising(error: Exception):
    def fail(*_: object, **__: object) -> None:
        raise error

    return fail


class KernelSocket(socket.socket):
    """What `recvmsg` gives, then nothing more; it is told to stop before the last three."""

    def __init__(self, messages, receiver_of) -> None:
        super().__init__()
        self.messages, self.receiver_of = list(messages), receiver_of

    def setblocking(self, flag: bool) -> None:
        assert flag

    def setsockopt(self, *option) -> None:
        pass

    def recvmsg(self, size, ancillary, flags=0):
        assert size >= 16
        assert ancillary >= socket.CMSG_SPACE(16)
        if self.messages and isinstance(self.messages[0], OSError):
            raise self.messages[0]
        # the last ones are taken on the way out
        self.receiver_of().stopped |= len(self.messages) <= 3
        if not self.messages:
            raise BlockingIOError
        return self.messages.pop(0)


def test_kernel_frames():
    """Identifier, flags and time by hand; beyond the length there are zeros, whatever
    the kernel left there.
    """
    raw = [
        (bytes.fromhex(text), [(socket.SOL_SOCKET, 35, struct.pack("qq", *stamp))], flags, None)
        for text, stamp, flags, _ in MESSAGES
    ]
    # of CAN FD
    too_long = (bytes.fromhex("86 01 00 00 40 01 00 00") + bytes(range(64)), raw[0][1], 0, None)
    without_time = (raw[0][0], [], 0, None)
    sock = KernelSocket([too_long, *raw[:4], without_time, *raw[4:]], lambda: receiver)
    receiver = Receiver(SimpleNamespace(socket=sock))
    receiver.run()
    assert receiver.error is None
    block = receiver.take()
    found = [
        (
            int(r["time_ns"]),
            int(r["can_id"]),
            int(r["length"]),
            int(r["flags"]),
            r["data"].tobytes().hex().upper(),
        )
        for r in block
    ]
    assert found.pop(0) == (1_000_000_002, 0x186, 8, CAN_FD, "0001020304050607")
    assert found == [(*row[:4], row[4].ljust(16, "0")) for _, _, _, row in MESSAGES]
    assert len(receiver.take()) == 0


class FakeBus:
    """As python-can's: hands out messages and raises errors, keeps what is sent."""

    def __init__(self, *messages: can.Message | Exception) -> None:
        self.messages, self.sent, self.ended = list(messages), [], False

    def recv(self, timeout):
        message = self.messages.pop(0) if self.messages else None
        if isinstance(message, Exception):
            raise message
        return message

    def send(self, message, timeout=None) -> None:
        self.sent.append((message.arbitration_id, bytes(message.data), message.is_extended_id))

    def shutdown(self) -> None:
        self.ended = True


def message(
    can_id: int = 0x185, data: bytes = b"\1\2", time_s: float = 1.5, **kind: bool
) -> can.Message:
    return can.Message(
        timestamp=time_s, arbitration_id=can_id, data=data, **({"is_extended_id": False} | kind)
    )


FRAMES = [
    (message(time_s=1700000000.123456), Frame(1700000000123456001, 0x185, b"\1\2", 0)),
    (message(0x12345678, is_extended_id=True), Frame(1_500_000_000, 0x12345678, b"\1\2", EXTENDED)),
    (message(4, bytes(8), is_error_frame=True), Frame(1_500_000_000, 4, bytes(8), ERROR)),
    (message(0x185, b"", is_remote_frame=True), Frame(1_500_000_000, 0x185, b"", REMOTE_REQUEST)),
    (message(0x80, b"", is_rx=False), Frame(1_500_000_000, 0x80, b"", SENT)),
]


@pytest.mark.parametrize(("given", "expected"), FRAMES)
def test_python_can_frames(given, expected):
    tapped: list[Frame] = []
    frame = Link(FakeBus(given), tap=tapped.append).take(0)
    assert frame[1:] == expected[1:]
    # a double holds no more of such a time
    assert frame.time_ns == pytest.approx(expected.time_ns, abs=200)
    assert tapped == [frame]


@pytest.mark.parametrize(
    ("bus", "told"),
    [
        (FakeBus(can.CanOperationError("adapter gone")), "adapter gone"),
        (
            SimpleNamespace(socket=KernelSocket([OSError(19, "No such device")], None)),
            "[Errno 19] No such device",
        ),
    ],
)
def test_receiver_ends_with_bus_and_reason(bus, told):
    receiver = Receiver(bus)
    receiver.run()
    assert receiver.error == told


@pytest.mark.parametrize("fd", [0, 3])
def test_can_fd_is_counted_not_recorded(tmp_path, fd):
    robot = robot_of(bus_text(1))
    recorder = Recorder(tmp_path / "a.mcap", robot, source="test", place="robot.toml")
    recorder.add(block_of([Frame(k, 0x185, bytes(8), CAN_FD if k < fd else 0) for k in range(5)]))
    found = recorder.finish(10)
    recording, text = read_recording(tmp_path / "a.mcap"), f"frames not recorded: {fd} of CAN FD"
    assert found.frames == len(recording.frames["test"]) == 5 - fd
    assert not recording.frames["test"]["flags"].any()
    assert found.warnings == ((text,) if fd else ())
    assert [
        event.text for event in overview(recording)["events"] if "CAN FD" in event.text
    ] == list(found.warnings)


def test_receiver_keeps_order_and_marks_can_fd():
    fake = FakeBus(*(given for given, _ in FRAMES), message(data=bytes(12), is_fd=True))
    receiver = Receiver(fake)
    receiver.stopped = True  # what has arrived is still taken
    receiver.run()
    assert receiver.error is None
    block = receiver.take()
    assert block["can_id"].tolist() == [*(frame.can_id for _, frame in FRAMES), 0x185]
    assert block["flags"].tolist() == [*(frame.flags for _, frame in FRAMES), CAN_FD]
    assert len(receiver.take()) == 0


def test_link_sends_frames():
    fake, tapped = FakeBus(), []
    link = Link(fake, tap=tapped.append)
    link.send(0x605, b"\x40\x41\x60\0\0\0\0\0")
    assert fake.sent == [(0x605, b"\x40\x41\x60\0\0\0\0\0", False)]
    assert [frame[1:] for frame in tapped] == [(0x605, b"\x40\x41\x60\0\0\0\0\0", SENT)]
    assert abs(tapped[0].time_ns - link.now_ns()) < 10e9
    link.close()
    assert fake.ended
    fake.shutdown = raising(can.CanOperationError("the adapter is gone"))
    link.close()  # it is left


def test_link_errors_are_reported_not_recorded():
    fake, tapped = FakeBus(OSError("gone")), []
    fake.send = raising(can.CanOperationError("buffer full"))
    link = Link(fake, tap=tapped.append)
    with pytest.raises(BusFaultError, match="bus: frame 0x605 cannot be sent: buffer full"):
        link.send(0x605, b"")
    with pytest.raises(BusFaultError, match="bus: reading failed: gone"):
        link.take(0)
    assert tapped == []


def group(*messages: can.Message | Exception) -> FakeBus:
    fake = FakeBus(*messages)
    fake._multicast = SimpleNamespace(_socket=None)
    return fake


def test_invalid_datagram_is_ignored_on_multicast():
    datagram, broken = can.CanOperationError("no frame"), can.CanOperationError("failed to wait")
    broken.__cause__ = OSError(19, "No such device")
    assert Link(group(datagram, message())).take(0.1).can_id == 0x185
    for fake, why in ((FakeBus(datagram), "no frame"), (group(broken), "failed to wait")):
        with pytest.raises(BusFaultError, match=f"bus: reading failed: {why}"):
            Link(fake).take(0.01)
    noisy = group()
    noisy.messages = SimpleNamespace(pop=lambda _: datagram)  # again and again
    assert Link(noisy).take(0.01) is None


def test_adapter_echo_is_not_received(monkeypatch):
    """As gs_usb does, marked as not received.

    What others send from this machine may be marked so too, and stays.
    """
    monkeypatch.setattr(FakeBus, "__module__", "can.interfaces.gs_usb")
    fake = FakeBus()
    link = Link(fake)
    link.send(0x80, b"")
    fake.messages.append(message(0x80, b"", is_rx=False))
    assert link.take(0.0) is None
    link.send(0x81, b"")
    fake.messages += [message(0x81, b""), message(0x81, b"", is_rx=False)]
    assert link.take(0.0).can_id == 0x81  # somebody else's
    assert link.take(0.0) is None


def test_multicast_echo_is_dropped_once():
    """A multicast group returns what was sent; the same bytes from somebody else, later, are
    a frame like any other.
    """
    heard = (
        message(0x80, b""),
        message(data=bytes(12), is_fd=True),
        message(0x185),
        message(0x80, b""),
    )
    # one gives nothing back
    for bus, ids in ((group(*heard), [0x185, 0x80]), (FakeBus(*heard), [0x80, 0x185, 0x80])):
        tapped: list[Frame] = []
        link = Link(bus, tap=tapped.append)
        link.send(0x80, b"")
        assert [link.take(1.0).can_id for _ in ids] == ids
        assert link.take(0) is None
        assert [(frame.can_id, frame.flags) for frame in tapped if frame.flags & CAN_FD] == [
            (0x185, CAN_FD)
        ]


def test_kernel_drop_count():
    """SO_MEMINFO: nine counters, the last one of drops; option 55 of SOL_SOCKET."""
    sock = SimpleNamespace(
        getsockopt=lambda *option: (
            struct.pack("9I", *range(10, 19)) if option == (1, 55, 36) else b""
        )
    )
    assert links.kernel_drops(sock) == 18
    assert links.kernel_drops(None) == 0
    assert links.kernel_drops(SimpleNamespace(getsockopt=lambda *_: b"")) == 0


def bus_file(**keys) -> BusFile:
    drive = DriveFile(node=1, reference="6074", counts_per_turn=1.0)
    return BusFile(
        **(
            {"interface": "socketcan", "channel": "can0", "drive": (drive,), "sync_period_s": 0.002}
            | keys
        )
    )


@pytest.mark.parametrize(
    ("keys", "passive", "expected"),
    [
        ({}, False, {"channel": "can0", "fd": True}),
        ({"interface": "pcan", "bitrate": 500_000}, False, {"channel": "can0", "bitrate": 500_000}),
        ({"interface": "slcan"}, False, {"channel": "can0", "bitrate": 1_000_000}),
        ({"interface": "slcan"}, True, {"channel": "can0", "bitrate": 1_000_000,
                                        "listen_only": True}),
        ({"interface": "gs_usb", "channel": "1"}, True, {"channel": 1, "bitrate": 1_000_000}),
        ({"interface": "udp_multicast", "channel": "239.1.2.3:4321"}, False,
         {"channel": "239.1.2.3", "port": 4321, "hop_limit": 0, "fd": False}),
        ({"interface": "udp_multicast", "channel": "239.1.2.3", "loopback": False}, False,
         {"channel": "239.1.2.3", "hop_limit": 1, "fd": False}),
    ],
)  # fmt: skip
def test_bus_opening(monkeypatch, keys, passive, expected):
    asked = []
    monkeypatch.setattr(can, "Bus", lambda **options: asked.append(options) or FakeBus())
    bus = open_bus(bus_file(**keys), passive=passive)
    (options,) = asked
    assert (
        options
        == {"interface": keys.get("interface", "socketcan"), "ignore_config": True} | expected
    )
    if not passive:
        bus.send(message())
        return
    for send in (bus.send, bus.send_periodic, Link(bus).send):
        with pytest.raises(RefusedError, match="passive") as caught:
            send(0x80, b"")
        assert (caught.value.place, caught.value.what) == ("bus", "sending")


def test_receive_queue_is_enlarged_if_permitted():
    for granted, forced in ((212_992, [(1, 33, 4 * 2**20)]), (8 * 2**20, [])):  # SO_RCVBUFFORCE
        asked = []
        sock = SimpleNamespace(
            setsockopt=lambda *option, a=asked: a.append(option), getsockopt=lambda *_, g=granted: g
        )
        links.request_queue_size(sock)
        assert asked == [(1, 8, 4 * 2**20), *forced]  # SO_RCVBUF
        assert links.queue_bytes(sock) == granted


def test_socket_of_kernel_and_multicast_bus():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        assert links.socket_of(SimpleNamespace(socket=sock)) is sock
        assert links.socket_of(SimpleNamespace(_multicast=SimpleNamespace(_socket=sock))) is sock
        file = bus_file(interface="udp_multicast", channel="239.1.2.3:4321")
        links.stay_on_loopback(SimpleNamespace(_multicast=SimpleNamespace(_socket=sock)), file)
        assert (
            socket.inet_ntoa(sock.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, 4))
            == "127.0.0.1"
        )
    assert links.socket_of(SimpleNamespace(socket="of another kind")) is None
    assert links.socket_of(SimpleNamespace()) is None


@pytest.mark.parametrize("step_ns", [3_600_000_000_000, 60_000_000, -60_000_000])
@pytest.mark.parametrize("seen_after", [0, 3])
def test_times_continue_after_clock_step(step_ns, seen_after):
    """Frames 2 ms apart, block by block; that the clock was set is noticed with the first new
    stamp, or a block before.
    """
    now, wall = [0], [0]
    clock = WallClock(lambda: now[0] + wall[0], lambda: now[0], offset_ns=0)
    true_ns, found = 10**9 + 2_000_000 * np.arange(500), []
    blocks = np.split(true_ns, [50, 100, 130 + seen_after, 200, 300, 400])
    for block in blocks:
        now[0] = int(block[-1])
        wall[0] = step_ns if now[0] >= true_ns[130] else 0
        assert clock.step_ns() == (step_ns if now[0] == blocks[2 if seen_after else 3][-1] else 0)
        found.append(clock.continued(block + step_ns * (block >= true_ns[130 + seen_after])))
    assert np.concatenate(found).tolist() == true_ns.tolist()
    assert clock.shift_ns == step_ns


@pytest.mark.parametrize("step_ns", [3_600_000_000_000, -3_600_000_000_000, -60_000_000])
def test_times_continue_after_step_in_first_block(step_ns):
    true_ns, wall = 10**13 + 2_000_000 * np.arange(6), [0]
    clock = WallClock(lambda: int(true_ns[-1]) + wall[0], lambda: int(true_ns[-1]), offset_ns=0)
    wall[0] = step_ns
    assert clock.step_ns() == step_ns
    assert clock.continued(true_ns + step_ns * (np.arange(6) >= 2)).tolist() == true_ns.tolist()


@pytest.mark.parametrize("step_ns", [3_600_000_000_000, 60_000_000, -60_000_000])
def test_times_continue_after_step_before_frames(step_ns):
    true_ns, wall = 10**9 + 2_000_000 * np.arange(100), [0]
    clock = WallClock(lambda: 10**9 + wall[0], lambda: 10**9, offset_ns=0)
    wall[0] = step_ns
    assert clock.step_ns() == step_ns
    found = [clock.continued(part + step_ns) for part in np.split(true_ns, [50])]
    assert np.concatenate(found).tolist() == true_ns.tolist()


def test_adapter_clock_is_kept():
    wall = [0]
    clock = WallClock(lambda: wall[0], lambda: 0, offset_ns=0)
    clock.continued(np.array([1, 2]))
    wall[0] = 100_000_000
    clock.step_ns()
    for first in (3, 5, 7):
        assert clock.continued(np.array([first, first + 1])).tolist() == [first, first + 1]
    assert clock.continued(np.array([90_000_000])).tolist() == [90_000_000]  # a pause


def test_clock_step_is_detected():
    wall, monotonic, found, hour_ns = [1_000_000_000], [5_000_000_000], [], 3_600_000_000_000
    clock = WallClock(lambda: wall[0], lambda: monotonic[0])
    for elapsed_ns, by_ns in (
        (500_000_000, 0),
        (500_000_000, 10_000_000),
        (100, hour_ns),
        (100, -50_000_000),
    ):
        wall[0] += elapsed_ns + by_ns
        monotonic[0] += elapsed_ns
        found.append(clock.step_ns())
    assert found == [0, 0, hour_ns, -50_000_000]
    assert clock.now_ns() == 2_000_000_200  # as if it had never been set
    assert describe_step(found[2]) == "the clock was set forward by 3.6e+03 s"
    assert describe_step(found[3]) == "the clock was set back by 0.05 s"
