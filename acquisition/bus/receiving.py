"""Receives frames in a thread; their stamps continue where the computer's clock is set."""

import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from ..arrays import Ints
from ..recording import CAN_FD, ERROR, EXTENDED, FRAME, REMOTE_REQUEST, SENT, Block
from .frames import block_of, frame_of
from .links import is_no_frame, socket_of

_CAN_FRAME = np.dtype(
    [("can_id", "<u4"), ("length", "u1"), ("pad", "u1", (3,)), ("data", "u1", (8,))]
)
_FD_BYTES = 72  # of a frame of CAN FD, which begins as a classic one
_TIMESPEC_BYTES = 16


class Receiver:
    """A receiver of frames by `run` in one thread; `take` returns them in another."""

    DRAIN_S = 2.0  # at most, to read the kernel's queue when a recording ends

    def __init__(self, bus: Any) -> None:
        self._bus, self._items = bus, deque[Any]()
        self.sock = socket_of(bus)
        # A SocketCAN socket is read directly, at a third of the cost of python-can's messages.
        self._raw = self.sock if getattr(bus, "socket", None) is self.sock else None
        self.stopped = False
        self.error: str | None = None

    def run(self) -> None:
        """Receive until `stopped` and the queue is empty; an error of the bus ends it
        and is stored in `error`.
        """
        try:
            if self._raw is None:
                self._run_messages()
            else:
                self._run_raw(self._raw)
        except Exception as error:  # of any kind: whoever reads `error` must see it
            self.error = str(error) or type(error).__name__

    def _run_raw(self, sock: socket.socket) -> None:
        sock.setblocking(True)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", 0, 100_000))
        size, receive = socket.CMSG_SPACE(_TIMESPEC_BYTES), sock.recvmsg
        while not self.stopped:
            with suppress(BlockingIOError, InterruptedError):
                self._items.append(receive(_FD_BYTES, size)[:3])
        until_s = time.monotonic() + self.DRAIN_S
        with suppress(BlockingIOError):  # the queue is empty
            while time.monotonic() < until_s:
                self._items.append(receive(_FD_BYTES, size, socket.MSG_DONTWAIT)[:3])

    def _run_messages(self) -> None:
        import can

        until_s = None
        while until_s is None or time.monotonic() < until_s:
            if self.stopped and until_s is None:
                until_s = time.monotonic() + self.DRAIN_S
            try:
                message = self._bus.recv(0.1 if until_s is None else 0.0)
            except can.CanOperationError as error:
                if not is_no_frame(self._bus, error):
                    raise
                continue
            if message is not None:
                self._items.append(message)
            elif until_s is not None:
                return

    def take(self) -> Block:
        """Return frames received since the last call, in order."""
        items = [self._items.popleft() for _ in range(len(self._items))]
        if not items:
            return np.zeros(0, FRAME)
        return _block_of_raw(items) if self._raw is not None else block_of(map(frame_of, items))


def _block_of_raw(items: list[Any]) -> Block:
    items = [item for item in items if len(item[0]) in (_CAN_FRAME.itemsize, _FD_BYTES) and item[1]]
    raw = np.frombuffer(b"".join(item[0][: _CAN_FRAME.itemsize] for item in items), _CAN_FRAME)
    stamps = np.frombuffer(b"".join(item[1][0][2] for item in items), "<i8").reshape(-1, 2)
    block = np.zeros(len(raw), FRAME)
    block["time_ns"] = stamps[:, 0] * 1_000_000_000 + stamps[:, 1]
    word = raw["can_id"]
    extended = (word & 0x80000000) != 0
    block["can_id"] = np.where(extended, word & 0x1FFFFFFF, word & 0x7FF)
    block["flags"] = (
        extended * EXTENDED
        | ((word & 0x40000000) != 0) * REMOTE_REQUEST
        | ((word & 0x20000000) != 0) * ERROR
        # made on this machine
        | (np.array([item[2] & socket.MSG_DONTROUTE for item in items]) != 0) * SENT
        | np.array([len(item[0]) == _FD_BYTES for item in items], bool) * CAN_FD
    )
    block["length"] = np.minimum(raw["length"], 8)
    block["data"] = raw["data"] * (np.arange(8) < block["length"][:, None])
    return block


MIN_STEP_NS = 50_000_000  # a clock that NTP only slews drifts less than this in half a second
_MAX_READ_NS = 5_000_000  # of both clocks; slower readings are repeated
_READINGS = 5
_MAX_BLOCKS_WAITED = 2  # for the stamps to jump


class WallClock:
    """A wall clock whose steps are detected by the monotonic clock; it continues timestamps without
    them.
    """

    def __init__(
        self,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        offset_ns: int | None = None,  # between the clocks when a session began; None: now
    ) -> None:
        self._wall_ns, self._monotonic_ns = wall_ns, monotonic_ns
        self._begin_ns = self._offset_ns = (
            wall_ns() - monotonic_ns() if offset_ns is None else offset_ns
        )
        self._last_ns: int | None = None  # latest stamp, uncorrected
        # a step not yet seen in the stamps, and for how many blocks
        self._pending_ns, self._waited = 0, 0
        self.shift_ns = 0  # sum of the steps removed from stamps

    def now_ns(self) -> int:
        """Return the time without the steps of the wall clock, ns."""
        return self._begin_ns + self._monotonic_ns()

    def step_ns(self) -> int:
        """Return the step of the wall clock since the last call, positive forward; 0 if it was not
        set.
        """
        for _ in range(_READINGS):
            before = self._monotonic_ns()
            offset = self._wall_ns() - before
            if self._monotonic_ns() - before <= _MAX_READ_NS:
                break
        else:
            return 0
        step, self._offset_ns = offset - self._offset_ns, offset
        if abs(step) < MIN_STEP_NS:
            return 0
        self._pending_ns, self._waited = self._pending_ns + step, 0
        return step

    def continued(self, stamps: Ints) -> Ints:
        """Return timestamps of the next block of frames without the steps that `step_ns` found.

        Each step begins where the timestamps jump.
        """
        if not len(stamps):
            return stamps
        shifts: Ints = np.full(len(stamps), self.shift_ns)
        if self._pending_ns:
            before = self.now_ns() if self._last_ns is None else self._last_ns
            jumps = np.diff(stamps, prepend=before) * np.sign(self._pending_ns)
            k = int(np.argmax(jumps))
            if jumps[k] > abs(self._pending_ns) / 2:
                shifts[k:] += self._pending_ns
                self.shift_ns, self._pending_ns = self.shift_ns + self._pending_ns, 0
            self._waited += 1
            if self._waited > _MAX_BLOCKS_WAITED:  # an adapter with a clock of its own
                self._pending_ns = 0
        self._last_ns = int(stamps[-1])
        return np.asarray(stamps - shifts)


def describe_step(step_ns: int) -> str:
    """Describe a step of the clock for the events of a recording."""
    return (
        f"the clock was set {'forward' if step_ns > 0 else 'back'} by {abs(step_ns) * 1e-9:.3g} s"
    )
