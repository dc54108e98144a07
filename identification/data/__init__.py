"""Recordings as signals on a uniform grid."""

from .agreement import check_one_robot
from .in_memory import OptionalColumns, signals_from_arrays
from .row_steps import PositionSteps, position_steps
from .signals import ON_GRID, Signals, load_signals
from .sources import RecordingFile, Recordings
