"""Checks before motion: every drive is homed, and the user has confirmed the joint positions.

The zero of an incremental encoder is where it was switched on, and no limit of position means anything before homing.
"""

from collections.abc import Callable

import numpy as np

from ..arrays import Array
from ..errors import AcquisitionError
from ..robot import Drive, DriveFile, Robot, parse_homed
from .master import Master

Confirm = Callable[[list[str]], bool]  # is shown the joint positions; True where the user confirms them


def joint_positions(robot: Robot, master: Master) -> Array:
    """Positions (n,) in rad or m, read by SDO. Raises `AcquisitionError` where a drive does not answer."""
    motors = []
    for drive in master.bus.drives:
        raw = master.read(drive.node, drive.position.index, drive.position.sub)
        counts = raw - (1 << drive.position.bits) if raw >> (drive.position.bits - 1) else raw
        motors.append(drive.position_codec.si(np.array(counts)))
    q: Array = robot.joint_position(np.array(motors, dtype=float)[None])[0]
    return q


def position_words(robot: Robot, q: Array) -> list[str]:
    """`joint_1 = 12.34 deg`, one for each joint; metres of one that slides."""
    return [
        f"{joint.name} = {value:.5f} m" if joint.type == "prismatic" else f"{joint.name} = {np.rad2deg(value):.2f} deg"
        for joint, value in zip(robot.joints, q, strict=True)
    ]


def homed(master: Master, drive: Drive, file: DriveFile) -> bool | None:
    """Whether the drive says that it is homed; None where the description names no object for it."""
    if file.homed is None:
        return None
    index, sub, bit = parse_homed(file.homed)
    value = master.read(drive.node, index, sub)
    return bool(value if bit is None else value >> bit & 1)


def refuse_unhomed(master: Master) -> None:
    """Raise `AcquisitionError` where a drive reports that it is not homed."""
    for drive, file in zip(master.bus.drives, master.bus.file.drive, strict=True):
        if homed(master, drive, file) is False:
            raise AcquisitionError(
                f"node {drive.node} ({drive.name}): homed = {file.homed!r}: not set: expected a homed drive before motion"
            )


def confirm_positions(robot: Robot, master: Master, confirm: Confirm) -> list[str]:
    """Joint positions as text, once confirmed.

    Raises `AcquisitionError` where the user does not confirm, or a drive is not homed.
    """
    refuse_unhomed(master)
    words = position_words(robot, joint_positions(robot, master))
    if not confirm(words):
        raise AcquisitionError(f"joint angles not confirmed ({', '.join(words)}): nothing was moved")
    return words
