"""python-can's buses: opened as the description says, unable to send where passive.

Network interfaces stay on this machine unless the description says otherwise.
"""

import logging
from typing import Any

from ..errors import AcquisitionError
from ..robot import BusFile
from .sockets import enlarge_queue, socket_of, stay_on_loopback

SHARED = ("socketcan", "udp_multicast", "virtual")  # interfaces that several programs (or bus objects) may open at once

_SILENT: dict[str, dict[str, Any]] = {"slcan": {"listen_only": True}}  # what makes an adapter not even acknowledge

# python-can's own warnings are not printed; its errors are raised and reported in one line.
logging.getLogger("can").addHandler(logging.NullHandler())


def refuse_to_send(*_: object, **__: object) -> None:
    """Raise `AcquisitionError`: takes the place of a passive bus's functions that send."""
    raise AcquisitionError("passive: nothing is ever sent", place="bus", expected="an active session for that")


def is_group(bus: Any) -> bool:
    """Whether a bus is a multicast group, which returns every frame sent."""
    return getattr(bus, "_multicast", None) is not None


def is_no_frame(bus: Any, error: Exception) -> bool:
    """Whether an error of reading is about a datagram that is no frame, which any program may send to a group."""
    import can

    failed = isinstance(error.__cause__, OSError)  # of the socket itself
    return isinstance(error, can.CanOperationError) and is_group(bus) and not failed


def open_bus(file: BusFile, *, passive: bool) -> Any:
    """Open the bus of a description as python-can does, with a receive queue of `QUEUE_BYTES` where the kernel grants it.

    A `passive` bus object cannot send, and an slcan adapter does not even acknowledge.
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
        problem = str(error) or type(error).__name__
        raise AcquisitionError(f"cannot be opened: {problem}", place=f"bus: {file.interface} {file.channel}") from error
    if file.interface == "udp_multicast" and file.loopback:
        stay_on_loopback(bus, file)
    if passive:
        for name in ("send", "send_periodic"):
            setattr(bus, name, refuse_to_send)
    sock = socket_of(bus)
    if sock is not None:
        enlarge_queue(sock)
    return bus
