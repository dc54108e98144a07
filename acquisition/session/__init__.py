"""The session: record, enable, track, stop; its guards; the recorder and the second
stop in another process.
"""

from .logs import InlineLog
from .recorder import RecordedSummary, Recorder, Status, write_decoded
from .running import INTERRUPTED, RecordOptions, UserInterface, record, replay, stop_on_signals
from .session import Outcome, Stop, Task, run_active
from .timing import DEVIATIONS, real_time_scheduling, scheduling_words, sync_jitter
