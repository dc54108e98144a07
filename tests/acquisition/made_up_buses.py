"""Robots with drives on a bus, and frames as such drives would send them, made up for tests."""

import re
import struct
from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from acquisition.errors import BadInputError
from acquisition.recording import FRAME, SENT, Block
from acquisition.robot import Bus, Robot, resolve, robot_from_files

JOINT = """
[[joint]]
name = "joint_{i}"
type = "revolute"
dh = {{ alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0 }}
position_deg = [-150, 150]
speed_deg_s = 200
acceleration_deg_s2 = 4000
following_error_deg = 5
[[motor]]
name = "motor_{i}"
ratio = {ratio}
effort_unit = "N m"
"""
DRIVE = """
[[bus.drive]]
node = {node}
reference = "6074"
rated_torque_nm = 0.42
counts_per_turn = 65536
"""


def bus_text(
    n: int = 2, *, period_s: float = 0.002, ratio: float = 50.0, extra: str = "", drive: str = "",
    interface: str = "virtual",
    channel: str = "test",
) -> str:  # fmt: skip
    """robot.toml of `n` joints and drives, nodes from 1; `extra` goes into [bus], `drive`
    into each [[bus.drive]].
    """
    joints = "".join(JOINT.format(i=i + 1, ratio=ratio) for i in range(n))
    bus = (
        f'[bus]\ninterface = "{interface}"\nchannel = "{channel}"\nsync_period_s = '
        f"{period_s}\n{extra}\n"
    )
    drives = "".join(DRIVE.format(node=i + 1) + drive + "\n" for i in range(n))
    return f'name = "made up"\n[controller]\nbandwidth_hz = 5\n{joints}{bus}{drives}'


def robot_of(text: str, files: Mapping[str, bytes] | None = None) -> Robot:
    return robot_from_files({"robot.toml": text.encode(), **(files or {})}, "robot.toml")


def bus_of(robot: Robot) -> Bus:
    return resolve(robot, "robot.toml")


def refused(text: str, expected: str, files: Mapping[str, bytes] | None = None) -> None:
    """A description is refused in one line with `expected` in it, which begins with
    the key that is wrong.
    """
    with pytest.raises(BadInputError, match=re.escape(expected)) as caught:
        bus_of(robot_of(text, files))
    assert str(caught.value).startswith(f"robot.toml: {caught.value.key}")


def frame(
    time_ns: int, can_id: int, data: bytes = b"", flags: int = 0
) -> tuple[int, int, int, int, NDArray[np.uint8]]:
    return (time_ns, can_id, len(data), flags, np.frombuffer(data.ljust(8, b"\0"), np.uint8))


def block(rows: list[tuple[int, int, int, int, NDArray[np.uint8]]]) -> Block:
    return np.array(rows, FRAME) if rows else np.zeros(0, FRAME)


def counts(node: int, k: int) -> int:
    """Position that drive `node` has at SYNC `k`."""
    return 1000 * node + 7 * k


def session(
    nodes: int = 2, syncs: int = 50, *, period_ns: int = 2_000_000, targets: bool = False
) -> list[list[object]]:
    """Frames SYNC by SYNC: a list of [time, id, data] for each interval, to be
    damaged and then flattened.
    """
    intervals: list[list[object]] = []
    for k in range(syncs):
        t = 1_000_000_000 + k * period_ns
        rows: list[object] = [frame(t, 0x80, flags=SENT)]
        for node in range(1, nodes + 1):
            data = struct.pack("<Hih", 0x1237, counts(node, k), 10 * node + k)
            rows.append(frame(t + 200_000 * node, 0x180 + node, data))
        if targets:
            for node in range(1, nodes + 1):
                data = struct.pack("<Hi", 0x0F, counts(node, k + 1) + 3)
                rows.append(frame(t + 1_500_000 + node, 0x200 + node, data, SENT))
        intervals.append(rows)
    return intervals


def flat(intervals: list[list[object]]) -> Block:
    return block([row for rows in intervals for row in rows])  # type: ignore[misc]
