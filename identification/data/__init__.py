"""Recordings as signals on a uniform grid, and where tasks on them run: this process, processes, a Dask cluster."""

from .agreement import check_one_robot
from .dask_cluster import cluster, versions
from .in_memory import OptionalColumns, signals_from_arrays
from .row_steps import PositionSteps, position_steps
from .signals import ON_GRID, Signals, load_signals
from .sources import RecordingFile, Recordings
from .work import Serial, Work, WorkersNotStartedError, processes
