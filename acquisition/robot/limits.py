"""Limits of efforts, and checks of recorded positions, speeds and efforts.

The limits of the description are those of joints and drives.

Impossible positions have causes that a fit does not detect: degrees read as radians, a wrong ratio,
a counter that wraps, a foreign sample. A small overshoot of a limit only gives a warning.
"""

import math
from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..errors import Location
from .description import Joint
from .robot import Robot

# Positions that exceed the limits by more than this share of the range have a systematic cause.
MAX_RANGE_EXCESS = 0.5
MAX_SPEED_RATIO = 3.0  # times the speed limit
# No joint of a robot is faster than this, in rad/s or m/s.
MAX_UNSTATED_SPEED = {"revolute": 100.0, "prismatic": 30.0}
# Efforts warn from this ratio to the limit on, because drives exceed their limits a little.
MIN_EFFORT_RATIO = 1.2
# Overshoots below this share of the range, or of the speed limit, give no warning.
MIN_OVERSHOOT = 0.01
# Differences over one sample below so many standard deviations of its noise are not a speed.
NOISE_DEVIATIONS = 8.0
# Positions and speeds are compared over this time, to reduce the noise of single samples.
SPEED_WINDOW_S = 0.05
# A joint that moves less than so many typical steps, or squares of noise, is at rest.
MIN_TRAVEL_STEPS, MIN_TRAVEL_RATIO = 50.0, 25.0
MAX_SPEED_DEVIATION = 0.1  # of the change of position; above it there is a warning
# Only a wrong unit, sign or column explains such a factor.
MAX_SPEED_GAIN = 2.0
# If radians were degrees, a joint that uses less than this share of its range would not move.
MIN_USED_RANGE = 0.1
RADIANS_AS_DEGREES = (
    "all joints use less than 1/57 of their ranges: positions may be radians, declared as degrees"
)
# A step of so many times the steps before and after it is a single jump.
_MIN_JUMP_RATIO = 3.0


@dataclass(frozen=True, kw_only=True, eq=False)
class EffortLimits:
    """Largest efforts: |directions tau| <= limits, with the joint efforts tau (n,).

    Attributes:
        names: (m,) names of joints, and of motors that act on several joints.
        directions: (m, n) directions of the joint efforts.
        limits: (m,) limits in N m or N; A or V if the drive gain is unknown.
        units: (m,) units of the limits.
    """

    names: tuple[str, ...]
    directions: Array
    limits: Array
    units: tuple[str, ...]


def effort_limits(robot: Robot) -> EffortLimits:
    """Collect the limits of a robot's efforts.

    The limit of a joint is the smaller of its own limit and the `saturation` of its drive. In
    coupled joints the effort of a motor is a sum over joints, and its limit applies to that sum.
    Limits of joints, in N m or N, are not used if the drive gain is unknown. Neither the rated
    effort, which drives exceed for seconds, nor the range of the object that reports it is a limit.
    """
    rows: list[tuple[str, Array, float, str]] = []
    # Recorded efforts of the motors = to_motor · joint efforts.
    to_motor = np.linalg.inv(robot.R.T) / robot.gain[:, None]
    uncoupled = np.count_nonzero(to_motor, axis=1) == 1
    for j, (joint, axis) in enumerate(zip(robot.joints, np.eye(robot.n), strict=True)):
        own = np.flatnonzero(uncoupled & (to_motor[:, j] != 0))
        limit = np.min(
            robot.saturation[own] / np.abs(to_motor[own, j]),
            initial=(robot.gain_known and joint.si("effort")) or math.inf,
        )
        rows.append((f"joint {joint.name}", axis, float(limit), robot.effort_units[j]))
    rows += [
        (f"motor {motor.name}", row, float(limit), motor.recorded_unit)
        for motor, row, limit, single in zip(
            robot.motors, to_motor, robot.saturation, uncoupled, strict=True
        )
        if not single
    ]
    rows = [row for row in rows if math.isfinite(row[2])]
    return EffortLimits(
        names=tuple(row[0] for row in rows),
        directions=np.array([row[1] for row in rows]).reshape(-1, robot.n),
        limits=np.array([row[2] for row in rows]),
        units=tuple(row[3] for row in rows),
    )


def check_recorded_positions(robot: Robot, stamp_s: Array, q: Array, place: str) -> tuple[str, ...]:
    """Check joint positions against the limits, and their speeds.

    Parameters
    ----------
    robot : the robot, with its limits.
    stamp_s : (N,) times in s.
    q : (N, n) joint positions in rad or m.
    place : name of the recording in errors.

    Returns
    -------
    Warnings: small overshoots of limits, or that positions may be radians declared as degrees.

    Raises
    ------
    BadInputError : a position exceeds its limits by more than half the joint's range, or a joint is
        more than three times as fast as its limit. The noise of samples is subtracted.
    """
    overshoots, at, step_s = [], Location(place), np.diff(stamp_s)
    step_s = np.maximum(step_s, np.median(step_s)) if len(step_s) else step_s
    for joint, x in zip(robot.joints, q.T, strict=True):
        overshoots += [*_position(joint, stamp_s, x, at), *_speed(joint, stamp_s, step_s, x, at)]
    turning = [
        (np.degrees([x.min(), x.max()]), joint.si("position"))
        for x, joint in zip(q.T, robot.joints, strict=True)
        if joint.type == "revolute" and len(q)
    ]
    within = all(by and by[0] <= min(0.0, x[0]) and max(0.0, x[1]) <= by[1] for x, by in turning)
    if within and any(np.ptp(x) > MIN_USED_RANGE * (by[1] - by[0]) for x, by in turning):
        overshoots.append(RADIANS_AS_DEGREES)
    return tuple(overshoots)


def check_recorded_efforts(robot: Robot, effort: Array) -> tuple[str, ...]:
    """Return warnings about joint efforts (N, n) of at least 1.2 times their limit.

    Such efforts show a wrong gain, ratio or unit.
    """
    limits = effort_limits(robot)
    peaks = [float(np.abs(effort @ row).max(initial=0.0)) for row in limits.directions]
    return tuple(
        f"the effort of {name} reaches {peak:.4g} {unit}, above its limit of {most:.4g} {unit}"
        for name, peak, most, unit in zip(
            limits.names, peaks, limits.limits, limits.units, strict=True
        )
        if peak >= MIN_EFFORT_RATIO * most
    )


def check_recorded_velocities(
    robot: Robot, q: Array, v: Array, rate_hz: float, place: str
) -> tuple[str, ...]:
    """Return warnings about speeds that differ from the derivative of the positions.

    Parameters
    ----------
    robot : the robot.
    q : (N, n) joint positions in rad or m.
    v : (N, n) joint speeds in rad/s or m/s.
    rate_hz : sample rate in Hz.
    place : name of the recording in errors.

    Raises
    ------
    BadInputError : a speed has a wrong unit or sign.
    """
    h = 1 / rate_hz
    step = max(1, round(SPEED_WINDOW_S / h))
    # Integrate joint by joint, because hours of all joints do not fit in memory.
    travelled = [np.cumsum(0.5 * h * (x[1:] + x[:-1]))[step - 1 :: step] for x in v.T]
    by_position, by_speed = (
        np.diff(q[::step], axis=0),
        np.diff(np.stack(travelled, axis=1), axis=0, prepend=0.0),
    )
    warnings = []
    for j, joint in enumerate(robot.joints):
        moved = float(by_position[:, j] @ by_position[:, j])
        if not _travels(q[:, j], moved):
            continue
        gain = float(by_position[:, j] @ by_speed[:, j]) / moved
        deviation = float(np.linalg.norm(by_speed[:, j] - by_position[:, j])) / np.sqrt(moved)
        text = (
            f"the velocity of joint {joint.name} is {gain:.3g} times the derivative of its "
            f"position, with a difference of {100 * deviation:.2g} %"
        )
        Location(place).require(
            deviation <= MAX_SPEED_DEVIATION or 1 / MAX_SPEED_GAIN < gain < MAX_SPEED_GAIN,
            text=text,
            advice="Check the unit, side, sign and column of the velocity",
        )
        if deviation > MAX_SPEED_DEVIATION:
            warnings.append(text)
    return tuple(warnings)


def _travels(q: Array, moved: float) -> bool:
    """Test whether positions q (N,) change by more than rounding and noise.

    `moved` is the sum of squared changes over the window.
    """
    steps = np.abs(np.diff(q))
    # Third differences of unit noise have the standard deviation sqrt(20).
    noise = float(np.sum(np.diff(q, n=3) ** 2)) / 20
    if moved == 0.0 or moved > MIN_TRAVEL_RATIO * noise:
        return moved > 0.0
    return bool(np.ptp(q) > MIN_TRAVEL_STEPS * np.median(steps[steps > 0]))


def _shown(joint: Joint, value: float) -> str:
    """Format a position in the unit of the description, deg or m."""
    return f"{math.degrees(value):.4g} deg" if joint.type == "revolute" else f"{value:.4g} m"


def _position(joint: Joint, stamp_s: Array, x: Array, place: Location) -> list[str]:
    limits = joint.si("position")
    if limits is None or not len(x):
        return []
    low, high = limits
    beyond = np.maximum(low - x, x - high)
    k = int(np.argmax(beyond))
    if beyond[k] <= MIN_OVERSHOOT * (high - low):
        return []
    text = (
        f"joint {joint.name} reaches {_shown(joint, x[k])} at {stamp_s[k] - stamp_s[0]:.3f} s, "
        f"outside its limits of {'±' if low == -high else f'{_shown(joint, low)} to '}"
        f"{_shown(joint, high)}"
    )
    if beyond[k] <= MAX_RANGE_EXCESS * (high - low):
        return [text]
    causes = "Check unit, ratio, zero and sign, and for a counter that wrapped"
    if (
        joint.type == "revolute"
        and np.abs(x).max() > 5 * max(-low, high)
        and low <= math.radians(x.min())
        and math.radians(x.max()) <= high
    ):
        causes = "Check for degrees declared as radians, and the ratio"
    place.refuse(text=text, advice=f"{causes}, or correct {joint.key('position')} in robot.toml")


def _speed(joint: Joint, stamp_s: Array, step_s: Array, x: Array, place: Location) -> list[str]:
    stated = joint.si("speed")
    most = MAX_SPEED_RATIO * stated if stated is not None else MAX_UNSTATED_SPEED[joint.type]
    step = np.abs(np.diff(x))
    if len(step) < 4:
        return []
    # Fourth differences of white noise of standard deviation d have the standard deviation
    # sqrt(70) d and the median 0.67 of that; motion hardly contributes to them.
    noise = float(np.median(np.abs(np.diff(x, n=4)))) / (0.6745 * math.sqrt(70))
    beyond = np.maximum(step - NOISE_DEVIATIONS * noise, 0.0) / step_s
    k = int(np.argmax(beyond))
    speed = f"{_shown(joint, step[k] / step_s[k])}/s"
    limit = (
        f"above its limit of {_shown(joint, stated)}/s"
        if stated is not None
        else f"above the {_shown(joint, most)}/s of the fastest robots"
    )
    when = f"{stamp_s[k + 1] - stamp_s[0]:.3f} s"
    if beyond[k] <= most:
        if stated is None or beyond[k] <= (1 + MIN_OVERSHOOT) * stated:
            return []
        return [f"joint {joint.name} reaches {speed} at {when}, {limit}"]
    neighbour = max(step[k - 1] if k else 0.0, step[k + 1] if k + 1 < len(step) else 0.0)
    place.require(
        step[k] <= _MIN_JUMP_RATIO * neighbour,
        text=f"joint {joint.name} jumps by {_shown(joint, step[k])} in one sample at {when} "
        f"({speed}, {limit})",
        advice="Check for a counter that wrapped, lost or foreign samples, or joined recordings",
    )
    place.refuse(
        text=f"joint {joint.name} reaches {speed} at {when}, {limit}",
        advice="Check for degrees declared as radians, the ratio and the sample rate, or correct "
        f"{joint.key('speed')} in robot.toml",
    )
