"""The one loop that sends: record, enable, track, stop; its guards; replay."""

from .recording_session import Operator, RecordOptions, ShowStatus, record, stop_on_signals
from .replaying import replay
from .scheduling import DEVIATIONS, steady, sync_jitter
from .session import run_active
from .task import Outcome, Stop, Task
