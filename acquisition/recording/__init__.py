"""The recording: the MCAP file's rows, content, reader, writer, recovery, overview."""

from .reader import NO_SAMPLES, Recording, has_reference, read_recording
from .recovery import recover
from .rows import (
    ERROR,
    EXTENDED,
    FRAME,
    LARGEST_STAMP_NS,
    OPTIONAL,
    REMOTE_REQUEST,
    SENT,
    WHOLE,
    Block,
    gaps,
    in_parts,
    sample_dtype,
)
from .schema import Header
from .summary import as_tables, overview
from .writer import RecordingWriter
