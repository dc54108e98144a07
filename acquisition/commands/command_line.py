"""Runs one command of a program: standard streams that cannot fail it, errors in one line, an exit status."""

import errno
import io
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TextIO, cast

from ..errors import one_line

STATUSES = (
    "exit status: 0 done; 1 an error, told in one line on standard error; 2 wrong usage; "
    "3 done, but the result is not to be trusted (robot-identify fit, validate); 130 interrupted by Ctrl-C"
)


class _Stream:
    """A text stream that drops what it cannot write and keeps the first error, so that no command ends at a print."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self.error: OSError | None = None
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Unicode shows ? where it has no sign

    def write(self, text: str) -> int:
        if self.error is None:
            try:
                self.stream.write(text)
            except OSError as error:
                self._fail(error)
        return len(text)

    def flush(self) -> None:
        if self.error is None:
            try:
                self.stream.flush()
            except OSError as error:
                self._fail(error)

    def __getattr__(self, name: str) -> object:
        return getattr(self.stream, name)

    def _fail(self, error: OSError) -> None:
        self.error = error
        # Python flushes once more at its end, and would complain: what is left goes nowhere.
        with suppress(OSError):  # a stream of a test has no descriptor
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self.stream.fileno())
            os.close(null)


def run_command(program: str, errors: Sequence[type[Exception]], command: Callable[[], int | None]) -> int:
    """Run `command` and return the exit status: its own (None is 0), 1 after one of `errors` in one line, 130 on Ctrl-C.

    A reader of standard output that goes away (`| head -1`) changes nothing. Standard output that cannot be written for
    another reason (a full disk) is status 1 and one line, after the command has done everything else.
    """
    with _standard_streams() as (out, err):
        try:
            status = command() or 0
        except KeyboardInterrupt:
            return _refuse(err, program, "interrupted", 130)
        except tuple(errors) as error:
            return _refuse(err, program, str(error), 1)
        except OSError as error:
            place = "" if error.filename is None else f"{error.filename}: "
            return _refuse(err, program, f"{place}{error.strerror or error}", 1)
        out.flush()
        if out.error is not None and out.error.errno != errno.EPIPE:
            text = f"standard output: cannot be written: {out.error.strerror or out.error}"
            return _refuse(err, program, text, 1)
        return status


def _refuse(err: _Stream, program: str, text: str, status: int) -> int:
    err.write(f"{program}: {one_line(text)}\n")
    return status


@contextmanager
def _standard_streams() -> Iterator[tuple[_Stream, _Stream]]:
    """Standard output and error, guarded for the time of the block; what is closed (`>&-`) goes nowhere."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes this number, which otherwise the next file to be written would get
    before = sys.stdout, sys.stderr
    with suppress(OSError):
        null = open(os.devnull, "w")  # noqa: SIM115
    out, err = _Stream(sys.stdout or null), _Stream(sys.stderr or null)
    sys.stdout, sys.stderr = cast(TextIO, out), cast(TextIO, err)
    try:
        yield out, err
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = before
