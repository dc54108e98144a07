"""Listens for another master before anything is sent, and names the service and node of a frame.

Services by identifier: CiA 301, predefined connection set.
"""

from typing import TYPE_CHECKING

from ..errors import AcquisitionError
from ..protocol import ANSWER, DISABLED, EMERGENCY, HEARTBEAT, REQUEST, State, usual_can_id
from ..recording import ERROR, EXTENDED, REMOTE_REQUEST
from ..robot import Bus
from .frame import Frame

if TYPE_CHECKING:
    from .master import Master

LISTEN_S = 0.5
_OF_NODES = {EMERGENCY: "emergency of", ANSWER: "SDO answer of", REQUEST: "SDO request to", HEARTBEAT: "heartbeat of"}
_PDOS = {"tpdo": "TPDO {} of", "rpdo": "RPDO {} to"}


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

    Only a master sends NMT commands, SDO requests, PDOs to drives, remote requests, the heartbeat of `master_node` and,
    unless the description says that another device does, SYNC.
    """
    service = service_of(frame, bus.file.sync_can_id)
    if frame.flags & EXTENDED:
        return None
    function, node = frame.can_id & 0x780, frame.can_id & 0x7F
    from_drives = {pdo.can_id for drive in bus.drives for pdo in drive.tpdos}
    to_drives = {pdo.can_id for drive in bus.drives for pdo in drive.rpdos}
    if frame.can_id == bus.file.sync_can_id:
        return service if bus.file.sync_producer == "recorder" else None
    if frame.flags & REMOTE_REQUEST or frame.can_id == 0 or frame.can_id in to_drives or (function == REQUEST and node):
        return service
    if function == HEARTBEAT and node == bus.file.master_node and not _is_boot_up(frame):
        return f"{service}, which is master_node of robot.toml"
    if frame.can_id not in from_drives and service.startswith("RPDO"):
        return service
    return None


def _is_boot_up(frame: Frame) -> bool:
    return frame.can_id & 0x780 == HEARTBEAT and frame.data == b"\0"


def other_node(frame: Frame, bus: Bus) -> int | None:
    """Node id of a heartbeat that neither a drive of the description nor one of `other_nodes` has, else None.

    A boot-up only shows that a node was switched on.
    """
    node, known = frame.can_id & 0x7F, {0, *bus.file.other_nodes, *(drive.node for drive in bus.drives)}
    beats = frame.can_id & 0x780 == HEARTBEAT and not frame.flags & EXTENDED and not _is_boot_up(frame)
    return node if beats and node not in known else None


def listen_for_others(master: "Master") -> AcquisitionError | None:
    """Listen for half a second; the refusal of another master, else of a device that is not described. Nothing is sent."""
    device, until_ns = None, master.link.now_ns() + round(LISTEN_S * 1e9)
    while master.link.now_ns() < until_ns:
        frame = master.link.receive(until_ns)
        if frame is None or frame.flags & ERROR:
            continue
        sign, node = sign_of_master(frame, master.bus), other_node(frame, master.bus)
        if sign is not None:
            expected = "none; `robot-acquire record --passive` records without sending. Nothing was sent"
            return AcquisitionError(f"{sign}: another master is active", place="bus", expected=expected)
        if node is not None:
            text = f"heartbeat of node {node}: a device that robot.toml does not describe, or a wrong node id"
            expected = f"it in other_nodes = [{node}] of [bus], unless it is a master. Nothing was sent"
            device = AcquisitionError(
                text, place="bus", key="other_nodes", value=master.bus.file.other_nodes, expected=expected
            )
    return device


def refuse_other_master(master: "Master") -> None:
    """Raise `AcquisitionError` where another master or an unknown device is heard, before anything is sent."""
    if (refusal := listen_for_others(master)) is not None:
        raise refusal


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
