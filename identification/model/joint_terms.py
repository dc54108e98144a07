"""What motors and friction add to the joint torques, as columns of the model: rotor inertia, friction, offset.

With v the speed of a joint, u = r·dq that along a direction r of Coulomb friction (a joint's own, or a coupled motor's):

| term | torque per unit of the parameter | along | parameters |
|---|---|---|---|
| viscous | v | joint, coupled motor | Fv, Fvm |
| coulomb | sign(u) | direction | Fc, Fcm |
| offset | 1 | joint | Off |
| asymmetric | abs(v) | joint | Fa |
| root | sqrt(abs(u)) sign(u) | direction | Fr, Frm |
| stribeck | exp(-(u/u_s)²) sign(u), u_s a stated speed | direction | Fs, Fsm |
| load | abs(tau_rigid) sign(v), tau_rigid the torque of the links | joint | mu |

Load friction depends on the parameters of the links: its column is made where these are known (`regression.load`).

Motors act through the motor matrix. With r the row of motor m, divided by its entry at joint m, the motor turns at r·dq
and adds rᵀ Ia (r·ddq), rᵀ Fvm (r·dq), rᵀ Fcm sign(r·dq); Fvm and Fcm exist where a motor turns with several joints. As is
the custom for coupled wrists, the part of Ia and Fvm that acts on one joint alone belongs to that joint's own Ia and Fv: on
the Stäubli TX40 tau5 has Ia6 ddq6 + Fvm6 dq6, and tau6 has Ia6 (ddq5 + ddq6) + Fvm6 dq5.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from acquisition.robot import Robot

from ..arrays import Array

Kind = Literal["rotor", "viscous", "coulomb", "offset", "asymmetric", "root", "stribeck", "load"]
SLIDING: tuple[Kind, ...] = (
    "coulomb",
    "root",
    "stribeck",
    "load",
)  # have the sign of a speed, and jump or are steep at 0

STEEPEST = 1e-3  # rad/s or m/s beside the speed under a rounded root
SHAPES: tuple[Kind, ...] = ("asymmetric", "root", "stribeck", "load")  # what friction has beside the usual terms


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTerm:
    """A standard parameter of a joint or motor, and its column of the regressor.

    rotor: matrix ddq; viscous: matrix dq; those with a sign act along r = `direction`, at the speed u = r·dq; offset and
    asymmetric: `direction`. A `side` of +1 or -1 restricts friction to dq > 0 or dq < 0 of one joint. `given_away` (n,) is
    what a motor adds to the diagonal of joints whose own parameter counts it, so that `matrix` lacks it. `speed` is that at
    which Stribeck friction has fallen to 37 %; `joint` the one whose number the name carries, from 0.
    """

    name: str
    joint: int
    unit: str
    kind: Kind
    matrix: Array
    direction: Array
    given_away: Array
    side: int = 0
    speed: float = field(default=float("nan"))

    @property
    def rows(self) -> NDArray[np.intp]:
        """Joints whose torque the parameter can change."""
        return np.flatnonzero(self.matrix.any(axis=1) | (self.direction != 0))

    @property
    def row(self) -> Array:
        """(n,) speed of its joint or motor per joint speed, 1 at `joint`: the direction that it acts along, whole.

        The share that counts in other joints' own parameters is included.
        """
        if self.direction.any():
            return self.direction
        return np.asarray(self.matrix[self.joint] + self.given_away[self.joint] * np.eye(len(self.matrix))[self.joint])

    def entry(self, j: int, dq: Array, ddq: Array) -> Array | float:
        """Column's entry at joint j over a motion: dq, ddq (N, n) → (N,); zero for load friction, which is not linear."""
        if self.kind == "rotor":
            return np.asarray(ddq @ self.matrix[j])
        if self.kind == "offset":
            return float(self.direction[j])
        if self.kind == "viscous":
            if self.side:
                dq = np.maximum(dq, 0.0) if self.side > 0 else np.minimum(dq, 0.0)
            return np.asarray(dq @ self.matrix[j])
        if self.kind == "load":
            return 0.0
        u = dq @ self.direction
        return np.asarray(self.direction[j] * self._along(u))

    def _along(self, u: Array) -> Array:
        """Friction (N,) along the direction at the speeds u (N,) there."""
        if self.kind == "asymmetric":
            return np.abs(u)
        if self.side:
            return np.asarray(self.side * (self.side * u > 0), dtype=float)
        sign = np.sign(u)
        if self.kind == "root":
            sign *= np.sqrt(np.abs(u))
        elif self.kind == "stribeck":
            sign *= np.exp(-((u / self.speed) ** 2))
        return sign

    def entry_slopes(self, j: int, dq: Array) -> tuple[Array, Array]:
        """Derivatives of `entry` by speed (N, n) and by acceleration (n,).

        None of terms that have the sign of a speed: in their place stands `rounded`.
        """
        by_speed, by_acceleration = np.zeros(dq.shape), np.zeros(dq.shape[1])
        if self.kind == "rotor":
            by_acceleration = self.matrix[j]
        elif self.kind == "viscous":
            acts = dq * self.side > 0 if self.side else np.ones(dq.shape)
            by_speed = acts * self.matrix[j]
        elif self.kind == "asymmetric":
            by_speed = self.direction[j] * np.outer(np.sign(dq @ self.direction), self.direction)
        return by_speed, by_acceleration

    def rounded(self, dq: Array, creep: Array) -> tuple[Array, Array]:
        """Coulomb, root or Stribeck friction along the direction at speeds dq (N, n), without jumps, and its slope, (N,) each.

        The sign of a speed u is x / sqrt(1 + x²), x in units of the creep speed, of joints (n,), along the direction; the root
        is sqrt(abs(u) + STEEPEST). The slope is the derivative by u.
        """
        u, slow = dq @ self.direction, float(creep @ np.abs(self.direction))
        x = u / slow
        sign, steepness = x / np.sqrt(1 + x**2), (1 + x**2) ** -1.5 / slow
        if self.kind == "root":
            size = np.sqrt(np.abs(u) + STEEPEST)
            return size * sign, 0.5 * np.sign(u) / size * sign + size * steepness
        if self.kind == "stribeck":
            size = np.exp(-((u / self.speed) ** 2))
            return size * sign, size * (steepness - 2 * u / self.speed**2 * sign)
        share = 0.5 if self.side else 1.0  # friction of one direction is half of sign(u) + 1 or of sign(u) - 1
        return share * (sign + self.side), share * steepness


def joint_terms(robot: Robot, j: int) -> list[JointTerm]:
    """The terms that carry the number of joint j, as described: Ia, friction of the joint, Off, friction of a coupled motor."""
    joint, n = robot.joints[j], robot.n
    motors = _motor_rows(robot)
    r, own = motors[j], np.eye(n)[j]
    alone = np.count_nonzero(motors, axis=1) == 1  # motors that turn with one joint only
    coupled = np.count_nonzero(r) > 1
    effort, length = robot.effort_units[j], joint.position_unit
    viscous_unit = f"{effort} s/{length}"
    blank = JointTerm(
        name="", joint=j, unit="", kind="offset", matrix=np.zeros((n, n)), direction=np.zeros(n), given_away=np.zeros(n)
    )

    def through_matrix(
        name: str, unit: str, kind: Literal["rotor", "viscous"], whole: Array, taken: Sequence[int] = (), side: int = 0
    ) -> JointTerm:
        matrix = whole.copy()
        matrix[list(taken), list(taken)] = 0.0
        given_away = np.diag(whole - matrix)
        return replace(
            blank, name=f"{name}{j + 1}", unit=unit, kind=kind, matrix=matrix, given_away=given_away, side=side
        )

    def along(name: str, kind: Kind, direction: Array, side: int = 0) -> JointTerm:
        unit = {"asymmetric": viscous_unit, "root": f"{effort} (s/{length})^½", "load": ""}.get(kind, effort)
        speed = joint.si("stribeck_speed") if kind == "stribeck" else float("nan")
        return replace(blank, name=f"{name}{j + 1}", unit=unit, kind=kind, direction=direction, side=side, speed=speed)

    terms: list[JointTerm] = []
    if joint.rotor_inertia:
        taken = [i for i in range(n) if i != j and alone[i] and robot.joints[i].rotor_inertia]
        terms.append(through_matrix("Ia", inertia_unit(robot, j), "rotor", np.outer(r, r), taken))
    for side, mark in ((1, "p"), (-1, "n")) if joint.one_sided else ((0, ""),):
        if "viscous" in joint.terms:
            terms.append(through_matrix(f"Fv{mark}", viscous_unit, "viscous", np.outer(own, own), side=side))
        if "coulomb" in joint.terms:
            terms.append(along(f"Fc{mark}", "coulomb", own, side))
    if "offset" in joint.terms:
        terms.append(along("Off", "offset", own))
    shapes: tuple[tuple[str, Kind], ...] = (("Fa", "asymmetric"), ("Fr", "root"), ("Fs", "stribeck"), ("mu", "load"))
    terms += [along(name, kind, own) for name, kind in shapes if kind in joint.terms]
    if coupled and "viscous" in joint.terms:
        taken = [i for i, other in enumerate(robot.joints) if "viscous" in other.terms and not other.one_sided]
        terms.append(through_matrix("Fvm", viscous_unit, "viscous", np.outer(r, r), taken))
    motor: tuple[tuple[str, Kind], ...] = (("Fcm", "coulomb"), ("Frm", "root"), ("Fsm", "stribeck"))
    terms += [along(name, kind, r) for name, kind in motor if coupled and kind in joint.terms]
    return terms


def corner_speeds(directions: Array) -> Array:
    """Sizes (m, k) of the speeds along k directions (k, n) at the corners, where planes across the directions meet.

    Coulomb friction takes the power sum_k Fc_k |d_k dq|, linear between these planes: not below zero anywhere where it is not
    so at the corners.
    """
    across, found = spanning(directions), dict[tuple[float, ...], None]()
    for standing in combinations(directions @ across.T, len(across) - 1):
        planes = np.array(standing).reshape(-1, len(across))
        if np.linalg.matrix_rank(planes) == len(planes):
            speeds = np.abs(directions @ (np.linalg.svd(planes)[2][-1] @ across))
            found[tuple((speeds / speeds.max()).round(9))] = None
    return np.array(list(found))


def spanning(rows: Array) -> Array:
    """Unit vectors (r, n) that span rows (k, n): those of the joints where they do."""
    moving, rank = np.flatnonzero(rows.any(axis=0)), int(np.linalg.matrix_rank(rows))
    return np.asarray(np.eye(rows.shape[1])[moving] if rank == len(moving) else np.linalg.svd(rows)[2][:rank])


def inertia_unit(robot: Robot, j: int) -> str:
    """Unit of an inertia about joint j's axis, or of a mass moved by it; in A or V where the gain is not known."""
    if not robot.gain_known:
        return f"{robot.effort_units[j]} s²/{robot.joints[j].position_unit}"
    return "kg m²" if robot.joints[j].type == "revolute" else "kg"


def _motor_rows(robot: Robot) -> Array:
    """Motor matrix (n, n) with each row divided by its entry at the motor's own joint, or else by its largest."""
    own = np.diag(robot.R).copy()
    for m in np.flatnonzero(own == 0):
        own[m] = robot.R[m, np.argmax(np.abs(robot.R[m]))]
    return np.asarray(robot.R / own[:, None])
