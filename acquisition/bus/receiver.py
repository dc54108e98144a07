"""Takes frames off a bus in a thread and only appends them."""

import socket
import struct
import time
from collections import deque
from contextlib import suppress
from typing import Any

import numpy as np

from ..recording import ERROR, EXTENDED, FRAME, REMOTE_REQUEST, SENT, Block
from .bus import is_no_frame
from .frame import block_of, frame_of
from .sockets import socket_of

_CAN_FRAME = np.dtype([("can_id", "<u4"), ("length", "u1"), ("pad", "u1", (3,)), ("data", "u1", (8,))])

_TIMESPEC_BYTES = 16

DRAIN_S = 2.0  # at most, to take what the kernel still holds when a recording ends


class Receiver:
    """Takes frames off a bus and only appends them: `run` in a thread, `take` what came since in another.

    A socket of the kernel's CAN is read directly, which costs a third of python-can's messages.
    """

    def __init__(self, bus: Any, *, raw_socket: socket.socket | None = None) -> None:
        self._bus, self._items = bus, deque[Any]()
        self._raw = raw_socket
        self.sock = raw_socket or socket_of(bus)
        self.stopped = False
        self.error: str | None = None
        if raw_socket is None and self.sock is not None and getattr(bus, "socket", None) is self.sock:
            self._raw = self.sock

    def run(self) -> None:
        """Until `stopped` and what had arrived is taken; an error of the bus ends it and is stored in `error`."""
        try:
            if self._raw is None:
                self._run_messages()
            else:
                self._run_raw(self._raw)
        except Exception as error:  # of any kind: the reader of `error` must see it
            self.error = str(error) or type(error).__name__

    def _run_raw(self, sock: socket.socket) -> None:
        sock.setblocking(True)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", 0, 100_000))
        size, receive = socket.CMSG_SPACE(_TIMESPEC_BYTES), sock.recvmsg
        while not self.stopped:
            try:
                self._items.append(receive(72, size)[:3])
            except (BlockingIOError, InterruptedError):
                continue
        until_s = time.monotonic() + DRAIN_S
        with suppress(BlockingIOError):  # the queue is empty
            while time.monotonic() < until_s:
                self._items.append(receive(72, size, socket.MSG_DONTWAIT)[:3])

    def _run_messages(self) -> None:
        import can

        until_s = None
        while until_s is None or time.monotonic() < until_s:
            if self.stopped and until_s is None:
                until_s = time.monotonic() + DRAIN_S
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
        """Frames received since the last call, in order."""
        items = [self._items.popleft() for _ in range(len(self._items))]
        if not items:
            return np.zeros(0, FRAME)
        if self._raw is not None:
            return _block_of_raw(items)
        return block_of([frame_of(m) for m in items if not getattr(m, "is_fd", False)])


def _block_of_raw(items: list[Any]) -> Block:
    items = [item for item in items if len(item[0]) == _CAN_FRAME.itemsize and item[1]]
    raw = np.frombuffer(b"".join(item[0] for item in items), _CAN_FRAME)
    stamps = np.frombuffer(b"".join(item[1][0][2] for item in items), "<i8").reshape(-1, 2)
    block = np.zeros(len(raw), FRAME)
    block["time_ns"] = stamps[:, 0] * 1_000_000_000 + stamps[:, 1]
    word = raw["can_id"]
    extended = (word & 0x80000000) != 0
    block["can_id"] = np.where(extended, word & 0x1FFFFFFF, word & 0x7FF)
    ours = np.array([item[2] & socket.MSG_DONTROUTE for item in items]) != 0  # made on this machine
    block["flags"] = (
        extended * EXTENDED
        | ((word & 0x40000000) != 0) * REMOTE_REQUEST
        | ((word & 0x20000000) != 0) * ERROR
        | ours * SENT
    )
    block["length"] = np.minimum(raw["length"], 8)
    block["data"] = raw["data"] * (np.arange(8) < block["length"][:, None])
    return block
