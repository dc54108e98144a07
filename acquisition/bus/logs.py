"""CAN logs of other tools: Vector ASC and BLF and PCAN TRC by python-can, candump by ourselves.

A line of `candump -L` is `(1700000000.000312) can0 181#2706000000000000`: seconds, interface,
identifier of 3 digits (11 bits) or 8 (29 bits; a further bit marks error frames), data. `R` stands
for a remote request, a second `#` for CAN FD, and T or R at the end for sent or received.
"""

import logging
import re
from binascii import unhexlify
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from ..errors import BadInputError, Place
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
from .frames import Frame, block_of, frame_of

SUFFIXES = (".log", ".asc", ".blf", ".trc")
_TRC_VERSIONS = ("1.0", "1.1", "1.3", "2.0", "2.1")  # python-can reads any other version as 1.0
_FIRST_CHANNEL = {".asc": 1, ".blf": 1, ".trc": 0}  # that python-can calls 0
_REQUEST = re.compile(r"\s*\d+\.\d+\s+(CANFD\s+)?\d+\s+(\w+\s+)?TxRq\b", re.IGNORECASE)
_STAMP = re.compile(r"\s*(\d+\.\d+)(?=\s)")
_RELATIVE = re.compile(r"\s*base\s+\w+\s+timestamps\s+relative", re.IGNORECASE)
_AT_ONCE = 10_000  # frames
MAX_PAYLOAD, MAX_CAN_ID = 8, 0x1FFFFFFF  # bytes of classic CAN, identifier of 29 bits
_CUT = "last line, which is cut"  # in place of an interface
_BYTES_AT_ONCE = 2**22
_MAX_INTERFACES = 64  # a damaged file could name any number
_LINE = re.compile(
    rb"(?m)^(?:[ \t]*\((\d{1,10})\.(\d{1,9})\)[ \t]+(\S{1,32})[ \t]+([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})"
    rb"#(#[0-9A-Fa-f]|[Rr]\d?|)((?:[0-9A-Fa-f]{2})*)(?:_[9A-Fa-f])?(?:[ \t]+([RTrt]))?)?[ \t\r]*$"
)
_ERROR_FRAME = 0x20000000  # bit of the identifier
_EXPECTED = "lines as `candump -L` or `-l` writes, such as (1700000000.000312) can0 181#2706"
# What else has the suffix .log: the beginning of a line, what it is, and what to do.
_OTHERS = (
    (rb"\*+ *BUSMASTER", "is no log of candump but of BUSMASTER", "its export as .asc"),
    (rb"[;\s]*(\$FILEVERSION|\d+\))", "is no log of candump but of PCAN", "the suffix .trc"),
    (rb"(?i)date |base |\s*\d+\.\d+ ", "is no log of candump but of Vector", "the suffix .asc"),
    (rb".*\s[\[{]\d+[\]}]", "is what candump shows on the screen, often without times", _EXPECTED),
    (rb"", "is no frame of candump", _EXPECTED),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Log:
    """A CAN log.

    Attributes:
        frames: by interface, as the file names or numbers it, the (m,) rows of `FRAME` in the
            order of the file; large ones are on disk.
        left_out: number of frames or lines that are not in `frames`, by what they are.
    """

    frames: Mapping[str, Block]
    left_out: Mapping[str, int]


def read_log(path: Path) -> Log:
    """Read a log: candump (.log), Vector ASC or BLF, PCAN TRC, by the suffix.

    Left out are frames of CAN FD, which CANopen does not use, requests to send, which are no frames
    on the bus, and a line that is cut. Raises `BadInputError` with file and frame or line (from 1):
    the log cannot be read or is damaged, or no recording holds a time, an identifier or the data.
    """
    if path.suffix.lower() not in SUFFIXES:
        expected = ".log (candump), .asc, .blf or .trc"
        raise BadInputError(f"suffix {path.suffix!r}", place=str(path), expected=expected)
    left_out, stored = Counter[str](), defaultdict[str, GrowingBytes](GrowingBytes)
    candump = path.suffix.lower() == ".log"
    try:
        for interface, block in _read_candump(path) if candump else _blocks(path, left_out):
            classic = block[block["flags"] & CAN_FD == 0]
            left_out["of CAN FD"] += len(block) - len(classic)
            if interface == _CUT:
                left_out[_CUT] += 1
            elif len(classic):
                stored[interface].extend(classic.tobytes())
    except OSError as error:
        raise BadInputError(
            f"cannot be read: {error.strerror or error}", place=str(path)
        ) from error
    frames = {name: np.frombuffer(some.whole(), FRAME) for name, some in stored.items()}
    return Log(frames=frames, left_out=+left_out)


def _refuse_skipped(record: logging.LogRecord) -> bool:
    """Refuse a line that python-can's TRC reader skips with a warning."""
    line = str(record.args[0]) if isinstance(record.args, tuple) and record.args else ""
    # the reader takes the last header line for a frame
    if record.levelno >= logging.WARNING and line.strip() and not line.startswith(";"):
        raise ValueError(record.getMessage())
    return True


def _lines(path: Path, left_out: Counter[str]) -> Iterator[str]:
    """Lines of an ASC or a TRC, which python-can's readers take as they take a file: with absolute
    times, without requests to send and a last line that is cut, which are counted.
    """
    relative, time_s = False, 0.0
    # Heads have dates and names in the encoding of their machine; all that is used is ASCII.
    with path.open(encoding="latin-1") as file:
        for line in file:
            relative = relative or _RELATIVE.match(line) is not None
            stamp = _STAMP.match(line)
            if relative and stamp is not None:
                time_s += float(stamp[1])
                line = f"{time_s:.9f}{line[stamp.end() :]}"
            if _REQUEST.match(line):
                left_out["requests to send (TxRq)"] += 1
            elif line.endswith("\n") or not line.strip()[:1].isdigit():
                yield line
            else:
                left_out[_CUT] += 1


def _blocks(path: Path, left_out: Counter[str]) -> Iterator[tuple[str, Block]]:
    """Interface and rows of `FRAME` from python-can's readers, some at a time."""
    import can

    found, count, suffix = defaultdict[str, list[Frame]](list), 0, path.suffix.lower()
    logger = logging.getLogger("can.io.trc")
    logger.addFilter(_refuse_skipped)
    try:
        if suffix == ".trc":
            _refuse_version(path)
        reader = can.ASCReader if suffix == ".asc" else can.TRCReader
        with can.LogReader(path) if suffix == ".blf" else reader(_lines(path, left_out)) as log:
            for message in log:
                count += 1
                size = 0 if message.is_fd else len(message.data)
                where = f"{path}: frame {count}"
                _refuse_frame(message.timestamp, message.arbitration_id, size, where)
                interface = str((message.channel or 0) + _FIRST_CHANNEL[suffix])
                found[interface].append(frame_of(message))
                if len(found[interface]) == _AT_ONCE:
                    yield interface, block_of(found.pop(interface))
    except (BadInputError, OSError):
        raise
    except Exception as error:  # on damaged files the readers raise errors of any kind
        problem = str(error) or type(error).__name__
        raise BadInputError(
            f"damaged after {count} frames: {problem[:200]}", place=str(path)
        ) from error
    finally:
        logger.removeFilter(_refuse_skipped)
    yield from ((interface, block_of(frames)) for interface, frames in found.items())


def _refuse_version(path: Path) -> None:
    with path.open("rb") as file:
        found = re.search(rb"(?m)^;\$FILEVERSION=([^\s]*)", file.read(4096))
    version = found[1].decode(errors="replace") if found else "1.0"
    if version not in _TRC_VERSIONS:
        expected = f"one of {', '.join(_TRC_VERSIONS)}"
        raise BadInputError(
            f"version {version} of PCAN's format", place=str(path), expected=expected
        )


def _read_candump(path: Path) -> Iterator[tuple[str, Block]]:
    """Yield interface and rows of `FRAME`, those of one interface in the order of the lines.

    A last line without its end is one row of zeros of the interface `_CUT`: a power cut leaves
    such a line, and its bytes may be cut too. Raises `BadInputError` with the number of a line
    that is none of candump, or that no recording holds.
    """
    rest, number = b"", 1
    with path.open("rb") as file:
        while new := file.read(_BYTES_AT_ONCE):
            text, end, rest = (rest + new).rpartition(b"\n")
            if end:
                yield from _frames(text, f"{path}: line", number)
                number += text.count(b"\n") + 1
            elif len(rest) > _BYTES_AT_ONCE:
                _refuse(rest, f"{path}: line {number}")
    if rest.strip(b" \t\r\0"):
        yield _CUT, np.zeros(1, FRAME)


def _frames(text: bytes, place: str, number: int) -> Iterator[tuple[str, Block]]:
    """Interfaces and frames of whole lines, the first of which has this number."""
    found = _LINE.findall(text)
    if len(found) <= text.count(b"\n"):
        lines = enumerate(text.split(b"\n"), number)
        _refuse(*next((line, f"{place} {k}") for k, line in lines if not _LINE.fullmatch(line)))
    seconds, parts, names, ids, kinds, data, ways = zip(*found, strict=True)
    named, interfaces = np.array(names), dict.fromkeys(filter(None, names))  # none: an empty line
    if len(interfaces) > _MAX_INTERFACES:
        expected = f"{_MAX_INTERFACES} at most"
        Place(place).refuse(text=f"{len(interfaces)} interfaces", expected=expected)
    times = [int(s + part.ljust(9, b"0")) for s, part in zip(seconds, parts, strict=True)]
    time_ns, can_id = np.array(times, np.uint64), np.array([int(x or b"0", 16) for x in ids])
    kind, size = np.array(kinds, "S1"), np.array([len(x) for x in data]) // 2
    bad = (time_ns > MAX_STAMP_NS) | (can_id > MAX_CAN_ID | _ERROR_FRAME)
    bad |= (size > MAX_PAYLOAD) & (kind != b"#")
    if bad.any():
        k = int(np.argmax(bad))
        _refuse_frame(times[k] * 1e-9, int(can_id[k]), int(size[k]), f"{place} {number + k}")
    block = np.zeros(len(found), FRAME)
    block["time_ns"], block["can_id"] = time_ns, can_id & MAX_CAN_ID
    block["length"] = np.minimum(size, MAX_PAYLOAD)
    flags = np.where(can_id & _ERROR_FRAME, ERROR, EXTENDED * np.array([len(x) > 3 for x in ids]))
    flags |= SENT * np.isin(ways, (b"T", b"t")) | REMOTE_REQUEST * np.isin(kind, (b"R", b"r"))
    block["flags"] = flags | CAN_FD * (kind == b"#")
    digits = b"".join([x[: 2 * MAX_PAYLOAD].ljust(2 * MAX_PAYLOAD, b"0") for x in data])
    block["data"] = np.frombuffer(unhexlify(digits), np.uint8).reshape(-1, MAX_PAYLOAD)
    for name in interfaces:
        yield name.decode(), block[named == name]


def _refuse(line: bytes, place: str) -> NoReturn:
    """Say what a line is that is none of candump."""
    _, text, expected = next(other for other in _OTHERS if re.match(other[0], line))
    raise BadInputError(text, place=place, expected=expected)


def _refuse_frame(time_s: float, can_id: int, size: int, place: str) -> None:
    """Refuse a frame of a log that no recording holds; errors name `place`."""
    where, max_time_s = Place(place), MAX_STAMP_NS * 1e-9
    if not 0 <= time_s < max_time_s:  # nor is NaN
        where.refuse(text=f"time {time_s:.10g} s", expected=f"0 to {max_time_s:.10g}")
    if can_id > MAX_CAN_ID:
        where.refuse(text=f"identifier 0x{can_id:X}", expected="29 bits at most")
    if size > MAX_PAYLOAD:
        expected = f"{MAX_PAYLOAD} at most, as of classic CAN"
        where.refuse(text=f"0x{can_id:03X}: {size} bytes", expected=expected)
