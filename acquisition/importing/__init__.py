"""Recordings out of tables, ROS 2 bags and CAN logs, decoding again, export."""

from .bags import BagChoice, import_bag, is_bag
from .conversions import (
    Converted,
    decode_recording,
    export_bag,
    export_csv,
    import_log,
    is_log,
    recover_recording,
    row_doubts,
)
from .samples import Imported
from .tables import import_tables
