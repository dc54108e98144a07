"""A CANopen master on a link: NMT, SDO, commands by PDO, and the last values of every node."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from .. import protocol as cia
from ..errors import NoAnswerError, RefusedError
from ..recording import ERROR, EXTENDED, REMOTE_REQUEST
from ..robot import Bus, Drive, axis_of
from .frames import Frame, command_ids, sign_of_master
from .links import MasterLink

SDO_TIMEOUT_NS, _SLICE_NS = 300_000_000, 50_000_000
START, PRE_OPERATIONAL = 1, 128
OPERATIONAL, STOPPED = 5, 4  # NMT states, CiA 301


@dataclass(kw_only=True)
class NodeWatch:
    """The last values received from a drive.

    Attributes:
        drive: the drive.
        statusword: last statusword; None before the first.
        counts: last position in counts; None before the first.
        answers: position PDOs since the last SYNC.
        silent_syncs: SYNCs in a row without an answer.
        nmt: NMT state of the last heartbeat.
        started: True once a heartbeat has reported operational since START.
        unstarted: number of heartbeats since START before that.
        heard_ns: time of the last heartbeat, or of START.
        beats: True if heartbeats are monitored; False for a drive without 1017h.
        emergency: error code of the last emergency message.
        booted: True if a boot-up message was received since START.
        ramp_objects: values of `RAMP_OBJECTS`; None for those that the drive does not have.
    """

    drive: Drive
    statusword: int | None = None
    counts: int | None = None
    answers: int = 0
    silent_syncs: int = 0
    nmt: int | None = None
    started: bool = False
    unstarted: int = 0
    heard_ns: int = 0
    beats: bool = True
    emergency: int | None = None
    booted: bool = False
    ramp_objects: dict[int, int | None] = field(default_factory=dict)

    @property
    def state(self) -> cia.State | None:
        """State in the last statusword; None before the first, or if it is not a CiA 402 state."""
        return None if self.statusword is None else cia.find_state(self.statusword)


class Master:
    """A master that sends requests and stores the last values received.

    Every received frame goes through `dispatch`.

    Attributes:
        nodes: values of the drives, in the order of the drives.
        by_node: the same by node id.
        bus_error: last error of the bus, as text; None without one.
        signs: signs of another master, as text, and whether they command the drives.
        while_awaiting: called every 50 ms while an SDO answer is awaited.
        unanswered: SDO requests without an answer, by node id.
        doubled: node ids that two devices have.
        sync_times: times of received SYNCs, ns.
        synced_ns: time of the last SYNC that was sent; None before the first.
        at_sync: called at every SYNC of any producer.
    """

    def __init__(self, link: MasterLink, bus: Bus) -> None:
        self.link, self.bus = link, bus
        self.nodes = [NodeWatch(drive=drive) for drive in bus.drives]
        self.bus_error: str | None = None
        self.signs: dict[str, bool] = {}
        self.while_awaiting: Callable[[], None] = lambda: None
        self._commands = command_ids(bus)
        self.by_node = {watch.drive.node: watch for watch in self.nodes}
        self._by_pdo = {
            pdo.can_id: (watch, pdo) for watch in self.nodes for pdo in watch.drive.tpdos
        }
        self._answers: dict[int, bytes] = {}
        # SDO requests of any master without an answer so far, by node. A late answer counts, too.
        self.unanswered = Counter[int]()
        # Nodes with more SDO answers than requests, because two devices have the same node id.
        self.doubled: set[int] = set()
        # Nodes that have given a size below four bytes give the right size in all answers.
        self._sized: set[int] = set()
        self.sync_times: list[int] = []
        self.synced_ns: int | None = None
        self.at_sync: Callable[[], None] = lambda: None

    def wait(self, until_ns: int, *, for_answers: bool = False) -> None:
        """Receive until `until_ns`. With `for_answers`, stop once every drive has answered SYNC."""
        self._receive(until_ns, lambda: for_answers and all(w.answers for w in self.nodes))

    def wait_for_sync(self, until_ns: int) -> bool:
        """Receive until another producer sends SYNC; return False if none arrives in time."""
        count = len(self.sync_times)
        return self._receive(until_ns, lambda: len(self.sync_times) > count)

    def _receive(self, until_ns: int, enough: Callable[[], bool]) -> bool:
        """Receive until `enough` returns True; return False if it does not in time."""
        while not enough():
            frame = self.link.receive(until_ns)
            if frame is None:
                return False
            self.dispatch(frame)
        return True

    def dispatch(self, frame: Frame) -> None:
        """Update the values of the node that sent a frame."""
        if frame.flags & ERROR:
            self.bus_error = f"error frame: {cia.error_frame_words(frame.can_id, frame.data)}"
            return
        function, node = frame.can_id & 0x780, frame.can_id & 0x7F
        if frame.flags & (EXTENDED | REMOTE_REQUEST):
            self._note_sign(frame)
        elif frame.can_id in self._by_pdo:
            self._process_data(frame)
        elif frame.can_id == self.bus.file.sync_can_id:
            self.sync_times.append(frame.time_ns)
            if self.bus.file.sync_producer == "recorder":
                # Drives would apply targets at the times of that producer.
                self.bus_error = "another producer sends SYNC"
            self._next_sync()
        elif function == cia.ANSWER and node:
            self._answers[node] = frame.data
            answer = cia.answer_of(frame.data)
            # A transfer in segments stays open here, since its server may still abort it: together
            # with the next answer, or after a timeout.
            if answer.kind != "other" and (answer.kind, answer.number) != (
                "abort",
                cia.ABORTS["timed out"],
            ):
                self.unanswered[node] -= 1
                self.doubled |= {node} if self.unanswered[node] < 0 else set()
        elif node in self.by_node and function == cia.HEARTBEAT and frame.data:
            watch = self.by_node[node]
            # The time of the link is used, because the timestamps may be of the adapter's clock.
            watch.nmt, watch.heard_ns = frame.data[0] & 0x7F, self.link.now_ns()
            watch.started |= watch.nmt == OPERATIONAL
            watch.unstarted += not watch.started
            watch.booted |= frame.data[0] == 0
        elif node in self.by_node and function == cia.EMERGENCY and len(frame.data) >= 2:
            # Code 0 reports that the error is cleared.
            if code := int.from_bytes(frame.data[:2], "little"):
                self.by_node[node].emergency = code
        else:
            self.unanswered[node] += function == cia.REQUEST
            self._note_sign(frame)

    def refuse_doubled(self) -> None:
        """Raise `RefusedError` if two devices have answered with the same node id."""
        if self.doubled:
            raise RefusedError(
                f"two devices answer as node {min(self.doubled)}",
                what="the session",
                place="bus",
                advice="Disconnect one of them, and change its node id",
            )

    def _note_sign(self, frame: Frame) -> None:
        # Frames of this master never arrive here, because the link drops those that return.
        if (sign := sign_of_master(frame, self.bus)) is not None:
            self.signs[sign] = frame.can_id in self._commands and not frame.flags & REMOTE_REQUEST

    def _process_data(self, frame: Frame) -> None:
        watch, pdo = self._by_pdo[frame.can_id]
        if len(frame.data) < pdo.length:
            # A PDO that is too short is ignored (CiA 301).
            return
        values, drive = pdo.unpack(frame.data), watch.drive
        watch.statusword = values.get(drive.status.key, watch.statusword)
        if (counts := values.get(drive.position.key)) is not None:
            watch.counts = counts
            watch.answers += 1

    def sync(self) -> None:
        """Send SYNC, after counting the drives that did not answer the one before."""
        self._next_sync()
        self.synced_ns = self.link.now_ns()
        self.link.send(self.bus.file.sync_can_id, b"")

    def _next_sync(self) -> None:
        """Count the drives that did not answer the last SYNC.

        Only drives that have reported operational or sent a position are counted.
        """
        for watch in self.nodes:
            late = not watch.answers and (watch.started or watch.counts is not None)
            watch.silent_syncs = watch.silent_syncs + 1 if late else 0
            watch.answers = 0
        self.at_sync()

    def nmt(self, command: int, node: int) -> None:
        """Send an NMT command to one node.

        It is never sent to all nodes (0), because other devices may be on the bus.
        """
        self.link.send(0, bytes([command, node]))

    def start(self) -> None:
        """Send START to all drives.

        Values received before are discarded, so that an old position is not taken for a new one.
        """
        for watch in self.nodes:
            watch.statusword = watch.counts = watch.emergency = watch.nmt = None
            watch.answers = watch.silent_syncs = watch.unstarted = 0
            watch.booted = watch.started = False
            self.nmt(START, watch.drive.node)
        for watch in self.nodes:
            watch.heard_ns = self.link.now_ns()

    def state(self, drive: Drive) -> cia.State:
        """Read the state of a drive by SDO (6041h).

        Raises
        ------
        BusFaultError : the drive does not answer, or its statusword is not a CiA 402 state.
        """
        return cia.state_of(self.read(drive.node, *drive.status.key))

    def read(self, node: int, index: int, sub: int = 0) -> int:
        """Read an object as an unsigned number.

        Raises
        ------
        SdoAbortedError : the drive refuses the access.
        NoAnswerError : it does not answer.
        """
        return cia.check_answer(
            self.upload(node, index, sub), "value", node, _place(node, index, sub)
        )

    def upload(self, node: int, index: int, sub: int = 0) -> cia.Transfer:
        """Return the answer of any kind to a read request.

        Some drives never give a size (CiA 301, 7.2.4.3.6), or always four bytes. Their values have
        the size of their type.

        Raises
        ------
        NoAnswerError : the drive does not answer.
        """
        answer = cia.answer_of(
            self.exchange(node, cia.read_request(index, sub), _place(node, index, sub))
        )
        if answer.kind != "value" or len(answer.data) < 4:
            self._sized |= {node} if answer.kind == "value" else set()
        elif node not in self._sized and (node in self.by_node or not answer.stated):
            watch = self.by_node.get(node)
            size_of = watch.drive.size_of if watch else cia.size_of
            return replace(answer, data=answer.data[: size_of(index, sub)])
        return answer

    def write(self, node: int, index: int, sub: int, value: int, size: int) -> None:
        """Write an object of `size` bytes.

        Raises
        ------
        SdoAbortedError : the drive refuses the access.
        NoAnswerError : it does not answer.
        """
        place = f"{_place(node, index, sub)} = {value}"
        cia.check_answer(
            cia.answer_of(self.exchange(node, cia.write_request(index, sub, value, size), place)),
            "written",
            node,
            place,
        )

    def post(self, node: int, request: bytes) -> None:
        """Send an SDO request without waiting for its answer, which `answered` returns."""
        self._answers.pop(node, None)
        self.link.send(cia.REQUEST + node, request)
        self.unanswered[node] += 1

    def answered(self, node: int, request: bytes) -> bytes | None:
        """Return the answer to a request sent by `post`, once; None until it arrives."""
        answer = self._answers.pop(node, None)
        if answer is None or len(answer) != 8:
            return None
        # The answer to a segment has the toggle bit of its request, or is an abort.
        if request[0] >> 5 == 3:
            return answer if answer[0] >> 5 == 4 or answer[0] & 0xF0 == request[0] & 0x10 else None
        return answer if answer[1:4] == request[1:4] else None

    def exchange(self, node: int, request: bytes, place: str) -> bytes:
        """Send an SDO request and return its answer.

        Raises
        ------
        NoAnswerError : the node does not answer within 0.3 s; the error has the `place`.
        """
        self.post(node, request)
        until_ns = self.link.now_ns()
        for _ in range(SDO_TIMEOUT_NS // _SLICE_NS):
            self.while_awaiting()
            until_ns += _SLICE_NS
            while (frame := self.link.receive(until_ns)) is not None:
                self.dispatch(frame)
                if (answer := self.answered(node, request)) is not None:
                    return answer
        raise NoAnswerError(
            f"the drive did not answer within {SDO_TIMEOUT_NS / 1e9:g} s",
            node=node,
            place=place,
            advice="Check that it is on and that its node id is right",
        )


def _place(node: int, index: int, sub: int) -> str:
    return f"node {node}: object {index:04X}:{sub}"


# Controlword and target counts of each drive, in the order of the drives.
Orders = list[tuple[int, int]]


def send_order(master: Master, watch: NodeWatch, control: int, target: int) -> None:
    """Send a command to one drive, by the PDOs that carry only command, target and mode.

    Parameters
    ----------
    master : sends the PDOs.
    watch : the drive.
    control : the controlword.
    target : target position in counts.

    Raises
    ------
    BusFaultError : the bus accepts no frame.
    """
    drive = watch.drive
    values = {
        drive.control.key: control,
        drive.target.key: target,
        (cia.MODE_OF_OPERATION + axis_of(drive), 0): int(cia.Mode.CYCLIC_SYNCHRONOUS_POSITION),
    }
    for pdo in drive.rpdos:
        if all(entry.key in values for entry in pdo.entries):
            master.link.send(pdo.can_id, pdo.pack(values))
