"""A bus as frames and times, silent where it must be. Only this file and `can_logs` import python-can.

Network interfaces stay on this machine unless the description tells otherwise.
"""

import logging
import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from ..errors import AcquisitionError
from ..recording import ERROR, EXTENDED, FRAME, REMOTE, SENT, Block
from ..robot import BusFile

QUEUE_BYTES = 4 * 2**20  # of the kernel's receive queue; the usual 212992 hold 31 ms of a full bus
SHARED = ("socketcan", "udp_multicast", "virtual")  # interfaces that several programs (or bus objects) may open at once
ECHOING = ("gs_usb", "cantact")  # modules of python-can whose buses return every frame sent, as not received
_SILENT: dict[str, dict[str, Any]] = {"slcan": {"listen_only": True}}  # what makes an adapter not even acknowledge
_SO_MEMINFO, _DROPS = 55, 8  # of Linux: nine counters, the last one counts frames dropped before the socket
_SO_RCVBUFFORCE = 33
_CAN_FRAME = np.dtype([("can_id", "<u4"), ("length", "u1"), ("pad", "u1", (3,)), ("data", "u1", (8,))])
_TIMESPEC_BYTES = 16
DRAIN_S = 2.0  # at most, to take what the kernel still holds when a recording ends


# What python-can warns of would stand among our own lines; what matters is raised, and told in one of them.
logging.getLogger("can").addHandler(logging.NullHandler())


class Frame(NamedTuple):
    """A CAN frame; `flags` as in `blocks`."""

    time_ns: int
    can_id: int
    data: bytes
    flags: int = 0


Tap = Callable[[Frame], None]


class Link:
    """A bus in real time. Where `passive`, sending raises: nothing ever goes out.

    `tap` is handed every frame sent and received.
    """

    def __init__(self, bus: Any, *, passive: bool, tap: Tap | None = None) -> None:
        self._bus, self._passive, self._tap = bus, passive, tap
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        # A multicast group and some adapters give back what was sent: frames on their way back to us.
        echoes = _is_group(bus) or type(bus).__module__.split(".")[-1] in ECHOING
        self._own: deque[tuple[int, bytes]] | None = deque(maxlen=1000) if echoes else None

    def now_ns(self) -> int:
        """Time of this link, of events and deadlines: the clock's at its opening, and never set back or forth since."""
        return self._epoch_ns + time.monotonic_ns()

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame. Raises `AcquisitionError` where the link is passive or the bus does not take it."""
        if self._passive:
            _refuse_to_send()
        import can

        if self._own is not None:
            self._own.append((can_id, data))
        try:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False), timeout=0.05)
        except can.CanError as error:
            raise AcquisitionError(f"bus: frame 0x{can_id:03X} cannot be sent: {error}") from error
        if self._tap is not None:
            self._tap(Frame(self.now_ns(), can_id, data, SENT))

    def receive(self, until_ns: int) -> Frame | None:
        """The next frame, None when there is none until `until_ns`. Raises `AcquisitionError` when the bus is gone."""
        return self.take(max(0.0, (until_ns - self.now_ns()) * 1e-9))

    def take(self, timeout_s: float) -> Frame | None:
        """The next frame, None when there is none within `timeout_s`."""
        import can

        until_s = time.monotonic() + timeout_s
        while True:
            try:
                message = self._bus.recv(max(0.0, until_s - time.monotonic()))
            except (can.CanError, OSError) as error:
                if _is_no_frame(self._bus, error):
                    if time.monotonic() >= until_s:
                        return None
                    continue
                raise AcquisitionError(f"bus: cannot be read: {error}") from error
            if message is None:
                return None
            if getattr(message, "is_fd", False):
                continue
            sent = (message.arbitration_id, bytes(message.data))
            if not self._own or sent not in self._own or (message.is_rx and not _is_group(self._bus)):
                break
            self._own.remove(sent)
        frame = frame_of(message)
        if self._tap is not None:
            self._tap(frame)
        return frame

    def close(self) -> None:
        """Leave the bus, also one that is gone."""
        import can

        with suppress(can.CanError, OSError):
            self._bus.shutdown()


class LockStepLink(Link):
    """A link in simulated time on an in-process bus: time stands still until everyone has said what they have to say.

    `others(now_ns)` lets the other participants act and tells whether they did; `due_ns()` is when they act by themselves.
    """

    def __init__(
        self,
        bus: Any,
        others: Callable[[int], bool],
        due_ns: Callable[[], int | None],
        *,
        passive: bool,
        tap: Tap | None = None,
        start_ns: int = 1_000_000_000,
    ) -> None:
        super().__init__(bus, passive=passive, tap=tap)
        self._others, self._due_ns, self._time_ns = others, due_ns, start_ns

    def now_ns(self) -> int:
        """Simulated time."""
        return self._time_ns

    def receive(self, until_ns: int) -> Frame | None:
        """As `Link.receive`; simulated time goes on only when nobody has anything to say."""
        while True:
            frame = self.take(0)
            if frame is not None:
                return frame
            if self._others(self._time_ns):
                continue
            due = self._due_ns()
            if self._time_ns >= until_ns:
                return None
            self._time_ns = until_ns if due is None else max(min(until_ns, due), self._time_ns + 1)

    def take(self, timeout_s: float) -> Frame | None:
        """The next frame, with the simulated time."""
        tap, self._tap = self._tap, None
        frame = super().take(0)
        self._tap = tap
        if frame is not None:
            frame = frame._replace(time_ns=self._time_ns)
            if tap is not None:
                tap(frame)
        return frame


def _refuse_to_send(*_: object, **__: object) -> None:
    raise AcquisitionError("bus: passive: nothing is ever sent: expected an active session for that")


def _is_group(bus: Any) -> bool:
    return getattr(bus, "_multicast", None) is not None


def _is_no_frame(bus: Any, error: Exception) -> bool:
    """Whether an error of reading is about a datagram that is no frame, which anyone may send to a group."""
    import can

    failed = isinstance(error.__cause__, OSError)  # of the socket itself
    return isinstance(error, can.CanOperationError) and _is_group(bus) and not failed


def open_bus(file: BusFile, *, passive: bool) -> Any:
    """python-can's bus object for a description; where `passive`, one that cannot send.

    Raises `AcquisitionError` when it cannot be opened.
    """
    import can

    options: dict[str, Any] = {"interface": file.interface, "channel": file.channel, "ignore_config": True}
    if file.interface in ("socketcan", "virtual", "udp_multicast"):
        if file.interface == "udp_multicast":
            # A hop limit of 0 keeps every frame on this machine.
            options |= {"hop_limit": 0 if file.loopback else 1, "fd": False}
            group, _, port = file.channel.partition(":")
            options |= {"channel": group} | ({"port": int(port)} if port.isdigit() else {})
    else:
        options["bitrate"] = file.bitrate
    if passive:
        options |= _SILENT.get(file.interface, {})
    try:
        bus = can.Bus(**options)
    except (can.CanError, OSError, ValueError, TypeError, ImportError, NotImplementedError) as error:
        told = str(error) or type(error).__name__
        raise AcquisitionError(f"bus: {file.interface} {file.channel}: cannot be opened: {told}") from error
    if file.interface == "udp_multicast" and file.loopback:
        _stay_on_loopback(bus, file)
    if passive:
        for name in ("send", "send_periodic"):
            setattr(bus, name, _refuse_to_send)
    sock = socket_of(bus)
    if sock is not None:
        _enlarge_queue(sock)
    return bus


def open_link(file: BusFile, *, passive: bool, tap: Tap | None = None) -> Link:
    """A link in real time."""
    return Link(open_bus(file, passive=passive), passive=passive, tap=tap)


def _stay_on_loopback(bus: Any, file: BusFile) -> None:
    """Multicast by the loopback interface only: neither sent to nor taken from the network."""
    sock, group = socket_of(bus), file.channel.partition(":")[0]
    if sock is None or sock.family != socket.AF_INET:
        return  # an IPv6 group: the hop limit alone keeps frames here
    here = socket.inet_aton("127.0.0.1")
    try:
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, here)
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group) + here)
    except OSError:
        return  # loopback is the group's interface already
    try:
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_DROP_MEMBERSHIP, socket.inet_aton(group) + bytes(4))
    except OSError:
        return  # it never was joined elsewhere


def socket_of(bus: Any) -> socket.socket | None:
    """The socket under a bus, where there is one."""
    found = getattr(bus, "socket", None) or getattr(getattr(bus, "_multicast", None), "_socket", None)
    return found if isinstance(found, socket.socket) else None


def _enlarge_queue(sock: socket.socket) -> None:
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, QUEUE_BYTES)
    if sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) < QUEUE_BYTES:
        try:  # past net.core.rmem_max, where we may
            sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, QUEUE_BYTES)
        except OSError:
            return


def queue_bytes(sock: socket.socket) -> int:
    """Size of the kernel's receive queue as granted."""
    return sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)


def kernel_drops(sock: socket.socket | None) -> int:
    """Frames that the kernel dropped because the queue was full; 0 where there is no socket to ask."""
    if sock is None:
        return 0
    try:
        return int(struct.unpack("9I", sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 36))[_DROPS])
    except (OSError, struct.error):
        return 0


class Receiver:
    """Takes frames off a bus and only appends them: `run` in a thread, `take` what came since in another.

    A socket of the kernel's CAN is read directly, which costs a third of python-can's messages.
    """

    def __init__(self, bus: Any, *, raw_socket: socket.socket | None = None) -> None:
        self._bus, self._items = bus, deque[Any]()
        self._raw = raw_socket
        self.sock = raw_socket or socket_of(bus)
        self.stopped = False
        self.error: str | None = None
        if raw_socket is None and self.sock is not None and getattr(bus, "socket", None) is self.sock:
            self._raw = self.sock

    def run(self) -> None:
        """Until `stopped` and what had arrived is taken; an error of the bus ends it and stands in `error`."""
        try:
            if self._raw is None:
                self._run_messages()
            else:
                self._run_raw(self._raw)
        except Exception as error:  # whatever it is, who reads must be told
            self.error = str(error) or type(error).__name__

    def _run_raw(self, sock: socket.socket) -> None:
        sock.setblocking(True)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", 0, 100_000))
        size, receive = socket.CMSG_SPACE(_TIMESPEC_BYTES), sock.recvmsg
        while not self.stopped:
            try:
                self._items.append(receive(72, size)[:3])
            except (BlockingIOError, InterruptedError):
                continue
        until_s = time.monotonic() + DRAIN_S
        with suppress(BlockingIOError):  # the queue is empty
            while time.monotonic() < until_s:
                self._items.append(receive(72, size, socket.MSG_DONTWAIT)[:3])

    def _run_messages(self) -> None:
        import can

        until_s = None
        while until_s is None or time.monotonic() < until_s:
            if self.stopped and until_s is None:
                until_s = time.monotonic() + DRAIN_S
            try:
                message = self._bus.recv(0.1 if until_s is None else 0.0)
            except can.CanOperationError as error:
                if not _is_no_frame(self._bus, error):
                    raise
                continue
            if message is not None:
                self._items.append(message)
            elif until_s is not None:
                return

    def take(self) -> Block:
        """Frames received since the last call, in order."""
        items = [self._items.popleft() for _ in range(len(self._items))]
        if not items:
            return np.zeros(0, FRAME)
        if self._raw is not None:
            return _block_of_raw(items)
        return block_of([frame_of(m) for m in items if not getattr(m, "is_fd", False)])


def _block_of_raw(items: list[Any]) -> Block:
    items = [item for item in items if len(item[0]) == _CAN_FRAME.itemsize and item[1]]
    raw = np.frombuffer(b"".join(item[0] for item in items), _CAN_FRAME)
    stamps = np.frombuffer(b"".join(item[1][0][2] for item in items), "<i8").reshape(-1, 2)
    block = np.zeros(len(raw), FRAME)
    block["time_ns"] = stamps[:, 0] * 1_000_000_000 + stamps[:, 1]
    word = raw["can_id"]
    extended = (word & 0x80000000) != 0
    block["can_id"] = np.where(extended, word & 0x1FFFFFFF, word & 0x7FF)
    ours = np.array([item[2] & socket.MSG_DONTROUTE for item in items]) != 0  # made on this machine
    block["flags"] = (
        extended * EXTENDED | ((word & 0x40000000) != 0) * REMOTE | ((word & 0x20000000) != 0) * ERROR | ours * SENT
    )
    block["length"] = np.minimum(raw["length"], 8)
    block["data"] = raw["data"] * (np.arange(8) < block["length"][:, None])
    return block


def block_of(frames: list[Frame]) -> Block:
    """Rows of `FRAME`."""
    block = np.zeros(len(frames), FRAME)
    if frames:
        block["time_ns"] = [f.time_ns for f in frames]
        block["can_id"] = [f.can_id for f in frames]
        block["flags"] = [f.flags for f in frames]
        block["length"] = [len(f.data) for f in frames]
        block["data"] = np.frombuffer(b"".join(f.data.ljust(8, b"\0") for f in frames), np.uint8).reshape(-1, 8)
    return block


def frame_of(message: Any) -> Frame:
    """A message of python-can as a frame."""
    flags = (
        (EXTENDED if message.is_extended_id and not message.is_error_frame else 0)
        | (ERROR if message.is_error_frame else 0)
        | (REMOTE if message.is_remote_frame else 0)
        | (0 if message.is_rx else SENT)
    )
    return Frame(round(message.timestamp * 1e9), message.arbitration_id, bytes(message.data)[:8], flags)
