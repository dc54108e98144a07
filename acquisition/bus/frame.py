"""A CAN frame, and blocks of them as rows of `FRAME`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..recording import ERROR, EXTENDED, FRAME, REMOTE_REQUEST, SENT, Block


class Frame(NamedTuple):
    """A CAN frame; `flags` as in `blocks`."""

    time_ns: int
    can_id: int
    data: bytes
    flags: int = 0


Tap = Callable[[Frame], None]


def block_of(frames: list[Frame]) -> Block:
    """Rows of `FRAME`."""
    block = np.zeros(len(frames), FRAME)
    if frames:
        block["time_ns"] = [f.time_ns for f in frames]
        block["can_id"] = [f.can_id for f in frames]
        block["flags"] = [f.flags for f in frames]
        block["length"] = [len(f.data) for f in frames]
        block["data"] = np.frombuffer(b"".join(f.data.ljust(8, b"\0") for f in frames), np.uint8).reshape(-1, 8)
    return block


def frame_of(message: Any) -> Frame:
    """A message of python-can as a frame."""
    flags = (
        (EXTENDED if message.is_extended_id and not message.is_error_frame else 0)
        | (ERROR if message.is_error_frame else 0)
        | (REMOTE_REQUEST if message.is_remote_frame else 0)
        | (0 if message.is_rx else SENT)
    )
    return Frame(round(message.timestamp * 1e9), message.arbitration_id, bytes(message.data)[:8], flags)
