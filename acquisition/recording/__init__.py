"""The recording: one MCAP file with the robot, its frames and its joint samples.

It owns the file, which it writes with the package mcap, reads, and follows while it grows; and the
decoding of CAN frames to rows on the SYNC grid. It may use `robot`, `protocol` and `files`.
"""

from .decoding import Decoded, decode, refuse_period
from .measured import in_gaps, measured_rows
from .reader import NO_SAMPLES, Event, Recording, RecordingFollower, read_recording, rewritten
from .rows import (
    CAN_FD,
    ERROR,
    EXTENDED,
    FRAME,
    MAX_STAMP_NS,
    OPTIONAL,
    REMOTE_REQUEST,
    SENT,
    Block,
    Rows,
    Traffic,
    gaps,
    in_parts,
    joint_samples,
    resolve_mapped,
    sample_dtype,
)
from .summary import as_tables, overview
from .sync_grid import Syncs, SyncTimes, minimum_ahead, recorded_syncs, sync_times, usual_period
from .writer import JOINT_STATE, Header, RecordingWriter
