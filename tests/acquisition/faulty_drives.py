"""Simulated drives that show faults, for tests."""

from collections.abc import Sequence
from dataclasses import dataclass

from acquisition.protocol import State
from acquisition.robot import Bus, Robot
from acquisition.simulated import DrivenPlant, SimulatedDrives


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault of drive `node` from the `sync`-th SYNC that it answers (from 1), for `count` SYNCs.

    `emergency`: continuous over current (2310h); `reset`: it boots; `late`, `missing`, `duplicate`, `short`: its PDOs are;
    `silent`: it sends nothing from then on; `slow`: it stays in switched on when it is to be enabled; `deaf`: it neither
    answers SYNC nor applies the PDOs received before it; `clear`: the `bits` of its statusword are 0.
    """

    kind: str
    node: int
    sync: int
    count: int = 1
    bits: int = 0


class FaultyDrives(SimulatedDrives):
    """Drives with `faults`; those in `silent`, by index, send nothing; frames in `late` (time, identifier, data) come late."""

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

    def receive(self, now_ns, can_id, data):
        return self._audible(super().receive(now_ns, can_id, data))

    def due_ns(self):
        due = [due_ns for due_ns, _, _ in self.late] + [super().due_ns()]
        return min((t for t in due if t is not None), default=None)

    def advance(self, now_ns):
        late = sorted((frame for frame in self.late if frame[0] <= now_ns), key=lambda frame: frame[0])
        self.late = [frame for frame in self.late if frame[0] > now_ns]
        return [frame[1:] for frame in late] + self._audible(super().advance(now_ns))

    def _audible(self, sent):
        silent = [self.nodes[i].drive.node for i in self.silent]
        return [(can_id, data) for can_id, data in sent if can_id & 0x7F not in silent]

    def _answer(self, i, now_ns):
        self._answered[i] += 1
        node, k = self.nodes[i], self._answered[i]
        acting = [f for f in self._faults if f.node == node.drive.node and f.sync <= k < f.sync + f.count]
        kinds = [fault.kind for fault in acting]
        node.values[node.drive.status.index, 0] &= ~sum(fault.bits for fault in acting if fault.kind == "clear")
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
