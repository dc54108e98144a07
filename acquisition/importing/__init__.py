"""Recordings out of tables and CAN logs, decoding again, export."""

from .conversions import Converted, decode_recording, export_csv, import_log, is_log
from .samples import Imported
from .tables import import_tables

__all__ = ["Converted", "Imported", "decode_recording", "export_csv", "import_log", "import_tables", "is_log"]
