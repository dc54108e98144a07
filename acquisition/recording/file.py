"""The recording: an MCAP file that holds everything a fit needs. Written and read here only.

| channel | content |
|---|---|
| `/can/<channel>/frames` | blocks of raw CAN frames, both directions: `FRAME` rows |
| `/samples` | blocks of joint samples in SI, and extra objects: `sample_dtype` rows |
| `/joint_states/measured`, `.../reference` | sensor_msgs/msg/JointState in CDR, at most 100 Hz, for viewers only |
| `/events` | JSON `{kind, text}`: session phases, errors of drives, marks |
| `/health` | JSON counters: kernel drops, late and missing messages |

The metadata record `recording` and the attachments (`robot.toml`, the URDF) stand before the data, so a file that was
cut still says what it is. Blocks are numpy rows, which cost far less than a message per row; the text of their schema
is the numpy dtype's `descr`.
"""

import json
import math
import os
import platform
import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata as packages
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
from mcap.writer import Writer

from ..errors import AcquisitionError
from ..files import whole_file
from ..robot import Robot, extra_columns, robot_from_files
from .content import Messages, read_content
from .rows import FRAME, Block, check_frames, check_samples, sample_dtype

SCHEMA_VERSION = 1
JOINT_STATE_RATE_HZ = 100.0

_FRAMES_TOPIC = re.compile(r"/can/([A-Za-z0-9_.-]{1,64})/frames")
_TEXT_SCHEMA = {"type": "object", "properties": {"kind": {"type": "string"}, "text": {"type": "string"}}}


class _EventText(msgspec.Struct):
    kind: str
    text: str


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that happened: a session phase, a drive's emergency message, an operator's mark."""

    stamp_ns: int
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
        samples: rows of `sample_dtype` with strictly increasing stamps, joint side, SI; `None` if there are none.
        frames: rows of `FRAME` by CAN channel.
        metadata: the record `recording`: source, created, versions, `effort_provenance`.
        attachments: by name; names are labels, never paths.
        robot: built from the attachments.
        sample_rate_hz: nominal rate of the samples.
        cut: the file has no proper end: this is what stands before the cut.
        sha256: of the file, hexadecimal.
    """

    samples: Block | None
    frames: Mapping[str, Block]
    events: tuple[Event, ...]
    health: tuple[Health, ...]
    metadata: Mapping[str, str]
    attachments: Mapping[str, bytes]
    robot: Robot
    sample_rate_hz: float
    cut: bool
    sha256: str


class RecordingWriter:
    """Writes a recording; a context manager. `flush` makes what was written so far survive a kill or a power cut.

    Metadata and attachments are on the disk when the constructor returns. Raises `OSError` as files do (use it within
    `whole_file` where the file must be whole or not there), and `AcquisitionError` for blocks that do not fit.
    """

    def __init__(
        self,
        path: Path,
        robot: Robot,
        *,
        source: str,
        sample_rate_hz: float,
        effort_provenance: str,
        notes: Mapping[str, str] | None = None,
        attachments: Mapping[str, bytes] | None = None,
    ) -> None:
        """`notes` are further metadata (bus, bitrate); `attachments` go beside the robot's own files, by name."""
        from rosbags.typesys import (
            Stores,
            get_typestore,
        )  # slow to import: needed for writing only, and not while it goes on

        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._robot, self._place = robot, str(path)
        self._layout: np.dtype[np.void] | None = None
        self._last_stamp_ns = -1
        self._step = max(1, math.ceil(sample_rate_hz / JOINT_STATE_RATE_HZ - 1e-9))
        self._until_joint_state = 0
        self._channels: dict[str, int] = {}
        self._file = path.open("wb")
        self._writer = Writer(self._file, enable_data_crcs=True)
        self._writer.start(profile="", library="robot-idim")
        description = {
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "software": _software(),
            **(notes or {}),
            "schema_version": str(SCHEMA_VERSION),
            "source": source,
            "sample_rate_hz": repr(float(sample_rate_hz)),
            "robot": robot.name,
            "joints": json.dumps([j.name for j in robot.joints]),
            "position_unit": json.dumps([j.position_unit for j in robot.joints]),
            "effort_unit": json.dumps(robot.effort_units),
            "effort_provenance": effort_provenance,
        }
        self._writer.add_metadata("recording", description | {"crc32": _crc(description)})
        for name, content in {**(attachments or {}), **robot.files}.items():
            self._writer.add_attachment(0, 0, name, "application/octet-stream", content)
        self.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def samples(self, block: Block) -> None:
        """Add rows of `sample_dtype` and their JointState messages."""
        n, place = self._robot.n, f"{self._place}: /samples"
        if block.dtype not in _layouts(self._robot):
            raise AcquisitionError(f"{place}: rows of {block.dtype}: expected sample_dtype of {n} joints")
        if self._layout not in (None, block.dtype):
            raise AcquisitionError(f"{place}: rows of {block.dtype}: expected {self._layout} as in the block before")
        if len(block) == 0:
            return
        check_samples(block, self._last_stamp_ns, place)
        self._layout, self._last_stamp_ns = block.dtype, int(block["stamp_ns"][-1])
        for part in _parts(block):
            self._block("/samples", "robot_idim/samples", part, int(part["stamp_ns"][0]))
            shown = part[self._until_joint_state :: self._step]
            self._until_joint_state = (self._until_joint_state - len(part)) % self._step
            self._joint_states("/joint_states/measured", shown, "position", self._robot.gain_known)
            if "reference" in (part.dtype.names or ()):
                self._joint_states("/joint_states/reference", shown, "reference", False)

    def frames(self, channel: str, block: Block) -> None:
        """Add rows of `FRAME` of one CAN channel. They are stored in blocks of at most 100 ms."""
        topic = f"/can/{channel}/frames"
        if not _FRAMES_TOPIC.fullmatch(topic):
            raise AcquisitionError(f"{self._place}: CAN channel {channel!r}: expected letters, digits and _ . - only")
        if block.dtype != FRAME:
            raise AcquisitionError(f"{self._place}: {topic}: rows of {block.dtype}: expected {FRAME}")
        if len(block):
            check_frames(block, f"{self._place}: {topic}")
            tenths = np.flatnonzero(np.diff(block["time_ns"] // 100_000_000)) + 1
            for part in (part for tenth in np.split(block, tenths) for part in _parts(tenth)):
                self._block(topic, "robot_idim/frames", part, int(part["time_ns"][0]))

    def event(self, stamp_ns: int, kind: str, text: str) -> None:
        """Note what happened at `stamp_ns`."""
        self._json("/events", "robot_idim/event", _TEXT_SCHEMA, stamp_ns, {"kind": kind, "text": text})

    def health(self, stamp_ns: int, counters: Mapping[str, float]) -> None:
        """Note the recorder's counters at `stamp_ns`; one that is not finite is stored as unknown and read as NaN."""
        self._json("/health", "robot_idim/health", {"type": "object"}, stamp_ns, dict(counters))

    def flush(self) -> None:
        """Bring everything written so far to the disk."""
        self._writer.flush()
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """End the file properly. Harmless when it is closed already."""
        if self._file.closed:
            return
        with self._file:
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())

    def _channel(self, topic: str, encoding: str, schema: str, schema_encoding: str, text: str) -> int:
        if topic not in self._channels:
            schema_id = self._writer.register_schema(schema, schema_encoding, text.encode())
            self._channels[topic] = self._writer.register_channel(topic, encoding, schema_id)
        return self._channels[topic]

    def _block(self, topic: str, schema: str, block: Block, stamp_ns: int) -> None:
        channel = self._channel(topic, "numpy", schema, "numpy", repr(block.dtype.descr))
        self._writer.add_message(channel, stamp_ns, block.tobytes(), stamp_ns)

    def _json(self, topic: str, schema: str, layout: Mapping[str, Any], stamp_ns: int, content: Any) -> None:
        if stamp_ns < 0:
            raise AcquisitionError(f"{self._place}: {topic}: stamp_ns = {stamp_ns}: expected a time from 0")
        channel = self._channel(topic, "json", schema, "jsonschema", json.dumps(layout))
        self._writer.add_message(channel, stamp_ns, msgspec.json.encode(content), stamp_ns)

    def _joint_states(self, topic: str, rows: Block, field: str, effort: bool) -> None:
        store, kind = self._types, "sensor_msgs/msg/JointState"
        text = store.generate_msgdef(kind, ros_version=2)[0]
        channel = self._channel(topic, "cdr", kind, "ros2msg", text)
        header, time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
        names, nothing = [j.name for j in self._robot.joints], np.zeros(0)
        for row in rows:
            stamp_ns = int(row["stamp_ns"])
            stamp = header(time(*divmod(stamp_ns, 1_000_000_000)), "")
            # A JointState's effort is in N m or N by definition: amperes and volts have no place there.
            state = store.types[kind](stamp, names, row[field], nothing, row["effort"] if effort else nothing)
            self._writer.add_message(channel, stamp_ns, bytes(store.serialize_cdr(state, kind)), stamp_ns)


def read_recording(path: Path) -> Recording:
    """Read a recording; CRCs are checked. A file without its end reads as far as it goes, with `cut` set.

    Raises `AcquisitionError` when the file cannot be read, is no recording, is damaged, is of a newer schema version,
    or holds blocks that do not fit their layout.
    """
    place = str(path)
    content = read_content(path, "recording", _check_metadata, _is_read)
    metadata, attachments, topics, cut = content.metadata, content.attachments, content.messages, content.cut
    told = " (the file is cut before its description)" if cut else ""
    if metadata is None:
        raise AcquisitionError(
            f"{place}: holds no metadata record 'recording'{told}: expected a recording of robot-acquire"
        )
    if "robot.toml" not in attachments:
        raise AcquisitionError(f"{place}: holds no robot.toml{told}: expected the robot's description as an attachment")
    robot = robot_from_files(attachments, f"{place}: robot.toml")
    if metadata.get("effort_unit") != json.dumps(robot.effort_units):
        expected = json.dumps(robot.effort_units)
        raise AcquisitionError(f"{place}: effort_unit = {metadata.get('effort_unit')}: expected {expected}")
    samples, frames = None, {}
    for topic, blocks in topics.items():
        if not blocks.stamps_ns:
            continue
        if topic == "/samples":
            samples = _rows(blocks, _layouts(robot), f"{place}: {topic}")
            check_samples(samples, -1, f"{place}: {topic}")
        elif match := _FRAMES_TOPIC.fullmatch(topic):
            frames[match[1]] = _rows(blocks, [FRAME], f"{place}: {topic}")
            check_frames(frames[match[1]], f"{place}: {topic}")
    events = _decoded(topics, "/events", _EventText, place)
    health = _decoded(topics, "/health", dict[str, float | None], place)
    return Recording(
        samples=samples,
        frames=frames,
        events=tuple(Event(stamp_ns=stamp, kind=e.kind, text=e.text) for stamp, e in events),
        health=tuple(
            Health(stamp_ns=stamp, counters={k: math.nan if v is None else v for k, v in counters.items()})
            for stamp, counters in health
        ),
        metadata=metadata,
        attachments=attachments,
        robot=robot,
        sample_rate_hz=_rate(metadata, place),
        cut=cut,
        sha256=content.sha256,
    )


def recover(cut_path: Path, out_path: Path) -> Recording:
    """Write to `out_path` a whole file of what the cut file `cut_path` still holds; return what that is.

    Raises `AcquisitionError` as `read_recording` does, when the file is not cut, and when `out_path` cannot be written.
    """
    recording = read_recording(cut_path)
    if not recording.cut:
        raise AcquisitionError(f"{cut_path}: has its proper end: nothing to recover")
    known = ("source", "effort_provenance")
    notes = {k: v for k, v in recording.metadata.items() if k not in known} | {"recovered_from": recording.sha256}
    with (
        whole_file(out_path) as partial,
        RecordingWriter(
            partial,
            recording.robot,
            source=recording.metadata.get("source", ""),
            sample_rate_hz=recording.sample_rate_hz,
            effort_provenance=recording.metadata.get("effort_provenance", ""),
            notes=notes,
            attachments=recording.attachments,
        ) as writer,
    ):
        if recording.samples is not None:
            writer.samples(recording.samples)
        for channel, frames in recording.frames.items():
            writer.frames(channel, frames)
        for event in recording.events:
            writer.event(event.stamp_ns, event.kind, event.text)
        for health in recording.health:
            writer.health(health.stamp_ns, health.counters)
    return recording


def _layouts(robot: Robot) -> list[np.dtype[np.void]]:
    """Rows that samples of a robot may have."""
    counts = dict.fromkeys((len(extra_columns(robot)), 0))
    return [sample_dtype(robot.n, reference=reference, extra=m) for m in counts for reference in (False, True)]


def _parts(block: Block) -> Iterator[Block]:
    """Pieces small enough for a chunk of about a mebibyte."""
    return (block[k : k + 2000] for k in range(0, len(block), 2000))


def _rows(blocks: Messages, known: list[np.dtype[np.void]], place: str) -> Block:
    """Concatenated rows. The schema's text is compared with the layouts this version writes, never evaluated."""
    for dtype in known:
        if repr(dtype.descr) == blocks.layout:
            break
    else:
        raise AcquisitionError(f"{place}: layout {blocks.layout[:200]!r}: expected {known[-1].descr}")
    if any(end % dtype.itemsize for end in blocks.ends):
        raise AcquisitionError(
            f"{place}: {len(blocks.data)} bytes: expected blocks of whole rows of {dtype.itemsize} bytes"
        )
    rows = np.frombuffer(blocks.data, dtype)
    rows.flags.writeable = False
    return rows


def _decoded(topics: Mapping[str, Messages], topic: str, kind: Any, place: str) -> list[tuple[int, Any]]:
    try:
        return [
            (stamp, msgspec.json.decode(text, type=kind))
            for stamp, text in (topics[topic].items() if topic in topics else [])
        ]
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise AcquisitionError(f"{place}: {topic}: {error}") from error


def _is_read(topic: str) -> bool:
    """All but the channels for viewers."""
    return topic in ("/samples", "/events", "/health") or _FRAMES_TOPIC.fullmatch(topic) is not None


def _check_metadata(metadata: Mapping[str, str], place: str) -> None:
    text = metadata.get("schema_version", "")
    if not re.fullmatch("[0-9]{1,9}", text, re.ASCII) or int(text) < 1:
        raise AcquisitionError(f"{place}: schema_version = {text!r}: expected a whole number from 1")
    if int(text) > SCHEMA_VERSION:
        raise AcquisitionError(
            f"{place}: schema_version = {text}: expected {SCHEMA_VERSION} at most; a newer robot-idim wrote this file"
        )
    if metadata.get("crc32") != _crc(metadata):
        raise AcquisitionError(f"{place}: metadata: crc32 = {metadata.get('crc32')!r}: expected {_crc(metadata)!r}")


def _crc(metadata: Mapping[str, str]) -> str:
    """Of all entries but itself. MCAP guards its metadata only by the CRC at the end, which a cut file has lost."""
    entries = sorted((key, value) for key, value in metadata.items() if key != "crc32")
    return f"{zlib.crc32(json.dumps(entries).encode()):08x}"


def _rate(metadata: Mapping[str, str], place: str) -> float:
    text = metadata.get("sample_rate_hz", "")
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = math.nan
    if not 0 < rate_hz < math.inf:
        raise AcquisitionError(f"{place}: sample_rate_hz = {text!r}: expected a positive number")
    return rate_hz


def _software() -> str:
    versions = [f"python {platform.python_version()}"]
    for name in ("robot-idim", "numpy", "mcap", "rosbags"):
        try:
            versions.append(f"{name} {packages.version(name)}")
        except packages.PackageNotFoundError:
            versions.append(f"{name} (not installed as a package)")
    return ", ".join(versions)
