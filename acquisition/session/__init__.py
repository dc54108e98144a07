"""The session: record, enable, track, stop.

It owns the loop that sends, its guards, and the recorder with the second stop in another process.
Every way out of motion leaves the drives disabled. It may use `simulated`, `bus`, `recording`,
`robot` and `protocol`.
"""

from .logs import InlineLog
from .recorder import RecordedSummary, Recorder, Status, write_decoded
from .replaying import replay
from .running import INTERRUPTED, RecordOptions, UserInterface, record, stop_on_signals
from .session import Outcome, Stop, Task, run_active
from .timing import DEVIATIONS, real_time_scheduling, scheduling_words, sync_jitter
