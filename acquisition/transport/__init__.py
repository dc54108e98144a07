"""The bus as frames and times, and logs of other tools. The only room that imports python-can."""

from .bus import SHARED, open_bus
from .frame import Frame, Tap, block_of
from .link import Link, LockStepLink, open_link
from .logs import SUFFIXES, read_log
from .receiver import DRAIN_S, Receiver
from .sockets import QUEUE_BYTES, kernel_drops, queue_bytes, socket_of
from .wall_clock import WallClock, describe_step
