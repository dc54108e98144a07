"""What writer and reader of a recording agree on: channels, schema version, layouts of rows, CRC of the metadata.

The README has a table of the channels. The metadata record `recording` and the attachments (`robot.toml`, the URDF) are
written before the data, so that a file without its end can still be read. Blocks are numpy rows, which cost far less than a
message per row; the text of their schema is the numpy dtype's `descr`.
"""

import json
import platform
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata as packages
from itertools import combinations

import numpy as np

from ..robot import EffortTiming, Robot, extra_columns
from .rows import OPTIONAL, sample_dtype

# Texts of the metadata's key `effort_timing`; without the key it is not known.
EFFORT_TIMINGS: Mapping[EffortTiming, str] = {
    "command": "command of the instant, held after it",
    "mean": "mean over the control period",
    "measured": "measured at the instant of the sample",
    "unknown": "not known",
}

SCHEMA_VERSION = 2  # 1: samples without the fields `OPTIONAL`

FRAMES_TOPIC = re.compile(r"/can/([A-Za-z0-9_.-]{1,64})/frames")


@dataclass(frozen=True, kw_only=True, eq=False)
class Header:
    """What a recording holds before its data.

    Attributes:
        robot: its files are attached.
        source: where the data come from, in words.
        sample_rate_hz: nominal rate of the samples.
        effort_provenance: object, reference or actual, raw unit, rated value and rule of each effort, in words.
        effort_timing: what instants efforts belong to.
        notes: further metadata by key (bus, bitrate); keys that the header writes itself are written anew.
        attachments: files by name, in addition to the robot's own.
    """

    robot: Robot
    source: str
    sample_rate_hz: float
    effort_provenance: str
    effort_timing: EffortTiming = "unknown"
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
        return entries | {"crc32": metadata_crc(entries)}

    @property
    def files(self) -> Mapping[str, bytes]:
        """All attachments by name; of two with one name the robot's own."""
        return {**self.attachments, **self.robot.files}


def sample_layouts(robot: Robot) -> list[np.dtype[np.void]]:
    """Rows that samples of a robot may have."""
    counts = dict.fromkeys((len(extra_columns(robot)), 0))
    columns = [some for k in range(len(OPTIONAL) + 1) for some in combinations(OPTIONAL, k)]
    return [
        sample_dtype(robot.n, reference=reference, extra=m, optional=optional)
        for m in counts
        for optional in reversed(columns)
        for reference in (False, True)
    ]


def metadata_crc(metadata: Mapping[str, str]) -> str:
    """Of all entries but itself. MCAP guards its metadata only by the CRC at the end, which a cut file has lost."""
    entries = sorted((key, value) for key, value in metadata.items() if key != "crc32")
    return f"{zlib.crc32(json.dumps(entries).encode()):08x}"


def _software() -> str:
    versions = [f"python {platform.python_version()}"]
    for name in ("robot-idim", "numpy", "mcap", "rosbags"):
        try:
            versions.append(f"{name} {packages.version(name)}")
        except packages.PackageNotFoundError:
            versions.append(f"{name} (not installed as a package)")
    return ", ".join(versions)
