"""Recordings as signals on a uniform grid."""

from .signals import ON_GRID, Signals, load_signals

__all__ = ["ON_GRID", "Signals", "load_signals"]
