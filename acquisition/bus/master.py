"""A CANopen master over a link: NMT, SDO, PDO configuration, orders, and the
last values of every node.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from .. import protocol as cia
from ..errors import BusFaultError, NoAnswerError, RefusedError
from ..recording import ERROR, EXTENDED, REMOTE_REQUEST
from ..robot import Bus, Drive, axis_of
from .frames import Frame, command_ids, sign_of_master
from .links import MasterLink

SDO_TIMEOUT_NS, _SLICE_NS = 300_000_000, 50_000_000
START, PRE_OPERATIONAL = 1, 128
OPERATIONAL, STOPPED = 5, 4  # NMT states, CiA 301


@dataclass(kw_only=True)
class NodeWatch:
    """The last values received from a drive."""

    drive: Drive
    statusword: int | None = None
    counts: int | None = None
    answers: int = 0  # position PDOs since SYNC
    silent_syncs: int = 0  # in a row without one
    nmt: int | None = None
    started: bool = False  # its heartbeat has reported operational since START
    unstarted: int = 0  # heartbeats before that
    heard_ns: int = 0
    beats: bool = True  # whether its heartbeat comes in time: not from a drive without 1017h
    emergency: int | None = None
    booted: bool = False
    # of `RAMP_OBJECTS`; None where it has none
    ramp_objects: dict[int, int | None] = field(default_factory=dict)

    @property
    def state(self) -> cia.State | None:
        """State by the last statusword, None before the first or for bits of no CiA 402 state."""
        try:
            return None if self.statusword is None else cia.state_of(self.statusword)
        except BusFaultError:
            return None


class Master:
    """A master that sends requests and stores the last values received.

    Every frame received goes through `dispatch`.
    """

    def __init__(self, link: MasterLink, bus: Bus) -> None:
        self.link, self.bus = link, bus
        self.nodes = [NodeWatch(drive=drive) for drive in bus.drives]
        self.bus_error: str | None = None
        # of another master, in words, and whether they command our drives
        self.signs: dict[str, bool] = {}
        # called every 50 ms while an SDO answer is awaited
        self.while_awaiting: Callable[[], None] = lambda: None
        self._commands = command_ids(bus)
        self.by_node = {watch.drive.node: watch for watch in self.nodes}
        self._by_pdo = {
            pdo.can_id: (watch, pdo) for watch in self.nodes for pdo in watch.drive.tpdos
        }
        self._answers: dict[int, bytes] = {}
        # SDO requests of any master, by node; a late answer is one too
        self.unanswered = Counter[int]()
        # nodes with more SDO answers than requests: two devices have their id
        self.doubled: set[int] = set()
        self._sized: set[int] = set()  # nodes that have stated a size below four bytes
        self.sync_times: list[int] = []
        self.synced_ns: int | None = None  # when we sent the last SYNC
        self.at_sync: Callable[[], None] = lambda: None  # called at every SYNC, from any producer

    def wait(self, until_ns: int, *, for_answers: bool = False) -> None:
        """Receive until `until_ns`; with `for_answers` only until every drive has answered SYNC."""
        self._receive(until_ns, lambda: for_answers and all(w.answers for w in self.nodes))

    def wait_for_sync(self, until_ns: int) -> bool:
        """Receive until another producer's SYNC; False where none came before `until_ns`."""
        count = len(self.sync_times)
        return self._receive(until_ns, lambda: len(self.sync_times) > count)

    def _receive(self, until_ns: int, enough: Callable[[], bool]) -> bool:
        """Receive until `enough` is true; False where it was not before `until_ns`."""
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
                # drives would apply targets at its times
                self.bus_error = "another producer sends SYNC"
            self._next_sync()
        elif function == cia.ANSWER and node:
            self._answers[node] = frame.data
            answer = cia.answer_of(frame.data)
            # Transfers in segments are left open here: their server may abort them, besides the
            # next answer or in time.
            if answer.kind != "other" and (answer.kind, answer.number) != (
                "abort",
                cia.ABORTS["timed out"],
            ):
                self.unanswered[node] -= 1
                self.doubled |= {node} if self.unanswered[node] < 0 else set()
        elif node in self.by_node and function == cia.HEARTBEAT and frame.data:
            watch = self.by_node[node]
            # Time of the link: an adapter may stamp frames by its own clock.
            watch.nmt, watch.heard_ns = frame.data[0] & 0x7F, self.link.now_ns()
            watch.started |= watch.nmt == OPERATIONAL
            watch.unstarted += not watch.started
            watch.booted |= frame.data[0] == 0
        elif node in self.by_node and function == cia.EMERGENCY and len(frame.data) >= 2:
            if code := int.from_bytes(frame.data[:2], "little"):  # 0: the error is cleared
                self.by_node[node].emergency = code
        else:
            self.unanswered[node] += function == cia.REQUEST
            self._note_sign(frame)

    def refuse_doubled(self) -> None:
        """Raise `RefusedError` where two devices have answered as one node."""
        if self.doubled:
            raise RefusedError(
                f"two devices answer as node {min(self.doubled)}",
                what="the session",
                place="bus",
                advice="Disconnect one of them, and change its node id",
            )

    def _note_sign(self, frame: Frame) -> None:
        # Our own frames never come here: a link leaves out those that its interface returns.
        if (sign := sign_of_master(frame, self.bus)) is not None:
            self.signs[sign] = frame.can_id in self._commands and not frame.flags & REMOTE_REQUEST

    def _process_data(self, frame: Frame) -> None:
        watch, pdo = self._by_pdo[frame.can_id]
        if len(frame.data) < pdo.length:
            return  # a PDO that is too short is ignored
        values, drive = pdo.unpack(frame.data), watch.drive
        watch.statusword = values.get(drive.status.key, watch.statusword)
        if (counts := values.get(drive.position.key)) is not None:
            watch.counts = counts
            watch.answers += 1

    def sync(self) -> None:
        """Send SYNC, and count the drives that did not answer the one before."""
        self._next_sync()
        self.synced_ns = self.link.now_ns()
        self.link.send(self.bus.file.sync_can_id, b"")

    def _next_sync(self) -> None:
        """Count the drives that did not answer the SYNC before, once they have reported
        operational or sent a position.
        """
        for watch in self.nodes:
            late = not watch.answers and (watch.started or watch.counts is not None)
            watch.silent_syncs = watch.silent_syncs + 1 if late else 0
            watch.answers = 0
        self.at_sync()

    def nmt(self, command: int, node: int) -> None:
        """Send an NMT command to one node; never to all (0), because other
        devices may be on the bus.
        """
        self.link.send(0, bytes([command, node]))

    def start(self) -> None:
        """Send START to all drives.

        Values received before are discarded, so that no old position is taken for a new one.
        """
        for watch in self.nodes:
            watch.statusword = watch.counts = watch.emergency = watch.nmt = None
            watch.answers = watch.silent_syncs = watch.unstarted = 0
            watch.booted = watch.started = False
            self.nmt(START, watch.drive.node)
        for watch in self.nodes:
            watch.heard_ns = self.link.now_ns()

    def state(self, drive: Drive) -> cia.State:
        """Return the state of a drive, read by SDO (6041h); raise `BusFaultError` if it does not
        answer.
        """
        return cia.state_of(self.read(drive.node, *drive.status.key))

    def read(self, node: int, index: int, sub: int = 0) -> int:
        """Read an object, as an unsigned number.

        Raises `BusFaultError` when refused or not answered.
        """
        return cia.check_answer(
            self.upload(node, index, sub), "value", node, _place(node, index, sub)
        )

    def upload(self, node: int, index: int, sub: int = 0) -> cia.Transfer:
        """Return the answer of any kind to a read request. Raises `NoAnswerError` when there is
        none.

        Where a drive has never stated a size below four bytes, values have that of their type: some
        state none (CiA 301, 7.2.4.3.6), or always four.
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
        """Write an object of `size` bytes. Raises `BusFaultError` when refused or not answered."""
        place = f"{_place(node, index, sub)} = {value}"
        cia.check_answer(
            cia.answer_of(self.exchange(node, cia.write_request(index, sub, value, size), place)),
            "written",
            node,
            place,
        )

    def post(self, node: int, request: bytes) -> None:
        """Send an SDO request without waiting; `answered` returns its answer."""
        self._answers.pop(node, None)
        self.link.send(cia.REQUEST + node, request)
        self.unanswered[node] += 1

    def answered(self, node: int, request: bytes) -> bytes | None:
        """Return the answer to a request sent by `post`, once; None until it has arrived."""
        answer = self._answers.pop(node, None)
        if answer is None or len(answer) != 8:
            return None
        if request[0] >> 5 == 3:  # for a segment: the answer has its toggle bit, or is an abort
            return answer if answer[0] >> 5 == 4 or answer[0] & 0xF0 == request[0] & 0x10 else None
        return answer if answer[1:4] == request[1:4] else None

    def exchange(self, node: int, request: bytes, place: str) -> bytes:
        """Send an SDO request and return its answer; raise `NoAnswerError` with `place` without
        one.
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


# controlword and target counts of each drive, in the order of the drives
Orders = list[tuple[int, int]]


def send_order(master: Master, watch: NodeWatch, control: int, target: int) -> None:
    """Send the RPDOs of one drive that carry only its command, target and mode.

    Raises `BusFaultError` when the bus accepts no frame.
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
