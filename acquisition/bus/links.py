"""A bus as frames and times, opened according to the description.

A passive link never sends, and its adapter only listens if python-can supports that. Multicast
stays on this computer unless the description allows more.
"""

import logging
import re
import socket
import struct
import subprocess
import time
from collections import deque
from contextlib import suppress
from typing import Any, Protocol

from ..errors import BusFaultError, RefusedError
from ..recording import CAN_FD, SENT
from ..robot import BusFile
from .frames import Frame, Tap, frame_of

# Size of the kernel's receive queue. The default of 212992 holds only 31 ms of a full bus.
QUEUE_BYTES = 4 * 2**20

# Constants of Linux. The last of SO_MEMINFO's nine counters counts the dropped frames.
_SO_RCVBUFFORCE, _SO_MEMINFO, _DROPS = 33, 55, 8


def stay_on_loopback(bus: Any, file: BusFile) -> None:
    """Restrict multicast to the loopback interface."""
    sock, group = socket_of(bus), file.channel.partition(":")[0]
    if sock is None or sock.family != socket.AF_INET:
        # The group is an IPv6 group, for which the hop limit keeps frames here.
        return
    here = socket.inet_aton("127.0.0.1")
    # The second option fails if the group uses the loopback interface already, and the third if the
    # group was not joined on another interface. Neither does harm.
    with suppress(OSError):
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, here)
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group) + here)
        sock.setsockopt(
            socket.IPPROTO_IP, socket.IP_DROP_MEMBERSHIP, socket.inet_aton(group) + bytes(4)
        )


def socket_of(bus: Any) -> socket.socket | None:
    """Return the socket of a python-can bus; None if it has none."""
    found = getattr(bus, "socket", None) or getattr(
        getattr(bus, "_multicast", None), "_socket", None
    )
    return found if isinstance(found, socket.socket) else None


def request_queue_size(sock: socket.socket) -> None:
    """Request a receive queue of `QUEUE_BYTES`. The kernel may grant less."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, QUEUE_BYTES)
    if queue_bytes(sock) < QUEUE_BYTES:
        # This exceeds net.core.rmem_max, if the system permits it.
        with suppress(OSError):
            sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, QUEUE_BYTES)


def queue_bytes(sock: socket.socket) -> int:
    """Return the granted size of the receive queue in bytes."""
    return sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)


def kernel_drops(sock: socket.socket | None) -> int:
    """Return how many frames the kernel dropped because the queue was full; 0 without a socket."""
    if sock is None:
        return 0
    try:
        return int(struct.unpack("9I", sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 36))[_DROPS])
    except (OSError, struct.error):
        return 0


# Several programs (or bus objects) may open these interfaces at once.
SHARED = ("socketcan", "udp_multicast", "virtual")

# Warnings of python-can are not printed, because its errors are raised and reported in one line.
logging.getLogger("can").addHandler(logging.NullHandler())


def refuse_to_send(*_: object, **__: object) -> None:
    """Raise `RefusedError`. This replaces the sending functions of a passive bus."""
    raise RefusedError(
        "a passive session never sends",
        what="sending",
        place="bus",
    )


# Arguments of python-can with which an adapter only listens. Other adapters acknowledge all frames.
LISTEN_ONLY: dict[str, dict[str, Any]] = {
    "slcan": {"listen_only": True},
    "pcan": {"state": "PASSIVE"},  # of can.BusState
    "kvaser": {"driver_mode": False},  # silent
    "cantact": {"monitor": True},
    "seeedstudio": {"operation_mode": "silent"},
}


def listening_words(file: BusFile) -> str:
    """Describe whether a passive recording acknowledges the frames of others, and the consequence.

    The text is empty without hardware.
    """
    listens, verb, way_out = (
        file.interface in LISTEN_ONLY,
        "acknowledges",
        "python-can has no listen-only mode for it",
    )
    if file.interface in ("virtual", "udp_multicast"):
        return ""
    if file.interface == "socketcan":
        shown = ""
        with suppress(OSError, subprocess.SubprocessError):
            shown = subprocess.run(
                ["ip", "-details", "link", "show", "dev", file.channel],
                capture_output=True,
                text=True,
                timeout=5,
            ).stdout
        if re.search(r"(?m)^\s+vx?can ", shown):
            return ""
        listens, verb = (
            bool(re.search(r"\bcan <[^>]*LISTEN-ONLY", shown)),
            verb if shown else "may acknowledge",
        )
        way_out = (
            f"to prevent this, run while it is down: ip link set {file.channel} type can bitrate "
            f"{file.bitrate} listen-only on"
        )
    return f"{file.interface} {file.channel} " + (
        "only listens: a drive that is alone on the bus gets no acknowledgement and repeats frames"
        if listens
        else f"{verb} all frames, and destroys frames if its bit rate is wrong; {way_out}"
    )


def refuse_unconfirmed(bus: Any, place: str) -> None:
    """Check that a PCAN adapter, the only one that reports it, only listens.

    Raises
    ------
    RefusedError : it does not confirm this.
    """
    if (driver := getattr(bus, "m_objPCANBasic", None)) is not None:
        from can.interfaces.pcan.basic import PCAN_ERROR_OK, PCAN_LISTEN_ONLY

        if driver.GetValue(bus.m_PcanHandle, PCAN_LISTEN_ONLY) != (PCAN_ERROR_OK, 1):
            bus.shutdown()
            raise RefusedError(
                "the adapter does not confirm that it only listens",
                what="recording",
                place=place,
                advice="Close other programs that use it, or use an adapter and driver that can",
            )


def is_group(bus: Any) -> bool:
    """Test whether a bus is a multicast group, which returns every frame sent."""
    return getattr(bus, "_multicast", None) is not None


def is_no_frame(bus: Any, error: Exception) -> bool:
    """Test whether reading failed at a datagram that is not a frame.

    Any program may send such datagrams to a multicast group.
    """
    import can

    return (
        isinstance(error, can.CanOperationError)
        and is_group(bus)
        # An OSError is an error of the socket itself.
        and not isinstance(error.__cause__, OSError)
    )


def open_bus(file: BusFile, *, passive: bool) -> Any:
    """Open the python-can bus of a description.

    Parameters
    ----------
    file : the description of the bus.
    passive : True for a bus that cannot send; adapters of `LISTEN_ONLY` only listen then.

    Raises
    ------
    BusFaultError : the bus cannot be opened.
    RefusedError : an adapter does not confirm that it only listens.
    """
    import can

    place = f"bus: {file.interface} {file.channel}"
    options: dict[str, Any] = {
        "interface": file.interface,
        "channel": file.channel,
        "ignore_config": True,
    }
    match file.interface:
        case "udp_multicast":
            group, _, port = file.channel.partition(":")
            # A hop limit of 0 keeps every frame on this machine.
            options |= {"hop_limit": 0 if file.loopback else 1, "fd": False, "channel": group}
            options |= {"port": int(port)} if port.isdigit() else {}
        case "socketcan":
            # Frames of CAN FD are received too, so that they can be counted.
            options["fd"] = True
        case adapter if adapter not in SHARED:
            if adapter == "gs_usb" and file.channel.isdigit():
                # The channel is the number of the device, which python-can accepts only as int.
                options["channel"] = int(file.channel)
            options |= {"bitrate": file.bitrate} | (LISTEN_ONLY.get(adapter, {}) if passive else {})
    if "state" in options:
        options["state"] = can.BusState[options["state"]]
    try:
        bus = can.Bus(**options)
    except (
        can.CanError,
        OSError,
        ValueError,
        TypeError,
        ImportError,
        NotImplementedError,
    ) as error:
        raise BusFaultError(
            f"the bus cannot be opened: {str(error) or type(error).__name__}",
            place=place,
            advice=(
                "Run `modprobe can_raw`, find the channel with `ip link`, or use another interface"
                if file.interface == "socketcan"
                else ""
            ),
        ) from error
    if file.interface == "udp_multicast" and file.loopback:
        stay_on_loopback(bus, file)
    if passive:
        refuse_unconfirmed(bus, place)
        bus.send = bus.send_periodic = refuse_to_send
    if (sock := socket_of(bus)) is not None:
        request_queue_size(sock)
    return bus


# Modules of python-can whose buses return every frame sent, marked as not received.
ECHOING = ("gs_usb", "cantact")


class MasterLink(Protocol):
    """The link of a master: its time, sending and receiving."""

    def now_ns(self) -> int:
        """Return the time of this link in ns, which its events and deadlines use."""

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame.

        Raises
        ------
        BusFaultError : the bus does not accept it.
        """

    def receive(self, until_ns: int) -> Frame | None:
        """Return the next frame; None if there is none until `until_ns`.

        Raises
        ------
        BusFaultError : the bus fails.
        """


class Link:
    """A bus in real time.

    `tap` is called with every frame that is sent or received.
    """

    def __init__(self, bus: Any, *, tap: Tap | None = None) -> None:
        self._bus = bus
        self._tap: Tap = tap or (lambda frame: None)
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        # A multicast group and some adapters return the frames that were sent. They are dropped.
        echoes = is_group(bus) or type(bus).__module__.split(".")[-1] in ECHOING
        self._own = deque[tuple[int, bytes]](maxlen=1000 if echoes else 0)

    def now_ns(self) -> int:
        """Return the time of this link in ns.

        It is the wall clock at opening, continued by the monotonic clock.
        """
        return self._epoch_ns + time.monotonic_ns()

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame.

        Raises
        ------
        RefusedError : the bus is passive.
        BusFaultError : the bus does not accept the frame.
        """
        import can

        self._own.append((can_id, data))
        try:
            self._bus.send(
                can.Message(arbitration_id=can_id, data=data, is_extended_id=False), timeout=0.05
            )
        except can.CanError as error:
            raise BusFaultError(
                f"frame 0x{can_id:03X} cannot be sent: {error}", place="bus"
            ) from error
        self._tap(Frame(self.now_ns(), can_id, data, SENT))

    def receive(self, until_ns: int) -> Frame | None:
        """Return the next frame; None if there is none until `until_ns`."""
        return self.take(max(0.0, (until_ns - self.now_ns()) * 1e-9))

    def take(self, timeout_s: float) -> Frame | None:
        """Return the next frame; None if there is none within `timeout_s`.

        Raises
        ------
        BusFaultError : the bus fails.
        """
        import can

        until_s = time.monotonic() + timeout_s
        while True:
            try:
                message = self._bus.recv(max(0.0, until_s - time.monotonic()))
            except (can.CanError, OSError) as error:
                if is_no_frame(self._bus, error):
                    if time.monotonic() >= until_s:
                        return None
                    continue
                raise BusFaultError(f"reading failed: {error}", place="bus") from error
            if message is None:
                return None
            frame = frame_of(message)
            sent = (frame.can_id, frame.data)
            if frame.flags & CAN_FD:
                self._tap(frame)
            elif sent in self._own and (is_group(self._bus) or not message.is_rx):
                self._own.remove(sent)
            else:
                self._tap(frame)
                return frame

    def close(self) -> None:
        """Close the bus, even if it has failed."""
        import can

        with suppress(can.CanError, OSError):
            self._bus.shutdown()


def open_link(file: BusFile, *, passive: bool, tap: Tap | None = None) -> Link:
    """Open a link in real time.

    Parameters
    ----------
    file : the description of the bus.
    passive : True for a link that cannot send.
    tap : called with every frame that is sent or received.

    Raises
    ------
    BusFaultError, RefusedError : as `open_bus`.
    """
    return Link(open_bus(file, passive=passive), tap=tap)
