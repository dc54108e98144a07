"""Marks of an operator for a recording that is being written: lines of `LOG.mcap.marks`, which the recorder takes over."""

import json
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from ..errors import AcquisitionError, one_line

MAX_SILENT_S = 5.0  # since the last change of a file that is being written


def add_mark(recording: Path, text: str) -> None:
    """Append the time and a text in one write. Raises `AcquisitionError` where the recording is not being written."""
    with recording.open("rb") as file:
        status = os.fstat(file.fileno())
        file.seek(max(0, status.st_size - 8))
        if file.read() == b"\x89MCAP0\r\n" or time.time() - status.st_mtime > MAX_SILENT_S:
            expected = "a recording that `robot-acquire record` is writing"
            raise AcquisitionError("is not being written", place=str(recording), expected=expected)
    descriptor = os.open(f"{recording}.marks", os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    with open(descriptor, "ab", buffering=0) as marks:
        marks.write(json.dumps([time.time_ns(), one_line(text)]).encode() + b"\n")


def take_marks(recording: Path) -> Iterator[tuple[int, str]]:
    """Ages in ns and texts of the marks since the last call; their file goes when all are taken. Others' lines are left out."""
    marks, taken = Path(f"{recording}.marks"), Path(f"{recording}.marks.taken")
    with suppress(OSError):  # none, which is usual
        marks.rename(taken)
        for line in taken.read_bytes().splitlines():
            with suppress(ValueError, TypeError):
                stamp_ns, text = json.loads(line)
                yield min(max(0, time.time_ns() - int(stamp_ns)), 10**10), str(text)
        taken.unlink()
