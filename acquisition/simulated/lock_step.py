"""Simulated drives on a bus: in lock-step with a session in this process, or in real time for any master."""

import itertools
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import msgspec

from ..bus import Link, LockStepLink, Tap, open_bus, open_link
from ..errors import AcquisitionError
from .drives import SimulatedDrives

IDLE_HEARTBEAT_MS = 200  # until a master sets another: a master that listens first must hear them
_NUMBERS = itertools.count()


@dataclass(frozen=True, kw_only=True, eq=False)
class DryRun:
    """The link of a session in simulated time, and the drives at the other end of the bus; `close` closes both ends."""

    link: LockStepLink
    drives: SimulatedDrives
    other_end: Link

    def close(self) -> None:
        """Close both ends of the bus."""
        self.link.close()
        self.other_end.close()


def dry_run(drives: SimulatedDrives, *, tap: Tap | None = None) -> DryRun:
    """Put simulated drives, not booted yet, on an in-process `virtual` bus, in lock-step with the link of a session.

    Time is simulated: it advances only when the link waits, and every run with the same drives gives the same frames. `tap`
    is called with every frame that the session's link sends or receives.
    """
    file = msgspec.structs.replace(drives.bus.file, interface="virtual", channel=f"dry_run_{next(_NUMBERS)}")
    other_end = Link(open_bus(file, passive=False), passive=False)
    own = open_bus(file, passive=False)

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

    link = LockStepLink(own, others, drives.due_ns, passive=False, tap=tap)
    for can_id, data in drives.boot():
        other_end.send(can_id, data)
    return DryRun(link=link, drives=drives, other_end=other_end)


def serve(drives: SimulatedDrives, stopped: Callable[[], bool], ready: Callable[[], None] = lambda: None) -> None:
    """Simulated drives, not booted yet, on the bus of their description, in real time, for any master.

    `stopped` is asked at least every 50 ms, and True ends the simulation; `ready` is called once the drives have booted.
    Raises `AcquisitionError` where the bus cannot be opened, or takes or gives no frames any more.
    """
    link = open_link(drives.bus.file, passive=False)
    try:
        drives.set_heartbeats(IDLE_HEARTBEAT_MS)
        sent = drives.boot()
        ready()
        while not stopped():
            for can_id, data in sent:
                link.send(can_id, data)
            now_ns = link.now_ns()
            due = drives.due_ns()
            frame = link.receive(min(now_ns + 50_000_000, due if due is not None else now_ns + 50_000_000))
            sent = [] if frame is None else drives.receive(link.now_ns(), frame.can_id, frame.data)
            if frame is None or (due is not None and due <= now_ns):  # heartbeats are sent on a busy bus too
                sent = sent + drives.advance(link.now_ns())
    finally:
        with suppress(AcquisitionError):
            link.close()
