"""The recorder of a session: it writes frames, status and counters, and decodes them at the end."""

import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from .. import recording
from ..errors import BadInputError, Location
from ..robot import Bus, Payload, Robot, resolve

# With less free space on the disk, the session ends.
MIN_FREE_BYTES = 100 * 2**20


@dataclass(frozen=True, kw_only=True)
class Status:
    """The state of the recorder, every half second.

    Attributes:
        frames: number of all frames.
        rate_hz: rate of frames in the last half second.
        drops: number of frames that the kernel dropped.
        losses: number of PDOs that were late, missing, duplicate or too short, by these words.
        lowest: lowest position of each joint, rad or m; empty before the first sample.
        highest: highest position of each joint.
        ends: why the session has to end; empty if it can continue.
    """

    frames: int = 0
    rate_hz: float = 0.0
    drops: int = 0
    losses: Mapping[str, int] = field(
        default_factory=lambda: dict.fromkeys(("late", "missing", "duplicate", "short"), 0)
    )
    lowest: tuple[float, ...] = ()
    highest: tuple[float, ...] = ()
    ends: str = ""


@dataclass(frozen=True, kw_only=True)
class RecordedSummary:
    """The result of a recording.

    Attributes:
        frames: number of frames.
        samples: number of samples.
        warnings: warnings of the decoder.
        no_samples: why there are no samples; else empty.
        path: where the recording is, which has a new name if the file was deleted; None if it had
            no frames and was removed.
    """

    frames: int
    samples: int
    warnings: tuple[str, ...]
    no_samples: str = ""
    path: Path | None = None


def refuse_taken(path: Path) -> None:
    """Check that a new recording can have this name.

    Raises
    ------
    BadInputError : the file exists, or its folder cannot be written.
    """
    taken = path.exists()
    Location(str(path)).require(
        not taken and os.access(f"{path.absolute().parent}/", os.W_OK),
        text="the file already exists" if taken else "the folder does not exist or is read-only",
        advice="Choose a new name in an existing folder; a recording is never replaced",
    )


class Recorder:
    """The writer of a recording. Data that is flushed survives a kill of the process.

    Attributes:
        channel: name of the channel in the recording.
        granted: counters for every message of `/health`.
    """

    def __init__(
        self, path: Path, robot: Robot, *, source: str, place: str, payload: Payload | None = None
    ) -> None:
        assert robot.bus is not None
        self._path, self._robot, self._place = path, robot, place
        file = robot.bus
        self._bus = None if file.mapped_by_traffic else resolve(robot, place)
        header = recording.Header(
            robot=robot,
            source=source,
            sample_rate_hz=1.0 / file.sync_period_s,
            effort_provenance=self._bus.provenance
            if self._bus
            else "mapped by another master, see the frames",
            effort_timing=file.effort_timing,
            payload=payload,
            notes={
                "bus": f"{file.interface} {file.channel}",
                "bitrate": str(file.bitrate),
                "sync_period_s": repr(file.sync_period_s),
                "clock": "receive times of the recorder; samples at the times of their SYNCs",
                **(_table(self._bus) if self._bus else {}),
            },
        )
        try:
            # If two sessions begin at once, only one of them gets the name.
            path.touch(exist_ok=False)
            self._writer = recording.RecordingWriter(path, header)
        except OSError as error:
            raise BadInputError(
                f"the recording cannot be written: {error.strerror or error}", place=str(path)
            ) from error
        self.channel = (
            "".join(c if c.isalnum() or c in "_.-" else "_" for c in file.channel)[:64] or "can"
        )
        self._recent: list[recording.Block] = []  # since the last status
        self._status = Status()
        # These counters are constant, and written with every message of `/health`.
        self.granted: dict[str, float] = {}
        self._flushed_ns: int | None = None
        self._fd_frames, self._ends, self._is_empty = 0, "", True

    def add(self, block: recording.Block) -> None:
        """Write frames in the order of reception. Programs that follow the file see them at once.

        Frames of CAN FD are only counted.
        """
        of_fd = (block["flags"] & recording.CAN_FD) != 0
        self._fd_frames += int(of_fd.sum())
        block = block[~of_fd]
        if len(block):
            self._is_empty = False
            self._writer.frames(self.channel, block)
            self._writer.flush(sync=False)
            self._recent.append(block)

    def event(self, stamp_ns: int, kind: str, text: str) -> None:
        """Write an event, and flush.

        Phases and notes are not flushed, because there may be many.
        """
        self._writer.event(stamp_ns, kind, text)
        if kind == "operator":
            self._is_empty = False
        elif kind != "phase":
            self._writer.flush()

    def tick(self, stamp_ns: int, drops: int, *, now: bool = False) -> Status | None:
        """Flush and return a status every half second, else None.

        `drops` is the number of frames that the kernel dropped; `now` flushes at once.
        """
        if self._flushed_ns is None:
            self._flushed_ns = stamp_ns
        elapsed_s = (stamp_ns - self._flushed_ns) * 1e-9
        if 0 <= elapsed_s < 0.5 and not now:
            return None
        recent = np.concatenate(self._recent) if self._recent else np.zeros(0, recording.FRAME)
        self._recent = []
        self._watch_file()
        self._status = status = self._next_status(recent, elapsed_s, drops)
        self._writer.health(
            stamp_ns,
            {**self.granted, "frames": status.frames, "kernel_drops": drops, **status.losses},
        )
        self._writer.flush()
        self._flushed_ns = stamp_ns
        return status

    def _next_status(self, recent: recording.Block, elapsed_s: float, drops: int) -> Status:
        last, found = self._status, dict[str, Any]()
        # Frames cannot be decoded while there is no SYNC, or no drive answers.
        with suppress(BadInputError):
            if self._bus is None:
                recent, self._bus = recording.resolve_mapped(recent, self._robot, self._place)
            decoded = recording.decode(recent, self._robot, self._bus, self._place, max_missing=1.0)
            q = decoded.samples["position"]
            found = {
                "lowest": tuple(np.minimum(q.min(axis=0), last.lowest or np.inf).tolist()),
                "highest": tuple(np.maximum(q.max(axis=0), last.highest or -np.inf).tolist()),
                "losses": {k: n + int(decoded.counters[k]) for k, n in last.losses.items()},
            }
        return replace(
            last,
            frames=last.frames + len(recent),
            rate_hz=len(recent) / max(elapsed_s, 1e-3),
            drops=drops,
            ends=self._ends,
            **found,
        )

    def finish(self, stamp_ns: int) -> RecordedSummary:
        """Decode the recorded frames, write the samples after them, and close the file."""
        self._writer.flush()
        self._watch_file()
        # The descriptor is used, because the file may have been renamed.
        written = recording.read_recording(Path(f"/proc/self/fd/{self._writer.fileno()}"))
        frames = written.frames.get(self.channel, np.zeros(0, recording.FRAME))
        found = write_decoded(self._writer, frames, self._robot, stamp_ns, str(self._path))
        if self._fd_frames:
            text = f"frames not recorded: {self._fd_frames} of CAN FD"
            self._writer.event(stamp_ns, "warning", text)
            found = replace(found, warnings=(*found.warnings, text))
        self.close()
        return replace(found, path=None if self._is_empty else self._path)

    def _watch_file(self) -> None:
        """Check whether the session has to end.

        A deleted file is written again from its descriptor, under a new name.
        """
        if not os.fstat(self._writer.fileno()).st_nlink:
            names = (self._path.with_stem(f"{self._path.stem}-{k}") for k in count(2))
            new = next(name for name in names if not name.exists())
            self._writer.move_to(new)
            self._ends = f"{self._path.name} was deleted; the recording is now in {new}"
            self._path = new
        elif shutil.disk_usage(self._writer.fileno()).free < MIN_FREE_BYTES:
            self._ends = self._ends or "the disk is nearly full"

    def close(self) -> None:
        """Close the file as it is. A file without frames and notes of the operator is removed."""
        if self._is_empty:
            # The file may be gone, or closed before.
            with suppress(OSError, ValueError):
                # Another file may have its name by now, and must stay.
                if os.path.samestat(os.fstat(self._writer.fileno()), self._path.stat()):
                    self._path.unlink()
        self._writer.close()


def write_decoded(
    writer: recording.RecordingWriter,
    frames: recording.Block,
    robot: Robot,
    stamp_ns: int,
    place: str,
) -> RecordedSummary:
    """Decode frames, and write samples, counters and warnings.

    If there are no samples, the reason is written.

    Parameters
    ----------
    writer : writer of the recording.
    frames : (m,) rows of `FRAME`.
    robot : the robot with its bus.
    stamp_ns : time of the written events, ns.
    place : name of the recording in errors.
    """
    try:
        mapped, bus = recording.resolve_mapped(frames, robot, place)
        decoded = recording.decode(mapped, robot, bus, place)
    except BadInputError as error:
        writer.event(stamp_ns, "warning", f"{recording.NO_SAMPLES}{error}")
        return RecordedSummary(frames=len(frames), samples=0, warnings=(), no_samples=str(error))
    decoded.write(writer, stamp_ns)
    return RecordedSummary(
        frames=len(frames), samples=len(decoded.stamps), warnings=decoded.warnings
    )


def _table(bus: Bus) -> dict[str, str]:
    """Return the PDOs and the raw rated values, for the metadata."""
    return {
        "pdo_table": "; ".join(
            f"node {d.node} {way} {p.number} 0x{p.can_id:03X}: {' '.join(map(str, p.entries))}"
            for d in bus.drives
            for way, found in (("tpdo", d.tpdos), ("rpdo", d.rpdos))
            for p in found
        ),
        "rated_raw": "; ".join(
            f"node {d.node} {index:04X} = {raw}"
            for d in bus.drives
            for index, raw in d.rated.items()
        ),
    }
