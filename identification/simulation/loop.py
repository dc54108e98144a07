"""The simulated robot: the direct dynamic model of any base estimate in closed loop with the robot's own controller.

Control acts on motor positions q_m = R q, once per controller period, and is held in between (sample and hold):

    u = Kp (R (q_r - q)) + Kd (R (phi dq_r - dq)) + Ki integral(alpha R (q_r - q) - R dq (1 - phi)),   tau = Rᵀ G u

| structure | Kp | Kd | phi | integral of |
|---|---|---|---|---|
| `pd` | position_gain | velocity_gain | 0 | - |
| `pd_velocity_feedforward` | position_gain | velocity_gain | 1 | - |
| `cascade_p_p` | position_gain · velocity_gain | velocity_gain | 0 | - |
| `cascade_p_pi` | position_gain · velocity_gain | velocity_gain | 0 | velocity error, Ki = velocity_gain · integral_gain |
| `pid` | position_gain | velocity_gain | 1 | position error, Ki = integral_gain |
| `computed_torque` | position_gain | velocity_gain | 1 | -; u is a motor acceleration, Kp in 1/s², Kd in 1/s |

A surrogate, of the controller or of the reference, adds the model's gravity along the reference: a real loop holds its
robot up by an integral or its own model, and a measured position has that sag in it already.

Computed torque gives tau = IDM(q, dq, ddq_r + R⁻¹ u). The saturation limits motor efforts, whatever the structure.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack

from acquisition.robot import Controller, Robot

from ..arrays import Array
from ..errors import IdentificationError
from ..model import DirectModel

STICTION = 1e-3  # of a direction's speed scale: Coulomb friction builds up linearly below this speed
MODE_PASSES = 8  # of the search for which directions stick; nearly always one or two are needed
_LOOK_EVERY = 64  # steps between looks at whether the simulation still follows


@dataclass(frozen=True, kw_only=True, eq=False)
class Loop:
    """A position loop in discrete time; gains (n,) per motor in recorded effort per motor rad (or m)."""

    period_s: float
    R: Array
    G: Array
    Kp: Array
    Kd: Array
    Ki: Array
    position_share: Array  # alpha: how the position error enters the integral
    feedforward: float  # phi
    saturation: Array
    velocity_estimate: str
    computed_torque: bool
    gravity: bool = False  # whether the model's gravity along the reference is added

    def scaled(self, factor: Array) -> "Loop":
        """The same loop for other inertias: gains and saturation times `factor` (n,), the gain update.

        Gains of computed torque stay: they are of accelerations, and the model in the loop has the other inertias.
        """
        gains = np.ones_like(factor) if self.computed_torque else factor
        return replace(
            self, Kp=self.Kp * gains, Kd=self.Kd * gains, Ki=self.Ki * gains, saturation=self.saturation * factor
        )

    def inertias(self, bandwidth_hz: float) -> Array:
        """J (n,) of the joints that Kp makes oscillators of the bandwidth of, w² J = Rᵀ G Kp R on the diagonal.

        Ones for computed torque, whose gains tell nothing of inertias.
        """
        if self.computed_torque:
            return np.ones(len(self.Kp))
        return np.asarray(((self.R**2).T @ (np.abs(self.G) * self.Kp)) / (2 * np.pi * bandwidth_hz) ** 2)


@dataclass(frozen=True, eq=False)
class Simulated:
    """A simulated motion: q, dq, ddq, tau (N, n), each row of one instant, tau held from there on.

    There are `substeps` rows to each controller period. `reason` says why it ended early, if it did.
    """

    q: Array
    dq: Array
    ddq: Array
    tau: Array
    reason: str | None


def recorded_loop(robot: Robot) -> Loop:
    """The loop of the description's `[controller]`; errors name the keys that are missing."""
    c, n = robot.controller, robot.n
    needed = ["structure", "sample_rate_hz", "position_gain", "velocity_gain"]
    needed += ["integral_gain"] if c.structure in ("cascade_p_pi", "pid") else []
    missing = [key for key in needed if getattr(c, key) is None]
    if missing:
        raise IdentificationError(
            f"robot {robot.name}: controller: {', '.join(missing)} missing; expected all of {', '.join(needed)}, or none "
            "of them: then a PD of the stated bandwidth_hz stands in"
        )
    assert c.position_gain is not None
    assert c.velocity_gain is not None
    assert c.sample_rate_hz is not None
    assert c.structure is not None
    kp, kd = np.array(c.position_gain), np.array(c.velocity_gain)
    ki = np.array(c.integral_gain) if c.integral_gain and c.structure in ("cascade_p_pi", "pid") else np.zeros(n)
    cascade = c.structure.startswith("cascade")
    return Loop(
        period_s=1.0 / c.sample_rate_hz,
        R=robot.R,
        G=robot.gain,
        Kp=kp * kd if cascade else kp,
        Kd=kd,
        Ki=ki * kd if cascade else ki,
        position_share=kp if cascade else np.ones(n),
        feedforward=0.0 if cascade or c.structure == "pd" else 1.0,
        saturation=np.array([m.saturation if m.saturation is not None else np.inf for m in robot.motors]),
        velocity_estimate=c.velocity_estimate or "backward_difference",
        computed_torque=c.structure == "computed_torque",
    )


def has_controller(controller: Controller) -> bool:
    """Whether a description states a control law, if only in part."""
    keys = ("structure", "sample_rate_hz", "position_gain", "velocity_gain", "integral_gain")
    return any(getattr(controller, key) is not None for key in keys)


SURROGATE_DAMPING = 0.8


def surrogate_loop(bandwidth_hz: float, J: Array, rate_hz: float) -> Loop:
    """A PD at the joints with velocity feed-forward and gravity: w_n = 2 pi bandwidth, zeta 0.8, inertias J (n,)."""
    w, n = 2 * np.pi * bandwidth_hz, len(J)
    return Loop(
        period_s=1.0 / rate_hz,
        R=np.eye(n),
        G=np.ones(n),
        Kp=J * w**2,
        Kd=2 * SURROGATE_DAMPING * w * J,
        Ki=np.zeros(n),
        position_share=np.ones(n),
        feedforward=1.0,
        saturation=np.full(n, np.inf),
        velocity_estimate="exact",
        computed_torque=False,
        gravity=True,
    )


@np.errstate(over="ignore", invalid="ignore")  # a loop that is not stable is told by where it goes
def simulate(
    model: DirectModel,
    loop: Loop,
    q_ref: Array,
    dq_ref: Array,
    ddq_ref: Array,
    *,
    start: tuple[Array, Array],
    bound: Array,
    substeps: int = 1,
) -> Simulated:
    """Follow a reference (N, n) given once per controller period, from the `start` position and speed, (n,) each.

    The smooth part of the model is stepped explicitly; viscous and Coulomb friction implicitly, Coulomb friction with its
    stick phases, so that light joints do not chatter: within a step it is found which directions stick (a semi-smooth
    Newton iteration). Stops with a `reason` where the position leaves the reference by more than `bound` (n,) or the
    inertia matrix is not positive. The state is never clipped.
    """
    N, n = q_ref.shape
    h = loop.period_s / substeps
    q_out, dq_out, tau_out = np.empty((3, N * substeps, n))
    q, v = (x.copy() for x in start)
    friction = Friction(model, dq_ref, v, h)
    control = _Control(model, loop, q_ref, dq_ref, ddq_ref, q, v)
    look_every, half, reason = max(1, _LOOK_EVERY // substeps), 0.5 * h, None
    rows = 0
    for k in range(N):
        tau = control.torque(k, q, v)
        for row in range(rows, rows + substeps):
            M, bias = model.inertia_and_bias(q, v)
            after = friction.step(M, h * (tau - bias), v)
            if after is None:
                reason = "the inertia matrix is not positive definite"
                break
            q_out[row], dq_out[row], tau_out[row] = q, v, tau
            q, v = q + half * (v + after), after
            rows = row + 1
        if reason is None and k % look_every == 0 and not (np.abs(q - q_ref[k]) < bound).all():
            reason = _lost(q, q_ref[k], bound, k * loop.period_s)
        if reason is not None:
            break
    far = np.flatnonzero(~(np.abs(q_out[:rows:substeps] - q_ref[: -(-rows // substeps)]) < bound).all(axis=1))
    if reason is None and far.size:
        k = int(far[0])
        reason, rows = _lost(q_out[k * substeps], q_ref[k], bound, k * loop.period_s), k * substeps
    dq = dq_out[:rows]
    return Simulated(q_out[:rows], dq, np.diff(dq, axis=0, append=v[None]) / h, tau_out[:rows], reason)


def _lost(q: Array, q_ref: Array, bound: Array, t_s: float) -> str:
    j = int(np.argmin(np.abs(q - q_ref) < bound))
    return f"the simulated robot leaves its reference at joint {j + 1}, {t_s:.3f} s"


class _Control:
    """The control law, instant by instant: it carries the integral and the positions before."""

    def __init__(
        self, model: DirectModel, loop: Loop, q_ref: Array, dq_ref: Array, ddq_ref: Array, q: Array, v: Array
    ) -> None:
        self._model, self._loop, self._T = model, loop, loop.period_s
        self._q_ref, self._dq_ref, self._ddq_ref = q_ref, dq_ref, ddq_ref
        self._P, self._D = loop.Kp[:, None] * loop.R, loop.Kd[:, None] * loop.R
        self._ahead = q_ref @ self._P.T + loop.feedforward * (dq_ref @ self._D.T)
        self._to_joints = loop.R.T * loop.G
        if loop.gravity and not loop.computed_torque:
            self._ahead = self._ahead + self._motor_effort(model.gravity(q_ref).T).T
        self._plain = False
        self._limited, self._integrates = bool(np.isfinite(loop.saturation).any()), bool(loop.Ki.any())
        self._q1, self._q2 = q - self._T * v, q - 2 * self._T * v
        self._integral = np.zeros(len(loop.Kp))
        if self._integrates:
            # What a loop that has been running for a while holds: the robot at rest. Speeds and accelerations of a single
            # instant would bring their noise into it.
            held = self._motor_effort(model.gravity(q[None])[0])
            if loop.gravity:
                held = held - self._motor_effort(model.gravity(q_ref[:1])[0])
            held = np.clip(held, -loop.saturation, loop.saturation)
            self._integral = np.divide(held, loop.Ki, out=self._integral, where=loop.Ki > 0)

        simple = loop.velocity_estimate == "exact" and not loop.computed_torque
        if simple and not self._limited and not self._integrates:  # a linear law: straight to joint torques
            self._plain, B = True, self._to_joints
            self._ahead, self._P, self._D = self._ahead @ B.T, B @ self._P, B @ self._D

    def torque(self, k: int, q: Array, v: Array) -> Array:
        """Joint torques (n,) that the controller gives at its instant k."""
        loop, dq = self._loop, v
        if self._plain:
            return np.asarray(self._ahead[k] - self._P.dot(q) - self._D.dot(v))
        if loop.velocity_estimate == "backward_difference":
            dq = (q - self._q1) / self._T
        elif loop.velocity_estimate == "two_sample_mean":
            dq = (q - self._q2) / (2 * self._T)
        self._q2, self._q1 = self._q1, q
        u = self._ahead[k] - self._P.dot(q) - self._D.dot(dq)
        if self._integrates:
            x = loop.position_share * loop.R.dot(self._q_ref[k] - q)
            if loop.feedforward == 0.0:  # of a cascade it is the velocity error that is integrated
                x = x - loop.R.dot(dq)
            before, self._integral = self._integral, self._integral + x * self._T
            u = u + loop.Ki * self._integral
        if loop.computed_torque:
            ddq = self._ddq_ref[k] + np.linalg.solve(loop.R, u)
            tau = self._model.inverse(q, v, ddq, self._dq_ref[k])
            if not self._limited:
                return tau
            u = self._motor_effort(tau)
        if self._limited:
            limited = np.clip(u, -loop.saturation, loop.saturation)
            if self._integrates:
                self._integral = np.where(limited != u, before, self._integral)  # no wind-up
            u = limited
        return np.asarray(self._to_joints.dot(u))

    def _motor_effort(self, tau: Array) -> Array:
        """Motor efforts (n, ...) that give the joint torques (n, ...)."""
        return np.asarray(np.linalg.solve(self._to_joints, tau))


class Friction:
    """Implicit friction: solves (M + h V) dv = force - h (V v + Sᵀ f + offset), where f in each direction slips or sticks.

    A direction slips at its full Coulomb level, or sticks: then its friction grows linearly up to a creep speed `v_s`. The
    modes of the step before are tried first; a direction that would turn round sticks, one that exceeds v_s slips.
    """

    def __init__(self, model: DirectModel, dq_ref: Array, v: Array, h: float) -> None:
        self._model, self._h, self._S, self._ST = model, h, model.directions, model.directions.T.copy()
        self._v_s = STICTION * np.maximum(np.abs(dq_ref @ self._ST).max(axis=0, initial=0.0), 1e-9)
        self._resists = (model.up + model.down) > 0
        self._slope = np.where(self._resists, (model.up + model.down) / (2 * self._v_s), 0.0)
        self._one_sided = bool(model.viscous_up.any() or model.viscous_down.any())
        self._V, self._hV = model.viscous, h * model.viscous
        self._turn(np.sign(self._S @ v))

    def _turn(self, mode: Array) -> None:
        """Take up the modes (c,): +1 and -1 slip that way, 0 sticks."""
        model, h = self._model, self._h
        self._mode, self._stuck = mode, bool((mode == 0).any())
        stuck = mode == 0
        level = np.where(stuck, (model.up - model.down) / 2, np.where(mode > 0, model.up, -model.down))
        self._slipping = h * (level @ self._S + model.offset)
        self._creep = h * (self._ST * (self._slope * stuck)) @ self._S

    def step(self, M: Array, force: Array, v: Array) -> Array | None:
        """Speed (n,) after a step under the impulse `force`; None where no positive definite matrix is to be solved with."""
        if self._one_sided:
            self._V = self._model.viscous + self._model.viscous_up * (v > 0) + self._model.viscous_down * (v < 0)
            self._hV = self._h * self._V
        M, force = M + self._hV, force - self._hV.dot(v)
        for _ in range(MODE_PASSES):
            if self._stuck:
                _, dv, info = lapack.dposv(M + self._creep, force - self._slipping - self._creep.dot(v))
            else:
                _, dv, info = lapack.dposv(M, force - self._slipping)
            if info:
                return None
            w = v + dv
            after, mode = self._S.dot(w), self._mode
            if not self._stuck and min((mode * after).tolist(), default=1.0) > 0:
                break
            stuck = mode == 0
            found = np.where(stuck & (np.abs(after) > self._v_s), np.sign(after), mode)
            found = np.where(~stuck & (mode * after < 0), np.where(self._resists, 0.0, -mode), found)
            if (found == mode).all():
                break
            self._turn(found)
        return np.asarray(w)
