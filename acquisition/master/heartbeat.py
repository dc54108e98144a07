"""The heartbeat of this master, and the drives' supervision of it (CiA 301, 1016h: consumer heartbeat time).

The heartbeat is sent at SYNC and nowhere else: a session that hangs sends none, and drives that supervise it stop.
"""

import math

from ..errors import AcquisitionError
from ..protocol import CONSUMER_HEARTBEAT
from ..robot import BusFile
from .master import OPERATIONAL, Master

HEARTBEATS_PER_TIMEOUT = 3
HEARTBEAT_ID = 0x700  # of CAN identifiers, plus the node id


def timeout_ms(file: BusFile) -> int:
    """Time without a heartbeat of the master after which a drive reacts: three heartbeats, of a SYNC period at least."""
    return math.ceil(round(HEARTBEATS_PER_TIMEOUT * max(file.heartbeat_s, file.sync_period_s) * 1000, 6))


def entry_of(file: BusFile) -> int:
    """What this master writes to a sub-index of 1016h: node id << 16 | time-out in ms."""
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
    """Producer of the heartbeat; `request` before the first SYNC, `release` when drives are disabled."""

    def __init__(self, master: Master) -> None:
        self._master, self._file = master, master.bus.file
        self._before: dict[int, tuple[int, int]] = {}  # node: sub-index, and what was there
        # A heartbeat is due at the last SYNC that is not later than `heartbeat_s` after the one before.
        self._due_ns = round(self._file.heartbeat_s * 1e9) - master.bus.period_ns
        self._sent_ns: int | None = None

    def request(self) -> list[str]:
        """Ask every drive to supervise this master; one line for each that cannot. From now on SYNC carries heartbeats.

        A consumer starts at the first heartbeat: nothing is supervised before.
        """
        refused = []
        for drive in self._master.bus.drives:
            node, entry = drive.node, entry_of(self._file)
            try:
                entries = consumers(self._master, node)
                sub = free_entry(entries, self._file.master_node)
                if sub is None:
                    raise AcquisitionError(f"node {node}: object 1016: no free sub-index: expected one")
                was = entries[sub - 1]
                # Our own entry was left by a session that was killed.
                self._before[node] = (sub, 0 if was == entry else was)
                self._master.write(node, CONSUMER_HEARTBEAT, sub, entry, 4)
            except AcquisitionError as error:
                self._before.pop(node, None)
                refused.append(f"{error}: the drive does not notice when this master dies")
        self._master.at_sync = self._at_sync
        return refused

    def release(self, disabled: list[int]) -> list[str]:
        """Restore 1016h of the nodes in `disabled`, then end the heartbeat; one line for each node that refuses.

        The others keep their supervision: the end of the heartbeat stops them.
        """
        refused = []
        for node in disabled:
            if node in self._before:
                sub, was = self._before.pop(node)
                try:
                    self._send()
                    self._master.write(node, CONSUMER_HEARTBEAT, sub, was, 4)
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
        self._master.link.send(HEARTBEAT_ID + self._file.master_node, bytes([OPERATIONAL]))
