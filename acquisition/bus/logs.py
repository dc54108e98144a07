"""CAN logs of other tools as frames: candump, Vector ASC and BLF, PCAN TRC."""

import logging
import re
from collections.abc import Iterator
from pathlib import Path

from ..errors import AcquisitionError
from ..recording import LARGEST_STAMP_NS
from .frame import Frame, frame_of

SUFFIXES = (".log", ".asc", ".blf", ".trc")
LARGEST_PAYLOAD = 8  # bytes, of classic CAN
_TRC_VERSIONS = ("1.0", "1.1", "1.3", "2.0", "2.1")  # that python-can reads; it reads any other as 1.0


class _Doubts(logging.Handler):
    """Keeps the first warning of python-can's TRC reader, which skips lines that it cannot read."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.first: str | None = None

    def emit(self, record: logging.LogRecord) -> None:
        line = str(record.args[0]) if isinstance(record.args, tuple) and record.args else ""
        if line.strip() and not line.startswith(";"):  # it reads the last line of a header as a frame
            self.first = self.first or record.getMessage()


def read_log(path: Path) -> Iterator[tuple[str | None, Frame | None]]:
    """Interface and frame, one by one, of a log of another tool: candump (.log), Vector ASC or BLF, PCAN TRC, by the suffix.

    The interface of an error frame in a candump log is None, because python-can does not give it. The frame is None for CAN FD,
    which CANopen does not use. An `AcquisitionError` names the file and the frame (from 1): the log cannot be read or is
    damaged, a time does not fit into a recording, or a frame has more than 8 bytes.
    """
    import can

    if path.suffix.lower() not in SUFFIXES:
        expected = ".log (candump), .asc, .blf or .trc"
        raise AcquisitionError(f"suffix {path.suffix!r}", place=str(path), expected=expected)
    count, latest_s, doubts = 0, LARGEST_STAMP_NS * 1e-9, _Doubts()
    logger = logging.getLogger("can.io.trc")
    logger.addHandler(doubts)
    try:
        if path.suffix.lower() == ".trc":
            _refuse_version(path)
        with can.LogReader(path) as reader:
            for message in reader:
                count += 1
                if not 0 <= message.timestamp <= latest_s:  # nor is NaN
                    problem = f"time {message.timestamp:.10g} s"
                    raise AcquisitionError(problem, place=f"{path}: frame {count}", expected=f"0 to {latest_s:.10g}")
                interface = None if message.channel is None else str(message.channel)
                if getattr(message, "is_fd", False):
                    yield interface, None
                    continue
                if len(message.data) > LARGEST_PAYLOAD:
                    where = f"{path}: frame {count} (0x{message.arbitration_id:03X})"
                    problem = f"{len(message.data)} bytes"
                    expected = f"{LARGEST_PAYLOAD} at most, as of classic CAN"
                    raise AcquisitionError(problem, place=where, expected=expected)
                yield interface, frame_of(message)
        if doubts.first is not None:
            raise AcquisitionError(f"damaged: {doubts.first[:200]}", place=str(path))
    except AcquisitionError:
        raise
    except OSError as error:
        raise AcquisitionError(f"cannot be read: {error.strerror or error}", place=str(path)) from error
    except Exception as error:  # the readers meet damage with whatever their parts raise
        problem = str(error) or type(error).__name__
        raise AcquisitionError(f"damaged after {count} frames: {problem[:200]}", place=str(path)) from error
    finally:
        logger.removeHandler(doubts)


def _refuse_version(path: Path) -> None:
    with path.open("rb") as file:
        found = re.search(rb"(?m)^;\$FILEVERSION=([^\s]*)", file.read(4096))
    version = found[1].decode(errors="replace") if found else "1.0"
    if version not in _TRC_VERSIONS:
        expected = f"one of {', '.join(_TRC_VERSIONS)}"
        raise AcquisitionError(f"version {version} of PCAN's format", place=str(path), expected=expected)
