"""The one loop that sends: record, enable, track, stop; its guards; replay."""

from .plan import Outcome, Plan, Stop
from .recording_session import RecordOptions, ShowStatus, record, stop_on_signals
from .replaying import replay
from .scheduling import DEVIATIONS, steady, sync_jitter
from .session import run_active

__all__ = [
    "DEVIATIONS",
    "Outcome",
    "Plan",
    "RecordOptions",
    "ShowStatus",
    "Stop",
    "record",
    "replay",
    "run_active",
    "steady",
    "stop_on_signals",
    "sync_jitter",
]
