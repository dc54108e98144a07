"""How a simulated drive reacts (6007h) to a lost master: lost heartbeats (1016h) and lost SYNC."""

from ..protocol import ABORT_CONNECTION, CONSUMER_HEARTBEAT, DISABLED, State
from .node import Sent, SimulatedNode

SYNC_LOST_NS = 100_000_000  # without SYNC for so long an enabled drive goes into fault, as a real one is set up to do
SYNC_LOST_CODE = 0x8700  # CiA 301: sync controller
HEARTBEAT_LOST_CODE = 0x8130  # CiA 301: life guard or heartbeat error
# 6007h, abort connection option code: state that an enabled drive goes to. 1, the fault signal, is handled below.
_REACTIONS = {2: State.SWITCH_ON_DISABLED, 3: State.QUICK_STOP_ACTIVE}


def leave_unsupervised(node: SimulatedNode) -> None:
    """Take away the drive's own supervision of its master: no 1016h, and no reaction to a lost connection."""
    for key in [key for key in node.values if key[0] == CONSUMER_HEARTBEAT]:
        del node.values[key]
    node.values[ABORT_CONNECTION, 0] = 0
    node.initial = dict(node.values)


class Supervision:
    """Of one drive. Where `watches_sync` is False it minds its heartbeat consumers alone."""

    def __init__(self, node: SimulatedNode, *, watches_sync: bool = True) -> None:
        self._node, self._watches_sync = node, watches_sync
        self._heard: dict[int, tuple[int, int]] = {}  # sub-index of 1016h: the entry then, and when
        self._sync_ns: int | None = None

    def sync(self, now_ns: int) -> None:
        """A SYNC came."""
        self._sync_ns = now_ns

    def heartbeat(self, now_ns: int, producer: int) -> None:
        """A heartbeat came: it starts the consumers of that producer (CiA 301, 7.2.8.3.3)."""
        for sub, entry in self._entries().items():
            if entry >> 16 == producer and entry & 0xFFFF:
                self._heard[sub] = (entry, now_ns)

    def due_ns(self) -> int | None:
        """When the next thing is lost, if nothing comes."""
        times = list(self._deadlines().values())
        if self._sync_lost_ns is not None:
            times.append(self._sync_lost_ns)
        return min(times, default=None)

    def advance(self, now_ns: int) -> Sent:
        """React to what is lost; emergency messages."""
        sent: Sent = []
        lost = [sub for sub, deadline in self._deadlines().items() if now_ns >= deadline]
        for sub in lost:
            del self._heard[sub]  # it starts again at the next heartbeat
        if lost:
            sent += self._lose_the_master()
        if self._sync_lost_ns is not None and now_ns >= self._sync_lost_ns:
            sent += self._fault(SYNC_LOST_CODE)
        return sent

    @property
    def _sync_lost_ns(self) -> int | None:
        minds = self._watches_sync and self._node.state not in DISABLED
        return None if self._sync_ns is None or not minds else self._sync_ns + SYNC_LOST_NS

    def _entries(self) -> dict[int, int]:
        values = self._node.values
        return {
            sub: values[CONSUMER_HEARTBEAT, sub]
            for sub in range(1, values.get((CONSUMER_HEARTBEAT, 0), 0) + 1)
            if (CONSUMER_HEARTBEAT, sub) in values
        }

    def _deadlines(self) -> dict[int, int]:
        """When each running consumer runs out; one that was written anew waits for its first heartbeat."""
        entries = self._entries()
        return {
            sub: then_ns + (entry & 0xFFFF) * 1_000_000
            for sub, (entry, then_ns) in self._heard.items()
            if entries.get(sub) == entry
        }

    def _lose_the_master(self) -> Sent:
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
