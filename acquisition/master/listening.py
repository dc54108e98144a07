"""Listens for another master before anything is sent, and names the service and node of a frame.

Services by identifier: CiA 301, predefined connection set.
"""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from ..errors import AcquisitionError
from ..protocol import ANSWER, DISABLED, EMERGENCY, HEARTBEAT, REQUEST, State, usual_can_id
from ..recording import ERROR, EXTENDED, REMOTE_REQUEST
from ..robot import Bus
from ..transport import Frame

if TYPE_CHECKING:
    from .master import Master, Wire

LISTEN_S = 0.5
_SLICE_NS = 50_000_000  # a stop is noticed after this time at the latest
_OF_NODES = {EMERGENCY: "emergency of", ANSWER: "SDO answer of", REQUEST: "SDO request to", HEARTBEAT: "heartbeat of"}
_PDOS = {"tpdo": "TPDO {} of", "rpdo": "RPDO {} to"}


def listen(link: "Wire", seconds: float, stopped: Callable[[], bool] = lambda: False) -> Iterator[Frame]:
    """Frames received during `seconds` without error frames; ends early when `stopped()` is true. Nothing is sent."""
    until_ns = link.now_ns() + round(seconds * 1e9)
    while link.now_ns() < until_ns and not stopped():
        frame = link.receive(min(until_ns, link.now_ns() + _SLICE_NS))
        if frame is not None and not frame.flags & ERROR:
            yield frame


def service_of(frame: Frame, sync_can_id: int) -> str:
    """Service and node of a frame in words: `SYNC`, `NMT command`, `heartbeat of node 5`."""
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
    """Identifiers of the frames by which a master commands the drives of `bus`: NMT, SDO requests, PDOs to drives."""
    to_drives = {pdo.can_id for drive in bus.drives for pdo in drive.rpdos}
    return {0} | to_drives | {REQUEST + drive.node for drive in bus.drives}


def sign_of_master(frame: Frame, bus: Bus) -> str | None:
    """The service in words where a frame shows that another master is on the bus, None where it does not.

    Only a master sends NMT commands, SDO requests, PDOs to drives, remote requests and, unless the description says that
    another device does, SYNC. A heartbeat of a node that is not described comes from another master or from one of its
    devices. A boot-up only shows that a node was switched on.
    """
    service = service_of(frame, bus.file.sync_can_id)
    if frame.flags & EXTENDED:
        return None
    function, node = frame.can_id & 0x780, frame.can_id & 0x7F
    ours = {drive.node for drive in bus.drives}
    from_drives = {pdo.can_id for drive in bus.drives for pdo in drive.tpdos}
    to_drives = {pdo.can_id for drive in bus.drives for pdo in drive.rpdos}
    if frame.can_id == bus.file.sync_can_id:
        return service if bus.file.sync_producer == "recorder" else None
    if frame.flags & REMOTE_REQUEST or frame.can_id == 0 or frame.can_id in to_drives or (function == REQUEST and node):
        return service
    if function == HEARTBEAT and node and node not in ours and not _is_boot_up(frame):
        return f"{service}, which is no drive of robot.toml"
    if frame.can_id not in from_drives and service.startswith("RPDO"):
        return service
    return None


def _is_boot_up(frame: Frame) -> bool:
    return frame.can_id & 0x780 == HEARTBEAT and frame.data == b"\0"


def other_master(master: "Master") -> str | None:
    """Listen for half a second; the first sign of another master in words, None without one. Nothing is sent."""
    signs = (sign_of_master(frame, master.bus) for frame in listen(master.link, LISTEN_S))
    return next((sign for sign in signs if sign is not None), None)


def refuse_other_master(master: "Master") -> None:
    """Raise `AcquisitionError` where another master is heard, before anything is sent."""
    found = other_master(master)
    if found is not None:
        expected = "none; `robot-acquire record --passive` records without sending. Nothing was sent"
        raise AcquisitionError(f"{found}: another master is active", place="bus", expected=expected)


def refuse_enabled(master: "Master") -> list[int]:
    """Read the state (6041h) of every drive, write nothing, and return the node ids of the drives in fault.

    An `AcquisitionError` where a drive gives torque although no master was heard, or does not answer.
    """
    in_fault = []
    for drive in master.bus.drives:
        state = master.state(drive)
        if state not in DISABLED:
            problem = f"{state.words} before the session began, and no other master is heard"
            expected = "switch on disabled; `robot-acquire disable` with this robot.toml disables it"
            raise AcquisitionError(problem, place=f"node {drive.node}", expected=expected)
        if state is State.FAULT:
            in_fault.append(drive.node)
    return in_fault
