"""Reads a recording, up to the cut if the file has no end, and writes a changed copy."""

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

from ..errors import Place
from ..files import atomic_write
from ..robot import EffortTiming, Payload, Robot, robot_from_files
from .content import Messages, read_content
from .rows import CAPTURE_TOPIC, FRAME, Block, check_frames, check_samples
from .writer import (
    EFFORT_TIMINGS,
    FRAMES_TOPIC,
    Header,
    RecordingWriter,
    sample_layouts,
)

# 2000-01-01; stamps before it count from the start of a computer or a recording
FIRST_DATE_NS = 946_684_800 * 10**9

# The end of a layout of rows with values of further objects of the drives, of earlier versions.
_EXTRA = re.compile(r"(.*), \('extra', '<f8', \(([1-9][0-9]{0,3}),\)\)\]")
NO_SAMPLES = "no samples: "  # begins the event that gives the reason


class Event(msgspec.Struct, frozen=True, kw_only=True):
    """Something that happened: a session phase, a drive's emergency message, an operator's mark."""

    stamp_ns: int = 0  # of its message, in which are the others
    kind: str
    text: str


@dataclass(frozen=True, kw_only=True)
class Health:
    """Counters of the recorder at `stamp_ns`, by name."""

    stamp_ns: int
    counters: Mapping[str, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """What a recording holds.

    Attributes:
        samples: rows of `sample_dtype` with strictly increasing stamps, joint side,
            SI; None without samples.
        frames: rows of `FRAME` by CAN channel.
        capture: a file of pcap with EtherCAT frames; empty without.
        attachments: by name; names are labels, never paths.
        payload: what the robot carried; None: nothing.
        cut: the file has no end; this is what was written before the cut.
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
        """Start of the recording: its first stamp if stamps are dates, else the creation of its
        file; None if unknown.
        """
        first_ns = (
            0
            if self.samples is None or len(self.samples) == 0
            else int(self.samples["stamp_ns"][0])
        )
        if first_ns >= FIRST_DATE_NS:
            return datetime.fromtimestamp(first_ns // 1000 / 1e6, UTC)
        try:
            created = datetime.fromisoformat(self.metadata.get("created", ""))
        except ValueError:
            return None
        return created.astimezone(UTC) if created.tzinfo else created.replace(tzinfo=UTC)

    @property
    def no_samples(self) -> str:
        """The reason why there are no samples, as recorded."""
        texts = [event.text for event in self.events if event.text.startswith(NO_SAMPLES)]
        return texts[-1] if texts else "holds no joint samples"

    @property
    def effort_timing(self) -> EffortTiming:
        """The instants that efforts belong to, as the recording states."""
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
            notes=self.metadata,  # with the payload, and what later versions say of it
            attachments={
                name: content
                for name, content in self.attachments.items()
                if name not in self.robot.files
            },
        )

    def __repr__(self) -> str:
        samples, frames = (
            0 if self.samples is None else len(self.samples),
            sum(map(len, self.frames.values())),
        )
        content = f"{samples} samples at {self.sample_rate_hz:g} Hz, {frames} CAN frames"
        return f"Recording({self.robot.name}: {content}{', cut' if self.cut else ''})"


def read_recording(path: str | PathLike[str]) -> Recording:
    """Read a recording and check its CRCs.

    Older schema versions are read too. A file without its end is read up to
    the cut, with `cut` set.

    Raises
    ------
    BadInputError
        The file cannot be read, is no recording, is damaged, has a newer schema version, or has
        blocks that do not fit their layout.
    """
    path = Path(path)
    place = Place(str(path))
    found, cut, sha256 = read_content(path)
    attachments, topics = found.attachments, found.messages
    note = " (the file is cut before its description)" if cut else ""
    expected = (
        "a recording of robot-acquire, which `robot-acquire import --topic NAME` makes of a "
        "ROS 2 bag, and `mcap filter` keeps with --include-metadata --include-attachments"
    )
    metadata = place.given(
        found.metadata, text=f"holds no metadata record 'recording'{note}", expected=expected
    )
    place.require(
        "robot.toml" in attachments,
        text=f"holds no robot.toml{note}",
        expected="the robot's description as an attachment",
    )
    robot = robot_from_files(attachments, f"{path}: robot.toml")
    unit, expected = metadata.get("effort_unit"), json.dumps(robot.effort_units)
    place.require(unit == expected, "effort_unit", unit, expected, shown=str(unit))
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
    captured = topics.get(CAPTURE_TOPIC)
    return Recording(
        samples=samples,
        frames=frames,
        capture=captured.data.whole() if captured is not None else b"",
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
    """Concatenated rows of a known layout, compared as text, never evaluated; further objects of
    old versions are skipped. Errors name `place`.
    """
    text, skipped = blocks.layout, 0
    if (earlier := _EXTRA.fullmatch(text)) is not None:
        text, skipped = f"{earlier[1]}]", int(earlier[2])
    dtype = Place(place).given(
        next((layout for layout in known if repr(layout.descr) == text), None),
        text=f"layout {blocks.layout[:200]!r}",
        expected=str(known[-1].descr),
    )
    whole = np.dtype([*dtype.descr, ("extra", "<f8", (skipped,))]) if skipped else dtype
    Place(place).require(
        all(end % whole.itemsize == 0 for end in blocks.ends),
        text=f"{blocks.data.tell()} bytes",
        expected=f"blocks of whole rows of {whole.itemsize} bytes",
    )
    rows = np.frombuffer(blocks.data.whole(), whole)
    if skipped:
        rows = rows[list(dtype.names or ())]
    rows.flags.writeable = False
    return rows


def events_of(
    topics: Mapping[str, Messages], path: Path
) -> tuple[tuple[Event, ...], tuple[Health, ...]]:
    """Events and counters in messages by topic."""
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
        messages = topics[topic].items() if topic in topics else ()
        return [(stamp, msgspec.json.decode(text, type=kind)) for stamp, text in messages]
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        Place(f"{path}: {topic}").refuse(text=str(error))


def _rate(metadata: Mapping[str, str], place: Place) -> float:
    text = metadata.get("sample_rate_hz", "")
    with suppress(ValueError):
        if 0 < (rate_hz := float(text)) < math.inf:
            return rate_hz
    place.refuse("sample_rate_hz", text, "a positive number")


def _payload(metadata: Mapping[str, str], place: Place) -> Payload | None:
    text = metadata.get("payload", "null")
    try:
        return msgspec.json.decode(text, type=Payload | None)
    except (msgspec.MsgspecError, RecursionError) as error:
        place.refuse("payload", text, text=str(error))


@contextmanager
def rewritten(
    recording: Recording, header: Header, out: Path, *, without: str = ""
) -> Iterator[RecordingWriter]:
    """Copy frames, health and events (except those of the kind `without`) of a recording; the
    block writes the samples. `out` is written whole or not at all.
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
