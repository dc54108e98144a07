"""Frames into a recording by a process of its own, decoded on the grid of SYNC; the second stop."""

from .decoding import UNCERTAIN, Decoded, decode
from .logs import InlineLog, ProcessLog
from .process import STOPPING, Role
from .recorder import Recorded, Recorder, Status, write_decoded
from .traffic import written_by_master
