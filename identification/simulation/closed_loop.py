"""The simulated robot: the direct model in closed loop, or as the plant of simulated drives.

Friction is integrated implicitly with stick phases, so that light joints do not chatter.
`described_robot` is the entry point in the group `robot_idim.plants` that dry runs use.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from acquisition.errors import BadInputError, Location
from acquisition.robot import Payload, Robot

from ..arrays import Array, Bools
from ..control import ARRAYS, FLOATS, Control, ControlLaw, Numbers, Reference, described_law
from ..model import (
    DirectModel,
    InverseModel,
    add_payload,
    base_parameters,
    cholesky_solver,
    described_parameters,
    direct_model,
    inertias,
    why_not_positive,
)

if TYPE_CHECKING:
    from acquisition.simulated import LoopGains

# Of a direction's speed scale: Coulomb friction grows linearly up to this speed.
STICTION = 1e-3
MODE_PASSES = range(8)  # to find the directions that stick; nearly always one or two suffice
BRAKE = 1e9  # added to the inertia of a joint whose brake holds
CHECK_EVERY = 64  # instants between checks of the tracking error
POSES = 200  # within the joint limits, for a plant's inertias
POSES_RANGE = np.pi  # rad or m to each side, for joints without given limits
MAX_PLANT_STEP_S = 0.0005


class Friction:
    """The robot's equation of motion, with explicit steps of its smooth part and implicit friction.

        (M + h V / 2) dv = h (tau - bias - V v - S' f - offset)

    A step h has viscous friction V at its middle. A direction of friction slips at its full Coulomb
    level, or sticks: then its friction grows linearly up to a creep speed `v_s`. The modes of the
    previous step are tried first; a direction that would reverse sticks, one that exceeds v_s
    slips. Square-root friction is linearised, below v_s with the slope at v_s, and has its value at
    the middle of the step as viscous friction has. Load-dependent friction has the torque of the
    links in the previous step.
    """

    def __init__(
        self, model: DirectModel, fastest: Array, v: Array, h: float, numbers: Numbers = ARRAYS
    ) -> None:
        """Set the initial state.

        Parameters
        ----------
        model : equation of motion of the robot.
        fastest : (c,) maximum speeds of the directions of friction, rad/s or m/s.
        v : (n,) initial joint speeds; later ones are of kind `numbers`.
        h : step, s.
        """
        self._model, self._h, self._S, self._numbers = model, h, model.directions, numbers
        self._at: Callable[[Any, Any], tuple[Any, Any]] = model.inertia_and_bias
        self._solve = cholesky_solver(len(v))
        if numbers is FLOATS:
            M, bias = numbers.own(model.inertia_and_bias(0 * v, 0 * v)[0]), model.lone_bias()
            self._at, self._solve = lambda q, _: (M, bias(q)), lambda A, b: b / A if A > 0 else None
        self._v_s = STICTION * np.maximum(fastest, 1e-9)
        self._rigid: Array | None = None  # torque of the links in the previous step
        self._one_sided = bool(model.viscous_up.any() or model.viscous_down.any())
        self._rotor, *self._sides = map(
            numbers.own, (model.rotor, model.viscous, model.viscous_up, model.viscous_down)
        )
        self._V = self._sides[0]
        self._added = self._rotor + 0.5 * h * self._V
        self._set_modes(np.sign(self._S @ v), *np.zeros((3, len(fastest))))

    def _set_modes(self, mode: Array, static: Array, sliding: Array, steepness: Array) -> None:
        """Set the modes (c,): +1 and -1 slip in that direction, 0 sticks.

        `static` and `sliding` (c,) are further friction of directions that stick and that slip,
        `steepness` its slope by the speed.
        """
        model, S, own, stuck = self._model, self._S, self._numbers.own, mode == 0
        rest = (model.up + model.down) / 2 + static
        slope = np.where(stuck, np.maximum(rest, 0.0) / self._v_s, 0.5 * steepness)
        slips = np.where(mode > 0, model.up, -model.down) + mode * sliding
        level = np.where(stuck, (model.up - model.down) / 2, slips)
        self._mode, self._resists, self._further = mode, rest > 0, (static, sliding, steepness)
        self._forward, self._level = own(mode[:, None] * S), own(level @ S + model.offset)
        self._slope, self._creep = (own((S.T * x) @ S) for x in (slope, slope * stuck))
        self._stuck, self._slopes = bool(stuck.any()), bool(slope.any())

    def step(self, q: Any, v: Any, tau: Any, held: Bools | None = None) -> Any:
        """Return the speed (n,) after a step from position q and speed v under the torque tau.

        Brakes act on the joints `held`. Raises `ArithmeticError` if M is not positive.
        """
        h, dot = self._h, self._numbers.dot
        M, bias = self._at(q, v)
        if self._one_sided:
            V, forward, backward = self._sides
            self._V = V + forward * (v > 0) + backward * (v < 0)
            self._added = self._rotor + 0.5 * h * self._V
        M = M + self._added
        if held is not None:
            M = M + np.diag(BRAKE * held)
        force = tau - bias - dot(self._V, v)
        if self._model.shapes:
            # Static friction equals the friction at the creep speed.
            along, v_s = self._S.dot(bias if self._rigid is None else self._rigid), self._v_s
            u = np.maximum(np.abs(self._S.dot(v)), v_s)
            static, sliding = (self._model.shape(x, along) for x in (v_s, u))
            self._set_modes(self._mode, static, sliding, self._model.steepness(u))
        for _ in MODE_PASSES:
            A, net = M, force - self._level
            if self._slopes:
                A, net = A + h * self._slope, net - dot(self._creep, v)
            if (dv := self._solve(A, h * net)) is None:
                raise ArithmeticError("the inertia matrix is not positive definite")
            w = v + dv
            if not self._stuck and not self._numbers.reverses(self._forward, w):
                break
            after, mode = self._S @ np.reshape(w, -1), self._mode
            found = np.where(
                mode == 0,
                np.where(np.abs(after) > self._v_s, np.sign(after), 0.0),
                np.where(mode * after < 0, np.where(self._resists, 0.0, -mode), mode),
            )
            if (found == mode).all():
                break
            self._set_modes(found, *self._further)
        if self._model.shapes:
            self._rigid = self._model.torques_of_links(q[None], v[None], dv[None] / h)[0]
        return w


class ClosedLoop:
    """A robot in closed loop, simulated part by part.

    The states of robot and controller continue from one part to the next.
    """

    def __init__(
        self,
        model: DirectModel,
        loop: ControlLaw,
        start: tuple[Array, Array],
        *,
        fastest: Array,
        gains: Array | None = None,
        substeps: int = 1,
    ) -> None:
        """Set the initial state.

        Parameters
        ----------
        model, loop : the robot and its control law.
        start : position and speed, (n,) each.
        fastest : (c,) maximum speeds of the directions of Coulomb friction.
        gains : (n,) factors on the gains of the loop.
        substeps : steps in a controller period.
        """
        q, v = (np.array(x) for x in start)
        self._numbers = ARRAYS if len(q) > 1 or model.shapes or loop.computed_torque else FLOATS
        self._h, self._substeps = loop.period_s / substeps, substeps
        self._friction = Friction(model, fastest, v, self._h, self._numbers)
        self._control = Control(
            model, loop if gains is None else loop.scaled(gains), q, v, self._numbers
        )
        self._q, self._v, self._instants = self._numbers.own(q), self._numbers.own(v), 0

    @np.errstate(over="ignore", invalid="ignore")  # an unstable loop is found by its tracking error
    def follow(self, reference: Reference, bound: Array) -> tuple[Array, str | None]:
        """Follow the next part of a reference that is given once per period of the loop.

        Parameters
        ----------
        reference : inputs of the loop at its instants.
        bound : (n,) largest distance of a position from the reference, rad or m.

        Returns
        -------
        q, dq, ddq, tau (4, N, n), with `substeps` rows per period: the true motion without encoder
        noise, and the controller's torque, held until the next row. And the reason for an early
        end, or None: a position is beyond its bound, or the inertia matrix is not positive. The
        state is never clipped.
        """
        substeps, q_ref, half = self._substeps, reference.q, 0.5 * self._h
        (N, n), rows, reason = q_ref.shape, 0, None
        out = np.empty((4, N * substeps, n))
        q_out, v_out, _, tau_out = out[..., 0] if self._numbers is FLOATS else out
        pushed = (
            None if reference.known_torque is None else self._numbers.each(reference.known_torque)
        )
        control, friction, q, v = self._control, self._friction, self._q, self._v
        control.take(reference)
        for first in range(0, N, CHECK_EVERY):
            try:
                for k in range(first, min(N, first + CHECK_EVERY)):
                    tau = control.torque(k, q, v)
                    acting = tau if pushed is None else tau + pushed[k]
                    for rows in range(k * substeps + 1, (k + 1) * substeps + 1):
                        after = friction.step(q, v, acting)
                        q_out[rows - 1], v_out[rows - 1], tau_out[rows - 1] = q, v, tau
                        q, v = q + half * (v + after), after
            except ArithmeticError as error:
                reason, rows = str(error), rows - 1
            off = out[0, first * substeps : rows : substeps] - q_ref[first : -(-rows // substeps)]
            far = np.argwhere(~(np.abs(off) < bound))  # or not finite
            if len(far):
                rows = (first + int(far[0, 0])) * substeps
                t_s = (self._instants * substeps + rows) * self._h
                reason = (
                    "the simulated robot leaves its reference at joint "
                    f"{1 + far[0, 1]}, {t_s:.3f} s"
                )
            if reason is not None:
                break
        self._q, self._v, self._instants = q, v, self._instants + N
        out[2, :rows] = np.diff(out[1, :rows], axis=0, append=np.reshape(v, (1, n))) / self._h
        return out[:, :rows], reason


class RigidBodyPlant:
    """The direct model stepped under given efforts, with a white disturbance torque.

    It satisfies the plant protocol of the simulated drives: quantities at the joints, SI. The same
    seed gives the same run.
    """

    def __init__(
        self,
        model: DirectModel,
        q: Array,
        *,
        speed_scale: Array,
        step_s: float,
        disturbance: Array | float = 0.0,
        seed: int = 0,
    ) -> None:
        """Set the initial state.

        Parameters
        ----------
        model : equation of motion of the robot.
        q : (n,) initial positions, rad or m.
        speed_scale : (n,) maximum speed, which sets the speed below which friction sticks.
        step_s : step, s, which divides the durations of `step`: otherwise the robot would move in
            another time than its drives.
        disturbance : (n,) rms of the white disturbance torque.
        seed : seed of the disturbance.
        """
        self._model, self._step_s = model, step_s
        self._q, self._dq = np.array(q, dtype=float), np.zeros(len(q))
        self._friction = Friction(model, np.abs(model.directions @ speed_scale), self._dq, step_s)
        self._disturbance, self._rng = disturbance, np.random.default_rng(seed)

    def state(self) -> tuple[Array, Array]:
        """Return position and speed, each (n,)."""
        return self._q.copy(), self._dq.copy()

    def prescribed_effort(self) -> Array | None:
        """Return None, because the robot moves as its drives command."""
        return None

    def step(self, effort: Array, held: Bools, duration_s: float) -> None:
        """Simulate `duration_s` under constant `effort`, with brakes on the joints `held`."""
        self._dq = np.where(held, 0.0, self._dq)
        if held.all():
            return
        noise = self._disturbance * self._rng.standard_normal(len(effort))
        for _ in range(max(1, round(duration_s / self._step_s))):
            # Evaluate the links' torque at the middle of the step: at its start it would be half a
            # step late.
            middle = self._q + 0.5 * self._step_s * self._dq
            after = self._friction.step(middle, self._dq, effort + noise, held=held)
            self._q, self._dq = middle + 0.5 * self._step_s * after, after


def open_loop(
    model: DirectModel,
    start: tuple[Array, Array],
    tau: Array,
    rate: tuple[float, float],
    fastest: Array,
) -> Array:
    """Simulate the positions (N, n) of a robot under given torques, rad or m.

    Parameters
    ----------
    model : equation of motion of the robot.
    start : position and speed (n,) at the start.
    tau : (N, n) torques, which follow straight lines between samples, N m or N.
    rate : rate of the torques, Hz, and the longest step, s.
    fastest : (n,) maximum speeds, which set the speed below which friction sticks.

    Raises
    ------
    ArithmeticError : M is not positive.
    """
    (q, v), (rate_hz, most_s) = start, rate
    steps, found = max(1, int(np.ceil(1 / (rate_hz * most_s)))), np.empty_like(tau)
    h, found[0] = 1 / (rate_hz * steps), q
    friction = Friction(model, np.abs(model.directions) @ fastest, v, h)
    for k, (before, after) in enumerate(pairwise(tau)):
        for i in range(steps):
            middle = q + 0.5 * h * v
            v = friction.step(middle, v, before + (i + 0.5) / steps * (after - before))
            q = middle + 0.5 * h * v
        found[k + 1] = q
    return found


def described_robot(
    robot: Robot, payload: Payload | None = None
) -> tuple[RigidBodyPlant, "LoopGains"]:
    """Return the plant of `robot-acquire record --dry-run`, with given `[parameters]` and payload.

    Its loops are set for the inertias of the robot without payload, as those of real drives. The
    robot is at rest in the middle of its limits.

    Raises
    ------
    BadInputError : the parameters are not of this robot, its inertia matrix is not positive, the
        payload's frame is not on its last link, or `[parameters]` are not in kg and N m.
    """
    from acquisition.simulated import SUBSTEPS, middle_of_range

    Location(f"robot {robot.name}").require(
        payload is None or robot.gain_known,
        "payload",
        str(payload),
        text="the weight of a payload in A or V is unknown",
        advice="Specify the drive_gain of every motor",
    )
    inverse = InverseModel(robot)
    base = base_parameters(inverse)
    parameters = base.standard_parameters(described_parameters(inverse, base))
    model = direct_model(inverse, parameters)
    carried = parameters if payload is None else add_payload(inverse, parameters, payload)
    low, high = np.transpose(
        [joint.si("position") or (-POSES_RANGE, POSES_RANGE) for joint in robot.joints]
    )
    M = model.inertia(np.random.default_rng(0).uniform(low, high, (POSES, robot.n)))
    if (reason := why_not_positive(M)) is not None:
        raise BadInputError(
            f"cannot be simulated: {reason}", place=f"robot {robot.name}: [parameters]"
        )
    duration_s = robot.bus.sync_period_s / SUBSTEPS if robot.bus is not None else MAX_PLANT_STEP_S
    return RigidBodyPlant(
        direct_model(inverse, carried),
        middle_of_range(robot),
        speed_scale=np.array([joint.si("speed") or 1.0 for joint in robot.joints]),
        step_s=duration_s / np.ceil(duration_s / MAX_PLANT_STEP_S),
    ), drive_loops(robot, inertias(M))


def drive_loops(robot: Robot, J: Array) -> "LoopGains":
    """Return the control law of simulated drives, for joint inertias J (n,).

    It is the given one, or cascaded loops of the given bandwidth.
    """
    from acquisition.simulated import LoopGains, cascaded_loops

    law = described_law(robot)
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
