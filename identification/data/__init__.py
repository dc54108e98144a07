"""Recordings as signals on a uniform grid, and workers for tasks: this process, others, Dask.

It owns `Signals`, the only form in which other subpackages see a recording, and `Work`; it alone
imports joblib and distributed. It may use `acquisition`, which reads the files, and no other
subpackage.
"""

from .recordings import ON_GRID, RecordingFile, Recordings, check_one_robot, load_signals
from .row_steps import position_steps
from .signals import Signals, signals_from_arrays
from .work import HERE, Work
