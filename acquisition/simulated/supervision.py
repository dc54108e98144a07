"""Reactions of a simulated drive (6007h) to a lost master: lost heartbeats (1016h) and lost SYNC."""

from ..protocol import ABORT_CONNECTION, CONSUMER_HEARTBEAT, DISABLED, FOLLOWING_ERROR_WINDOW, State
from ..robot import axis_of
from .node import Sent, SimulatedNode

SYNC_LOST_NS = 100_000_000  # an enabled drive without SYNC for so long goes into fault, as real drives are set to do
SYNC_LOST_CODE = 0x8700  # CiA 301: sync controller
FOLLOWING_ERROR_CODE, NO_WINDOW = 0x8611, 2**32 - 1
HEARTBEAT_LOST_CODE = 0x8130  # CiA 301: life guard or heartbeat error
# 6007h, abort connection option code: the state that an enabled drive changes to. 1 (fault signal) is handled below.
_REACTIONS = {2: State.SWITCH_ON_DISABLED, 3: State.QUICK_STOP_ACTIVE}


class Supervision:
    """By one drive, if `supervised`: heartbeat consumers, SYNC, following error over `window` counts."""

    def __init__(self, node: SimulatedNode, window: float, *, supervised: bool) -> None:
        self._node, self._watches_sync = node, supervised
        if not supervised:
            for key in [key for key in node.values if key[0] == CONSUMER_HEARTBEAT]:
                del node.values[key]
            node.values[ABORT_CONNECTION, 0] = 0
            node.initial = dict(node.values)
            window = NO_WINDOW
        self._window = (FOLLOWING_ERROR_WINDOW + axis_of(node.drive), 0)
        if self._window in node.values:
            node.values[self._window] = node.initial[self._window] = round(min(window, NO_WINDOW))
        # By sub-index of 1016h: its entry at the last heartbeat, and the time of that.
        self._heard: dict[int, tuple[int, int]] = {}
        self._sync_ns: int | None = None

    def sync(self, now_ns: int) -> None:
        """Take note of a SYNC."""
        self._sync_ns = now_ns

    def follow(self, counts: float) -> Sent:
        """React to a following error of so many counts."""
        window = self._node.values.get(self._window, NO_WINDOW)
        beyond = self._node.state is State.OPERATION_ENABLED and window != NO_WINDOW and abs(counts) > window
        return self._fault(FOLLOWING_ERROR_CODE) if beyond else []

    def heartbeat(self, now_ns: int, producer: int) -> None:
        """Take note of a heartbeat: it starts the consumers of that producer (CiA 301, 7.2.8.3.3)."""
        for sub, entry in self._entries().items():
            if entry >> 16 == producer and entry & 0xFFFF:
                self._heard[sub] = (entry, now_ns)

    def due_ns(self) -> int | None:
        """When a heartbeat or SYNC counts as lost next, if none is received; None where nothing is supervised."""
        times = list(self._deadlines().values())
        if self._sync_lost_ns is not None:
            times.append(self._sync_lost_ns)
        return min(times, default=None)

    def advance(self, now_ns: int) -> Sent:
        """React to lost heartbeats and lost SYNC; the emergency messages."""
        sent: Sent = []
        lost = [sub for sub, deadline in self._deadlines().items() if now_ns >= deadline]
        for sub in lost:
            del self._heard[sub]  # starts again at the next heartbeat
        if lost:
            sent += self._react_to_lost_heartbeat()
        if self._sync_lost_ns is not None and now_ns >= self._sync_lost_ns:
            sent += self._fault(SYNC_LOST_CODE)
        return sent

    @property
    def _sync_lost_ns(self) -> int | None:
        supervised = self._watches_sync and self._node.state not in DISABLED
        return None if self._sync_ns is None or not supervised else self._sync_ns + SYNC_LOST_NS

    def _entries(self) -> dict[int, int]:
        values = self._node.values
        return {
            sub: values[CONSUMER_HEARTBEAT, sub]
            for sub in range(1, values.get((CONSUMER_HEARTBEAT, 0), 0) + 1)
            if (CONSUMER_HEARTBEAT, sub) in values
        }

    def _deadlines(self) -> dict[int, int]:
        """Time at which each consumer times out; one that was rewritten starts with the next heartbeat."""
        entries = self._entries()
        self._heard = {sub: heard for sub, heard in self._heard.items() if entries.get(sub) == heard[0]}
        return {sub: then_ns + (entry & 0xFFFF) * 1_000_000 for sub, (entry, then_ns) in self._heard.items()}

    def _react_to_lost_heartbeat(self) -> Sent:
        node, option = self._node, self._node.values.get((ABORT_CONNECTION, 0), 0)
        if option == 1:
            return self._fault(HEARTBEAT_LOST_CODE)
        if node.state is State.OPERATION_ENABLED:
            node.state = _REACTIONS.get(option, node.state)
        node.tick()
        return node.error(HEARTBEAT_LOST_CODE)

    def _fault(self, code: int) -> Sent:
        frames = self._node.emergency(code)
        self._node.tick()
        return frames
