"""Plays the frames that the drives of a recording sent, and SYNC, onto an idle bus."""

import time
from contextlib import closing
from pathlib import Path

import numpy as np

from ..bus import LISTEN_S, open_link, service_of
from ..errors import COMMAND_LINE, Place, RefusedError
from ..protocol import ANSWER, EMERGENCY, HEARTBEAT
from ..recording import (
    ERROR,
    EXTENDED,
    REMOTE_REQUEST,
    Block,
    Recording,
    read_recording,
    resolve_mapped,
)
from ..robot import BusFile
from .session import Stop

WITHOUT_HARDWARE = ("virtual", "udp_multicast")  # the second: UDP on this computer


def replay(
    path: Path, file: BusFile, stop: Stop, *, speed: float = 1.0, onto_bus: bool = False
) -> int:
    """Send the frames that the drives of a recording sent, and its SYNCs, in their order
    and with their timing.

    Commands are never sent. `file` is the bus to send on, `speed` a factor on the recorded speed,
    and `onto_bus` allows interfaces with hardware. Returns the number of frames sent. Raises
    `RobotIdimError`: `speed` or the interface is refused, the recording holds no frames of drives,
    another node sends before or between these frames, or the bus accepts none.
    """
    COMMAND_LINE.require(speed > 0, "--speed", speed, "more than 0")
    if file.interface not in WITHOUT_HARDWARE and not onto_bus:
        raise RefusedError(
            "hardware may be on this bus",
            what="sending",
            key="--interface",
            value=file.interface,
            expected=f"--onto-bus, or one of {', '.join(WITHOUT_HARDWARE)}",
        )
    frames, described = from_drives(read_recording(path), str(path))
    due_s = np.maximum.accumulate((frames["time_ns"] - frames["time_ns"][:1]) * 1e-9 / speed)
    count = 0

    def listen_until(until_s: float) -> None:
        """Wait. Raises `RefusedError` at the first frame that is not our own."""
        while not stop.reason:
            left_s = until_s - time.monotonic()
            frame = link.take(min(max(left_s, 0.0), 0.1))
            if frame is not None and not frame.flags & ERROR:
                sent = f"{count} frames were" if count else "nothing was"
                raise RefusedError(
                    f"{service_of(frame, described.sync_can_id)} received",
                    what="sending",
                    place=f"{file.interface} {file.channel}",
                    expected=f"an idle bus; {sent} sent",
                )
            if left_s <= 0:
                return

    with closing(open_link(file, passive=False)) as link:
        listen_until(time.monotonic() + max(LISTEN_S, 1.5 * described.heartbeat_s))
        start_s = time.monotonic()
        for row, at_s in zip(frames, due_s.tolist(), strict=True):
            listen_until(start_s + at_s)
            if stop.reason:
                break
            link.send(int(row["can_id"]), row["data"].tobytes()[: row["length"]])
            count += 1
    return count


def from_drives(recording: Recording, place: str) -> tuple[Block, BusFile]:
    """Frames that the drives of the recording sent, and SYNC, from the channel with the most
    frames; and the bus as described.

    Drives are those of the description in the recording: their TPDOs, emergencies, SDO answers and
    heartbeats. Error frames, remote requests and 29-bit frames are left out. Raises `BadInputError`
    where no frame is left.
    """
    at = Place(place)
    at.require(recording.frames, text="holds no CAN frames", expected="a recording of drives")
    frames = max(recording.frames.values(), key=len)
    _, bus = resolve_mapped(frames, recording.robot, f"{place}: robot.toml")
    ids = [
        bus.file.sync_can_id,
        *(pdo.can_id for drive in bus.drives for pdo in drive.tpdos),
        *(s + drive.node for drive in bus.drives for s in (EMERGENCY, ANSWER, HEARTBEAT)),
    ]
    plain = (frames["flags"] & (EXTENDED | ERROR | REMOTE_REQUEST)) == 0
    found: Block = frames[plain & np.isin(frames["can_id"], ids)]
    at.require(
        len(found), text="holds no frame of its drives, and no SYNC", expected="some to send"
    )
    return found, bus.file
