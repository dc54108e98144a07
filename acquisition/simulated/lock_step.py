"""Simulated drives on a bus: in lock-step with a session in this process, or in real time for any master."""

import itertools
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import msgspec

from ..errors import AcquisitionError
from ..robot import Bus, Robot
from ..transport import Link, LockStepLink, Tap, open_bus, open_link
from .drives import SimulatedDrives
from .faults import SimulatedFault
from .mechanism import Mechanism, mechanism_of

IDLE_HEARTBEAT_MS = 200  # before a master sets another: who listens first must hear them
_NUMBERS = itertools.count()


@dataclass(frozen=True, kw_only=True, eq=False)
class DryRun:
    """A link in simulated time, and the drives at its other end; `close` both."""

    link: LockStepLink
    drives: SimulatedDrives
    other_end: Link

    def close(self) -> None:
        """Leave the bus."""
        self.link.close()
        self.other_end.close()


def dry_run(
    robot: Robot,
    bus: Bus,
    mechanism: Mechanism | None = None,
    faults: Sequence[SimulatedFault] = (),
    *,
    tap: Tap | None = None,
    passive: bool = False,
    supervised: bool = True,
) -> DryRun:
    """Simulated drives on an in-process `virtual` bus, in lock-step with the link: simulated time, the same every run."""
    drives = _drives(robot, bus, mechanism, faults, supervised=supervised)
    file = msgspec.structs.replace(bus.file, interface="virtual", channel=f"dry_run_{next(_NUMBERS)}")
    other_end = Link(open_bus(file, passive=False), passive=False)
    own = open_bus(file, passive=passive)

    def others(now_ns: int) -> bool:
        frame = other_end.take(0)
        sent = [] if frame is None else drives.receive(now_ns, frame.can_id, frame.data)
        if frame is None:
            due = drives.due_ns()
            if due is not None and due <= now_ns:
                sent = drives.advance(now_ns)
        for can_id, data in sent:
            other_end.send(can_id, data)
        return frame is not None or bool(sent)

    link = LockStepLink(own, others, drives.due_ns, passive=passive, tap=tap)
    for can_id, data in drives.boot():
        other_end.send(can_id, data)
    return DryRun(link=link, drives=drives, other_end=other_end)


def serve(
    robot: Robot,
    bus: Bus,
    stopped: Callable[[], bool],
    mechanism: Mechanism | None = None,
    faults: Sequence[SimulatedFault] = (),
    ready: Callable[[], None] = lambda: None,
    *,
    supervised: bool = True,
) -> SimulatedDrives:
    """Simulated drives on the bus of the description, in real time, until `stopped()`; `ready` is called at the start."""
    drives = _drives(robot, bus, mechanism, faults, supervised=supervised)
    link = open_link(bus.file, passive=False)
    try:
        drives.tell_heartbeats(IDLE_HEARTBEAT_MS)
        sent = drives.boot()
        ready()
        while not stopped():
            for can_id, data in sent:
                link.send(can_id, data)
            now_ns = link.now_ns()
            due = drives.due_ns()
            frame = link.receive(min(now_ns + 50_000_000, due if due is not None else now_ns + 50_000_000))
            sent = [] if frame is None else drives.receive(link.now_ns(), frame.can_id, frame.data)
            if frame is None or (due is not None and due <= now_ns):  # a full bus keeps no heartbeat back
                sent = sent + drives.advance(link.now_ns())
    finally:
        with suppress(AcquisitionError):
            link.close()
    return drives


def _drives(
    robot: Robot, bus: Bus, mechanism: Mechanism | None, faults: Sequence[SimulatedFault], *, supervised: bool
) -> SimulatedDrives:
    mechanism = mechanism or mechanism_of(robot, bus)
    return SimulatedDrives(robot, bus, mechanism.plant, mechanism.loops, faults, supervised=supervised)
