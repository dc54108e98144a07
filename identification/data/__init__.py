"""Recordings as signals on a uniform grid."""

from .in_memory import signals_from_arrays
from .signals import ON_GRID, Signals, load_signals

__all__ = ["ON_GRID", "Signals", "load_signals", "signals_from_arrays"]
