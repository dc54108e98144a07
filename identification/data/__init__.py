"""Recordings as signals on a uniform grid."""

from .in_memory import signals_from_arrays
from .signals import EFFORT_TIMING, MEAN, ON_GRID, Signals, load_signals

__all__ = ["EFFORT_TIMING", "MEAN", "ON_GRID", "Signals", "load_signals", "signals_from_arrays"]
