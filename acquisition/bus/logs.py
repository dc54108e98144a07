"""CAN logs of other tools: candump, read here; Vector ASC and BLF, PCAN TRC, read by python-can.

A line of `candump -L` is `(1700000000.000312) can0 181#2706000000000000`: seconds, interface,
identifier of 3 digits (11 bits) or 8 (29 bits; a further bit marks error frames), data. `R` means
a remote request, a second `#` means CAN FD, and T or R at the end mean sent or received.
"""

import logging
import re
from binascii import unhexlify
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from ..errors import BadInputError, Location
from ..files import GrowingBytes
from ..recording import (
    CAN_FD,
    ERROR,
    EXTENDED,
    FRAME,
    MAX_STAMP_NS,
    REMOTE_REQUEST,
    SENT,
    Block,
)
from .frames import ROW, Frame, frame_of

SUFFIXES = (".log", ".asc", ".blf", ".trc")
MAX_PAYLOAD, MAX_CAN_ID = 8, 0x1FFFFFFF  # bytes of classic CAN, identifier of 29 bits
_CUT = "truncated last line"
# Number in the file of the channel that python-can calls 0.
_FIRST_CHANNEL = {".asc": 1, ".blf": 1, ".trc": 0}
_REQUEST = re.compile(r"\s*\d+\.\d+\s+(CANFD\s+)?\d+\s+(\w+\s+)?TxRq\b", re.IGNORECASE)
_STAMP = re.compile(r"\s*(\d+\.\d+)(?=\s)")
_RELATIVE = re.compile(r"\s*base\s+\w+\s+timestamps\s+relative", re.IGNORECASE)
# python-can would read these versions as version 1.0.
_OTHER_VERSION = re.compile(r";\$FILEVERSION=(?!(?:1\.[013]|2\.[01])\s*$)(.*)")
_LINE = re.compile(
    rb"[ \t]*\((\d{1,10})\.(\d{1,9})\)[ \t]+(\S{1,32})[ \t]+([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})"
    rb"#(?:(#[0-9A-Fa-f])|([Rr]\d?))?((?:[0-9A-Fa-f]{2})*)(?:_[9A-Fa-f])?"
    rb"(?:[ \t]+(?:([Tt])|[Rr]))?[ \t\r]*\n"
)
_ERROR_FRAME = 0x20000000  # bit of the identifier
_RECORD = "Record with `candump -l`: lines such as (1700000000.000312) can0 181#2706"
# Other files with the suffix .log: how a line begins, what the file is, and what to do.
_OTHERS = (
    (rb"\*+ *BUSMASTER", "the log is of BUSMASTER, not of candump", "Export it as .asc"),
    (rb"[;\s]*(\$FILEVERSION|\d+\))", "the log is of PCAN, not of candump", "Rename it to .trc"),
    (rb"(?i)date |base |\s*\d+\.\d+ ", "the log is of Vector, not of candump", "Rename it to .asc"),
    (
        rb".*\s[\[{]\d+[\]}]",
        "this is what candump shows on the screen, often without times",
        _RECORD,
    ),
    (rb"", "the line is not a frame of candump", _RECORD),
)


def read_log(path: Path) -> tuple[Mapping[str, Block], Mapping[str, int]]:
    """Read a log of candump (.log), Vector (.asc, .blf) or PCAN (.trc), by its suffix.

    Parameters
    ----------
    path : the log.

    Returns
    -------
    Two mappings. The rows of `FRAME` (m,) by interface as the file names or numbers it, in the
    order of the file, and on disk if they are large. The number of frames or lines that are left
    out, by kind.

    Left out are frames of CAN FD, which CANopen does not use, requests to send, which are not
    frames on the bus, and a truncated last line.

    Raises
    ------
    BadInputError : the log cannot be read or is damaged, or a recording cannot contain a time, an
        identifier or the data. The place has the file and the frame or line (from 1).
    """
    Location(str(path)).require(
        path.suffix.lower() in SUFFIXES,
        text=f"the suffix {path.suffix!r} is unknown",
        expected=".log (candump), .asc, .blf or .trc",
    )
    left_out, stored = Counter[str](), defaultdict[str, GrowingBytes](GrowingBytes)
    reader = _read_candump if path.suffix.lower() == ".log" else _read_others
    try:
        for number, (interface, frame) in enumerate(reader(path, left_out), 1):
            time_ns, can_id, data, flags = frame
            if flags & CAN_FD:
                left_out["of CAN FD"] += 1
            elif 0 <= time_ns <= MAX_STAMP_NS and can_id <= MAX_CAN_ID and len(data) <= MAX_PAYLOAD:
                stored[interface].write(ROW.pack(time_ns, can_id, len(data), flags, data))
            else:
                Location(f"{path}: frame {number}").refuse(
                    text=f"the frame has time {time_ns / 1e9:.10g} s, identifier 0x{can_id:X} and "
                    f"{len(data)} bytes",
                    expected=f"0 to {MAX_STAMP_NS * 1e-9:.10g} s, at most 29 bits and 8 bytes",
                )
    except OSError as error:
        raise BadInputError(
            f"the log cannot be read: {error.strerror or error}", place=str(path)
        ) from error
    return {name: np.frombuffer(some.whole(), FRAME) for name, some in stored.items()}, +left_out


def _read_candump(path: Path, left_out: Counter[str]) -> Iterator[tuple[str, Frame]]:
    """Yield interface and frame of each line.

    After a power cut the last line has no end. Its bytes may be truncated, or zeros.
    """
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            if found := _LINE.fullmatch(line):
                seconds, part, interface, digits, fd, remote, data, sent = found.groups()
                word = int(digits, 16)
                error = word & ~MAX_CAN_ID == _ERROR_FRAME
                yield (
                    interface.decode(errors="replace"),
                    Frame(
                        int(seconds + part.ljust(9, b"0")),
                        word - _ERROR_FRAME if error else word,
                        unhexlify(data),
                        (EXTENDED if len(digits) > 3 and not error else 0)
                        | (ERROR if error else 0)
                        | (REMOTE_REQUEST if remote else 0)
                        | (SENT if sent else 0)
                        | (CAN_FD if fd else 0),
                    ),
                )
            elif not line.endswith(b"\n"):
                left_out[_CUT] += bool(line.strip(b" \t\r\0"))
            elif line.strip():
                _, text, advice = next(other for other in _OTHERS if re.match(other[0], line))
                raise BadInputError(text, place=f"{path}: line {number}", advice=advice)


def _read_others(path: Path, left_out: Counter[str]) -> Iterator[tuple[str, Frame]]:
    """Yield interface and frame of each message, read by python-can."""
    import can

    count, suffix, logger = 0, path.suffix.lower(), logging.getLogger("can.io.trc")
    reader = can.ASCReader if suffix == ".asc" else can.TRCReader
    logger.addFilter(_refuse_skipped)
    try:
        with can.LogReader(path) if suffix == ".blf" else reader(_lines(path, left_out)) as log:
            for message in log:
                count += 1
                yield (
                    str((message.channel or 0) + _FIRST_CHANNEL[suffix]),
                    frame_of(message)._replace(data=bytes(message.data)),
                )
    except (BadInputError, OSError):
        raise
    # The readers raise errors of any kind if a file is damaged.
    except Exception as error:
        raise BadInputError(
            f"the log is damaged after {count} frames: {str(error)[:200] or type(error).__name__}",
            place=str(path),
        ) from error
    finally:
        logger.removeFilter(_refuse_skipped)


def _refuse_skipped(record: logging.LogRecord) -> bool:
    """Raise `ValueError` for a line that python-can's TRC reader skips with a warning.

    The last line of a header is an exception, because that reader takes it for a frame.
    """
    if record.levelno >= logging.WARNING and not re.search("message '[;']", record.getMessage()):
        raise ValueError(record.getMessage())
    return True


def _lines(path: Path, left_out: Counter[str]) -> Iterator[str]:
    """Yield the lines of an ASC or TRC file, for the readers of python-can.

    Times are absolute. Requests to send and a truncated last line are left out and counted.
    """
    relative, time_s = False, 0.0
    # Headers have dates and names in the encoding of their computer, but only ASCII is used.
    with path.open(encoding="latin-1") as file:
        for line in file:
            if version := _OTHER_VERSION.match(line):
                Location(str(path)).refuse(
                    text=f"version {version[1]} of the PCAN format is not supported",
                    expected="1.0, 1.1, 1.3, 2.0 or 2.1",
                )
            relative = relative or _RELATIVE.match(line) is not None
            if relative and (stamp := _STAMP.match(line)):
                time_s += float(stamp[1])
                line = f"{time_s:.9f}{line[stamp.end() :]}"
            if _REQUEST.match(line):
                left_out["requests to send (TxRq)"] += 1
            elif line.endswith("\n") or not line.strip()[:1].isdigit():
                yield line
            else:
                left_out[_CUT] += 1
