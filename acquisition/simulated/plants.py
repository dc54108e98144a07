"""Plants that simulated drives move: joint efforts in, joint positions and speeds out."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import AcquisitionError
from ..recording import Block
from ..robot import Robot

Mask = NDArray[np.bool_]

TYPICAL_LOAD = 0.3  # of the rated effort: gravity load of a horizontal joint of an industrial arm


class Plant(Protocol):
    """A mechanism of n joints, all quantities at the joint, SI (effort in the robot's units)."""

    def state(self) -> tuple[Array, Array]:
        """Position and speed, each (n,)."""
        ...

    def prescribed_effort(self) -> Array | None:
        """Effort (n,) that drives report in place of that of their loops; None for a plant that their loops move."""
        ...

    def step(self, effort: Array, held: Mask, duration_s: float) -> None:
        """Step by `duration_s` under constant `effort` (n,); brakes hold the joints where `held` (n,)."""
        ...


class JointwisePlant:
    """Independent joints: inertia a = effort - load cos(q) - viscous v - coulomb sign(v); each quantity (n,).

    `load` is the effort that holds a horizontal joint; a prismatic joint (`slides`) carries it at every position.
    """

    def __init__(
        self, inertia: Array, viscous: Array, coulomb: Array, load: Array, *, slides: Mask, position: Array
    ) -> None:
        self._inertia, self._viscous, self._coulomb, self._load, self._slides = inertia, viscous, coulomb, load, slides
        self._q, self._dq = np.array(position, dtype=float), np.zeros(len(position))

    def state(self) -> tuple[Array, Array]:
        """Position and speed."""
        return self._q.copy(), self._dq.copy()

    def prescribed_effort(self) -> Array | None:
        """None: the loops move it."""
        return None

    def step(self, effort: Array, held: Mask, duration_s: float) -> None:
        """Load at the middle of the step; Coulomb friction stops a joint, but does not reverse its motion."""
        speed = np.where(held, 0.0, self._dq)
        middle = self._q + 0.5 * duration_s * speed
        load = self._load * np.where(self._slides, 1.0, np.cos(middle))
        free = speed + duration_s / self._inertia * (effort - load - self._viscous * speed)
        rubbed = duration_s / self._inertia * self._coulomb
        self._dq = np.where(held, 0.0, np.sign(free) * np.maximum(np.abs(free) - rubbed, 0.0))
        self._q = middle + 0.5 * duration_s * self._dq


def typical_plant(robot: Robot, rated_motor_effort: Array, load_share: float = TYPICAL_LOAD) -> JointwisePlant:
    """Independent joints that suit the drives of `robot`: half the rated effort gives the stated acceleration.

    A horizontal joint carries `load_share` of its rated effort. Each joint starts in the middle of its range.
    """
    rated = np.abs(robot.joint_effort(rated_motor_effort[None])[0])
    speed = np.array([j.si("speed") or 1.0 for j in robot.joints])
    return JointwisePlant(
        typical_inertia(robot, rated_motor_effort),
        0.05 * rated / speed,
        0.05 * rated,
        load_share * rated,
        slides=np.array([j.type == "prismatic" for j in robot.joints]),
        position=middle_of_range(robot),
    )


def typical_inertia(robot: Robot, rated_motor_effort: Array) -> Array:
    """Inertias (n,) at the joints: half the rated effort gives the stated acceleration."""
    acceleration = np.array([j.si("acceleration") or 10.0 for j in robot.joints])
    return np.asarray(0.5 * np.abs(robot.joint_effort(rated_motor_effort[None])[0]) / acceleration)


def middle_of_range(robot: Robot) -> Array:
    """Joint positions (n,) in the middle of the stated limits, 0 where none are stated; rad or m."""
    return np.array([np.mean(j.si("position") or (0.0, 0.0)) for j in robot.joints])


class TablePlant:
    """Replays joint samples, one row per period, whatever the loops of the drives demand."""

    def __init__(self, samples: Block, sample_rate_hz: float) -> None:
        if len(samples) == 0:
            raise AcquisitionError("the table to replay holds no samples", expected="some")
        self._samples, self._rate_hz, self._elapsed_s = samples, sample_rate_hz, 0.0

    @property
    def _row(self) -> int:
        return min(round(self._elapsed_s * self._rate_hz), len(self._samples) - 1)

    def state(self) -> tuple[Array, Array]:
        """Position of the row; speed between it and the next."""
        q = self._samples["position"]
        now, following = q[self._row], q[min(self._row + 1, len(q) - 1)]
        return now.copy(), (following - now) * self._rate_hz

    def prescribed_effort(self) -> Array | None:
        """Effort of the row."""
        effort: Array = self._samples["effort"][self._row].copy()
        return effort

    def step(self, effort: Array, held: Mask, duration_s: float) -> None:
        """Advance to the row at the time reached."""
        self._elapsed_s += duration_s
