"""Joint torques of motors and friction, as columns of the model: rotor inertia, friction, offset.

With v the speed of a joint and u = r·dq the speed along a direction r of Coulomb friction (of a
joint or of a coupled motor):

| term | torque per unit of the parameter | along | parameters |
|---|---|---|---|
| viscous | v | joint, coupled motor | Fv, Fvm |
| coulomb | sign(u) | direction | Fc, Fcm |
| offset | 1 | joint | Off |
| asymmetric | abs(v) | joint | Fa |
| root | sqrt(abs(u)) sign(u) | direction | Fr, Frm |
| stribeck | exp(-(u/u_s)²) sign(u), u_s a given speed | direction | Fs, Fsm |
| load | abs(tau_rigid) sign(v), tau_rigid the torque of the links | joint | mu |

Motors act through the motor matrix. Let r be the row of motor m, divided by its entry at joint m.
The motor turns at r·dq and adds r' Ia (r·ddq), r' Fvm (r·dq) and r' Fcm sign(r·dq). Fvm and Fcm
exist if a motor turns with several joints. As usual for coupled wrists, the part of Ia and Fvm that
acts on one joint only belongs to the Ia and Fv of that joint: on the Stäubli TX40 tau5 has Ia6 ddq6
+ Fvm6 dq6, and tau6 has Ia6 (ddq5 + ddq6) + Fvm6 dq5.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from acquisition.robot import FRICTION, FrictionTerm, Robot

from ..arrays import Array, Ints

Kind = Literal["rotor"] | FrictionTerm
ROOT_ROUNDING = 1e-3  # rad/s or m/s, added to the speed under a rounded root
# Sizes of further friction, neither viscous nor Coulomb, by speed or load.
SIZES = {kind: friction.size for kind, friction in FRICTION.items() if friction.size is not None}
SHAPES = tuple(SIZES)
SLIDING = tuple(kind for kind, friction in FRICTION.items() if friction.has_sign)


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTerm:
    """A standard parameter of a joint or motor, and its column of the regressor.

    Rotor inertia acts by `matrix` ddq, viscous friction by `matrix` dq, an offset by `direction`.
    The terms of `FRICTION` act along r = `direction`, with the speed u = r·dq.

    Attributes:
        name: name of the parameter.
        joint: number in the name, counted from 0.
        unit: unit of the parameter.
        kind: kind of the term.
        matrix: (n, n) torque per acceleration or speed.
        direction: (n,) direction r.
        given_away: (n,) part of a motor's diagonal that belongs to other joints' parameters, and is
            not in `matrix`.
        side: +1 or -1 restricts friction to dq > 0 or dq < 0 of one joint; 0 for both.
        speed: speed u_s at which Stribeck friction has fallen to 37 %, rad/s or m/s.
    """

    name: str
    joint: int
    unit: str
    kind: Kind
    matrix: Array
    direction: Array
    given_away: Array
    side: int = 0
    speed: float = np.inf

    @property
    def rows(self) -> Ints:
        """Joints whose torque the parameter can change."""
        return np.flatnonzero(self.matrix.any(axis=1) | (self.direction != 0))

    @property
    def row(self) -> Array:
        """Speed of its joint or motor per joint speed, (n,), which is 1 at `joint`."""
        if self.direction.any():
            return self.direction
        return np.asarray(
            self.matrix[self.joint]
            + self.given_away[self.joint] * np.eye(len(self.matrix))[self.joint]
        )

    def entry(self, j: int, dq: Array, ddq: Array, load: Array | float = 0.0) -> Array | float:
        """Return the entry (N,) of the column at joint j over a motion dq, ddq (N, n).

        `load` (N,) is the absolute torque of the links.
        """
        if self.kind == "offset":
            return float(self.direction[j])
        if self.kind in ("rotor", "viscous"):
            along = ddq if self.kind == "rotor" else dq
            if self.side:
                along = self.side * np.maximum(self.side * along, 0.0)
            return np.asarray(along @ self.matrix[j])
        u, friction = dq @ self.direction, FRICTION[self.kind]
        sign: Array | float = np.sign(u) if friction.has_sign else 1.0
        if self.side:
            sign = np.asarray(self.side * (self.side * u > 0), dtype=float)
        size = SIZES[self.kind](np.abs(u), self.speed, load) if self.kind in SIZES else 1.0
        return np.asarray(self.direction[j] * (sign * size))

    def entry_slopes(self, j: int, dq: Array) -> tuple[Array, Array]:
        """Return derivatives of `entry` by speed (N, n) and by acceleration (n,).

        They are zero for terms with a sign, for which `rounded` exists.
        """
        by_speed, by_acceleration = np.zeros(dq.shape), np.zeros(dq.shape[1])
        if self.kind == "rotor":
            by_acceleration = self.matrix[j]
        elif self.kind == "viscous":
            by_speed = (dq * self.side > 0 if self.side else np.ones(dq.shape)) * self.matrix[j]
        elif self.kind in SHAPES and self.kind not in SLIDING:
            by_speed = self.direction[j] * np.outer(
                np.sign(u := dq @ self.direction)
                * FRICTION[self.kind].slope(np.abs(u), self.speed),
                self.direction,
            )
        return by_speed, by_acceleration

    def rounded(self, dq: Array, creep: Array) -> tuple[Array, Array]:
        """Return friction with a sign, but without jumps, and its slope by u, (N,) each.

            sign(u) := x / sqrt(1 + x²),     x = u / creep speed along the direction
            sqrt(abs(u)) := sqrt(abs(u) + ROOT_ROUNDING)

        `dq` (N, n) are the speeds, `creep` (n,) the creep speeds of the joints, rad/s or m/s.
        """
        friction = FRICTION[self.kind]
        u, slow = dq @ self.direction, float(creep @ np.abs(self.direction))
        x = u / slow
        sign, steepness = x / np.sqrt(1 + x**2), (1 + x**2) ** -1.5 / slow
        at = np.abs(u) + ROOT_ROUNDING * friction.is_steep
        size, slope = (
            (SIZES[self.kind](at, self.speed, 0.0), np.sign(u) * friction.slope(at, self.speed))
            if self.kind in SIZES
            else (1.0, 0.0)
        )
        # Friction for one direction of motion is half of sign(u) + 1 or of sign(u) - 1.
        share = 0.5 if self.side else 1.0
        return share * (sign + self.side) * size, share * (size * steepness + slope * sign)


def joint_terms(robot: Robot, j: int) -> Iterator[JointTerm]:
    """Yield the given terms numbered j + 1: Ia, friction of the joint, Off, friction of a motor.

    A motor has friction of its own if it turns with several joints.
    """
    joint, own, motors = robot.joints[j], np.eye(robot.n)[j], _motor_rows(robot)
    none, square, row = np.zeros(robot.n), np.zeros((robot.n, robot.n)), motors[j]
    blank = JointTerm(
        name="", joint=j, unit="", kind="offset", matrix=square, direction=none, given_away=none
    )
    if joint.rotor_inertia:
        single = np.count_nonzero(motors, axis=1) == 1  # motors that turn with one joint only
        others = [i for i, x in enumerate(robot.joints) if i != j and single[i] and x.rotor_inertia]
        yield _through_matrix(robot, blank, "rotor", "Ia", row, others)
    for side, mark in ((1, "p"), (-1, "n")) if joint.one_sided else ((0, ""),):
        one = replace(blank, side=side)
        if "viscous" in joint.terms:
            yield _through_matrix(robot, one, "viscous", f"Fv{mark}", own)
        if "coulomb" in joint.terms:
            yield _along(robot, one, "coulomb", f"Fc{mark}", own)
    if "offset" in joint.terms:
        yield replace(blank, name=f"Off{j + 1}", unit=robot.effort_units[j], direction=own)
    for kind in SHAPES:
        if kind in joint.terms:
            yield _along(robot, blank, kind, FRICTION[kind].name, own)
    if np.count_nonzero(row) > 1:
        if "viscous" in joint.terms:
            others = [
                i for i, x in enumerate(robot.joints) if "viscous" in x.terms and not x.one_sided
            ]
            yield _through_matrix(robot, blank, "viscous", "Fvm", row, others)
        for kind, friction in FRICTION.items():
            if friction.motor_name and kind in joint.terms:
                yield _along(robot, blank, kind, friction.motor_name, row)


def _through_matrix(
    robot: Robot,
    blank: JointTerm,
    kind: Literal["rotor", "viscous"],
    name: str,
    row: Array,
    others: Sequence[int] = (),
) -> JointTerm:
    """Return a term of the matrix r'r of a motor's `row` r.

    Its diagonal at `others` belongs to parameters of these joints.
    """
    j, whole = blank.joint, np.outer(row, row)
    matrix = whole.copy()
    matrix[list(others), list(others)] = 0.0
    viscous = f"{robot.effort_units[j]} s/{robot.joints[j].position_unit}"
    return replace(
        blank,
        name=f"{name}{j + 1}",
        unit=viscous if kind == "viscous" else inertia_unit(robot, j),
        kind=kind,
        matrix=matrix,
        given_away=np.diag(whole - matrix),
    )


def _along(robot: Robot, blank: JointTerm, kind: Kind, name: str, direction: Array) -> JointTerm:
    joint, effort = robot.joints[blank.joint], robot.effort_units[blank.joint]
    return replace(
        blank,
        name=f"{name}{blank.joint + 1}",
        unit=FRICTION[kind].unit.format(effort=effort, length=joint.position_unit),
        kind=kind,
        direction=direction,
        speed=joint.si("stribeck_speed") or np.inf,
    )


def corner_speeds(directions: Array) -> Array:
    """Return absolute speeds (m, k) along k directions (k, n) where the planes d_k dq = 0 meet.

    The power of Coulomb friction, sum_k Fc_k |d_k dq|, is linear between these planes. If it is not
    negative at these corners, it is not negative anywhere.
    """
    across, corners = spanning(directions), dict[tuple[float, ...], None]()
    for standing in combinations(directions @ across.T, len(across) - 1):
        planes = np.array(standing).reshape(-1, len(across))
        if np.linalg.matrix_rank(planes) == len(planes):
            speeds = np.abs(directions @ (np.linalg.svd(planes)[2][-1] @ across))
            corners[tuple((speeds / speeds.max()).round(9))] = None
    return np.array(list(corners))


def spanning(rows: Array) -> Array:
    """Return unit vectors (r, n) that span rows (k, n): joint axes if possible."""
    moving, rank = np.flatnonzero(rows.any(axis=0)), int(np.linalg.matrix_rank(rows))
    return np.asarray(
        np.eye(rows.shape[1])[moving] if rank == len(moving) else np.linalg.svd(rows)[2][:rank]
    )


def inertia_unit(robot: Robot, j: int) -> str:
    """Return the unit of an inertia about joint j's axis, or of a mass that it moves.

    It has A or V if the drive gain is unknown.
    """
    if not robot.gain_known:
        return f"{robot.effort_units[j]} s²/{robot.joints[j].position_unit}"
    return "kg m²" if robot.joints[j].type == "revolute" else "kg"


def _motor_rows(robot: Robot) -> Array:
    """Return the motor matrix (n, n), with each row divided by its entry at the motor's joint.

    If that entry is zero, the row is divided by its largest.
    """
    largest = np.take_along_axis(robot.R, np.abs(robot.R).argmax(axis=1)[:, None], axis=1)
    own = np.diag(robot.R)[:, None]
    return np.asarray(robot.R / np.where(own != 0, own, largest))
