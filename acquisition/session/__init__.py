"""The one loop that sends: record, enable, track, stop; its guards; replay."""

from .plan import Ending, Plan, Stop
from .recording_session import Told, Wanted, record, stop_on_signals
from .replaying import replay
from .scheduling import DEVIATIONS, steady, sync_jitter
from .session import run_active

__all__ = [
    "DEVIATIONS",
    "Ending",
    "Plan",
    "Stop",
    "Told",
    "Wanted",
    "record",
    "replay",
    "run_active",
    "steady",
    "stop_on_signals",
    "sync_jitter",
]
