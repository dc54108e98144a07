"""Frames into a recording by a process of its own, decoded on the grid of SYNC; the second stop."""

from .decoding import Decoded, decode, written_by_master
from .process import STOPPING, InlineLog, ProcessLog
from .recorder import Recorded, Recorder, Status

__all__ = [
    "STOPPING",
    "Decoded",
    "InlineLog",
    "ProcessLog",
    "Recorded",
    "Recorder",
    "Status",
    "decode",
    "written_by_master",
]
