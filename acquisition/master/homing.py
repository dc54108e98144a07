"""Checks before motion: every drive is homed, and the user has confirmed the joint positions.

Before homing, the zero of an incremental encoder is the position at which it was switched on: position limits do not hold yet.
"""

from collections.abc import Callable, Sequence

import numpy as np

from ..arrays import Array
from ..errors import AcquisitionError
from ..robot import Bus, Drive, DriveFile, Robot, parse_homed
from .master import Master

Confirm = Callable[[list[str]], bool]  # shows the joint positions to the operator; True where they are confirmed


def joint_positions(robot: Robot, master: Master) -> Array:
    """Positions (n,) of the joints in rad or m, from the position objects (6064h or as described) read by SDO.

    Raises `AcquisitionError` where a drive does not answer.
    """
    counts = []
    for drive in master.bus.drives:
        raw = master.read(drive.node, drive.position.index, drive.position.sub)
        counts.append(raw - (1 << drive.position.bits) if raw >> (drive.position.bits - 1) else raw)
    return joints_of(robot, master.bus, counts)


def joints_of(robot: Robot, bus: Bus, counts: Sequence[int]) -> Array:
    """Joint positions (n,) in rad or m of the drives' `counts` (n), in the order of the drives."""
    motors = [drive.position_codec.si(np.array(c)) for drive, c in zip(bus.drives, counts, strict=True)]
    q: Array = robot.joint_position(np.array(motors, dtype=float)[None])[0]
    return q


def position_words(robot: Robot, q: Array) -> list[str]:
    """One text for each joint, in degrees or metres: `joint_1 = 12.34 deg`."""
    return [
        f"{joint.name} = {value:.5f} m" if joint.type == "prismatic" else f"{joint.name} = {np.rad2deg(value):.2f} deg"
        for joint, value in zip(robot.joints, q, strict=True)
    ]


def homed(master: Master, drive: Drive, file: DriveFile) -> bool | None:
    """Whether the object or bit that the description names for it (`homed`) reports the drive as homed; None without one.

    Raises `AcquisitionError` where the drive does not answer.
    """
    if file.homed is None:
        return None
    index, sub, bit = parse_homed(file.homed)
    value = master.read(drive.node, index, sub)
    return bool(value if bit is None else value >> bit & 1)


def refuse_unhomed(master: Master) -> None:
    """Raise `AcquisitionError` where a drive reports that it is not homed."""
    for drive, file in zip(master.bus.drives, master.bus.file.drive, strict=True):
        if homed(master, drive, file) is False:
            where, expected = f"node {drive.node} ({drive.name})", "a homed drive before motion"
            raise AcquisitionError("not set", place=where, key="homed", value=file.homed, expected=expected)


def confirm_positions(robot: Robot, master: Master, confirm: Confirm) -> list[str]:
    """Refuse drives that are not homed, ask whether the measured joint positions are right, and return them in words.

    Raises `AcquisitionError` where a drive is not homed or does not answer, or the operator does not confirm.
    """
    refuse_unhomed(master)
    words = position_words(robot, joint_positions(robot, master))
    if not confirm(words):
        raise AcquisitionError(f"joint angles not confirmed ({', '.join(words)}): nothing was moved")
    return words
