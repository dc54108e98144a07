"""Recordings from what others have measured: tables, ROS 2 bags, CAN logs, EtherCAT captures.

It owns the formats of others, their units and their times. It also decodes the frames of a
recording again, and exports recordings as tables. It may use `session`, `bus`, `recording`,
`robot`, `protocol` and `files`, and the package rosbags.
"""

from .bags import BagOptions, import_bag, is_bag
from .completed_map import complete_map, effort_unit, split_columns
from .conversions import import_log, import_recording, is_log, summary_lines
from .ethercat import cycle_numbers
from .held import grid_of_new_rows
from .proposed_map import RAD_OR_DEG, TORQUE_SENSORS, propose_map
from .quantities import EFFORT_UNITS
from .stamps import rows_in_time, stamps_warning, ticks_from_velocity
from .tables import TableMap, export_csv, import_tables, lines_to_fill_in
from .time_base import ImportSummary, interpolate, rate_warnings, resample, time_report
