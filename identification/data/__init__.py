"""Recordings as signals on a uniform grid, and where tasks on them run: this process,
processes, a Dask cluster.
"""

from .recordings import ON_GRID, RecordingFile, Recordings, check_one_robot, load_signals
from .row_steps import position_steps
from .signals import Signals, signals_from_arrays
from .work import HERE, Work
