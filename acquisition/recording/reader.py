"""Reading of recordings, writing of changed copies, and following of a growing recording.

A recording grows while it is written. A file without its end is read up to there. A growing one is
followed from the file alone: new rows, events and counters. The last seconds of its frames are
decoded again with each block. Rows are returned once, when later frames cannot change them any
more: PDOs that are late at the end of a block are awaited, and behind a gap and where PDOs are late
as many SYNCs as `associate` looks ahead.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from mmap import mmap
from os import PathLike
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ..errors import BadInputError, Location
from ..files import atomic_write
from ..robot import EffortTiming, Payload, Robot, resolve, robot_from_files
from .content import GrowingContent, Messages, read_content
from .decoding import decode
from .rows import (
    CAPTURE_TOPIC,
    FRAME,
    Block,
    Traffic,
    check_frames,
    check_samples,
    resolve_mapped,
)
from .sync_grid import MAX_RUN_SYNCS, MIN_PAUSE_PERIODS
from .writer import (
    EFFORT_TIMINGS,
    FRAMES_TOPIC,
    Header,
    RecordingWriter,
    sample_layouts,
)

# Timestamps before 2000-01-01 count from the start of a computer or a recording.
FIRST_DATE_NS = 946_684_800 * 10**9

# Earlier versions recorded values of further objects of the drives at the end of a row.
_EXTRA = re.compile(r"(.*), \('extra', '<f8', \(([1-9][0-9]{0,3}),\)\)\]")
NO_SAMPLES = "no samples: "  # begins the event that gives the reason


class Event(msgspec.Struct, frozen=True, kw_only=True):
    """An event: a session phase, a drive's emergency message, an operator's annotation."""

    # The message of the event has this time; kind and text are its content.
    stamp_ns: int = 0
    kind: str
    text: str


@dataclass(frozen=True, kw_only=True)
class Health:
    """Counters of the recorder at `stamp_ns`, by name."""

    stamp_ns: int
    counters: Mapping[str, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """Content of a recording.

    Attributes:
        samples: rows of `sample_dtype` with strictly increasing timestamps, joint side, SI; None
            without samples.
        frames: rows of `FRAME` by CAN channel.
        capture: a pcap file with EtherCAT frames; empty without them.
        events: session phases, warnings and annotations.
        health: counters of the recorder.
        metadata: the metadata record.
        attachments: content by name; names are labels, never paths.
        robot: the robot.
        payload: what the robot carried; None if nothing.
        sample_rate_hz: nominal sample rate in Hz.
        cut: whether the file has no end, so that this is what was written before.
        sha256: digest of the file, hexadecimal.
    """

    samples: Block | None
    frames: Mapping[str, Block]
    capture: bytes | mmap
    events: tuple[Event, ...]
    health: tuple[Health, ...]
    metadata: Mapping[str, str]
    attachments: Mapping[str, bytes]
    robot: Robot
    payload: Payload | None
    sample_rate_hz: float
    cut: bool
    sha256: str

    @property
    def began(self) -> datetime | None:
        """Start of the recording; None if unknown.

        It is the first timestamp if timestamps are dates, otherwise the creation of the file.
        """
        if self.samples is not None and (self.samples["stamp_ns"][:1] >= FIRST_DATE_NS).any():
            return datetime.fromtimestamp(int(self.samples["stamp_ns"][0]) // 1000 / 1e6, UTC)
        with suppress(ValueError):
            created = datetime.fromisoformat(self.metadata.get("created", ""))
            return created.astimezone(UTC) if created.tzinfo else created.replace(tzinfo=UTC)
        return None

    @property
    def no_samples(self) -> str:
        """The recorded reason for missing samples."""
        return next(
            (e.text for e in reversed(self.events) if e.text.startswith(NO_SAMPLES)),
            "the recording contains no samples",
        )

    @property
    def effort_timing(self) -> EffortTiming:
        """The instants to which efforts belong, as recorded."""
        return next(
            (
                timing
                for timing, text in EFFORT_TIMINGS.items()
                if text == self.metadata.get("effort_timing")
            ),
            "unknown",
        )

    @property
    def header(self) -> Header:
        """Header of another recording of the same session."""
        return Header(
            robot=self.robot,
            source=self.metadata.get("source", ""),
            sample_rate_hz=self.sample_rate_hz,
            effort_provenance=self.metadata.get("effort_provenance", ""),
            effort_timing=self.effort_timing,
            # The metadata contain the payload, with keys of later versions.
            notes=self.metadata,
            attachments={
                name: content
                for name, content in self.attachments.items()
                if name not in self.robot.files
            },
        )

    def __repr__(self) -> str:
        return (
            f"Recording({self.robot.name}: {0 if self.samples is None else len(self.samples)} "
            f"samples at {self.sample_rate_hz:g} Hz, "
            f"{sum(map(len, self.frames.values()))} CAN frames{', cut' if self.cut else ''})"
        )


def read_recording(path: str | PathLike[str]) -> Recording:
    """Read a recording and check its CRCs.

    Older schema versions are read, too. A file without its end is read up to there, with `cut` set.

    Parameters
    ----------
    path : the file.

    Returns
    -------
    The content of the recording.

    Raises
    ------
    BadInputError : the file cannot be read, is not a recording, is damaged, has a newer schema
        version, or has blocks that do not fit their layout.
    """
    path = Path(path)
    place = Location(str(path))
    found, cut, sha256 = read_content(path)
    attachments, topics = found.attachments, found.messages
    note = " (it is truncated before its description)" if cut else ""
    if (metadata := found.metadata) is None:
        place.refuse(
            text=f"the file has no metadata record 'recording'{note}",
            advice="Import a ROS 2 bag by `robot-acquire import --topic NAME`; filter a recording "
            "by `mcap filter --include-metadata --include-attachments`",
        )
    if "robot.toml" not in attachments:
        place.refuse(text=f"the recording has no robot.toml attached{note}")
    robot = robot_from_files(attachments, f"{path}: robot.toml")
    unit, expected = metadata.get("effort_unit"), json.dumps(robot.effort_units)
    if unit != expected:
        place.refuse("effort_unit", unit, expected, shown=str(unit))
    samples, frames = None, {}
    for topic, blocks in topics.items():
        if not blocks.stamps_ns:
            continue
        where = f"{path}: {topic}"
        if topic == "/samples":
            samples = rows_of(blocks, sample_layouts(robot), where)
            check_samples(samples, -1, where)
        elif match := FRAMES_TOPIC.fullmatch(topic):
            frames[match[1]] = rows_of(blocks, [FRAME], where)
            check_frames(frames[match[1]], where)
    events, health = events_of(topics, path)
    return Recording(
        samples=samples,
        frames=frames,
        capture=topics[CAPTURE_TOPIC].data.whole() if CAPTURE_TOPIC in topics else b"",
        events=events,
        health=health,
        metadata=metadata,
        attachments=attachments,
        robot=robot,
        payload=_payload(metadata, place),
        sample_rate_hz=_rate(metadata, place),
        cut=cut,
        sha256=sha256,
    )


def rows_of(blocks: Messages, known: list[np.dtype[np.void]], place: str) -> Block:
    """Concatenate rows of a known layout, which is compared as text, never evaluated.

    Further objects of old versions are skipped. `place` is the name of the recording in errors.
    """
    earlier = _EXTRA.fullmatch(blocks.layout)
    text, skipped = (f"{earlier[1]}]", int(earlier[2])) if earlier else (blocks.layout, 0)
    if (dtype := next((one for one in known if repr(one.descr) == text), None)) is None:
        Location(place).refuse(
            text=f"the rows have the layout {blocks.layout[:200]!r}",
            expected=str(known[-1].descr),
        )
    whole = np.dtype([*dtype.descr, ("extra", "<f8", (skipped,))]) if skipped else dtype
    if any(end % whole.itemsize for end in blocks.ends):
        Location(place).refuse(
            text=f"the blocks have {blocks.data.tell()} bytes",
            expected=f"whole rows of {whole.itemsize} bytes",
        )
    # An array over bytes is read-only.
    rows = np.frombuffer(blocks.data.whole(), whole)
    return rows[list(dtype.names or ())] if skipped else rows


def events_of(
    topics: Mapping[str, Messages], path: Path
) -> tuple[tuple[Event, ...], tuple[Health, ...]]:
    """Decode events and counters in messages by topic."""
    return (
        tuple(
            msgspec.structs.replace(event, stamp_ns=stamp)
            for stamp, event in _decode_json(topics, "/events", Event, path)
        ),
        tuple(
            Health(
                stamp_ns=stamp,
                counters={k: math.nan if v is None else v for k, v in counters.items()},
            )
            for stamp, counters in _decode_json(topics, "/health", dict[str, float | None], path)
        ),
    )


def _decode_json(
    topics: Mapping[str, Messages], topic: str, kind: Any, path: Path
) -> list[tuple[int, Any]]:
    try:
        return [
            (stamp, msgspec.json.decode(text, type=kind))
            for stamp, text in (topics[topic].items() if topic in topics else ())
        ]
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        Location(f"{path}: {topic}").refuse(text=str(error))


def _rate(metadata: Mapping[str, str], place: Location) -> float:
    text = metadata.get("sample_rate_hz", "")
    with suppress(ValueError):
        if 0 < (rate_hz := float(text)) < math.inf:
            return rate_hz
    place.refuse("sample_rate_hz", text, "a positive number")


def _payload(metadata: Mapping[str, str], place: Location) -> Payload | None:
    text = metadata.get("payload", "null")
    try:
        return msgspec.json.decode(text, type=Payload | None)
    except (msgspec.MsgspecError, RecursionError) as error:
        place.refuse("payload", text, text=str(error))


@contextmanager
def rewritten(
    recording: Recording, header: Header, out: Path, *, without: str = ""
) -> Iterator[RecordingWriter]:
    """Copy frames, health and events of a recording; the block writes the samples.

    Events of the kind `without` are left out. `out` is written whole or not at all.
    """
    with atomic_write(out) as partial, RecordingWriter(partial, header) as writer:
        for channel, frames in recording.frames.items():
            writer.frames(channel, frames)
        for at in range(0, len(recording.capture), 2**20):
            writer.captured(recording.capture[at : at + 2**20], 0)
        for event in recording.events:
            if event.kind != without:
                writer.event(event.stamp_ns, event.kind, event.text)
        for health in recording.health:
            writer.health(health.stamp_ns, health.counters)
        yield writer


class RecordingFollower:
    """A recording that is being written at `path`.

    After each `read`, `rows`, `events` and `health` are the new ones, and `problem` is the reason
    for missing rows. The constructor raises `BadInputError` as `read` does, and if the description
    is not written yet.
    """

    def __init__(self, path: Path) -> None:
        self._path, self.ended, self.problem = path, False, ""
        self._content = GrowingContent(path)
        self._content.read()
        attachments, place = self._content.attachments, Location(str(path))
        self.metadata = place.given(
            self._content.metadata if "robot.toml" in attachments else None,
            text="the recording has no description yet",
            advice="Wait until the recording has started",
        )
        self.robot = robot_from_files(attachments, f"{path}: robot.toml")
        self._file = place.given(
            self.robot.bus,
            text="robot.toml has no [bus], so no drives are recorded",
            advice="Follow a recording of `robot-acquire record`",
        )
        self._bus = None if self._file.mapped_by_traffic else resolve(self.robot, str(path))
        self._frames = np.zeros(0, FRAME)
        self._last: Block | None = None  # the last row that was returned
        self.rows: Block | None = None
        self.events: tuple[Event, ...] = ()
        self.health: tuple[Health, ...] = ()

    def read(self) -> bool:
        """Read what is new; return whether the file has grown.

        Raises
        ------
        BadInputError : the file was removed, truncated, replaced or damaged.
        """
        grown, topics = self._content.read(), self._content.take()
        self.ended = self._content.complete
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
        half_ns = 0.5e9 * self._file.sync_period_s
        shown_ns = -1 if self._last is None else int(self._last["stamp_ns"])
        # The SYNCs before the last row are decoded again. Without a row, old frames are dropped.
        first = max(
            int(np.searchsorted(sync_ns, shown_ns)) - 2 * MAX_RUN_SYNCS,
            len(sync_ns) - 8 * MAX_RUN_SYNCS,
        )
        if self._bus is None:
            # The master may not have mapped all drives yet.
            with suppress(BadInputError):
                self._frames, self._bus = resolve_mapped(self._frames, self.robot, str(self._path))
        elif first > 0:
            self._frames, sync_ns = self._frames[sync_rows[first] :], sync_ns[first:]
        if self._bus is None or len(sync_ns) < 2:
            return
        try:
            found = decode(self._frames, self.robot, self._bus, str(self._path), max_missing=1.0)
        except BadInputError as error:
            self.problem = str(error)
            return
        samples, self.problem = found.samples, ""
        stamps = samples["stamp_ns"]
        same = np.flatnonzero(np.abs(stamps - shown_ns) < half_ns)
        # Position counters may have wrapped in the dropped frames, so continue from the last row.
        if self._last is not None and len(same):
            off = self._last["position"] - samples["position"][same[0]]
            for name in {"position", "reference"} & {*(samples.dtype.names or ())}:
                samples[name] += off
        # Later frames may assign rows behind a gap to other SYNCs, and remove late ones.
        new = stamps > shown_ns + half_ns
        behind_gap = np.diff(stamps, prepend=stamps[0]) > 2 * MIN_PAUSE_PERIODS * half_ns
        recent = stamps > sync_ns[max(0, len(sync_ns) - MAX_RUN_SYNCS)]
        early = new & (behind_gap | found.late) & recent & (not self.ended)
        rows = samples[new & ~np.logical_or.accumulate(early)]
        if len(rows):
            self.rows, self._last = rows, rows[-1]
