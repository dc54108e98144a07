"""Sessions on simulated drives in simulated time, for tests."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.bus import Frame, Master, MasterLink, configure, needs_of
from acquisition.commands.checking import Finding, check_drives
from acquisition.protocol import DISABLED, Command, State
from acquisition.recording import FRAME, SENT, Block, Recording, read_recording
from acquisition.robot import Bus, Robot
from acquisition.session import (
    InlineLog,
    Outcome,
    RecordedSummary,
    Recorder,
    Stop,
    Task,
    run_active,
)
from acquisition.simulated import (
    DrivenPlant,
    LockStepLink,
    Plant,
    SimulatedDrives,
    SimulatedNode,
    cascaded_loops,
    rated_motor_effort,
    typical_inertia,
)


def swing(
    n: int, *, seconds: float = 1.0, period_s: float = 0.002, amplitude: float = 0.3
) -> np.ndarray:
    t = np.arange(round(seconds / period_s) + 1) * period_s
    return np.repeat(amplitude * (1 - np.cos(2 * np.pi * t / seconds))[:, None], n, axis=1)


class Answering:
    """A link whose time goes on where nothing comes; `answer` gives what comes
    after a frame that is sent.
    """

    def __init__(
        self, answer: Callable[[int, bytes], list[tuple[int, bytes]]] = lambda can_id, data: []
    ) -> None:
        self.answer, self.sent, self.waiting, self.time_ns = answer, [], [], 1_000_000_000

    def now_ns(self):
        return self.time_ns

    def send(self, can_id, data):
        self.sent.append((can_id, data))
        self.waiting += self.answer(can_id, data)

    def receive(self, until_ns):
        if self.waiting:
            return Frame(self.time_ns, *self.waiting.pop(0))
        self.time_ns = max(self.time_ns, until_ns)
        return None

    def close(self):
        pass


@dataclass(kw_only=True)
class Through:
    """A link that passes everything on; tests override what they damage."""

    link: object

    def now_ns(self) -> int:
        return self.link.now_ns()  # type: ignore[attr-defined,no-any-return]

    def send(self, can_id: int, data: bytes) -> None:
        self.link.send(can_id, data)  # type: ignore[attr-defined]

    def receive(self, until_ns: int) -> Frame | None:
        return self.link.receive(until_ns)  # type: ignore[attr-defined,no-any-return]


@dataclass(kw_only=True)
class Unasked(Through):
    """Frames of somebody else come at their times."""

    frames: list[Frame]

    def receive(self, until_ns):
        if self.frames and self.frames[0].time_ns <= self.now_ns():
            return self.frames.pop(0)._replace(time_ns=self.now_ns())
        frame = super().receive(min([until_ns, *(f.time_ns for f in self.frames[:1])]))
        return self.receive(until_ns) if frame is None and self.now_ns() < until_ns else frame


@dataclass(kw_only=True)
class Edited(Through):
    """Frames come as `edit` makes them, or are lost where it makes None of them."""

    edit: Callable[[Frame], Frame | None]

    def receive(self, until_ns):
        while True:
            frame = super().receive(until_ns)
            if frame is None or (frame := self.edit(frame)) is not None:
                return frame


@dataclass(kw_only=True)
class At(Through):
    at_ns: int
    act: Callable[[], object] | None

    def receive(self, until_ns):
        if self.act is not None and self.now_ns() > self.at_ns:
            self.act, act = None, self.act
            act()
        return super().receive(until_ns)


@dataclass(kw_only=True)
class SyncOfAnother(Through):
    next_ns: int = 1_050_000_000
    ends_ns: int = 4_000_000_000

    def receive(self, until_ns):
        if self.next_ns >= self.ends_ns:
            return super().receive(until_ns)
        frame = super().receive(min(until_ns, self.next_ns))
        if frame is None and self.now_ns() >= self.next_ns:
            self.next_ns += 2_000_000
            self.link.send(0x80, b"")
            return Frame(self.now_ns(), 0x80, b"")
        return frame


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault of drive `node` from the `sync`-th SYNC that it answers (from 1), for `count` SYNCs.

    `slow`: it stays in switched on; `deaf`: it neither answers SYNC nor applies PDOs; `clear`:
        `bits` of its statusword are 0.
    """

    kind: str
    node: int
    sync: int
    count: int = 1
    bits: int = 0


class FaultyDrives(SimulatedDrives):
    """Drives with `faults`; those in `silent`, by index, send nothing; frames in `late` (time,
    identifier, data) come late.
    """

    def __init__(
        self,
        robot: Robot,
        bus: Bus,
        mechanism: DrivenPlant | None = None,
        faults: Sequence[Fault] = (),
        *,
        supervised: bool = True,
    ) -> None:
        super().__init__(robot, bus, mechanism, supervised=supervised)
        self.silent: set[int] = set()
        self.late: list[tuple[int, int, bytes]] = []
        self._faults, self._answered = tuple(faults), [0] * robot.n

    @property
    def states(self):
        return [node.state for node in self.nodes]

    def receive(self, now_ns, can_id, data):
        return self._audible(super().receive(now_ns, can_id, data))

    def due_ns(self):
        due = [due_ns for due_ns, _, _ in self.late] + [super().due_ns()]
        return min((t for t in due if t is not None), default=None)

    def advance(self, now_ns):
        late = sorted(
            (frame for frame in self.late if frame[0] <= now_ns), key=lambda frame: frame[0]
        )
        self.late = [frame for frame in self.late if frame[0] > now_ns]
        return [frame[1:] for frame in late] + self._audible(super().advance(now_ns))

    def _audible(self, sent):
        silent = [self.nodes[i].drive.node for i in self.silent]
        return [(can_id, data) for can_id, data in sent if can_id & 0x7F not in silent]

    def _answer(self, i, now_ns):
        self._answered[i] += 1
        node, k = self.nodes[i], self._answered[i]
        acting = [
            f for f in self._faults if f.node == node.drive.node and f.sync <= k < f.sync + f.count
        ]
        kinds = [fault.kind for fault in acting]
        node.values[node.drive.status.index, 0] &= ~sum(
            fault.bits for fault in acting if fault.kind == "clear"
        )
        if "deaf" in kinds:
            return []
        was = node.state
        frames = super()._answer(i, now_ns)
        if was is State.SWITCHED_ON and node.state is State.OPERATION_ENABLED and "slow" in kinds:
            node.state = was
        before = []
        for kind in kinds:
            if kind == "emergency":
                before += node.emergency(0x2310)  # continuous over current
            elif kind == "silent":
                self.silent.add(i)
            elif kind == "reset":
                return node.boot()
            elif kind == "late":
                late_ns = now_ns + round(1.1 * self.bus.period_ns)
                self.late += [(late_ns, can_id, data) for can_id, data in frames]
                frames = []
            elif kind == "missing":
                frames = []
            elif kind == "duplicate":
                frames = frames * 2
            elif kind == "short":
                frames = [(can_id, data[:-1]) for can_id, data in frames]
        return before + frames


class Moved:
    q = np.zeros(2)

    def state(self):
        return self.q.copy(), np.zeros(2)

    def prescribed_effort(self):
        return np.zeros(2)


class SlowAnswers(FaultyDrives):
    """Drives that answer an SDO request 60 to 100 ms late, once they are operational."""

    asked = 0

    def receive(self, now_ns, can_id, data):
        sent = super().receive(now_ns, can_id, data)
        late = [
            frame
            for frame in sent
            if 0x580 < frame[0] < 0x600 and self.nodes[frame[0] - 0x581].operational
        ]
        self.asked += len(late)
        due_ns = now_ns + 60_000_000 + self.asked * 7_000_000 % 40_000_000
        self.late += [(due_ns, *frame) for frame in late]
        return [frame for frame in sent if frame not in late]


@dataclass(frozen=True, kw_only=True)
class DrySession:
    outcome: Outcome | None
    raised: BaseException | None
    drives: SimulatedDrives
    recorded: RecordedSummary
    recording: Recording
    announced: tuple[Outcome, ...]

    def events(self, kind: str) -> list[str]:
        return [e.text for e in self.recording.events if e.kind == kind]

    @property
    def phases(self) -> dict[str, int]:
        return {e.text: e.stamp_ns for e in self.recording.events if e.kind == "phase"}

    @property
    def frames(self) -> Block:
        return next(iter(self.recording.frames.values()), np.zeros(0, FRAME))

    @property
    def sent(self) -> Block:
        return self.frames[(self.frames["flags"] & SENT) != 0]


def dry_session(
    path: Path,
    task: Task,
    *,
    robot: Robot | None = None,
    bus: Bus | None = None,
    faults: Sequence[Fault] = (),
    plant: Plant | None = None,
    through: Callable[..., Through] = Through,
    stop: Stop | None = None,
    drives: Bus | None = None,
    simulated: type[FaultyDrives] = FaultyDrives,
    log_of: Callable[[Recorder], InlineLog] = InlineLog,
    announce: Callable[[Outcome], None] = lambda _: None,
    read_from: Path | None = None,
) -> DrySession:
    """A session from start to end; what is left afterwards, 0.2 s later, whatever was raised:
    drives that are disabled.

    `drives` are those on the bus, where they are others than the session thinks.
    """
    robot = robot or robot_of(bus_text(2))
    bus = bus or bus_of(robot)
    log = log_of(Recorder(path, robot, source="dry run", place="robot.toml"))
    loops = cascaded_loops(robot, typical_inertia(robot, rated_motor_effort(bus)))
    mechanism = None if plant is None else DrivenPlant(plant=plant, loops=loops)
    run = LockStepLink(simulated(robot, drives or bus, mechanism, faults), tap=log.tap)
    outcome, raised = None, None
    announced: list[Outcome] = []

    def announce_to_all(outcome: Outcome) -> None:
        announced.append(outcome)
        announce(outcome)

    try:
        master = Master(through(link=run), bus)
        outcome = run_active(robot, master, log, task, stop or Stop(), announce_to_all)
    except BaseException as error:
        raised = error
    until_ns = run.now_ns() + 200_000_000
    while run.receive(until_ns):
        pass
    assert DISABLED.issuperset(run.drives.states)
    recorded = log.finish(run.now_ns())
    return DrySession(
        outcome=outcome,
        raised=raised,
        drives=run.drives,
        recorded=recorded,
        recording=read_recording(read_from or path),
        announced=tuple(announced),
    )


def connected(
    robot: Robot | None = None, kind: type[SimulatedDrives] = FaultyDrives, **how: object
) -> tuple[LockStepLink, Master]:
    """Simulated drives of a robot, of two joints unless another is given, and
    a master on their bus.
    """
    robot = robot or robot_of(bus_text(2))
    run = LockStepLink(kind(robot, bus_of(robot), **how))
    return run, Master(run, run.drives.bus)


def enable(master: Master, *, start: bool = True) -> None:
    drives = master.bus.drives
    needs = [need for drive in drives for need in needs_of(master, drive, track=True)]
    configure(master, needs, track=True)
    for watch in master.nodes:
        watch.ramp_objects.clear()  # they are read again by the stop
    if start:
        master.start()
    for watch in master.nodes:
        for command in (Command.SHUTDOWN, Command.SWITCH_ON, Command.ENABLE_OPERATION):
            master.write(watch.drive.node, 0x6040, 0, command.controlword, 2)


def findings(
    link: MasterLink, bus: Bus, subject: str = "", node: int | None = None
) -> list[Finding]:
    """What `check` finds about the drives, or of it only what it finds about one
    subject, or of one node.
    """
    found = check_drives(link, bus)
    return [f for f in found if subject in ("", f.subject) and node in (None, f.node)]


def at_boot(patch: pytest.MonkeyPatch, change: Callable[[SimulatedNode], object]) -> None:
    boot = SimulatedNode.boot

    def changed(node: SimulatedNode) -> object:
        sent = boot(node)
        change(node)
        return sent

    patch.setattr(SimulatedNode, "boot", changed)


def say(patch: pytest.MonkeyPatch, word: Callable[[int, int], int]) -> None:
    """Every simulated drive says the statusword that `word` makes of its node and
    of its own statusword.
    """
    plain = SimulatedNode.statusword.fget
    patch.setattr(
        SimulatedNode, "statusword", property(lambda node: word(node.drive.node, plain(node)))
    )
