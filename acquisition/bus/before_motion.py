"""Checks before sending and before motion: no other master, no enabled drive, all drives homed,
joint positions confirmed.

Before homing, the zero of an incremental encoder is the position at which it was switched on:
position limits do not hold yet.
"""

from collections.abc import Callable, Sequence

import numpy as np

from ..arrays import Array
from ..errors import NoAnswerError, RefusedError, SdoAbortedError
from ..protocol import ANSWER, DISABLED, State, error_words, signed
from ..recording import ERROR
from ..robot import Bus, Drive, Robot, axis_of, parse_homed
from .frames import other_node, sign_of_master
from .master import Master

LISTEN_S = 0.5


def listen_for_others(master: Master) -> RefusedError | None:
    """Listen for half a second; the error for another master, else for a device that is not
    described. Nothing is sent.
    """
    device, until_ns = None, master.link.now_ns() + round(LISTEN_S * 1e9)
    while master.link.now_ns() < until_ns:
        frame = master.link.receive(until_ns)
        if frame is None or frame.flags & ERROR:
            continue
        if frame.can_id & 0x780 == ANSWER:
            master.dispatch(frame)
        sign, node = sign_of_master(frame, master.bus), other_node(frame, master.bus)
        if sign is not None:
            return RefusedError(
                f"{sign}: another master is active",
                what="sending",
                place="bus",
                expected="none; `robot-acquire record --passive` records without sending. "
                "Nothing was sent",
            )
        if node is not None:
            device = RefusedError(
                f"heartbeat of node {node}: a device that robot.toml does not describe, or a "
                "wrong node id",
                what="sending",
                place="bus",
                key="other_nodes",
                value=master.bus.file.other_nodes,
                expected=f"it in other_nodes = [{node}] of [bus], unless it is a master. Nothing "
                "was sent",
            )
    return device


def refuse_enabled(master: Master) -> list[int]:
    """Nodes in fault, found by reading only.

    Raises `RefusedError`: a drive is enabled, or two are one node.
    """
    in_fault = []
    for drive in master.bus.drives:
        state = master.state(drive)
        if state not in DISABLED:
            raise RefusedError(
                f"{state.words} before the session began, but no other master was heard",
                what="the session",
                place=f"node {drive.node}",
                expected="switch on disabled; `robot-acquire disable` with this robot.toml "
                "disables it",
            )
        if state is State.FAULT:
            in_fault.append(drive.node)
    # for a second device's answer to the last request
    master.wait(master.link.now_ns() + 30_000_000)
    master.refuse_doubled()
    return in_fault


ERROR_REGISTER, ERROR_FIELD, ERROR_CODE = 0x1001, 0x1003, 0x603F
# Shows joint positions, and drives in fault that would be reset, to the operator; True
# where both are confirmed.
Confirm = Callable[[list[str], list[str]], bool]


def joint_positions(robot: Robot, master: Master) -> Array:
    """Joint positions (n,) in rad or m, read by SDO.

    Raises `RefusedError` where a drive does not answer.
    """
    return joints_of(
        robot,
        master.bus,
        [
            signed(master.read(drive.node, *drive.position.key), drive.position.bits)
            for drive in master.bus.drives
        ],
    )


def joints_of(robot: Robot, bus: Bus, counts: Sequence[int]) -> Array:
    """Joint positions (n,) in rad or m of the drives' `counts` (n), in the order of the drives."""
    motors = [
        drive.position_codec.si(np.array(c)) for drive, c in zip(bus.drives, counts, strict=True)
    ]
    return np.asarray(robot.joint_position(np.array(motors, dtype=float)[None])[0])


def position_words(robot: Robot, q: Array) -> list[str]:
    """One text for each joint, in degrees or metres: `joint_1 = 12.34 deg`."""
    return [
        f"{joint.name} = {value:.5f} m"
        if joint.type == "prismatic"
        else f"{joint.name} = {np.rad2deg(value):.2f} deg"
        for joint, value in zip(robot.joints, q, strict=True)
    ]


def is_homed(master: Master, drive: Drive) -> bool | None:
    """Whether the drive's object or bit named by `homed` is set; None where the
    description names none.
    """
    if drive.file.homed is None:
        return None
    index, sub, bit = parse_homed(drive.file.homed)
    value = master.read(drive.node, index, sub)
    return bool(value if bit is None else value >> bit & 1)


def confirm_motion(
    robot: Robot, master: Master, confirm: Confirm, *, reset_faults: bool = False
) -> list[str]:
    """Refuse drives that are not homed, then ask the operator about the measured joint
    positions and drives in fault.

    With `reset_faults` drives in fault are reset without asking. Returns the confirmed texts, one
    for each joint and drive in fault: `joint_1 = 12.34 deg`. Raises `RefusedError`: not homed, no
    answer, or not confirmed.
    """
    for drive in master.bus.drives:
        if is_homed(master, drive) is False:
            raise RefusedError(
                "not set",
                what="motion",
                place=f"node {drive.node} ({drive.name})",
                key="homed",
                value=drive.file.homed,
                expected="a homed drive before motion",
            )
    words = position_words(robot, joint_positions(robot, master))
    in_fault = [drive for drive in master.bus.drives if master.state(drive) is State.FAULT]
    faults = [
        f"in fault: {error_report(master, drive) or f'node {drive.node} ({drive.name})'}"
        for drive in in_fault
    ]
    if confirm(words, [] if reset_faults else faults):
        return words + faults
    if faults and not reset_faults:
        raise RefusedError(
            f"not confirmed: {'; '.join(faults)}",
            what="motion",
            place="drives",
            expected="yes to their reset, or --reset-faults. Nothing was moved",
        )
    raise RefusedError(
        f"joint angles not confirmed ({', '.join(words)}): nothing was moved", what="motion"
    )


def error_report(master: Master, drive: Drive) -> str:
    """Error register (1001h), last error (1003h:1) and error code (603Fh) in one line; empty where
    a drive has none of them.
    """
    values = []
    for index, sub, name in (
        (ERROR_REGISTER, 0, "error register 1001"),
        (ERROR_FIELD, 1, "last error 1003:1"),
        (ERROR_CODE + axis_of(drive), 0, f"error code {ERROR_CODE + axis_of(drive):04X}"),
    ):
        try:
            value = master.read(drive.node, index, sub)
        except (NoAnswerError, SdoAbortedError):
            continue  # many drives lack one of them
        values.append(
            f"{name} = "
            + (f"0x{value:02X}" if index == ERROR_REGISTER else error_words(value & 0xFFFF))
        )
    return f"node {drive.node} ({drive.name}): {', '.join(values)}" if values else ""
