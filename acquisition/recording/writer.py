"""Writing of a recording, one MCAP file with everything that a fit needs.

The module also has the definitions that writer and reader share. The guide on recordings has a
table of the channels. The metadata record `recording` and the attachments (`robot.toml`, the URDF)
are written before the data, so that a file without its end can be read. Blocks are numpy rows,
which need far less space than a message per row; the text of their schema is the numpy dtype's
`descr`.
"""

import json
import math
import os
import platform
import re
import shutil
import zlib
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ..arrays import Array, Ints
from ..errors import Location
from ..files import BLOCK_ROWS
from ..robot import EffortTiming, Payload, Robot
from ..versions import version_of
from .rows import (
    CAPTURE_TOPIC,
    FRAME,
    OPTIONAL,
    Block,
    check_frames,
    check_samples,
    in_parts,
    sample_dtype,
)

# The texts of the key `effort_timing` in the metadata; a missing key means "unknown".
EFFORT_TIMINGS: Mapping[EffortTiming, str] = {
    "command": "command of the instant, held after it",
    "mean": "mean over the control period",
    "measured": "measured at the instant of the sample",
    "unknown": "not known",
}

SCHEMA_VERSION = 2  # 1: samples without the fields `OPTIONAL`

FRAMES_TOPIC = re.compile(r"/can/([A-Za-z0-9_.-]{1,64})/frames")
JOINT_STATE = "sensor_msgs/msg/JointState"


@dataclass(frozen=True, kw_only=True, eq=False)
class Header:
    """The part of a recording before its data.

    Attributes:
        robot: the robot.
        source: origin of the data, as text.
        sample_rate_hz: nominal sample rate in Hz.
        effort_provenance: object, reference or actual, raw unit, rated value and rule of each
            effort, as text.
        effort_timing: instants to which efforts belong.
        payload: what the robot carried; JSON of its fields in the metadata.
        notes: further metadata by key (bus, bit rate); keys of the header itself are overwritten.
        attachments: files by name, in addition to the robot's own, which replace others of the same
            name.
    """

    robot: Robot
    source: str
    sample_rate_hz: float
    effort_provenance: str
    effort_timing: EffortTiming = "unknown"
    payload: Payload | None = None
    notes: Mapping[str, str] = field(default_factory=dict)
    attachments: Mapping[str, bytes] = field(default_factory=dict)

    @property
    def metadata(self) -> Mapping[str, str]:
        """The metadata record `recording`, with its CRC."""
        joints = self.robot.joints
        entries = {
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "software": _software(),
            **self.notes,
            "schema_version": str(SCHEMA_VERSION),
            "source": self.source,
            "sample_rate_hz": repr(float(self.sample_rate_hz)),
            "robot": self.robot.name,
            "joints": json.dumps([j.name for j in joints]),
            "position_unit": json.dumps([j.position_unit for j in joints]),
            "effort_unit": json.dumps(self.robot.effort_units),
            "effort_provenance": self.effort_provenance,
            "effort_timing": EFFORT_TIMINGS[self.effort_timing],
        }
        if self.payload is not None:
            entries["payload"] = msgspec.json.encode(self.payload).decode()
        return entries | {"crc32": metadata_crc(entries)}


def sample_layouts(robot: Robot) -> list[np.dtype[np.void]]:
    """Return all row layouts that samples of a robot may have."""
    columns = [some for k in range(len(OPTIONAL) + 1) for some in combinations(OPTIONAL, k)]
    return [
        sample_dtype(len(robot.joints), reference=reference, optional=optional)
        for optional in reversed(columns)
        for reference in (False, True)
    ]


def metadata_crc(metadata: Mapping[str, str]) -> str:
    """Compute the CRC of all other entries.

    The CRC that MCAP has for its metadata is at the end, which a truncated file has lost.
    """
    entries = sorted((key, value) for key, value in metadata.items() if key != "crc32")
    return f"{zlib.crc32(json.dumps(entries).encode()):08x}"


def _software() -> str:
    packages = ("robot-idim", "numpy", "mcap", "rosbags")
    versions = (f"{name} {version_of(name, '(not installed as a package)')}" for name in packages)
    return ", ".join([f"python {platform.python_version()}", *versions])


class RecordingWriter(AbstractContextManager["RecordingWriter"]):
    """A writer of a recording; a context manager.

    `flush` makes everything so far survive a kill or a power cut. Metadata and attachments are on
    the disk when the constructor returns. Methods raise `OSError` as files do (use `atomic_write`
    if the file must be written whole or not at all), and `BadInputError` for blocks that do not
    fit.
    """

    def __init__(self, path: Path, header: Header) -> None:
        from mcap.writer import Writer

        # This package is slow to import, and only needed for writing.
        from rosbags.typesys import Stores, get_typestore

        # The store is slow to make, so it is not made while frames arrive.
        self._ros = get_typestore(Stores.ROS2_JAZZY)
        self._joint_state: str = self._ros.generate_msgdef(JOINT_STATE, ros_version=2)[0]
        self._robot, self._place = header.robot, str(path)
        self._layout: np.dtype[np.void] | None = None
        self._last_stamp_ns = -1
        # Viewers get at most 100 JointStates per second.
        self._step = max(1, math.ceil(header.sample_rate_hz / 100.0 - 1e-9))
        self._until_joint_state = 0
        self._channels: dict[str, int] = {}
        self._file = path.open("wb")
        self._writer = Writer(self._file, enable_data_crcs=True)
        self._writer.start(profile="", library="robot-idim")
        self._writer.add_metadata("recording", dict(header.metadata))
        for name, content in {**header.attachments, **header.robot.files}.items():
            self._writer.add_attachment(0, 0, name, "application/octet-stream", content)
        self.flush()

    def __exit__(self, *_: object) -> None:
        self.close()

    def samples(self, block: Block) -> None:
        """Add rows of `sample_dtype` and their JointState messages."""
        place = Location(f"{self._place}: /samples")
        # A block of which fields were skipped has the same layout.
        layout = np.dtype([(name, block.dtype[name]) for name in block.dtype.names or ()])
        place.require(
            layout in sample_layouts(self._robot),
            text=f"the rows have the type {block.dtype}",
            expected=f"sample_dtype of {self._robot.n} joints",
        )
        place.require(
            self._layout in (None, layout),
            text=f"the rows have the type {block.dtype}",
            expected=f"{self._layout}, as in the block before",
        )
        if len(block) == 0:
            return
        check_samples(block, self._last_stamp_ns, str(place))
        self._layout, self._last_stamp_ns = layout, int(block["stamp_ns"][-1])
        for part in _parts(block):
            self._block(
                "/samples",
                "robot_idim/samples",
                part.astype(layout, copy=False),
                int(part["stamp_ns"][0]),
            )
            shown = part[self._until_joint_state :: self._step]
            self._until_joint_state = (self._until_joint_state - len(part)) % self._step
            self._joint_states("/joint_states/measured", shown, "position", self._robot.gain_known)
            if "reference" in (part.dtype.names or ()):
                self._joint_states("/joint_states/reference", shown, "reference", False)

    def columns(self, stamp_ns: Array | Ints, values: Mapping[str, Array]) -> None:
        """Add samples at timestamps (N,) of `values` (N, n) by field, block by block.

        The samples of hours do not fit in memory.
        """
        layout = sample_dtype(self._robot.n, reference="reference" in values, optional=values)
        for first in range(0, len(stamp_ns), BLOCK_ROWS):
            rows = np.empty(min(BLOCK_ROWS, len(stamp_ns) - first), layout)
            for name, column in {"stamp_ns": stamp_ns, **values}.items():
                rows[name] = column[first : first + BLOCK_ROWS]
            self.samples(rows)

    def frames(self, channel: str, block: Block) -> None:
        """Add rows of `FRAME` of one CAN channel. They are stored in blocks of at most 100 ms."""
        topic = f"/can/{channel}/frames"
        Location(self._place).require(
            FRAMES_TOPIC.fullmatch(topic),
            text=f"the CAN channel {channel!r} has an invalid name",
            expected="letters, digits and _ . -",
        )
        Location(f"{self._place}: {topic}").require(
            block.dtype == FRAME, text=f"the rows have the type {block.dtype}", expected=str(FRAME)
        )
        check_frames(block, f"{self._place}: {topic}")
        for some in in_parts(block):
            tenths = np.flatnonzero(np.diff(some["time_ns"] // 100_000_000)) + 1
            for part in (part for tenth in np.split(some, tenths) for part in _parts(tenth)):
                self._block(topic, "robot_idim/frames", part, int(part["time_ns"][0]))

    def captured(self, records: bytes, stamp_ns: int) -> None:
        """Add records of pcap.

        All of them form a pcap file with nanoseconds, whose head is in the first ones.
        """
        self._add(
            CAPTURE_TOPIC,
            ("pcap", "robot_idim/pcap", "text", "parts of a pcap file"),
            stamp_ns,
            records,
        )

    def event(self, stamp_ns: int, kind: str, text: str) -> None:
        """Add an event."""
        self._json(
            "/events",
            "robot_idim/event",
            {
                "type": "object",
                "properties": {"kind": {"type": "string"}, "text": {"type": "string"}},
            },
            stamp_ns,
            {"kind": kind, "text": text},
        )

    def health(self, stamp_ns: int, counters: Mapping[str, float]) -> None:
        """Add the recorder's counters.

        A value that is not finite is stored as null and read as NaN.
        """
        self._json("/health", "robot_idim/health", {"type": "object"}, stamp_ns, dict(counters))

    def flush(self, *, sync: bool = True) -> None:
        """Write everything so far to the file, where other programs see it.

        With `sync`, everything is written to the disk, too.
        """
        self._writer.flush()
        self._file.flush()
        if sync:
            os.fsync(self._file.fileno())

    def fileno(self) -> int:
        """Return the descriptor of the file, which may have another name by now."""
        return self._file.fileno()

    def move_to(self, path: Path) -> None:
        """Copy the file to `path`, which must not exist, and continue there.

        This rescues a deleted file, which only its descriptor still reaches.
        """
        self.flush(sync=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("xb") as new, open(f"/proc/self/fd/{self.fileno()}", "rb") as old:
            shutil.copyfileobj(old, new)
            new.flush()
            os.dup2(new.fileno(), self.fileno())
        self.flush()

    def close(self) -> None:
        """Write the end of the file. A closed file is left alone."""
        if self._file.closed:
            return
        with self._file:
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())

    def _add(
        self, topic: str, kind: tuple[str, str, str, str], stamp_ns: int, content: bytes
    ) -> None:
        """Add a message; `kind` is its encoding, and name, encoding and text of the schema."""
        if topic not in self._channels:
            encoding, schema, schema_encoding, text = kind
            schema_id = self._writer.register_schema(schema, schema_encoding, text.encode())
            self._channels[topic] = self._writer.register_channel(topic, encoding, schema_id)
        self._writer.add_message(self._channels[topic], stamp_ns, content, stamp_ns)

    def _block(self, topic: str, schema: str, block: Block, stamp_ns: int) -> None:
        self._add(
            topic,
            ("numpy", schema, "numpy", repr(block.dtype.descr)),
            stamp_ns,
            block.tobytes(),
        )

    def _json(
        self, topic: str, schema: str, layout: Mapping[str, Any], stamp_ns: int, content: Any
    ) -> None:
        Location(f"{self._place}: {topic}").require(
            stamp_ns >= 0, "stamp_ns", stamp_ns, "0 or greater"
        )
        self._add(
            topic,
            ("json", schema, "jsonschema", json.dumps(layout)),
            stamp_ns,
            msgspec.json.encode(content),
        )

    def _joint_states(self, topic: str, rows: Block, field: str, effort: bool) -> None:
        """Add JointStates, serialised to CDR by the package rosbags."""
        kind, types = ("cdr", JOINT_STATE, "ros2msg", self._joint_state), self._ros.types
        state, time = types[JOINT_STATE], types["builtin_interfaces/msg/Time"]
        header = types["std_msgs/msg/Header"]
        names, nothing = [j.name for j in self._robot.joints], np.zeros(0)
        for row in rows:
            stamp_ns = int(row["stamp_ns"])
            stamp = header(time(*divmod(stamp_ns, 1_000_000_000)), "")
            # The effort of a JointState is in N m or N by definition, never in A or V.
            shown = state(stamp, names, row[field], nothing, row["effort"] if effort else nothing)
            self._add(topic, kind, stamp_ns, bytes(self._ros.serialize_cdr(shown, JOINT_STATE)))


def _parts(block: Block) -> Iterator[Block]:
    """Split a block into parts small enough for a chunk of about 1 MiB."""
    return (block[k : k + 2000] for k in range(0, len(block), 2000))
