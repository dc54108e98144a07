"""Follows a recording while it is written, from the file alone: new rows, events and counters.

The last seconds of frames are decoded again with each block. Rows are given once, and no earlier
than later frames can change them: PDOs that are late at the end of a block are awaited, and behind
a gap and where PDOs are late as many SYNCs as `associate` looks ahead.
"""

from contextlib import suppress
from pathlib import Path

import numpy as np

from ..errors import BadInputError, Place
from ..robot import resolve, robot_from_files
from .content import GrowingContent
from .decoding import decode
from .mapped import resolve_mapped
from .reader import Event, Health, events_of, rows_of
from .rows import FRAME, Block, Traffic
from .sync_grid import MAX_RUN_SYNCS, MIN_PAUSE_PERIODS
from .writer import FRAMES_TOPIC

HISTORY_SYNCS = 2 * MAX_RUN_SYNCS  # before the next row, which are decoded again
MAX_SYNCS = 8 * MAX_RUN_SYNCS  # without a row; older frames are dropped


class RecordingFollower:
    """A recording that is being written at `path`.

    After each `read`, `rows`, `events` and `health` are the new ones.

    `problem` is why there are no rows. Raises `BadInputError` as `read` does, and where the
    description is not written yet.
    """

    def __init__(self, path: Path) -> None:
        self._path, self.ended, self.problem = path, False, ""
        self._content = GrowingContent(path)
        self._content.read()
        found = self._content.found
        place = Place(str(path))
        if found.metadata is None or "robot.toml" not in found.attachments:
            place.refuse(text="has no description yet", expected="a recording that is written")
        self.metadata, self.robot = (
            found.metadata,
            robot_from_files(found.attachments, f"{path}: robot.toml"),
        )
        self._file = place.given(
            self.robot.bus, text="is of no bus", expected="a recording of `robot-acquire record`"
        )
        self._bus = None if self._file.mapped_by_traffic else resolve(self.robot, str(path))
        self._frames = np.zeros(0, FRAME)
        self._last: Block | None = None  # the last row that was given
        self.rows: Block | None = None
        self.events: tuple[Event, ...] = ()
        self.health: tuple[Health, ...] = ()

    def read(self) -> bool:
        """Whether the file has grown.

        Raises `BadInputError`: it is gone, cut, replaced or damaged.
        """
        grown, found = self._content.read(), self._content.found
        self.ended, topics = found.complete, found.take()
        self.events, self.health = events_of(topics, self._path)
        blocks = [
            rows_of(messages, [FRAME], f"{self._path}: {topic}")
            for topic, messages in topics.items()
            if FRAMES_TOPIC.fullmatch(topic)
        ]
        self._frames, self.rows = np.concatenate([self._frames, *blocks]), None
        if any(map(len, blocks)) or self.ended:
            self._decode()
        return grown

    def _decode(self) -> None:
        """Set `rows`, and drop the frames that no later row needs."""
        sync_rows = Traffic(self._frames).rows_of(self._file.sync_can_id)
        sync_ns = self._frames["time_ns"][sync_rows]
        half_ns, shown_ns = (
            0.5e9 * self._file.sync_period_s,
            -1 if self._last is None else int(self._last["stamp_ns"]),
        )
        first = max(
            int(np.searchsorted(sync_ns, shown_ns)) - HISTORY_SYNCS, len(sync_ns) - MAX_SYNCS
        )
        if self._bus is None:
            with suppress(BadInputError):  # the master has not mapped all drives yet
                self._frames, self._bus = resolve_mapped(self._frames, self.robot, str(self._path))
        elif first > 0:
            self._frames, sync_ns = self._frames[sync_rows[first] :], sync_ns[first:]
        if self._bus is None or len(sync_ns) < 2:
            return
        try:
            found = decode(self._frames, self.robot, self._bus, str(self._path), max_missing=1.0)
        except BadInputError as error:
            self.problem = error.args[0]
            return
        samples, self.problem = found.samples, ""
        stamps = samples["stamp_ns"]
        same = np.flatnonzero(np.abs(stamps - shown_ns) < half_ns)
        # wraps of position counters in the dropped frames count on
        if self._last is not None and len(same):
            off = self._last["position"] - samples["position"][same[0]]
            for name in ("position", "reference"):
                if name in (samples.dtype.names or ()):
                    samples[name] += off
        # Later frames may assign those behind a gap to other SYNCs, and leave out late ones.
        early = (np.diff(stamps, prepend=stamps[0]) > 2 * MIN_PAUSE_PERIODS * half_ns) | found.late
        early &= (stamps > shown_ns + half_ns) & (not self.ended)
        early &= stamps > sync_ns[max(0, len(sync_ns) - MAX_RUN_SYNCS)]
        rows = samples[: int(np.argmax(early))] if early.any() else samples
        rows = rows[rows["stamp_ns"] > shown_ns + half_ns]
        if len(rows):
            self.rows, self._last = rows, rows[-1]
