"""The one loop that sends: record, enable, track, stop; its guards; the recorder, and the second stop, in another process."""

from .logs import InlineLog, ProcessLog
from .process import Role
from .recorder import Recorded, Recorder, Status, write_decoded
from .recording_session import Operator, RecordOptions, record, stop_on_signals
from .replaying import replay
from .scheduling import DEVIATIONS, steady, sync_jitter
from .session import run_active
from .task import Outcome, Stop, Task
