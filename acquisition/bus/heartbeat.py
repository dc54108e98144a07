"""The heartbeat of this master, and the drives' supervision of it (CiA 301, 1016h: consumer heartbeat time).

The heartbeat is sent only at SYNC: a session that hangs sends none, so the drives that supervise it stop.
"""

import math

from ..errors import AcquisitionError
from ..protocol import CONSUMER_HEARTBEAT, HEARTBEAT
from ..robot import BusFile
from .master import OPERATIONAL, Master

HEARTBEATS_PER_TIMEOUT = 3


def timeout_ms(file: BusFile) -> int:
    """Time without a heartbeat of the master after which a drive reacts: three times its interval, a SYNC period at least."""
    return math.ceil(round(HEARTBEATS_PER_TIMEOUT * max(file.heartbeat_s, file.sync_period_s) * 1000, 6))


def entry_of(file: BusFile) -> int:
    """The value (U32) that this master writes to a sub-index of 1016h: node id << 16 | time-out in ms."""
    return file.master_node << 16 | timeout_ms(file)


def consumers(master: Master, node: int) -> list[int]:
    """Entries of a drive's 1016h, from sub-index 1. Raises `AcquisitionError` where it has none."""
    return [master.read(node, CONSUMER_HEARTBEAT, k + 1) for k in range(master.read(node, CONSUMER_HEARTBEAT, 0))]


def free_entry(entries: list[int], master_node: int) -> int | None:
    """Sub-index of 1016h for `master_node`: its own, or an unused one; None where there is none.

    CiA 301 allows one entry for each producer. An entry of time 0, or of a node id outside 1 to 127, is unused.
    """
    own = [k for k, entry in enumerate(entries, 1) if entry >> 16 == master_node]
    unused = [k for k, entry in enumerate(entries, 1) if not entry & 0xFFFF or not 1 <= entry >> 16 <= 127]
    return next(iter(own + unused), None)


class MasterHeartbeat:
    """Produces the heartbeat; call `request` before the first SYNC, and `release` once drives are disabled."""

    def __init__(self, master: Master) -> None:
        self._master, self._file = master, master.bus.file
        self._before: dict[int, tuple[int, int]] = {}  # by node: sub-index of 1016h, and its value before
        # A heartbeat is due at the last SYNC that is not later than `heartbeat_s` after the one before.
        self._due_ns = round(self._file.heartbeat_s * 1e9) - master.bus.period_ns
        self._sent_ns: int | None = None

    def request(self) -> list[str]:
        """Write this master to 1016h of every drive, and send heartbeats with SYNC from now on; they start the supervision.

        Returns a line, with the reason, for each drive that does not supervise this master.
        """
        refused = []
        for drive in self._master.bus.drives:
            node, entry = drive.node, entry_of(self._file)
            try:
                entries = consumers(self._master, node)
                sub = free_entry(entries, self._file.master_node)
                if sub is None:
                    raise AcquisitionError("no free sub-index", place=f"node {node}: object 1016", expected="one")
                before = entries[sub - 1]
                # An entry of this master was left by a session that was killed: it is removed at the end.
                self._before[node] = (sub, 0 if before == entry else before)
                self._master.write(node, CONSUMER_HEARTBEAT, sub, entry, 4)
            except AcquisitionError as error:
                self._before.pop(node, None)
                refused.append(f"{error}: the drive does not notice when this master dies")
        self._master.at_sync = self._at_sync
        return refused

    def release(self, disabled: list[int]) -> list[str]:
        """Restore 1016h of the nodes in `disabled`, then end the heartbeat; a line for each node that refuses the old value.

        The other drives still supervise this master: they stop when the heartbeat ends.
        """
        refused = []
        for node in disabled:
            if node in self._before:
                sub, before = self._before.pop(node)
                try:
                    self._send()
                    self._master.write(node, CONSUMER_HEARTBEAT, sub, before, 4)
                except AcquisitionError as error:
                    refused.append(str(error))
        self._master.at_sync = lambda: None
        return refused

    def _at_sync(self) -> None:
        now_ns = self._master.link.now_ns()
        if self._sent_ns is None or now_ns - self._sent_ns > self._due_ns:
            self._send()

    def _send(self) -> None:
        self._sent_ns = self._master.link.now_ns()
        self._master.link.send(HEARTBEAT + self._file.master_node, bytes([OPERATIONAL]))
