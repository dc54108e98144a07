"""The kernel's sockets under a bus: size of the receive queue, dropped frames, multicast on loopback only."""

import socket
import struct
from typing import Any

from ..robot import BusFile

QUEUE_BYTES = 4 * 2**20  # of the kernel's receive queue; the usual 212992 hold 31 ms of a full bus

_SO_MEMINFO, _DROPS = 55, 8  # of Linux: nine counters, the last one counts frames dropped before the socket

_SO_RCVBUFFORCE = 33


def stay_on_loopback(bus: Any, file: BusFile) -> None:
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


def enlarge_queue(sock: socket.socket) -> None:
    """Ask for a receive queue of `QUEUE_BYTES`; a smaller one stays where the kernel refuses."""
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
