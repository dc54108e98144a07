"""Imports tables, ROS 2 bags and CAN logs; decodes recordings again, recovers and exports them."""

from .bags import BagOptions, import_bag, is_bag
from .conversions import decode_recording, import_log, is_log, recover_recording, row_warnings
from .exports import export_csv
from .tables import import_tables
from .time_base import ImportSummary
