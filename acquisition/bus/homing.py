"""Checks before motion: every drive is homed, and the user has confirmed the joint positions.

Before homing, the zero of an incremental encoder is the position at which it was switched on: position limits do not hold yet.
"""

from collections.abc import Callable, Sequence

import numpy as np

from ..arrays import Array
from ..errors import AcquisitionError
from ..protocol import State
from ..robot import Bus, Drive, DriveFile, Robot, parse_homed
from .master import Master
from .reports import error_report

# Shows joint positions, and drives in fault that would be reset, to the operator; True where both are confirmed.
Confirm = Callable[[list[str], list[str]], bool]


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


def confirm_motion(robot: Robot, master: Master, confirm: Confirm, *, reset_faults: bool = False) -> list[str]:
    """Refuse drives that are not homed, then ask the operator about the measured joint positions and drives in fault.

    With `reset_faults` the reset of drives in fault is not asked. Returns a text for each joint and drive in fault, as
    confirmed: `joint_1 = 12.34 deg`. Raises `AcquisitionError`: not homed, no answer, or not confirmed.
    """
    refuse_unhomed(master)
    words = position_words(robot, joint_positions(robot, master))
    in_fault = [drive for drive in master.bus.drives if master.state(drive) is State.FAULT]
    faults = [f"in fault: {error_report(master, drive) or f'node {drive.node} ({drive.name})'}" for drive in in_fault]
    if confirm(words, [] if reset_faults else faults):
        return words + faults
    if faults and not reset_faults:
        expected = "yes to their reset, or --reset-faults. Nothing was moved"
        raise AcquisitionError(f"not confirmed: {'; '.join(faults)}", place="drives", expected=expected)
    raise AcquisitionError(f"joint angles not confirmed ({', '.join(words)}): nothing was moved")
