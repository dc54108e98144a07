"""One fit per recording of a fleet: rows that survive the end of a run, the table of them, drift with control limits."""

from .results import Chart, Drift, control_limits, drifts, fleet_document, write_table
from .rows import FleetSettings, Row, Value, fit_row
from .run import Kept, found_recordings, method_of, run_fleet
