"""Imports the joint states of a ROS 2 bag into a recording."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import AcquisitionError
from ..robot import Robot
from ..ros import JointStates, read_joint_states
from .quantities import effort_at_joint, effort_side, position_side, si_units
from .samples import Imported, Samples, write_samples
from .stamps import stamps_warning
from .table_map import EFFORT_UNITS, LARGEST_GAP_PERIODS
from .time_base import rate_doubts, resample, stamps_ns

SUFFIXES = (".mcap", ".db3")


@dataclass(frozen=True, kw_only=True)
class BagChoice:
    """What a bag does not say: the topic of its joint states, the unit of their efforts, the rate to interpolate to.

    `effort_unit`: one for all joints or one for each. N m and N are torques and forces at the joints; A, V and the like are of
    the motors, in the order of the joints. `resample_hz` None: the roundest rate that the stamps have.
    """

    topic: str
    effort_unit: tuple[str, ...]
    resample_hz: float | None = None


def is_bag(path: Path) -> bool:
    """Whether a path looks like a ROS 2 bag: a folder, or a file of one."""
    return path.is_dir() or path.suffix.lower() in SUFFIXES


def import_bag(bag: Path, robot: Robot, choice: BagChoice, out: Path) -> Imported:
    """Write the recording `out` from joint states of a ROS 2 bag; joints go by their names in robot.toml.

    Times are the headers' stamps, or those of reception where headers have none; values are interpolated to a uniform grid.
    The recording says that efforts were measured at these times: a JointState has no commands.

    Parameters
    ----------
    bag : a folder, .mcap or .db3.

    Raises
    ------
    AcquisitionError
        With `place`, `key`, `value` and `expected`: the bag or its topic cannot be read, efforts are missing, zero, not finite
        or of other units than robot.toml says, stamps do not grow or leave gaps. Nothing is written then.
    """
    joints = [joint.name for joint in robot.joints]
    place = f"{bag}: {choice.topic}"
    position_side(robot, "joint", "position", place)
    states = read_joint_states(bag, choice.topic, joints)
    effort, provenance = _effort(robot, states, choice, place)
    parts = {"position": states.position, "effort": effort}
    doubts = []
    if states.velocity is not None and np.isfinite(states.velocity).all():
        parts["velocity"] = states.velocity
    elif states.velocity is not None:
        doubts.append("velocities that are not finite numbers are left out")
    if states.received:
        doubts.append("headers have no stamps: times are those of reception, which jitter more")
    if states.others:
        doubts.append(f"{states.others} messages without any of the joints are left out")
    first_ns = int(states.stamps_ns[0])
    time_s = np.asarray((states.stamps_ns - first_ns) * np.float64(1e-9))
    grid = resample(time_s, parts, rate_hz=choice.resample_hz, largest_gap_periods=LARGEST_GAP_PERIODS, place=place)
    assert grid.report is not None
    growing = np.concatenate([[True], np.diff(time_s) > 0])
    way_out = "record a topic that the robot's own clock stamps, or import a table whose map states sample_rate_hz"
    warning = stamps_warning(time_s[growing], states.position[growing], way_out)
    clock = "times of reception" if states.received else "header stamps"
    samples = Samples(
        robot=robot,
        parts=grid.parts,
        stamps=first_ns + stamps_ns(0.0, len(grid.parts["position"]), grid.rate_hz, place),
        rate_hz=grid.rate_hz,
        place=place,
        source=f"ROS 2 bag {bag.name}, topic {choice.topic}",
        provenance=provenance,
        report=replace(grid.report, clock=clock),
        effort_timing="measured",
        doubts=(*doubts, *rate_doubts(grid.report), *([warning] if warning else [])),
    )
    return write_samples(samples, out)


def _effort(robot: Robot, states: JointStates, choice: BagChoice, place: str) -> tuple[Array, str]:
    """Joint efforts (N, n) and where they come from. A bag does not say what its efforts are."""
    if states.effort is None:
        raise AcquisitionError("messages have no effort", place=place, expected="measured torques or currents in them")
    _refuse_no_effort(robot, states.effort, place)
    given = choice.effort_unit * robot.n if len(choice.effort_unit) == 1 else choice.effort_unit
    units = si_units(given, robot.n, EFFORT_UNITS, "--effort-unit", place)
    found = tuple(unit for unit, _ in units)
    at_joint = all(unit in ("N m", "N") for unit in found)
    if at_joint and len(choice.effort_unit) == 1:  # an effort in N m is a force in N where a joint slides
        found = tuple("N m" if joint.type == "revolute" else "N" for joint in robot.joints)
    side = effort_side(robot, found, "joint" if at_joint else None, "effort", place)
    effort, rule = effort_at_joint(robot, states.effort * np.array([factor for _, factor in units]), side)
    return effort, f"effort of {place}: {', '.join(choice.effort_unit)} at the {side}, as stated; {rule}"


def _refuse_no_effort(robot: Robot, effort: Array, place: str) -> None:
    finite = np.isfinite(effort)
    for j, joint in enumerate(robot.joints):
        where = f"effort of joint {joint.name}"
        if not finite[:, j].any():
            raise AcquisitionError("is not a number throughout", place=place, key=where, expected="measured efforts")
        if not finite[:, j].all():
            row = int(np.argmin(finite[:, j]))
            raise AcquisitionError(
                place=f"{place}: state {row + 1}", key=where, value=float(effort[row, j]), expected="a finite number"
            )
    if not effort.any():
        expected = "measured efforts; this driver does not publish them"
        raise AcquisitionError("is zero throughout", place=place, key="effort", expected=expected)
