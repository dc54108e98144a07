"""The bus as frames and times, and the CANopen master on it.

This subpackage owns the link to an adapter (with python-can), SDO requests and answers, listening,
the heartbeat, the checks before motion, and the only stop of all drives. It may use `recording`,
`robot`, `protocol` and `files`.
"""

from .before_motion import (
    LISTEN_S,
    Confirm,
    Readings,
    Uploads,
    confirm_motion,
    error_report,
    is_homed,
    joint_positions,
    joints_of,
    listen_for_others,
    position_words,
    refuse_enabled,
    scan_nodes,
    upload_segments,
)
from .configuring import Need, configure, needs_of, read_needs
from .frames import Frame, Tap, block_of, command_ids, other_node, service_of, sign_of_master
from .links import (
    LISTEN_ONLY,
    QUEUE_BYTES,
    SHARED,
    Link,
    MasterLink,
    kernel_drops,
    listening_words,
    open_bus,
    open_link,
    queue_bytes,
    request_queue_size,
    socket_of,
)
from .logs import SUFFIXES, read_log
from .master import OPERATIONAL, Master, Orders, send_order
from .receiving import Receiver, WallClock, describe_step
from .stopping import leave_operational, not_disabled, safe_stop, stop_drives
from .supervision import (
    MasterHeartbeat,
    free_entry,
    read_if_there,
    refuse_unsupervised,
    second_stop,
    stop_ramp,
    supervision_of,
    supervision_refusal,
    timeout_ms,
)
