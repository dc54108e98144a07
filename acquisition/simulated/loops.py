"""Control loops of simulated drives: their law, and the reference between two targets."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..robot import SIMULATED_CONTROLLER, Controller, Robot, robot_from_files

SUBSTEPS = 4  # of the control loops in a SYNC period


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopGains:
    """The law of the drives, each with its own motor: u = Kp e + Kd (phi dr - dq) + Ki integral(alpha e - (1 - phi) dq).

    e = r - q, in rad (or m) of the motor; u in the recorded effort; gains (n,).

    Attributes:
        position, velocity, integral: Kp, Kd, Ki.
        position_share: alpha, (n,).
        feedforward: phi, the share of the reference's speed that is fed forward.
        smooth: whether the reference between two targets is a cubic of continuous speed. Else it is a line, from which motion
            deviates: the demand has a ripple in each SYNC period.
        current_s: time constant of the current loop.
    """

    position: Array
    velocity: Array
    integral: Array
    position_share: Array
    feedforward: float = 1.0
    smooth: bool = True
    current_s: float = 3e-4


def cascaded_loops(robot: Robot, inertia: Array) -> LoopGains:
    """Position loops of the stated bandwidth w, velocity loops four times as fast with an integral, speed fed forward.

    `inertia` (n,) at the joints. Kd ((w e + de) + w integral(w e + de)) = 2 w Kd e + Kd de + w² Kd integral(e).
    """
    w = 2 * np.pi * robot.bandwidth_hz
    velocity = 4 * w * (np.linalg.inv(robot.R) ** 2).T @ inertia / robot.gain
    return LoopGains(
        position=2 * w * velocity, velocity=velocity, integral=w**2 * velocity, position_share=np.ones(robot.n)
    )


def describe_loops(robot: Robot, loops: LoopGains) -> Robot:
    """The description for a recording of simulated drives: where it states no law, with that of `cascaded_loops`.

    The fit then simulates the drives that were recorded. The law has a file of its own: of the robot's real drives nothing is
    known, and robot.toml, from which a description is exported, stays as it is.
    """
    bandwidth_hz = robot.controller.bandwidth_hz
    if robot.bus is None or robot.controller != Controller(bandwidth_hz=bandwidth_hz):
        return robot
    law = (
        f'bandwidth_hz = {bandwidth_hz}\nstructure = "pid"\nvelocity_estimate = "exact"\n'
        f"sample_rate_hz = {SUBSTEPS / robot.bus.sync_period_s}\nposition_gain = {loops.position.tolist()}\n"
        f"velocity_gain = {loops.velocity.tolist()}\nintegral_gain = {loops.integral.tolist()}\n"
    )
    return robot_from_files({**robot.files, SIMULATED_CONTROLLER: law.encode()}, "recording")


def cubic(share: float, travel: Array, first: Array, last: Array) -> tuple[Array, Array]:
    """Way and speed at a share of the period, by a cubic over `travel` with the speeds `first` and `last` at its ends."""
    # Speeds are times the period, so that all are in rad or m, (n,).
    rest, a, b = 1 - share, first - travel, last - travel
    speed = travel + rest * (1 - 3 * share) * a - share * (2 - 3 * share) * b
    return share * (travel + rest * (rest * a - share * b)), speed
