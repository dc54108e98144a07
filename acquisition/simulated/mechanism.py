"""Plants and control loops of simulated drives: the robot, a recorded table, or independent joints.

This package does not contain the dynamics of `[parameters]`. Another package provides them by an
entry point of the group `robot_idim.plants`. It is a function of the robot and its payload, and
returns the plant, and control loops that suit the inertias of the unloaded robot. It raises
`BadInputError` if the description cannot be simulated.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..arrays import Array, Bools
from ..errors import Location
from ..recording import Block
from ..robot import SIMULATED_CONTROLLER, Bus, Controller, Payload, Robot, robot_from_files


class Plant(Protocol):
    """A mechanism of n joints. All quantities are those of the joints.

    Units are SI, with efforts in the units of the robot.
    """

    def state(self) -> tuple[Array, Array]:
        """Return position and speed, each (n,)."""

    def prescribed_effort(self) -> Array | None:
        """Return the effort (n,) that drives report instead of that of their loops.

        It is None if the loops move the plant.
        """

    def step(self, effort: Array, held: Bools, duration_s: float) -> None:
        """Step by `duration_s` under constant `effort` (n,). Brakes hold the joints in `held`."""


class JointwisePlant:
    """Independent joints.

        inertia a = effort - load cos(q) - viscous v - coulomb sign(v)

    All quantities are (n,). `load` is the effort that holds a horizontal joint. A prismatic joint
    (`slides`) carries it at every position.
    """

    def __init__(
        self,
        inertia: Array,
        viscous: Array,
        coulomb: Array,
        load: Array,
        *,
        slides: Bools,
        position: Array,
    ) -> None:
        self._inertia, self._viscous, self._coulomb, self._load, self._slides = (
            inertia,
            viscous,
            coulomb,
            load,
            slides,
        )
        self._q, self._dq = np.array(position, dtype=float), np.zeros(len(position))

    def state(self) -> tuple[Array, Array]:
        """Return position and speed, each (n,)."""
        return self._q.copy(), self._dq.copy()

    def prescribed_effort(self) -> Array | None:
        """Return None, because the loops move this plant."""
        return None

    def step(self, effort: Array, held: Bools, duration_s: float) -> None:
        """Step with the load in the middle of the step.

        Coulomb friction stops a joint, but does not reverse its motion.
        """
        speed = np.where(held, 0.0, self._dq)
        middle = self._q + 0.5 * duration_s * speed
        load = self._load * np.where(self._slides, 1.0, np.cos(middle))
        free = speed + duration_s / self._inertia * (effort - load - self._viscous * speed)
        rubbed = duration_s / self._inertia * self._coulomb
        self._dq = np.where(held, 0.0, np.sign(free) * np.maximum(np.abs(free) - rubbed, 0.0))
        self._q = middle + 0.5 * duration_s * self._dq


def typical_plant(
    robot: Robot, rated_motor_effort: Array, load_share: float = 0.3
) -> JointwisePlant:
    """Return independent joints that suit the drives, in the middle of their range.

    Parameters
    ----------
    robot : the robot, with its limits.
    rated_motor_effort : (n,) rated efforts of the motors.
    load_share : load of a horizontal joint, as a share of its rated effort; the default is typical
        of gravity on an industrial arm.
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
    """Return inertias (n,) at the joints. Half the rated effort gives the acceleration limit."""
    return np.asarray(
        0.5
        * np.abs(robot.joint_effort(rated_motor_effort[None])[0])
        / [j.si("acceleration") or 10.0 for j in robot.joints]
    )


def middle_of_range(robot: Robot) -> Array:
    """Return joint positions (n,) in the middle of the limits, rad or m; 0 without limits."""
    return np.array([np.mean(j.si("position") or (0.0, 0.0)) for j in robot.joints])


class TablePlant:
    """A plant that replays joint samples, one row per period. Control loops have no effect."""

    def __init__(self, samples: Block, sample_rate_hz: float) -> None:
        Location("").require(len(samples), text="the table to replay contains no samples")
        self._samples, self._rate_hz, self._elapsed_s = samples, sample_rate_hz, 0.0

    @property
    def _row(self) -> int:
        return min(round(self._elapsed_s * self._rate_hz), len(self._samples) - 1)

    def state(self) -> tuple[Array, Array]:
        """Return the position of the row, and the speed between it and the next row."""
        q = self._samples["position"]
        now, following = q[self._row], q[min(self._row + 1, len(q) - 1)]
        return now.copy(), (following - now) * self._rate_hz

    def prescribed_effort(self) -> Array | None:
        """Return the effort (n,) of the row."""
        return np.array(self._samples["effort"][self._row])

    def step(self, effort: Array, held: Bools, duration_s: float) -> None:
        """Advance to the row at the time reached."""
        self._elapsed_s += duration_s


# The control loops of a drive run faster than SYNC, in so many steps per period.
SUBSTEPS = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopGains:
    """Control law of the drives, each with its own motor.

        u = Kp e + Kd (phi dr - dq) + Ki integral(alpha e - (1 - phi) dq),     e = r - q

    Positions are in rad (or m) of the motor, u is in the unit of the recorded effort.

    Attributes:
        position: (n,) gains Kp.
        velocity: (n,) gains Kd.
        integral: (n,) gains Ki.
        position_share: (n,) factors alpha.
        feedforward: phi, the share of the speed of the reference that is fed forward.
        smooth: True if the reference between two targets is a cubic of continuous speed. With a
            straight line, the demand has a ripple in each SYNC period.
        current_s: time constant of the current loop, s.
    """

    position: Array
    velocity: Array
    integral: Array
    position_share: Array
    feedforward: float = 1.0
    smooth: bool = True
    current_s: float = 3e-4


def cascaded_loops(robot: Robot, inertia: Array) -> LoopGains:
    """Return position loops of the given bandwidth w, with velocity loops four times as fast.

    The velocity loops have an integral, and the speed is fed forward.

        Kd ((w e + de) + w integral(w e + de)) = 2 w Kd e + Kd de + w² Kd integral(e)

    Parameters
    ----------
    robot : the robot, with the bandwidth of its controller.
    inertia : (n,) inertias at the joints.
    """
    w = 2 * np.pi * robot.bandwidth_hz
    velocity = 4 * w * (np.linalg.inv(robot.R) ** 2).T @ inertia / robot.gain
    return LoopGains(
        position=2 * w * velocity,
        velocity=velocity,
        integral=w**2 * velocity,
        position_share=np.ones(robot.n),
    )


def describe_loops(robot: Robot, loops: LoopGains) -> Robot:
    """Return the description for a recording of simulated drives.

    The control law of `cascaded_loops` is added if the description has none, so that the fit
    simulates the recorded drives. It is in a separate file because it does not describe the real
    drives. The file robot.toml, from which a description is exported, stays unchanged.
    """
    bandwidth_hz = robot.controller.bandwidth_hz
    if robot.bus is None or robot.controller != Controller(bandwidth_hz=bandwidth_hz):
        return robot
    law = (
        f'bandwidth_hz = {bandwidth_hz}\nstructure = "pid"\nvelocity_estimate = "exact"\n'
        f"sample_rate_hz = {SUBSTEPS / robot.bus.sync_period_s}\nposition_gain = "
        f"{loops.position.tolist()}\n"
        f"velocity_gain = {loops.velocity.tolist()}\nintegral_gain = {loops.integral.tolist()}\n"
    )
    return robot_from_files({**robot.files, SIMULATED_CONTROLLER: law.encode()}, "recording")


def cubic(share: float, travel: Array, first: Array, last: Array) -> tuple[Array, Array]:
    """Return distance and speed of a cubic over `travel` at a share of the period.

    `first` and `last` are the speeds at its ends.
    """
    # Speeds are multiplied by the period, so that all quantities (n,) are in rad or m.
    rest, a, b = 1 - share, first - travel, last - travel
    return (
        share * (travel + rest * (rest * a - share * b)),
        travel + rest * (1 - 3 * share) * a - share * (2 - 3 * share) * b,
    )


GROUP = "robot_idim.plants"


@dataclass(frozen=True, kw_only=True, eq=False)
class DrivenPlant:
    """The plant of simulated drives, and their control loops.

    Attributes:
        plant: the plant.
        loops: the control loops.
        warning: why the plant is not the described robot; None if it is.
    """

    plant: Plant
    loops: LoopGains
    warning: str | None = None


def driven_plant(robot: Robot, bus: Bus, payload: Payload | None = None) -> DrivenPlant:
    """Return the robot of `[parameters]` with its payload.

    Without parameters or dynamics, independent joints are returned, with a warning.

    Raises
    ------
    BadInputError : the description cannot be simulated.
    """
    if not robot.parameters:
        return _independent_joints(robot, bus, "robot.toml has no [parameters]")
    from importlib.metadata import entry_points

    plants = list(entry_points(group=GROUP))
    if not plants:
        return _independent_joints(
            robot, bus, f"no installed package provides the dynamics (entry point {GROUP})"
        )
    try:
        plant_of: Callable[[Robot, Payload | None], tuple[Plant, LoopGains]] = plants[0].load()
    except (ImportError, AttributeError) as error:
        Location(f"entry point {GROUP} {plants[0].value}").refuse(
            text=f"it cannot be loaded: {error}"
        )
    plant, loops = plant_of(robot, payload)
    return DrivenPlant(plant=plant, loops=loops)


def _independent_joints(robot: Robot, bus: Bus, why: str) -> DrivenPlant:
    rated = rated_motor_effort(bus)
    return DrivenPlant(
        plant=typical_plant(robot, rated),
        loops=cascaded_loops(robot, typical_inertia(robot, rated)),
        warning=(
            "simulated as independent joints with a gravity-like load, not as the robot of "
            f"robot.toml: {why}"
        ),
    )


def rated_motor_effort(bus: Bus) -> Array:
    """Return the rated efforts (n,) of the motors, in the recorded units.

    They are 1000 raw units of the effort object of each drive.
    """
    return np.array([1000.0 * abs(drive.effort.scale) for drive in bus.drives])
