"""Recorded values → values at the joint in SI: units, sides, the robot's rule.

The rule from motors to joints is `Robot.joint_position`, `Robot.joint_velocity` and
`Robot.joint_effort`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from ..arrays import Array, Bools
from ..errors import Location
from ..files import read_columns
from ..robot import Robot, note

Units = Mapping[str, tuple[str, float]]
Side = Literal["motor", "joint"]
TableNumber = Annotated[int, msgspec.Meta(ge=1)]

# For each unit the SI unit to which values are converted, and the factor.
POSITION_UNITS = {
    "rad": ("rad", 1.0),
    "deg": ("rad", np.pi / 180),
    "m": ("m", 1.0),
    "mm": ("m", 1e-3),
    "um": ("m", 1e-6),
}
VELOCITY_UNITS = {
    "rad/s": ("rad", 1.0),
    "deg/s": ("rad", np.pi / 180),
    "rpm": ("rad", np.pi / 30),
    "m/s": ("m", 1.0),
    "mm/s": ("m", 1e-3),
}
EFFORT_UNITS = {
    "A": ("A", 1.0),
    "mA": ("A", 1e-3),
    "V": ("V", 1.0),
    "mV": ("V", 1e-3),
    "N m": ("N m", 1.0),
    "mN m": ("N m", 1e-3),
    "N": ("N", 1.0),
    "%": ("%", 1.0),
    "per mille": ("%", 0.1),
    "‰": ("%", 0.1),
}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # in s
TURN = 2 * np.pi
MAX_WRAPPED = 1.001  # range of angles that jump, in turns, with their rounding
# Efforts that exist at one side only, and the reason.
ONE_SIDE: Mapping[str, tuple[Side, str]] = {
    "known_torque": ("joint", "where it acts"),
    "feedforward": ("motor", "where the controller's output acts"),
}


class Quantity(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`[position]`, `[effort]` and others: columns, one per motor or joint, with unit and side."""

    columns: Annotated[
        tuple[str | int, ...],
        note("columns by name or number, one per motor or joint", min_length=1),
    ]
    unit: Annotated[str | tuple[str, ...], note("unit of all columns, or one per column")]
    table: Annotated[
        TableNumber, note("file of the columns, counted from 1 on the command line")
    ] = 1
    side: Annotated[
        Side | None, note("whether values are those of motors or joints (default: from the unit)")
    ] = None
    signs: Annotated[
        tuple[Literal[1, -1], ...] | None,
        note("1 or -1 per column, -1 for one that counts backwards (default: all 1)"),
    ] = None


class Angles(Quantity, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`[position]` and `[reference]`: columns of angles or lengths."""

    unwrap: Annotated[bool, note("whether angles jump by a turn, such as from 180 to -180 deg")] = (
        False
    )


@dataclass(frozen=True, kw_only=True)
class Source:
    """Tables, their robot, and the location of the map, for errors."""

    tables: Sequence[Path]
    robot: Robot
    place: Location

    def table(self, key: str, number: int) -> Path:
        """Return the table with this `number`, counted from 1."""
        self.place.require(
            number <= len(self.tables),
            key,
            number,
            f"at most {len(self.tables)}, the number of tables",
        )
        return self.tables[number - 1]

    def position(self, key: str, quantity: Angles) -> Array:
        """Read joint positions (N, n) in rad or m."""
        units, values = self._read(key, quantity, POSITION_UNITS)
        side = position_side(self.robot, quantity.side, key, self.place)
        self._check_kinds(key, units, side)
        values = self._without_jumps(key, quantity, units, values, side)
        return self.robot.joint_position(values) if side == "motor" else values

    def _without_jumps(
        self, key: str, quantity: Angles, units: Sequence[str], x: Array, side: Side
    ) -> Array:
        """Remove jumps by a turn from values x (N, n) if the map asks for it.

        The angles are then about 0. Jumps are refused that the map does not declare, that may be
        motion, or that are those of a motor: its turns before the first row are unknown, and turn
        the joint unless the ratio is a whole number.
        """
        angles, of_motor = np.array(units) == "rad", np.linalg.inv(self.robot.R)
        unwrapped = np.where(angles, np.unwrap(x, axis=0), x)
        slow = np.abs(np.diff(unwrapped, axis=0))[:, angles].max(initial=0.0) < TURN / 4
        known = slow and (side == "joint" or np.allclose(of_motor, np.rint(of_motor)))
        jumps = (turn_jumps(x, TURN) & angles).any(axis=1)
        self.place.require(
            known if quantity.unwrap else not jumps.any(),
            f"{key}.unwrap",
            quantity.unwrap,
            text=f"the angles jump by a turn before row {np.argmax(jumps) + 2}"
            if jumps.any()
            else "the turns of a geared motor, or of angles with steps above 90 deg, cannot be "
            "counted",
            advice="Set it to true"
            if known
            else "Record angles over all turns, or joint angles at a higher rate",
        )
        near_0 = unwrapped - TURN * np.rint(np.median(unwrapped, axis=0) / TURN)
        return np.where(angles, near_0, x) if quantity.unwrap else x

    def velocity(self, key: str, quantity: Quantity) -> Array:
        """Read joint speeds (N, n) in rad/s or m/s."""
        units, values = self._read(key, quantity, VELOCITY_UNITS)
        side = _side_or_joint(quantity.side, _is_identity(self.robot.R), key, self.place)
        self._check_kinds(key, units, side)
        return self.robot.joint_velocity(values) if side == "motor" else values

    def effort(self, key: str, quantity: Quantity) -> tuple[Array, str, str]:
        """Read joint efforts (N, n) in the robot's units.

        Also return their origin as a text, and their unit and side as another.
        """
        units, values = self._read(key, quantity, EFFORT_UNITS)
        side = effort_side(self.robot, units, quantity.side, f"{key}.unit", self.place)
        unit = quantity.unit if isinstance(quantity.unit, str) else ", ".join(quantity.unit)
        what = f"{unit} at the {side}"
        joint_effort, rule = effort_at_joint(self.robot, values, side)
        return (
            joint_effort,
            f"{self.tables[quantity.table - 1].name}: "
            f"{', '.join(map(str, quantity.columns))}: {what}; {rule}",
            what,
        )

    def effort_of_one_side(self, key: str, quantity: Quantity) -> Array:
        """Read efforts of one side (N, n).

        These are external torques on the joints in N m (forces in N), or feed-forward by motor in
        the unit of the recorded effort.
        """
        side, why = ONE_SIDE[key]
        self.place.require(
            side != "joint" or self.robot.gain_known,
            key,
            text=f"it cannot be added to efforts in {join_units(self.robot.effort_units)}",
            advice="Give the drive gains in robot.toml, which convert efforts to N m or N",
        )
        self.place.require(
            quantity.side in (None, side), f"{key}.side", quantity.side, f"{side!r}, {why}"
        )
        units, values = self._read(key, quantity, EFFORT_UNITS)
        effort_side(self.robot, units, side, f"{key}.unit", self.place)
        return values

    def _read(self, key: str, quantity: Quantity, known: Units) -> tuple[tuple[str, ...], Array]:
        """Read the values (N, n) of columns in SI; also return the SI unit of each."""
        n = self.robot.n
        units, factors = si_units(
            (quantity.unit,) * n if isinstance(quantity.unit, str) else quantity.unit,
            n,
            known,
            f"{key}.unit",
            self.place,
        )
        values = read_columns(self.table(f"{key}.table", quantity.table), quantity.columns, n)
        signs = np.array(quantity.signs or [1] * n)
        self.place.require(
            values.shape[1] == n == len(signs),
            f"{key}.{'columns' if len(signs) == n else 'signs'}",
            text=f"the table has {values.shape[1]} such columns for {n} joints"
            if len(signs) == n
            else f"{len(signs)} signs are given for {n} joints",
            advice="Give one per joint",
        )
        return units, np.asarray(values * factors * signs)

    def _check_kinds(self, key: str, units: Sequence[str], side: Side) -> None:
        kinds = [joint.position_unit for joint in self.robot.joints]
        each = f", one unit for each joint, as {kinds}" if len(set(kinds)) > 1 else ""
        for i, (joint, unit) in enumerate(zip(self.robot.joints, units, strict=True)):
            # A motor that turns may drive any joint; a motor that slides drives
            # a joint that slides.
            self.place.require(
                unit == joint.position_unit or (side == "motor" and unit == "rad"),
                f"{key}.unit",
                expected=f"{'an angle' if joint.type == 'revolute' else 'a length'}{each}",
                text=f"joint {i + 1} ({joint.name}) has values in {unit}",
            )


def turn_jumps(x: Array, turn: float) -> Bools:
    """Find steps (N - 1, n) of angles x (N, n) that are a turn, to a quarter of it.

    Only angles within a turn are considered.
    """
    return np.asarray(
        (np.abs(np.abs(np.diff(x, axis=0)) / turn - 1) < 0.25)
        & (np.ptp(x, axis=0) <= MAX_WRAPPED * turn)
    )


def si_units(
    units: Sequence[str], n: int, known: Units, key: str, place: Location
) -> tuple[tuple[str, ...], Array]:
    """Return SI unit and factor (n,) of each of n units."""
    place.require(
        len(units) == n,
        key,
        text=f"{len(units)} units are given for {n} joints",
        advice="Give one unit, or one per joint",
    )
    for unit in units:
        place.require(unit in known, key, unit, f"one of {', '.join(known)}")
    return tuple(known[unit][0] for unit in units), np.array([known[unit][1] for unit in units])


def position_side(robot: Robot, side: Side | None, key: str, place: Location) -> Side:
    """Return the side of positions; by default that of the joint if both are equal."""
    side = _side_or_joint(side, _is_identity(robot.R) and not robot.zero.any(), key, place)
    if side == "joint" and robot.zero.any():
        joint = robot.joints[int(np.flatnonzero(robot.zero)[0])]
        name = "zero_deg" if joint.type == "revolute" else "zero_m"
        place.refuse(
            f"{key}.side",
            side,
            text=f"{name} of joint {joint.name} in robot.toml does not apply to joint positions",
            advice=f"Remove {name}, or import motor positions",
        )
    return side


def _is_identity(R: Array) -> bool:
    return np.array_equal(R, np.eye(len(R)))


def _side_or_joint(side: Side | None, same: bool, key: str, place: Location) -> Side:
    place.require(side is not None or same, f"{key}.side", None, "'motor' or 'joint'")
    return side or "joint"


def effort_side(
    robot: Robot, given: tuple[str, ...], side: Side | None, key: str, place: Location
) -> Side:
    """Return the side of efforts in the units `given` for `key`.

    By default, it is the side whose units match.
    """
    expected = {"motor": tuple(m.recorded_unit for m in robot.motors), "joint": robot.effort_units}
    fits = [side for side in ("motor", "joint") if given == expected[side]]
    if side is None:
        place.require(
            len(fits) != 2 or _is_identity(robot.R * robot.gain[:, None]),
            key.replace(".unit", ".side"),
            None,
            "'motor' or 'joint'",
        )
        side = "joint" if fits == ["joint"] else "motor"
    place.require(
        side in fits,
        key,
        expected=join_units(expected[side]),
        text=f"{join_units(given)} at the {side} does not match robot.toml",
    )
    return side


def effort_at_joint(robot: Robot, values: Array, side: Side) -> tuple[Array, str]:
    """Convert values (N, n) in the units of their side to joint efforts (N, n).

    Also return the rule as text.
    """
    units = join_units(robot.effort_units)
    if side == "joint":
        return values, f"joint effort = value in {units}"
    has_gain = robot.gain_known and any(m.drive_gain for m in robot.motors)
    gain = f" · drive gain {robot.gain.tolist()}" if has_gain else ""
    return robot.joint_effort(values), f"joint effort = motor_matrixᵀ{gain} · value, in {units}"


def join_units(units: Sequence[str]) -> str:
    """Join units to a text; one if all are the same."""
    return units[0] if len(set(units)) == 1 else ", ".join(units)
