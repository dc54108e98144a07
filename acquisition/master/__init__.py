"""The CANopen master: requests and answers, listening, heartbeat, supervision, the one stop of all drives."""

from .heartbeat import MasterHeartbeat
from .homing import Confirm, confirm_motion, homed, joint_positions, joints_of, position_words
from .listening import LISTEN_S, command_ids, listen_for_others, refuse_enabled, refuse_other_master, service_of
from .master import OPERATIONAL, Master, Wire
from .orders import Orders, send_orders
from .reports import FOLLOWS, REMOTE, error_report, error_words, notices, status_words
from .stopping import leave_operational, not_disabled, safe_stop, stop_drives
from .supervision import (
    refuse_slow_ramps,
    refuse_unsupervised,
    second_stop,
    stop_ramp,
    supervision_of,
    supervision_refusal,
)
