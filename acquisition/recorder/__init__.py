"""Frames into a recording by a process of its own, decoded on the grid of SYNC; the second stop."""

from .decoding import Decoded, decode
from .logs import InlineLog, ProcessLog
from .process import STOPPING, Role
from .recorder import Recorded, Recorder, Status
from .traffic import written_by_master
