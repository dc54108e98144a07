"""The bus as frames and times, and the CANopen master on it: requests, listening, heartbeat, the one stop of all drives."""

from .bus import SHARED, open_bus
from .frame import Frame, Tap, block_of
from .heartbeat import MasterHeartbeat
from .homing import Confirm, confirm_motion, homed, joint_positions, joints_of, position_words
from .link import Link, LockStepLink, open_link
from .listening import LISTEN_S, command_ids, listen_for_others, refuse_enabled, refuse_other_master, service_of
from .logs import SUFFIXES, read_log
from .master import OPERATIONAL, Master, Wire
from .orders import Orders, send_orders
from .receiver import DRAIN_S, Receiver
from .reports import FOLLOWS, REMOTE, error_report, error_words, notices, status_words
from .sockets import QUEUE_BYTES, kernel_drops, queue_bytes, socket_of
from .stopping import leave_operational, not_disabled, safe_stop, stop_drives
from .supervision import (
    refuse_slow_ramps,
    refuse_unsupervised,
    second_stop,
    stop_ramp,
    supervision_of,
    supervision_refusal,
)
from .wall_clock import WallClock, describe_step
