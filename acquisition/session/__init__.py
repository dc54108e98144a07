"""The session: record, enable, track, stop.

This subpackage owns the loop that sends, its guards, and the recorder's process with the watchdog.
Every way out of motion leaves the drives disabled. It may use `simulated`, `bus`, `recording`,
`robot` and `protocol`.
"""

from .logs import InlineLog, ProcessLog, Role
from .process import Watchdog, WatchdogPipe, silence_s
from .recorder import RecordedSummary, Recorder, Status, write_decoded
from .running import (
    INTERRUPTED,
    RecordOptions,
    UserInterface,
    record,
    replay,
    stop_on_signals,
)
from .session import Outcome, Stop, Task, run_active
from .timing import (
    DEVIATIONS,
    Pace,
    largest_delay_s,
    real_time_scheduling,
    refuse_jitter,
    scheduling_words,
    sync_jitter,
)
