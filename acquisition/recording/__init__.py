"""The recording: the MCAP file's rows, content, reader, writer, recovery, overview."""

from .reader import Recording, read_recording
from .recovery import recover
from .rows import ERROR, EXTENDED, FRAME, LARGEST_STAMP_NS, OPTIONAL, REMOTE_REQUEST, SENT, Block, sample_dtype
from .schema import EFFORT_MEAN, EFFORT_MEASURED, EFFORT_TIMING, Header
from .summary import as_tables, overview
from .writer import RecordingWriter

__all__ = [
    "EFFORT_MEAN",
    "EFFORT_MEASURED",
    "EFFORT_TIMING",
    "ERROR",
    "EXTENDED",
    "FRAME",
    "LARGEST_STAMP_NS",
    "OPTIONAL",
    "REMOTE_REQUEST",
    "SENT",
    "Block",
    "Header",
    "Recording",
    "RecordingWriter",
    "as_tables",
    "overview",
    "read_recording",
    "recover",
    "sample_dtype",
]
