"""Recordings as signals on a uniform grid."""

from .agreement import check_one_robot
from .in_memory import signals_from_arrays
from .signals import EFFORT_TIMING, MEAN, ON_GRID, Signals, load_signals
from .sources import RecordingFile, Recordings

__all__ = [
    "EFFORT_TIMING",
    "MEAN",
    "ON_GRID",
    "RecordingFile",
    "Recordings",
    "Signals",
    "check_one_robot",
    "load_signals",
    "signals_from_arrays",
]
