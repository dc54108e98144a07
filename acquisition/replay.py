"""A recording's frames back on a bus, with their timing."""

import time
from pathlib import Path

import numpy as np

from . import AcquisitionError
from .blocks import ERROR, EXTENDED, REMOTE
from .bus import open_link
from .bus_description import BusFile
from .recording import read_recording
from .session import Stop


def replay(path: Path, file: BusFile, stop: Stop, *, speed: float = 1.0) -> int:
    """Send the frames of the recording `path` in order; the number sent.

    Error frames, remote requests and 29-bit frames are left out. Raises `AcquisitionError` where the bus refuses.
    """
    if not speed > 0:
        raise AcquisitionError(f"--speed {speed:g}: expected more than 0")
    recording = read_recording(path)
    if not recording.frames:
        raise AcquisitionError(f"{path}: holds no CAN frames: expected a recording of drives")
    frames = max(recording.frames.values(), key=len)
    frames = frames[(frames["flags"] & (EXTENDED | ERROR | REMOTE)) == 0]
    since_s = (frames["time_ns"] - frames["time_ns"][:1]) * 1e-9 / speed
    due_s = np.maximum.accumulate(since_s) if len(frames) else since_s
    link = open_link(file, passive=False)
    count = 0
    try:
        start_s = time.monotonic()
        for row, at_s in zip(frames, due_s.tolist(), strict=True):
            wait_s = start_s + at_s - time.monotonic()
            while wait_s > 0 and not stop.reason:
                time.sleep(min(wait_s, 0.1))
                wait_s = start_s + at_s - time.monotonic()
            if stop.reason:
                break
            link.send(int(row["can_id"]), row["data"].tobytes()[: row["length"]])
            count += 1
    finally:
        link.close()
    return count
