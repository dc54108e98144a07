"""The simulated robot: the direct model with any base parameters, in closed loop or as the
plant of simulated drives.

Friction is stepped implicitly with stick phases, so that light joints do not chatter.
`described_robot` is the entry point in the group `robot_idim.plants` that dry runs use.
"""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from acquisition.robot import Payload, Robot

from .. import model as dynamics
from ..arrays import Array
from ..errors import BadInputError
from ..model import DirectModel, cholesky_solver
from .control_law import Control, ControlLaw, LoneControl, Reference, recorded_loop

if TYPE_CHECKING:
    from acquisition.simulated import LoopGains

# of a direction's speed scale: Coulomb friction builds up linearly below this speed
STICTION = 1e-3
MAX_MODE_PASSES = 8  # to find the directions that stick; nearly always one or two suffice
BRAKE = 1e9  # added to the inertia of a joint whose brake holds
CHECK_EVERY = 64  # steps between checks of the tracking error
POSES = 200  # within the joint limits, for a plant's inertias
POSES_RANGE = np.pi  # rad or m to each side, for joints without a stated range
MAX_PLANT_STEP_S = 0.0005


class Friction:
    """The robot's equation of motion, its smooth part stepped explicitly and
    its friction implicitly.

    A step h solves (M + h V / 2) dv = h (tau - bias - V v - Sᵀ f - offset), with viscous friction
    at the middle of the step. A direction slips at its full Coulomb level, or sticks: then its
    friction grows linearly up to a creep speed `v_s`. The modes of the previous step are tried
    first; a direction that would reverse sticks, one that exceeds v_s slips. Root friction is
    linearised, below v_s with the slope at v_s, and taken at the middle of the step like viscous
    friction. Load friction uses the links' torque of the previous step.
    """

    def __init__(self, model: DirectModel, fastest: Array, v: Array, h: float) -> None:
        """`fastest` (c,) are the maximum speeds of the directions, `v` (n,) the initial joint
        speeds, `h` the step in s.
        """
        self._solve, self._model, self._h, self._S = (
            cholesky_solver(len(v)),
            model,
            h,
            model.directions,
        )
        self._v_s = STICTION * np.maximum(fastest, 1e-9)
        self._shaped = bool(model.shapes)
        self._rigid: Array | None = None  # torque of the links in the previous step
        self._coulomb = (model.up + model.down) / 2
        self.set_static_level(self._coulomb)
        self._one_sided = bool(model.viscous_up.any() or model.viscous_down.any())
        self._V, self._added = model.viscous, model.rotor + 0.5 * h * model.viscous
        self.set_modes(np.sign(self._S @ v))

    def set_static_level(self, level: Array) -> None:
        """Set the friction at rest, `level` (c,): half of the distance
        between its two directions.
        """
        self._resists = level > 0
        self._slope = np.where(self._resists, level / self._v_s, 0.0)

    def set_modes(self, mode: Array) -> None:
        """Set the modes (c,): +1 and -1 slip that way, 0 sticks."""
        model, S = self._model, self._S
        self._mode, self._forward = mode, mode[:, None] * S
        stuck = mode == 0
        level = np.where(
            stuck, (model.up - model.down) / 2, np.where(mode > 0, model.up, -model.down)
        )
        self._stuck, self._level = bool(stuck.any()), level @ S + model.offset
        self._creep = (S.T * (self._slope * stuck)) @ S

    def step(self, q: Any, v: Any, tau: Any, held: NDArray[np.bool_] | None = None) -> Any:
        """Speed (n,) after a step under the torque tau, with brakes on the joints `held`;
        None if M is not positive.
        """
        h = self._h
        M, bias = self._model.inertia_and_bias(q, v)
        if self._one_sided:
            self._V = (
                self._model.viscous
                + self._model.viscous_up * (v > 0)
                + self._model.viscous_down * (v < 0)
            )
            self._added = self._model.rotor + 0.5 * h * self._V
        M = M + self._added
        if held is not None:
            M = M + np.diag(BRAKE * held)
        force = tau - bias - self._V.dot(v)
        if self._shaped:
            shape, steepness = self._shapes(bias if self._rigid is None else self._rigid, v)
        A = M
        for _ in range(MAX_MODE_PASSES):
            level = self._level
            if self._shaped:
                level = level + (self._mode * shape) @ self._S
                A = M + 0.5 * h * (self._S.T * (steepness * (self._mode != 0))) @ self._S
            if self._stuck:
                creep = self._creep
                dv = self._solve(A + h * creep, h * (force - level - creep.dot(v)))
            else:
                dv = self._solve(A, h * (force - level))
            if dv is None:
                return None
            w = v + dv
            if not self._stuck and min(self._forward.dot(w).tolist(), default=1.0) > 0:
                break
            after, mode = self._S.dot(w), self._mode
            stuck = mode == 0
            found = np.where(stuck & (np.abs(after) > self._v_s), np.sign(after), mode)
            found = np.where(
                ~stuck & (mode * after < 0), np.where(self._resists, 0.0, -mode), found
            )
            if (found == mode).all():
                break
            self.set_modes(found)
        if self._shaped:
            self._rigid = self._model.torques_of_links(q[None], v[None], dv[None] / h)[0]
        return np.asarray(w)

    def _shapes(self, rigid: Array, v: Array) -> tuple[Array, Array]:
        """Further friction (c,) of directions that slip at the speeds v (n,), and
        its slope by the speed.
        """
        model, v_s = self._model, self._v_s
        along = self._S.dot(rigid)
        # Static friction equals the friction at the creep speed.
        self.set_static_level(self._coulomb + model.shape(v_s, along))
        if self._stuck:
            self._creep = (self._S.T * (self._slope * (self._mode == 0))) @ self._S
        u = np.maximum(np.abs(self._S.dot(v)), v_s)
        return model.shape(u, along), model.steepness(u)


class LoneFriction(Friction):
    """`Friction` of a lone joint in Python floats; without brake, and without shapes."""

    def __init__(self, model: DirectModel, fastest: Array, v: Array, h: float) -> None:
        """See `Friction`."""
        super().__init__(model, fastest, v, h)
        V, up, down = (x.item() for x in (model.viscous, model.viscous_up, model.viscous_down))
        M, _ = model.inertia_and_bias(np.zeros(1), np.zeros(1))
        sides = ((x, (M + (model.rotor + 0.5 * h * x)).item()) for x in (V, V + up, V + down))
        (self._at_rest, self._forwards, self._backwards), self._bias = sides, model.lone_bias()
        # without a direction of friction zero
        sizes = (model.up, model.down, self._slope, self._v_s)
        up, down, self._lone_slope, self._lone_v_s = (x.sum().item() for x in sizes)
        offset, self._lone_mode = model.offset.item(), np.sign(v).item()
        self._levels = {1.0: up + offset, -1.0: -down + offset, 0.0: (up - down) / 2 + offset}

    def step(self, q: Any, v: Any, tau: Any, held: NDArray[np.bool_] | None = None) -> Any:
        """See `Friction`."""
        V, M = self._forwards if v > 0.0 else self._backwards if v < 0.0 else self._at_rest
        h, slope, mode, force = (
            self._h,
            self._lone_slope,
            self._lone_mode,
            tau - self._bias(q) - V * v,
        )
        for _ in range(MAX_MODE_PASSES):
            A, net = M, force - self._levels[mode]
            if not mode:
                A, net = M + h * slope, net - slope * v
            if not A > 0.0:
                return None
            w = v + h * net / A
            if mode:
                if not mode * w < 0.0:
                    break
                mode = 0.0 if slope > 0.0 else -mode
            else:
                if not abs(w) > self._lone_v_s:
                    break
                mode = math.copysign(1.0, w)
        self._lone_mode = mode
        return w


class ClosedLoop:
    """A robot in closed loop, simulated span by span; the states of robot and controller
    continue from one to the next.
    """

    def __init__(
        self,
        model: DirectModel,
        loop: ControlLaw,
        start: tuple[Array, Array],
        *,
        fastest: Array,
        substeps: int = 1,
    ) -> None:
        """`start` is position and speed, (n,) each; `fastest` (c,) maximum speeds of the
        directions of Coulomb friction.

        A controller period has `substeps` steps.
        """
        self._q, self._v = (np.array(x) for x in start)
        self._alone = len(self._q) == 1 and not model.shapes and not loop.computed_torque
        self._h, self._substeps, self._period_s = loop.period_s / substeps, substeps, loop.period_s
        laws = (LoneControl, LoneFriction) if self._alone else (Control, Friction)
        self._control = laws[0](model, loop, self._q, self._v)
        self._friction = laws[1](model, fastest, self._v, self._h)
        self._instants = 0

    @np.errstate(over="ignore", invalid="ignore")  # an unstable loop is found by its tracking error
    def follow(self, reference: Reference, bound: Array) -> tuple[Array, str | None]:
        """Follow the next span of a reference given once per controller period.

        Returns q, dq, ddq, tau (4, N, n), `substeps` rows a period: the true motion and the
        controller's torque, held until the next row, without encoder noise. And why it ended early,
        or None: the position differs from the reference by more than `bound` (n,), or the inertia
        matrix is not positive. The state is never clipped.
        """
        h, substeps, q_ref = self._h, self._substeps, reference.q
        (N, n), known = q_ref.shape, reference.known_torque
        out = np.empty((4, N * substeps, n))
        q_out, dq_out, ddq_out, tau_out = out
        control, friction = self._control, self._friction
        q: Any = self._q  # of a lone joint a float
        v: Any = self._v
        control.take(reference)
        if self._alone:
            (q, v), (q_out, dq_out, _, tau_out) = (x.item() for x in (q, v)), out[..., 0]
            known = None if known is None else known[:, 0].tolist()
        check_every, half, reason, rows = max(1, CHECK_EVERY // substeps), 0.5 * h, None, 0
        for k in range(N):
            tau = control.torque(k, q, v)
            acting = tau if known is None else tau + known[k]
            for row in range(rows, rows + substeps):
                after = friction.step(q, v, acting)
                if after is None:
                    reason = "the inertia matrix is not positive definite"
                    break
                q_out[row], dq_out[row], tau_out[row] = q, v, tau
                q, v = q + half * (v + after), after
                rows = row + 1
            if reason is None and k % check_every == 0 and not (np.abs(q - q_ref[k]) < bound).all():
                reason = self._why_lost(q, q_ref[k], bound, k)
            if reason is not None:
                break
        far = np.flatnonzero(
            ~(np.abs(out[0, :rows:substeps] - q_ref[: -(-rows // substeps)]) < bound).all(axis=1)
        )
        if reason is None and far.size:
            k = int(far[0])
            reason, rows = self._why_lost(out[0, k * substeps], q_ref[k], bound, k), k * substeps
        self._q, self._v, self._instants = np.reshape(q, n), np.reshape(v, n), self._instants + N
        ddq_out[:rows] = np.diff(out[1, :rows], axis=0, append=self._v[None]) / h
        return out[:, :rows], reason

    def _why_lost(self, q: Array, q_ref: Array, bound: Array, k: int) -> str:
        j, t_s = int(np.argmin(np.abs(q - q_ref) < bound)), (self._instants + k) * self._period_s
        return f"the simulated robot leaves its reference at joint {j + 1}, {t_s:.3f} s"


class RigidBodyPlant:
    """The direct model stepped under given efforts, with white disturbance torque of
    `disturbance` (n,) rms.

    Satisfies the plant protocol of the simulated drives: quantities at the joints, SI. The same
    seed gives the same run.
    """

    def __init__(
        self,
        model: DirectModel,
        q: Array,
        *,
        speed_scale: Array,
        step_s: float,
        disturbance: Array,
        seed: int,
    ) -> None:
        """`speed_scale` (n,) is the maximum speed, which sets the speed below
        which friction sticks.

        `step_s` divides the durations of `step`: else the robot would move in
            another time than its drives.
        """
        self._model, self._step_s = model, step_s
        self._q, self._dq = np.array(q, dtype=float), np.zeros(len(q))
        self._friction = Friction(model, np.abs(model.directions @ speed_scale), self._dq, step_s)
        self._disturbance, self._rng = disturbance, np.random.default_rng(seed)

    def state(self) -> tuple[Array, Array]:
        """Position and speed, each (n,)."""
        return self._q.copy(), self._dq.copy()

    def prescribed_effort(self) -> Array | None:
        """None: it moves as its drives command."""
        return None

    def step(self, effort: Array, held: NDArray[np.bool_], duration_s: float) -> None:
        """Simulate `duration_s` under constant `effort`, with brakes on the joints `held`."""
        self._dq = np.where(held, 0.0, self._dq)
        if held.all():
            return
        noise = self._disturbance * self._rng.standard_normal(len(effort))
        steps = max(1, round(duration_s / self._step_s))
        for _ in range(steps):
            # The links' torque at the start position would be half a step late.
            middle = self._q + 0.5 * self._step_s * self._dq
            after = self._friction.step(middle, self._dq, effort + noise, held=held)
            if after is None:
                raise ArithmeticError(
                    "the inertia matrix of the simulated robot is not positive definite"
                )
            self._q, self._dq = middle + 0.5 * self._step_s * after, after


def described_robot(
    robot: Robot, payload: Payload | None = None
) -> tuple[RigidBodyPlant, "LoopGains"]:
    """The plant of `robot-acquire record --dry-run`, with the description's `[parameters]` and a
    payload, and loops for the inertias of the robot without it, as those of real drives.

    The robot is at rest in the middle of its ranges. Raises `BadInputError` if the parameters are
    not of this robot, its inertia matrix is not positive, the payload's frame is not on its last
    link, or `[parameters]` are not in kg and N m.
    """
    from acquisition.simulated import SUBSTEPS, middle_of_range

    if payload is not None and not robot.gain_known:
        raise BadInputError(
            place=f"robot {robot.name}",
            key="payload",
            value=str(payload),
            expected="drive gains of the motors: in A or V a mass has no weight",
        )
    inverse = dynamics.InverseModel(robot)
    base = dynamics.base_parameters(inverse)
    parameters = base.standard_parameters(dynamics.described_parameters(inverse, base))
    model = loaded = dynamics.direct_model(inverse, parameters)
    if payload is not None:
        loaded = dynamics.direct_model(inverse, dynamics.add_payload(inverse, parameters, payload))
    ranges = np.array(
        [joint.si("position") or (-POSES_RANGE, POSES_RANGE) for joint in robot.joints]
    )
    poses = np.random.default_rng(0).uniform(ranges[:, 0], ranges[:, 1], (POSES, robot.n))
    M = model.inertia(poses)
    if (reason := dynamics.why_not_positive(M)) is not None:
        raise BadInputError(f"robot {robot.name}: [parameters] cannot be simulated: {reason}")
    duration_s = robot.bus.sync_period_s / SUBSTEPS if robot.bus is not None else MAX_PLANT_STEP_S
    plant = RigidBodyPlant(
        loaded,
        middle_of_range(robot),
        speed_scale=np.array([joint.si("speed") or 1.0 for joint in robot.joints]),
        step_s=duration_s / math.ceil(duration_s / MAX_PLANT_STEP_S),
        disturbance=np.zeros(robot.n),
        seed=0,
    )
    return plant, drive_loops(robot, dynamics.inertias(M))


def drive_loops(robot: Robot, J: Array) -> "LoopGains":
    """The law of simulated drives: the description's, or cascaded loops of its bandwidth for
    joint inertias J (n,).
    """
    from acquisition.simulated import LoopGains, cascaded_loops

    law = recorded_loop(robot)
    # Computed torque needs a model, which drives do not have.
    if law is None or law.computed_torque:
        return cascaded_loops(robot, J)
    return LoopGains(
        position=law.Kp,
        velocity=law.Kd,
        integral=law.Ki,
        position_share=law.position_share,
        feedforward=law.feedforward,
    )
