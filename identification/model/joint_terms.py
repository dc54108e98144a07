"""What motors and friction add to the joint torques, as columns of the model: rotor inertia, friction, offset.

Motors act through the motor matrix. With r the row of motor m, divided by its entry at joint m, the motor turns at r·dq
and adds rᵀ Ia (r·ddq), rᵀ Fvm (r·dq), rᵀ Fcm sign(r·dq); Fvm and Fcm exist where a motor turns with several joints. As is
the custom for coupled wrists, the part of Ia and Fvm that acts on one joint alone belongs to that joint's own Ia and Fv: on
the Stäubli TX40 tau5 has Ia6 ddq6 + Fvm6 dq6, and tau6 has Ia6 (ddq5 + ddq6) + Fvm6 dq5.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from acquisition.robot import Robot

from ..arrays import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTerm:
    """A standard parameter of a joint or motor, and its column of the regressor.

    rotor: matrix ddq; viscous: matrix dq; coulomb: r sign(r·dq) with r = `direction`; offset: `direction`. A `side` of
    +1 or -1 restricts friction to dq > 0 or dq < 0 of one joint. `given_away` (n,) is what a motor adds to the diagonal of
    joints whose own parameter counts it, so that `matrix` lacks it. `joint` is the one whose number the name carries, from 0.
    """

    name: str
    joint: int
    unit: str
    kind: str  # rotor, viscous, coulomb, offset; any other is a torque that the speed alone gives
    matrix: Array
    direction: Array
    given_away: Array
    side: int = 0

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

    def torque(self, dq: Array) -> Array:
        """Torque (..., n) per unit of the parameter at the speed dq (..., n), of a kind in which acceleration has no part."""
        speeds = np.atleast_2d(dq)
        tau = np.zeros(speeds.shape)
        for j in self.rows:
            tau[:, j] = self.entry(int(j), speeds, speeds)
        return tau.reshape(dq.shape)

    def entry(self, j: int, dq: Array, ddq: Array) -> Array | float:
        """Column's entry at joint j over a motion: dq, ddq (N, n) → (N,)."""
        if self.kind == "rotor":
            return np.asarray(ddq @ self.matrix[j])
        if self.kind == "offset":
            return float(self.direction[j])
        if self.kind == "viscous":
            if self.side:
                dq = np.maximum(dq, 0.0) if self.side > 0 else np.minimum(dq, 0.0)
            return np.asarray(dq @ self.matrix[j])
        u = dq @ self.direction
        sign = np.sign(u) if self.side == 0 else self.side * (self.side * u > 0)
        return np.asarray(self.direction[j] * sign)

    def entry_slopes(self, j: int, dq: Array) -> tuple[Array, Array]:
        """Derivatives of `entry` by speed (N, n) and by acceleration (n,); a jump of Coulomb friction has none."""
        by_speed, by_acceleration = np.zeros(dq.shape), np.zeros(dq.shape[1])
        if self.kind == "rotor":
            by_acceleration = self.matrix[j]
        elif self.kind == "viscous":
            acts = dq * self.side > 0 if self.side else np.ones(dq.shape)
            by_speed = acts * self.matrix[j]
        return by_speed, by_acceleration


def joint_terms(robot: Robot, j: int) -> list[JointTerm]:
    """The terms that carry the number of joint j: Ia, Fv, Fc (or Fvp, Fcp, Fvn, Fcn), Off, Fvm, Fcm as described."""
    joint, n = robot.joints[j], robot.n
    motors = _motor_rows(robot)
    r, own = motors[j], np.eye(n)[j]
    alone = np.count_nonzero(motors, axis=1) == 1  # motors that turn with one joint only
    coupled = np.count_nonzero(r) > 1
    effort, length = robot.effort_units[j], joint.position_unit
    viscous_unit = f"{effort} s/{length}"
    nothing, none = np.zeros((n, n)), np.zeros(n)

    def through_matrix(
        name: str, unit: str, kind: Literal["rotor", "viscous"], whole: Array, taken: Sequence[int] = (), side: int = 0
    ) -> JointTerm:
        matrix = whole.copy()
        matrix[list(taken), list(taken)] = 0.0
        given_away = np.diag(whole - matrix)
        return JointTerm(
            name=f"{name}{j + 1}",
            joint=j,
            unit=unit,
            kind=kind,
            matrix=matrix,
            direction=none,
            given_away=given_away,
            side=side,
        )

    def along(name: str, kind: Literal["coulomb", "offset"], direction: Array, side: int = 0) -> JointTerm:
        return JointTerm(
            name=f"{name}{j + 1}",
            joint=j,
            unit=effort,
            kind=kind,
            matrix=nothing,
            direction=direction,
            given_away=none,
            side=side,
        )

    terms: list[JointTerm] = []
    if joint.rotor_inertia:
        taken = [i for i in range(n) if i != j and alone[i] and robot.joints[i].rotor_inertia]
        terms.append(through_matrix("Ia", inertia_unit(robot, j), "rotor", np.outer(r, r), taken))
    for side, mark in ((0, ""),) if joint.friction == "symmetric" else ((1, "p"), (-1, "n")):
        if joint.viscous:
            terms.append(through_matrix(f"Fv{mark}", viscous_unit, "viscous", np.outer(own, own), side=side))
        if joint.coulomb:
            terms.append(along(f"Fc{mark}", "coulomb", own, side))
    if joint.offset:
        terms.append(along("Off", "offset", own))
    if coupled and joint.viscous:
        taken = [i for i in range(n) if robot.joints[i].viscous and robot.joints[i].friction == "symmetric"]
        terms.append(through_matrix("Fvm", viscous_unit, "viscous", np.outer(r, r), taken))
    if coupled and joint.coulomb:
        terms.append(along("Fcm", "coulomb", r))
    return terms


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
