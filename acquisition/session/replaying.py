"""Sends the frames of a recording's drives, and SYNC, on a silent bus with their timing. Commands are never sent again."""

import time
from pathlib import Path

import numpy as np

from ..bus import LISTEN_S, open_link, service_of
from ..errors import AcquisitionError
from ..protocol import ANSWER, EMERGENCY, HEARTBEAT
from ..recording import ERROR, EXTENDED, REMOTE_REQUEST, Block, Recording, read_recording, written_by_master
from ..robot import BusFile, resolve
from .task import Stop

WITHOUT_HARDWARE = ("virtual", "udp_multicast")  # the second: UDP on this computer


def replay(path: Path, file: BusFile, stop: Stop, *, speed: float = 1.0, onto_bus: bool = False) -> int:
    """Send the frames that the drives of a recording sent, and its SYNCs, in their order and with their timing.

    Parameters
    ----------
    path : the recording.
    file : the bus to send on: interface and channel.
    stop : ends the replay when it has a reason.
    speed : times as fast as recorded, more than 0.
    onto_bus : allows interfaces that hardware may be connected to.

    Returns
    -------
    The number of frames sent.

    Raises
    ------
    AcquisitionError
        `speed` or the interface is refused, the recording holds no frames of drives, any frame of another node is received
        before or between those that are sent, or the bus takes no frames.
    """
    if not speed > 0:
        raise AcquisitionError(key="--speed", value=speed, expected="more than 0")
    if file.interface not in WITHOUT_HARDWARE and not onto_bus:
        problem = "hardware may be on this bus"
        expected = f"--onto-bus, or one of {', '.join(WITHOUT_HARDWARE)}"
        raise AcquisitionError(problem, key="--interface", value=file.interface, expected=expected)
    recording = read_recording(path)
    frames = from_drives(recording, str(path))
    assert recording.robot.bus is not None  # else there were no drives
    since_s = (frames["time_ns"] - frames["time_ns"][:1]) * 1e-9 / speed
    due_s = np.maximum.accumulate(since_s) if len(frames) else since_s
    link = open_link(file, passive=False)
    count, sync_can_id = 0, recording.robot.bus.sync_can_id

    def listen_until(until_s: float) -> None:
        """Wait; an error at the first frame that is not our own."""
        while not stop.reason:
            left_s = until_s - time.monotonic()
            frame = link.take(min(max(left_s, 0.0), 0.1))
            if frame is not None and not frame.flags & ERROR:
                place, sent = f"{file.interface} {file.channel}", f"{count} frames were" if count else "nothing was"
                problem, expected = f"{service_of(frame, sync_can_id)} is heard", f"a silent bus; {sent} sent"
                raise AcquisitionError(problem, place=place, expected=expected)
            if left_s <= 0:
                return

    try:
        listen_until(time.monotonic() + max(LISTEN_S, 1.5 * recording.robot.bus.heartbeat_s))
        start_s = time.monotonic()
        for row, at_s in zip(frames, due_s.tolist(), strict=True):
            listen_until(start_s + at_s)
            if stop.reason:
                break
            link.send(int(row["can_id"]), row["data"].tobytes()[: row["length"]])
            count += 1
    finally:
        link.close()
    return count


def from_drives(recording: Recording, place: str) -> Block:
    """Frames that the drives of the recording sent, and SYNC, from the channel with the most frames.

    Drives are those of the description in the recording: their TPDOs, emergencies, SDO answers and heartbeats. Error frames,
    remote requests and 29-bit frames are left out. Raises `AcquisitionError` where no frame is left.
    """
    if not recording.frames:
        raise AcquisitionError("holds no CAN frames", place=place, expected="a recording of drives")
    frames = max(recording.frames.values(), key=len)
    bus = resolve(recording.robot, f"{place}: robot.toml", written_by_master(frames))
    ids = [bus.file.sync_can_id]
    for drive in bus.drives:
        ids += [pdo.can_id for pdo in drive.tpdos]
        ids += [service + drive.node for service in (EMERGENCY, ANSWER, HEARTBEAT)]
    plain = (frames["flags"] & (EXTENDED | ERROR | REMOTE_REQUEST)) == 0
    found: Block = frames[plain & np.isin(frames["can_id"], ids)]
    if not len(found):
        raise AcquisitionError("holds no frame of its drives, and no SYNC", place=place, expected="some to send")
    return found
