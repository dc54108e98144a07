"""Reception of frames in a thread, with timestamps that ignore steps of the computer's clock."""

import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
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
_ANCILLARY_BYTES = socket.CMSG_SPACE(16)  # of a timespec


class Receiver:
    """A receiver of frames: `run` receives in one thread, `take` returns them in another.

    Attributes:
        sock: socket of the bus; None without one.
        stopped: set to True to end `run`.
        error: error that has ended `run`; None without one.
    """

    # When a recording ends, reading the queue of the kernel may take so long.
    DRAIN_S = 2.0

    def __init__(self, bus: Any) -> None:
        self._bus, self._items = bus, deque[Any]()
        self.sock = socket_of(bus)
        # A SocketCAN socket is read directly, which takes a third of the time of python-can.
        self._raw = self.sock if getattr(bus, "socket", None) is self.sock else None
        self.stopped = False
        self.error: str | None = None

    def run(self) -> None:
        """Receive until `stopped` is set and the queue is empty.

        An error of the bus ends it and is stored in `error`.
        """
        try:
            receive = self._receive_message
            if self._raw is not None:
                self._raw.setblocking(True)
                self._raw.setsockopt(
                    socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", 0, 100_000)
                )
                receive = partial(self._receive_raw, self._raw)
            while not self.stopped:
                receive(0.1)
            until_s = time.monotonic() + self.DRAIN_S
            while time.monotonic() < until_s and receive(0.0):
                pass
        # Any error ends the thread, so the reader of `error` must see it.
        except Exception as error:
            self.error = str(error) or type(error).__name__

    def _receive_raw(self, sock: socket.socket, timeout_s: float) -> bool:
        """Receive as `_receive_message`; any timeout but 0 is that of the socket."""
        with suppress(BlockingIOError, InterruptedError):
            flags = 0 if timeout_s else socket.MSG_DONTWAIT
            self._items.append(sock.recvmsg(_FD_BYTES, _ANCILLARY_BYTES, flags)[:3])
            return True
        return False

    def _receive_message(self, timeout_s: float) -> bool:
        """Receive once; return False if nothing came within `timeout_s`."""
        import can

        try:
            message = self._bus.recv(timeout_s)
        except can.CanOperationError as error:
            if not is_no_frame(self._bus, error):
                raise
            return True
        if message is not None:
            self._items.append(message)
        return message is not None

    def take(self) -> Block:
        """Return the frames received since the last call, in order."""
        items = [self._items.popleft() for _ in range(len(self._items))]
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
        # The kernel sets this flag if the frame was sent on this computer.
        | (np.array([item[2] & socket.MSG_DONTROUTE for item in items]) != 0) * SENT
        | np.array([len(item[0]) == _FD_BYTES for item in items], bool) * CAN_FD
    )
    block["length"] = np.minimum(raw["length"], 8)
    block["data"] = raw["data"] * (np.arange(8) < block["length"][:, None])
    return block


# A clock that NTP slews without a step drifts less than this in half a second.
MIN_STEP_NS = 50_000_000
# Reading both clocks must take less than this, and is repeated otherwise.
_MAX_READ_NS = 5_000_000
_READINGS = 5
# The timestamps of an adapter with its own clock never jump. They are awaited for so many blocks.
_MAX_BLOCKS_WAITED = 2


class WallClock:
    """A wall clock whose steps are detected by means of the monotonic clock.

    Its times, and the timestamps of frames, continue without the steps.

    Attributes:
        shift_ns: sum of the steps removed from timestamps.
    """

    def __init__(
        self,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        offset_ns: int | None = None,
    ) -> None:
        self._wall_ns, self._monotonic_ns = wall_ns, monotonic_ns
        self._begin_ns = self._offset_ns = (
            wall_ns() - monotonic_ns() if offset_ns is None else offset_ns
        )
        self._last_ns: int | None = None  # latest timestamp, uncorrected
        # A step that has not been seen in the timestamps yet, and for how many blocks.
        self._pending_ns, self._waited = 0, 0
        self.shift_ns = 0  # sum of the steps removed from timestamps

    def now_ns(self) -> int:
        """Return the wall clock without its steps, ns."""
        return self._begin_ns + self._monotonic_ns()

    def step_ns(self) -> int:
        """Return the step of the wall clock since the last call, in ns.

        The step is positive if the clock was set forward, and 0 if it was not set.
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
        """Remove the steps that `step_ns` found from timestamps of the next block of frames.

        Each step is removed from where the timestamps jump.

        Parameters
        ----------
        stamps : (m,) timestamps in ns.

        Returns
        -------
        (m,) timestamps without the steps, ns.
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
            # The adapter has its own clock.
            if self._waited > _MAX_BLOCKS_WAITED:
                self._pending_ns = 0
        self._last_ns = int(stamps[-1])
        return np.asarray(stamps - shifts)


def describe_step(step_ns: int) -> str:
    """Describe a step of the clock for the events of a recording."""
    return (
        f"the clock was set {'forward' if step_ns > 0 else 'back'} by {abs(step_ns) * 1e-9:.3g} s"
    )
