"""CAN frames, blocks of frames, and the service of a frame in words (CiA 301, connection set)."""

import struct
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from ..protocol import ANSWER, EMERGENCY, HEARTBEAT, REQUEST, usual_can_id
from ..recording import CAN_FD, ERROR, EXTENDED, FRAME, REMOTE_REQUEST, SENT, Block
from ..robot import Bus

ROW = struct.Struct("<qIBB8s")  # of `FRAME`


class Frame(NamedTuple):
    """A CAN frame.

    Attributes:
        time_ns: time of reception or sending, ns.
        can_id: identifier, of 11 or 29 bits.
        data: up to 8 bytes.
        flags: flags of a row of a `Block`.
    """

    time_ns: int
    can_id: int
    data: bytes
    flags: int = 0


Tap = Callable[[Frame], None]


def block_of(frames: Iterable[Frame]) -> Block:
    """Return frames as rows of `FRAME`."""
    return np.frombuffer(
        bytearray().join(
            ROW.pack(f.time_ns, f.can_id, len(f.data), f.flags, f.data) for f in frames
        ),
        FRAME,
    )


def frame_of(message: Any) -> Frame:
    """Convert a message of python-can to a frame."""
    extended = message.is_extended_id or message.arbitration_id > 0x7FF
    return Frame(
        round(message.timestamp * 1e9),
        message.arbitration_id,
        bytes(message.data)[:8],
        (EXTENDED if extended and not message.is_error_frame else 0)
        | (ERROR if message.is_error_frame else 0)
        | (REMOTE_REQUEST if message.is_remote_frame else 0)
        | (0 if message.is_rx else SENT)
        | (CAN_FD if message.is_fd else 0),
    )


_OF_NODES = {
    EMERGENCY: "emergency of",
    ANSWER: "SDO answer of",
    REQUEST: "SDO request to",
    HEARTBEAT: "heartbeat of",
}
_PDOS = {"tpdo": "TPDO {} of", "rpdo": "RPDO {} to"}


def service_of(frame: Frame, sync_can_id: int) -> str:
    """Name service and node of a frame: `SYNC`, `NMT command`, `heartbeat of node 5`.

    `sync_can_id` is the identifier of SYNC.
    """
    if frame.flags & EXTENDED:
        return f"29-bit frame 0x{frame.can_id:08X}"
    remote = "remote request for " if frame.flags & REMOTE_REQUEST else ""
    function, node = frame.can_id & 0x780, frame.can_id & 0x7F
    if frame.can_id == 0:
        return "NMT command"
    if frame.can_id == sync_can_id:
        return f"{remote}SYNC"
    if node and _is_boot_up(frame):
        return f"boot-up of node {node}"
    if node and function in _OF_NODES:
        return f"{remote}{_OF_NODES[function]} node {node}"
    for way, words in _PDOS.items():
        for number in range(1, 5):
            if node and usual_can_id(way, number, node) == frame.can_id:
                return f"{remote}{words.format(number)} node {node}"
    return f"{remote}frame 0x{frame.can_id:03X}"


def command_ids(bus: Bus) -> set[int]:
    """Return the identifiers of the frames by which a master commands the drives of `bus`.

    These are NMT, SDO requests and PDOs to drives.
    """
    return {
        0,
        *(REQUEST + drive.node for drive in bus.drives),
        *(pdo.can_id for drive in bus.drives for pdo in drive.rpdos),
    }


def sign_of_master(frame: Frame, bus: Bus) -> str | None:
    """Return the service of a frame that only another master sends; else None.

    Only a master sends NMT commands, SDO requests, PDOs to drives, remote requests and the
    heartbeat of `master_node`. The same holds for SYNC, unless the description gives another
    producer.
    """
    service = service_of(frame, bus.file.sync_can_id)
    if frame.flags & EXTENDED:
        return None
    function, node = frame.can_id & 0x780, frame.can_id & 0x7F
    if frame.can_id == bus.file.sync_can_id:
        return service if bus.file.sync_producer == "recorder" else None
    if (
        frame.flags & REMOTE_REQUEST
        or frame.can_id in command_ids(bus)
        or (function == REQUEST and node)
    ):
        return service
    if function == HEARTBEAT and node == bus.file.master_node and not _is_boot_up(frame):
        return f"{service}, which is master_node of robot.toml"
    from_drives = {pdo.can_id for drive in bus.drives for pdo in drive.tpdos}
    return service if frame.can_id not in from_drives and service.startswith("RPDO") else None


def _is_boot_up(frame: Frame) -> bool:
    return frame.can_id & 0x780 == HEARTBEAT and frame.data == b"\0"


def other_node(frame: Frame, bus: Bus) -> int | None:
    """Return the node id of a heartbeat from a node that is not described; else None.

    A boot-up message does not count as a heartbeat.
    """
    node, known = (
        frame.can_id & 0x7F,
        {0, *bus.file.other_nodes, *(drive.node for drive in bus.drives)},
    )
    is_heartbeat = (
        frame.can_id & 0x780 == HEARTBEAT and not frame.flags & EXTENDED and not _is_boot_up(frame)
    )
    return node if is_heartbeat and node not in known else None
