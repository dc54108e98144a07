"""Imports tables, ROS 2 bags, CAN logs and recordings, whose frames it decodes; exports recordings."""

from .bags import BagOptions, import_bag, is_bag
from .conversions import import_log, import_recording, is_log
from .exports import export_csv
from .tables import import_tables
from .time_base import ImportSummary
