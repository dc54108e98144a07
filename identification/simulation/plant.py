"""The rigid robot as what simulated drives move: effort in, position and speed out; and drives that suit it.

`described_robot` is the package's entry point in the group `robot_idim.plants`, by which a dry run finds it.
"""

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import AcquisitionError
from acquisition.robot import Robot
from acquisition.simulated import SUBSTEPS, LoopGains, cascaded_loops, middle_of_range

from ..arrays import Array
from ..errors import IdentificationError
from ..model import DirectModel, InverseModel, base_parameters, direct_model, inertias, not_positive, truth
from .control_law import has_controller, recorded_loop
from .friction import Friction

POSES = 200  # within the limits of the joints, at which the inertias are looked at
POSES_RANGE = np.pi  # rad or m to each side, of these poses alone, where a joint states no range
PLANT_STEP_S = 0.0005  # at most


class RigidBodyPlant:
    """The direct model stepped under given efforts, with white disturbance torque of `disturbance` (n,) rms.

    Satisfies the plant protocol of the simulated drives: quantities at the joints, SI. The same seed gives the same run.
    """

    def __init__(
        self, model: DirectModel, q: Array, *, speed_scale: Array, step_s: float, disturbance: Array, seed: int
    ) -> None:
        """`speed_scale` (n,) is the speed that motion reaches, which sets where friction counts as sticking."""
        self._model, self._step_s = model, step_s
        self._q, self._dq = np.array(q, dtype=float), np.zeros(len(q))
        self._friction = Friction(model, np.abs(model.directions @ speed_scale), self._dq, step_s)
        self._disturbance, self._rng = disturbance, np.random.default_rng(seed)

    def state(self) -> tuple[Array, Array]:
        """Position and speed, each (n,)."""
        return self._q.copy(), self._dq.copy()

    def prescribed_effort(self) -> Array | None:
        """None: it obeys."""
        return None

    def step(self, effort: Array, held: NDArray[np.bool_], duration_s: float) -> None:
        """Go on for `duration_s` under constant `effort`; brakes hold the joints where `held`."""
        self._dq = np.where(held, 0.0, self._dq)
        if held.all():
            return
        noise = self._disturbance * self._rng.standard_normal(len(effort))
        steps = max(1, round(duration_s / self._step_s))
        for _ in range(steps):
            # The torque of the links is that of the middle position: at the start's it would be half a step late.
            middle = self._q + 0.5 * self._step_s * self._dq
            after = self._friction.step(middle, self._dq, effort + noise, held=held)
            if after is None:
                raise ArithmeticError("the inertia matrix of the simulated robot is not positive definite")
            self._q, self._dq = middle + 0.5 * self._step_s * after, after


def described_robot(robot: Robot) -> tuple[RigidBodyPlant, LoopGains]:
    """The plant of `robot-acquire record --dry-run`: the rigid robot of the description's `[parameters]`.

    The robot is at rest in the middle of its ranges; the loops of its drives are for its inertias. An `AcquisitionError` where
    the parameters are not of this robot, or no motion is possible with them.
    """
    try:
        dynamics = InverseModel(robot)
        base = base_parameters(dynamics)
        model = direct_model(dynamics, base.standard_parameters(truth(dynamics, base)))
    except IdentificationError as error:
        raise AcquisitionError(str(error)) from error
    ranges = np.array([joint.si("position") or (-POSES_RANGE, POSES_RANGE) for joint in robot.joints])
    poses = np.random.default_rng(0).uniform(ranges[:, 0], ranges[:, 1], (POSES, robot.n))
    reason = not_positive(model, poses)
    if reason is not None:
        raise AcquisitionError(f"robot {robot.name}: [parameters] cannot be simulated: {reason}")
    period_s = robot.bus.sync_period_s if robot.bus is not None else SUBSTEPS * PLANT_STEP_S
    plant = RigidBodyPlant(
        model,
        middle_of_range(robot),
        speed_scale=np.array([joint.si("speed") or 1.0 for joint in robot.joints]),
        step_s=min(period_s / SUBSTEPS, PLANT_STEP_S),
        disturbance=np.zeros(robot.n),
        seed=0,
    )
    return plant, drive_loops(robot, inertias(model, poses))


def drive_loops(robot: Robot, J: Array) -> LoopGains:
    """The law of simulated drives: the description's, or cascaded loops of its bandwidth for inertias J (n,) at the joints.

    Computed torque needs a model that drives do not have: a description with it is given the second.
    """
    if not has_controller(robot.controller) or robot.controller.structure == "computed_torque":
        return cascaded_loops(robot, J)
    law = recorded_loop(robot)
    return LoopGains(
        position=law.Kp,
        velocity=law.Kd,
        integral=law.Ki,
        position_share=law.position_share,
        feedforward=law.feedforward,
    )
