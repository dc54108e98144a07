"""Checks that only listen and read, before a drive is commanded; and the scan of an unknown bus.

The checks find another master, and drives that are enabled or not homed. They read the joint
positions, which the operator confirms. The scan uses a link that can send only SDO reads.

Before homing, the zero of an incremental encoder is the position at which it was switched on.
Position limits do not hold yet then.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from .. import protocol as cia
from ..arrays import Array
from ..errors import NoAnswerError, RefusedError, SdoAbortedError
from ..recording import ERROR
from ..robot import Bus, BusFile, Drive, Robot, axis_of, parse_homed
from .frames import Frame, other_node, service_of, sign_of_master
from .links import MasterLink
from .master import SDO_TIMEOUT_NS, Master

LISTEN_S = 0.5


def listen_for_others(master: Master) -> RefusedError | None:
    """Listen for half a second for another master and for devices that are not described.

    Nothing is sent.

    Parameters
    ----------
    master : its link is read.

    Returns
    -------
    The error to raise, preferably that of another master. None if nothing was heard.
    """
    device, until_ns = None, master.link.now_ns() + round(LISTEN_S * 1e9)
    while master.link.now_ns() < until_ns:
        frame = master.link.receive(until_ns)
        if frame is None or frame.flags & ERROR:
            continue
        if frame.can_id & 0x780 == cia.ANSWER:
            master.dispatch(frame)
        sign, node = sign_of_master(frame, master.bus), other_node(frame, master.bus)
        if sign is not None:
            return RefusedError(
                f"another master is active ({sign}), so nothing was sent",
                what="sending",
                place="bus",
                advice="Stop it, or record without sending: `robot-acquire record --passive`",
            )
        if node is not None:
            device = RefusedError(
                f"node {node} sends heartbeats, but robot.toml does not describe it; nothing was "
                "sent",
                what="sending",
                place="bus",
                key="other_nodes",
                value=master.bus.file.other_nodes,
                advice=f"Correct the node ids, or set other_nodes = [{node}] in [bus] if the node "
                "is not a master",
            )
    return device


def refuse_enabled(master: Master) -> list[int]:
    """Check that no drive is enabled, and return the node ids of drives in fault.

    Drives are only read.

    Raises
    ------
    RefusedError : a drive is enabled, or two devices have the same node id.
    BusFaultError : a drive does not answer.
    """
    in_fault = []
    for drive in master.bus.drives:
        state = master.state(drive)
        if state not in cia.DISABLED:
            raise RefusedError(
                f"the drive is in {state.words}, but no other master was heard",
                what="the session",
                place=f"node {drive.node}",
                advice="Disable it with this robot.toml: `robot-acquire disable ROBOT.toml`",
            )
        if state is cia.State.FAULT:
            in_fault.append(drive.node)
    # A second device with this node id may answer later.
    master.wait(master.link.now_ns() + 30_000_000)
    master.refuse_doubled()
    return in_fault


ERROR_REGISTER, ERROR_FIELD, ERROR_CODE = 0x1001, 0x1003, 0x603F
# Shows joint positions, and the faults that would be reset, to the operator. Returns True if both
# are confirmed.
Confirm = Callable[[list[str], list[str]], bool]


def joint_positions(robot: Robot, master: Master) -> Array:
    """Read the joint positions (n,) by SDO, in rad or m.

    Raises
    ------
    BusFaultError : a drive refuses to answer, or does not answer.
    """
    return joints_of(
        robot,
        master.bus,
        [
            cia.signed(master.read(drive.node, *drive.position.key), drive.position.bits)
            for drive in master.bus.drives
        ],
    )


def joints_of(robot: Robot, bus: Bus, counts: Sequence[int]) -> Array:
    """Convert counts of the drives to joint positions.

    Parameters
    ----------
    robot : converts motor positions to joint positions.
    bus : has the drives with their codecs.
    counts : (n,) position counts, in the order of the drives.

    Returns
    -------
    Joint positions (n,) in rad or m.
    """
    motors = [
        drive.position_codec.si(np.array(c)) for drive, c in zip(bus.drives, counts, strict=True)
    ]
    return np.asarray(robot.joint_position(np.array(motors, dtype=float)[None])[0])


def position_words(robot: Robot, q: Array) -> list[str]:
    """Return a text for each joint from positions `q` (n,) in rad or m: `joint_1 = 12.34 deg`."""
    return [
        f"{joint.name} = {value:.5f} m"
        if joint.type == "prismatic"
        else f"{joint.name} = {np.rad2deg(value):.2f} deg"
        for joint, value in zip(robot.joints, q, strict=True)
    ]


def is_homed(master: Master, drive: Drive) -> bool | None:
    """Read whether a drive is homed.

    Returns
    -------
    True if the object or bit `homed` of the description is set; None if the description has no
    `homed`.

    Raises
    ------
    BusFaultError : the drive refuses to answer, or does not answer.
    """
    if drive.file.homed is None:
        return None
    index, sub, bit = parse_homed(drive.file.homed)
    value = master.read(drive.node, index, sub)
    return bool(value if bit is None else value >> bit & 1)


def confirm_motion(
    robot: Robot, master: Master, confirm: Confirm, *, reset_faults: bool = False
) -> list[str]:
    """Check that the drives are homed, then ask the operator to confirm positions and faults.

    Parameters
    ----------
    robot : has the joints whose positions are shown.
    master : reads the drives.
    confirm : shows the joint positions and the faults that would be reset, and returns True if the
        operator confirms them.
    reset_faults : True to reset faults without asking.

    Returns
    -------
    The confirmed texts, one for each joint and each drive in fault: `joint_1 = 12.34 deg`.

    Raises
    ------
    RefusedError : a drive is not homed, or the operator does not confirm.
    BusFaultError : a drive does not answer.
    """
    for drive in master.bus.drives:
        if is_homed(master, drive) is False:
            raise RefusedError(
                "the drive is not homed",
                what="motion",
                place=f"node {drive.node} ({drive.name})",
                key="homed",
                value=drive.file.homed,
                advice="Home it before motion",
            )
    words = position_words(robot, joint_positions(robot, master))
    in_fault = [drive for drive in master.bus.drives if master.state(drive) is cia.State.FAULT]
    faults = [
        f"in fault: {error_report(master, drive) or f'node {drive.node} ({drive.name})'}"
        for drive in in_fault
    ]
    if confirm(words, [] if reset_faults else faults):
        return words + faults
    if faults and not reset_faults:
        raise RefusedError(
            f"the reset was not confirmed, so nothing has moved; {'; '.join(faults)}",
            what="motion",
            place="drives",
            advice="Answer yes, or reset faults without asking",
            arguments=("reset_faults",),
        )
    raise RefusedError(
        f"the joint positions were not confirmed, so nothing has moved ({', '.join(words)})",
        what="motion",
    )


def error_report(master: Master, drive: Drive) -> str:
    """Read error register (1001h), last error (1003h:1) and error code (603Fh) of a drive.

    Returns
    -------
    One line; empty if the drive has none of these objects.
    """
    values = []
    for index, sub, name in (
        (ERROR_REGISTER, 0, "error register 1001"),
        (ERROR_FIELD, 1, "last error 1003:1"),
        (ERROR_CODE + axis_of(drive), 0, f"error code {ERROR_CODE + axis_of(drive):04X}"),
    ):
        try:
            value = master.read(drive.node, index, sub)
        except (NoAnswerError, SdoAbortedError):
            # Many drives lack one of these objects.
            continue
        values.append(
            f"{name} = "
            + (f"0x{value:02X}" if index == ERROR_REGISTER else cia.error_words(value & 0xFFFF))
        )
    return f"node {drive.node} ({drive.name}): {', '.join(values)}" if values else ""


# Requests are spaced, so that a scan takes little of the bus from other nodes.
REQUEST_INTERVAL_NS = 1_000_000
# Instead of answering, a server may abort the upload before, which was too long for one frame.
TRIES = 2
# A node that leaves as many objects in a row unanswered is not asked any more.
MAX_UNANSWERED = 2
MAX_ENTRIES = 8  # of an array


class Reading(NamedTuple):
    """The answer to an SDO read.

    Attributes:
        value: raw integer; None without an answer, and for texts.
        problem: what is wrong with the answer (missing, aborted, of another size); else empty.
        text: value of an object of `TEXTS`.
    """

    value: int | None
    problem: str = ""
    text: str = ""


NO_ANSWER = Reading(None, "no answer")
Readings = dict[tuple[int, int], Reading]  # by index and sub-index


class Uploads:
    """A link that can send only SDO read requests.

    Once it has received an error frame, or a frame of another master, it sends nothing any more.

    Attributes:
        bus: the bus, without drives.
        heard: services received, by node id.

    `say` is called with a text before each request.
    """

    def __init__(
        self, link: MasterLink, file: BusFile, say: Callable[[str], None] = lambda text: None
    ) -> None:
        self.bus, self.heard = Bus(file=file, drives=()), dict[int, set[str]]()
        self._link, self._say, self._received, self._refusal = link, say, deque[Frame](), ""
        self._sent = self._next_ns = 0

    def now_ns(self) -> int:
        """Return the time of the link, ns."""
        return self._link.now_ns()

    def send(self, can_id: int, data: bytes) -> None:
        """Send a read request, at least a millisecond after the last one.

        All frames received until then are checked first.

        Raises
        ------
        RefusedError : a received frame is not allowed, or the request is not a read.
        """
        while (frame := self._link.receive(self._next_ns)) is not None:
            self._received.append(self._checked(frame))
        is_read = data[:1] == b"\x40" and data[4:] == bytes(4)
        # The next segment of an upload is a read, too.
        is_read |= data[:1] in (b"\x60", b"\x70") and data[1:] == bytes(7)
        if not cia.REQUEST < can_id <= cia.REQUEST + 127 or not is_read:
            self._refusal = f"frame 0x{can_id:03X} is not an SDO read"
        self._refuse()
        self._say(f"asking node {can_id - cia.REQUEST} of 127")
        self._next_ns, self._sent = self.now_ns() + REQUEST_INTERVAL_NS, self._sent + 1
        self._link.send(can_id, data)

    def receive(self, until_ns: int) -> Frame | None:
        """Return the next frame; None if there is none until `until_ns`.

        Raises
        ------
        RefusedError : the frame is of another master, or an error frame.
        """
        frame = None if self._received else self._link.receive(until_ns)
        return self._received.popleft() if self._received else frame and self._checked(frame)

    def _checked(self, frame: Frame) -> Frame:
        if frame.flags & ERROR:
            self._refusal = (
                f"the bus has errors ({cia.error_frame_words(frame.can_id, frame.data)}): the bit "
                "rate or the terminators may be wrong"
            )
        elif sign := sign_of_master(frame, self.bus):
            self._refusal = f"another master is active ({sign})"
        self._refuse()
        service, _, node = service_of(frame, self.bus.file.sync_can_id).rpartition(" of node ")
        if service:
            self.heard.setdefault(int(node), set()).add(service)
        return frame

    def _refuse(self) -> None:
        if self._refusal:
            raise RefusedError(
                f"{self._refusal}; "
                + (f"{self._sent} SDO reads were sent" if self._sent else "nothing was sent"),
                what="sending",
                place="bus",
                advice="Scan only a bus without another master and without errors",
            )


def scan_nodes(
    uploads: Uploads, objects: Sequence[tuple[int, int]], arrays: Sequence[int]
) -> dict[int, Readings]:
    """Listen, then read objects of all nodes that answer.

    Parameters
    ----------
    uploads : the link to the bus.
    objects : index and sub-index of the objects to read.
    arrays : indices of arrays, of which all entries are read (at most 8).

    Returns
    -------
    The readings of each node, by node id.

    Raises
    ------
    RefusedError : another master or an error frame was received, or two devices have the same node
        id.
    """
    master, request = Master(uploads, uploads.bus), cia.read_request(cia.DEVICE_TYPE, 0)
    master.wait(uploads.now_ns() + round(LISTEN_S * 1e9))
    for node in range(1, 128):
        master.post(node, request)
    master.wait(uploads.now_ns() + SDO_TIMEOUT_NS)
    found = [node for node in range(1, 128) if master.answered(node, request) is not None]
    return {node: _read_node(master, node, objects, arrays) for node in found}


def _read_node(
    master: Master, node: int, objects: Sequence[tuple[int, int]], arrays: Sequence[int]
) -> Readings:
    readings, keys, unanswered = Readings(), [*objects, *((index, 0) for index in arrays)], 0
    for index, sub in keys:
        reading = _read(master, node, index, sub) if unanswered < MAX_UNANSWERED else NO_ANSWER
        unanswered = unanswered + 1 if reading is NO_ANSWER else 0
        readings[index, sub] = reading
        if index in arrays and not sub:
            keys += [(index, k + 1) for k in range(min(reading.value or 0, MAX_ENTRIES))]
    master.refuse_doubled()
    return readings


def upload_segments(master: Master, node: int, index: int) -> cia.Transfer:
    """Continue an upload whose first answer was of kind `other`, in segments.

    Parameters
    ----------
    master : exchanges the requests.
    node : node id.
    index : the object, for the result.

    Returns
    -------
    The value, or an abort.

    Raises
    ------
    NoAnswerError : the node does not answer.
    """
    data = b""
    # 64 segments hold 448 bytes, more than the names and versions of devices have.
    for k in range(64):
        # The toggle bit alternates, so that a segment that is sent twice is noticed.
        request = bytes((0x60 | (k & 1) << 4,)).ljust(8, b"\0")
        answer = master.exchange(node, request, f"node {node}")
        if answer[0] >> 5:
            return cia.answer_of(answer)
        master.unanswered[node] -= 1
        data += answer[1 : 8 - (answer[0] >> 1 & 7)]
        if answer[0] & 1:
            # The request that began the upload is answered now, too.
            master.unanswered[node] -= 1
            break
    return cia.Transfer(kind="value", index=index, data=data)


def _read(master: Master, node: int, index: int, sub: int) -> Reading:
    size, signed = cia.BITS[cia.object_type(index, sub)] // 8, cia.object_type(index, sub)[0] == "I"
    for _ in range(TRIES):
        try:
            answer = master.upload(node, index, sub)
            if answer.kind == "other" and index in cia.TEXTS:
                answer = upload_segments(master, node, index)
        except NoAnswerError:
            continue
        if answer.kind == "other":
            return Reading(None, f"more than 4 bytes instead of {size}")
        try:
            cia.check_answer(answer, "value", node, "")
        except SdoAbortedError as error:
            return Reading(None, f"{error.meaning} (0x{error.code:08X})")
        if index in cia.TEXTS:
            return Reading(None, text=answer.data.decode(errors="replace").strip("\0 "))
        return Reading(
            int.from_bytes(answer.data[:size], "little", signed=signed),
            "" if len(answer.data) == size else f"{len(answer.data)} bytes instead of {size}",
        )
    return NO_ANSWER
