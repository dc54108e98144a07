"""Marks of an operator for a recording that is being written: lines of `LOG.mcap.marks`, which
the recorder takes over.
"""

import fcntl
import json
import os
import time
from contextlib import suppress
from pathlib import Path

import msgspec

from ..errors import BadInputError, one_line
from .writer import RecordingWriter

MAX_SILENT_S = 5.0  # since the last change of a file that is being written
MAX_BYTES = 2**20  # of marks that are taken together: a recorder must not be held up


def add_mark(recording: Path, text: str) -> None:
    """Append the time and a text.

    Raises `BadInputError` where the recording is not being written.
    """
    with recording.open("rb") as file:
        # marks are not taken, and the file does not end, in between
        fcntl.flock(file, fcntl.LOCK_EX)
        status = os.fstat(file.fileno())
        file.seek(max(0, status.st_size - 8))
        if file.read() == b"\x89MCAP0\r\n" or time.time() - status.st_mtime > MAX_SILENT_S:
            raise BadInputError(
                "is not being written",
                place=str(recording),
                expected="a recording that `robot-acquire record` is writing",
            )
        with open(f"{recording.resolve()}.marks", "ab", buffering=0) as marks:  # not beside a link
            marks.write(json.dumps([time.time_ns(), one_line(text)]).encode() + b"\n")


def take_marks(
    recording: Path, writer: RecordingWriter, *, last: bool = False
) -> list[tuple[int, str]]:
    """Ages in ns and texts of the marks since the last call; their file goes.

    After the `last` call none can be added.

    Never raises: other lines are left out. What cannot be taken stays: no file, too large,
        or others keep the lock.
    """
    for _ in range(100 if last else 1):
        with suppress(OSError):  # another has the lock, or the file system has none
            fcntl.flock(writer, fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
        time.sleep(0.01)
    else:
        return []
    found = list[tuple[int, str]]()
    for name in (".marks.taken", ".marks"):  # older versions left the first after a kill
        path = Path(f"{recording.resolve()}{name}")
        with suppress(OSError):  # there is none, which is usual
            if path.is_file() and path.stat().st_size <= MAX_BYTES:
                content = path.read_bytes()
                path.unlink()
                for line in content.splitlines():
                    with suppress(msgspec.MsgspecError, ValueError, RecursionError):
                        stamp_ns, text = msgspec.json.decode(line, type=tuple[int, str])
                        found.append(
                            (min(max(0, time.time_ns() - stamp_ns), 10**10), one_line(text))
                        )
    if not last:
        fcntl.flock(writer, fcntl.LOCK_UN)
    return found
