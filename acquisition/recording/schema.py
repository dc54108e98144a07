"""What writer and reader of a recording agree on: channels, schema version, layouts of rows, CRC of the metadata.

| channel | content |
|---|---|
| `/can/<channel>/frames` | blocks of raw CAN frames, both directions: `FRAME` rows |
| `/samples` | blocks of joint samples in SI, and extra objects: `sample_dtype` rows |
| `/joint_states/measured`, `.../reference` | sensor_msgs/msg/JointState in CDR, at most 100 Hz, for viewers only |
| `/events` | JSON `{kind, text}`: session phases, errors of drives, marks |
| `/health` | JSON counters: kernel drops, late and missing messages |

The metadata record `recording` and the attachments (`robot.toml`, the URDF) are written before the data, so that a file
without its end can still be read. Blocks are numpy rows, which cost far less than a message per row; the text of their
schema is the numpy dtype's `descr`.
"""

import json
import re
import zlib
from collections.abc import Mapping

import numpy as np

from ..robot import Robot, extra_columns
from .rows import sample_dtype

SCHEMA_VERSION = 1

FRAMES_TOPIC = re.compile(r"/can/([A-Za-z0-9_.-]{1,64})/frames")


def sample_layouts(robot: Robot) -> list[np.dtype[np.void]]:
    """Rows that samples of a robot may have."""
    counts = dict.fromkeys((len(extra_columns(robot)), 0))
    return [sample_dtype(robot.n, reference=reference, extra=m) for m in counts for reference in (False, True)]


def metadata_crc(metadata: Mapping[str, str]) -> str:
    """Of all entries but itself. MCAP guards its metadata only by the CRC at the end, which a cut file has lost."""
    entries = sorted((key, value) for key, value in metadata.items() if key != "crc32")
    return f"{zlib.crc32(json.dumps(entries).encode()):08x}"
