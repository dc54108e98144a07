"""CAN frames, blocks of frames, the service of a frame in words (CiA 301's connection set), and
CAN logs of other tools.
"""

import logging
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import BadInputError
from ..protocol import ANSWER, EMERGENCY, HEARTBEAT, REQUEST, usual_can_id
from ..recording import CAN_FD, ERROR, EXTENDED, FRAME, MAX_STAMP_NS, REMOTE_REQUEST, SENT, Block
from ..robot import Bus


class Frame(NamedTuple):
    """A CAN frame; `flags` as in a `Block`."""

    time_ns: int
    can_id: int
    data: bytes
    flags: int = 0


Tap = Callable[[Frame], None]


def block_of(frames: list[Frame]) -> Block:
    """Rows of `FRAME`."""
    block = np.zeros(len(frames), FRAME)
    if frames:
        block["time_ns"] = [f.time_ns for f in frames]
        block["can_id"] = [f.can_id for f in frames]
        block["flags"] = [f.flags for f in frames]
        block["length"] = [len(f.data) for f in frames]
        block["data"] = np.frombuffer(
            b"".join(f.data.ljust(8, b"\0") for f in frames), np.uint8
        ).reshape(-1, 8)
    return block


def frame_of(message: Any) -> Frame:
    """A message of python-can as a frame."""
    flags = (
        (EXTENDED if message.is_extended_id and not message.is_error_frame else 0)
        | (ERROR if message.is_error_frame else 0)
        | (REMOTE_REQUEST if message.is_remote_frame else 0)
        | (0 if message.is_rx else SENT)
        | (CAN_FD if message.is_fd else 0)
    )
    return Frame(
        round(message.timestamp * 1e9), message.arbitration_id, bytes(message.data)[:8], flags
    )


_OF_NODES = {
    EMERGENCY: "emergency of",
    ANSWER: "SDO answer of",
    REQUEST: "SDO request to",
    HEARTBEAT: "heartbeat of",
}
_PDOS = {"tpdo": "TPDO {} of", "rpdo": "RPDO {} to"}


def service_of(frame: Frame, sync_can_id: int) -> str:
    """Service and node of a frame in words: `SYNC`, `NMT command`, `heartbeat of node 5`."""
    if frame.flags & EXTENDED:
        return f"29-bit frame 0x{frame.can_id:08X}"
    remote = "remote request for " if frame.flags & REMOTE_REQUEST else ""
    function, node = frame.can_id & 0x780, frame.can_id & 0x7F
    if frame.can_id == 0:
        return "NMT command"
    if frame.can_id == sync_can_id:
        return f"{remote}SYNC"
    if node and _is_boot_up(frame):
        return f"boot-up of node {node}"
    if node and function in _OF_NODES:
        return f"{remote}{_OF_NODES[function]} node {node}"
    for way, words in _PDOS.items():
        for number in range(1, 5):
            if node and usual_can_id(way, number, node) == frame.can_id:
                return f"{remote}{words.format(number)} node {node}"
    return f"{remote}frame 0x{frame.can_id:03X}"


def command_ids(bus: Bus) -> set[int]:
    """Identifiers of the frames by which a master commands the drives of `bus`: NMT, SDO
    requests, PDOs to drives.
    """
    to_drives = {pdo.can_id for drive in bus.drives for pdo in drive.rpdos}
    return {0} | to_drives | {REQUEST + drive.node for drive in bus.drives}


def sign_of_master(frame: Frame, bus: Bus) -> str | None:
    """The service in words if a frame shows another master on the bus, else None.

    Only a master sends NMT commands, SDO requests, PDOs to drives, remote requests, the heartbeat
    of `master_node` and, unless the description says that another device does, SYNC.
    """
    service = service_of(frame, bus.file.sync_can_id)
    if frame.flags & EXTENDED:
        return None
    function, node = frame.can_id & 0x780, frame.can_id & 0x7F
    if frame.can_id == bus.file.sync_can_id:
        return service if bus.file.sync_producer == "recorder" else None
    if (
        frame.flags & REMOTE_REQUEST
        or frame.can_id in command_ids(bus)
        or (function == REQUEST and node)
    ):
        return service
    if function == HEARTBEAT and node == bus.file.master_node and not _is_boot_up(frame):
        return f"{service}, which is master_node of robot.toml"
    from_drives = {pdo.can_id for drive in bus.drives for pdo in drive.tpdos}
    return service if frame.can_id not in from_drives and service.startswith("RPDO") else None


def _is_boot_up(frame: Frame) -> bool:
    return frame.can_id & 0x780 == HEARTBEAT and frame.data == b"\0"


def other_node(frame: Frame, bus: Bus) -> int | None:
    """Node id of a heartbeat (not a boot-up) of a node that is neither a drive nor in
    `other_nodes`, else None.
    """
    node, known = (
        frame.can_id & 0x7F,
        {0, *bus.file.other_nodes, *(drive.node for drive in bus.drives)},
    )
    is_heartbeat = (
        frame.can_id & 0x780 == HEARTBEAT and not frame.flags & EXTENDED and not _is_boot_up(frame)
    )
    return node if is_heartbeat and node not in known else None


SUFFIXES = (".log", ".asc", ".blf", ".trc")
MAX_PAYLOAD = 8  # bytes, of classic CAN
_TRC_VERSIONS = ("1.0", "1.1", "1.3", "2.0", "2.1")  # python-can reads any other version as 1.0


class _FirstWarning(logging.Handler):
    """Stores the first warning of python-can's TRC reader, which skips
    lines that it cannot read.
    """

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.first: str | None = None

    def emit(self, record: logging.LogRecord) -> None:
        line = str(record.args[0]) if isinstance(record.args, tuple) and record.args else ""
        # the reader takes the last header line for a frame
        if line.strip() and not line.startswith(";"):
            self.first = self.first or record.getMessage()


def read_log(path: Path) -> Iterator[tuple[str | None, Frame | None]]:
    """Yield interface and frame from a log: candump (.log), Vector ASC or BLF,
    PCAN TRC, by the suffix.

    The interface is None for error frames of a candump log, where python-can does not give it. The
    frame is None for CAN FD, which CANopen does not use. Raises `BadInputError` with file and frame
    (from 1): the log cannot be read or is damaged, a time does not fit into a recording, or a frame
    has more than 8 bytes.
    """
    import can

    if path.suffix.lower() not in SUFFIXES:
        expected = ".log (candump), .asc, .blf or .trc"
        raise BadInputError(f"suffix {path.suffix!r}", place=str(path), expected=expected)
    count, max_time_s, warnings = 0, MAX_STAMP_NS * 1e-9, _FirstWarning()
    logger = logging.getLogger("can.io.trc")
    logger.addHandler(warnings)
    try:
        if path.suffix.lower() == ".trc":
            _refuse_version(path)
        with can.LogReader(path) as reader:
            for message in reader:
                count += 1
                if not 0 <= message.timestamp <= max_time_s:  # nor is NaN
                    problem = f"time {message.timestamp:.10g} s"
                    raise BadInputError(
                        problem, place=f"{path}: frame {count}", expected=f"0 to {max_time_s:.10g}"
                    )
                interface = None if message.channel is None else str(message.channel)
                if getattr(message, "is_fd", False):
                    yield interface, None
                    continue
                if len(message.data) > MAX_PAYLOAD:
                    where = f"{path}: frame {count} (0x{message.arbitration_id:03X})"
                    problem = f"{len(message.data)} bytes"
                    expected = f"{MAX_PAYLOAD} at most, as of classic CAN"
                    raise BadInputError(problem, place=where, expected=expected)
                yield interface, frame_of(message)
        if warnings.first is not None:
            raise BadInputError(f"damaged: {warnings.first[:200]}", place=str(path))
    except BadInputError:
        raise
    except OSError as error:
        raise BadInputError(
            f"cannot be read: {error.strerror or error}", place=str(path)
        ) from error
    except Exception as error:  # on damaged files the readers raise errors of any kind
        problem = str(error) or type(error).__name__
        raise BadInputError(
            f"damaged after {count} frames: {problem[:200]}", place=str(path)
        ) from error
    finally:
        logger.removeHandler(warnings)


def _refuse_version(path: Path) -> None:
    with path.open("rb") as file:
        found = re.search(rb"(?m)^;\$FILEVERSION=([^\s]*)", file.read(4096))
    version = found[1].decode(errors="replace") if found else "1.0"
    if version not in _TRC_VERSIONS:
        expected = f"one of {', '.join(_TRC_VERSIONS)}"
        raise BadInputError(
            f"version {version} of PCAN's format", place=str(path), expected=expected
        )
