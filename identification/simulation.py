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
| `computed_torque` | position_gain | velocity_gain | 1 | -; the law gives an acceleration, the model the torque |
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from acquisition.robot import Controller, Robot

from . import IdentificationError
from .dynamics import DirectModel

Vector = NDArray[np.float64]

STICTION = 1e-3  # of a direction's speed scale: Coulomb friction builds up linearly below this speed
MODE_PASSES = 8  # of the search for which directions stick; nearly always one or two are needed
_LOOK_EVERY = 64  # steps between looks at whether the simulation still follows


@dataclass(frozen=True, kw_only=True, eq=False)
class Loop:
    """A position loop in discrete time; gains (n,) per motor in recorded effort per motor rad (or m)."""

    period_s: float
    R: Vector
    G: Vector
    Kp: Vector
    Kd: Vector
    Ki: Vector
    position_share: Vector  # alpha: how the position error enters the integral
    feedforward: float  # phi
    saturation: Vector
    velocity_estimate: str
    computed_torque: bool

    def scaled(self, factor: Vector) -> "Loop":
        """The same loop for other inertias: all gains and the saturation times `factor` (n,), the gain update."""
        if self.computed_torque:
            return self
        return replace(
            self,
            Kp=self.Kp * factor,
            Kd=self.Kd * factor,
            Ki=self.Ki * factor,
            saturation=self.saturation * factor,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulated:
    """A simulated motion: q, dq, ddq, tau (N, n), each row of one instant, tau held from there on; `reason` if it failed."""

    q: Vector
    dq: Vector
    ddq: Vector
    tau: Vector
    saturated: int
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
        velocity_estimate=c.velocity_estimate,
        computed_torque=c.structure == "computed_torque",
    )


def has_controller(controller: Controller) -> bool:
    """Whether a description states a control law, if only in part."""
    keys = ("structure", "position_gain", "velocity_gain", "integral_gain")
    return any(getattr(controller, key) is not None for key in keys)


SURROGATE_DAMPING = 0.8


def surrogate_loop(bandwidth_hz: float, J: Vector, rate_hz: float) -> Loop:
    """A PD at the joints with velocity feed-forward: w_n = 2 pi bandwidth, zeta 0.8, for the inertias J (n,)."""
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
    )


def simulate(
    model: DirectModel, loop: Loop, q_ref: Vector, dq_ref: Vector, ddq_ref: Vector, *, bound: Vector, substeps: int = 1
) -> Simulated:
    """Follow a reference (N, n) given once per controller period, from rest on the reference.

    The smooth part of the model is stepped explicitly; viscous and Coulomb friction implicitly, Coulomb friction with its
    stick phases, so that light joints do not chatter: within a step it is found which directions stick (a semi-smooth
    Newton iteration). Stops with a `reason` where the position leaves the reference by more than `bound` (n,) or the
    inertia matrix is not positive. The state is never clipped.
    """
    N, n = q_ref.shape
    h = loop.period_s / substeps
    q_out, dq_out, ddq_out, tau_out = np.empty((4, N, n))
    q, v = q_ref[0].copy(), dq_ref[0].copy()
    R, RG = loop.R, loop.R.T * loop.G
    S, up, down = model.directions, model.up, model.down
    v_s = STICTION * np.maximum(np.abs(dq_ref @ S.T).max(axis=0), 1e-9)
    resists = up + down > 0
    middle, slope = (up - down) / 2, np.where(resists, (up + down) / (2 * v_s), 0.0)
    mode = np.sign(S @ v)  # +1, -1: slips that way, 0: sticks
    one_sided = bool(model.viscous_up.any() or model.viscous_down.any())
    V = model.viscous
    limited, integral, saturated = bool(np.isfinite(loop.saturation).any()), np.zeros(n), 0
    integrates = bool(loop.Ki.any())
    estimate = loop.velocity_estimate
    q1, q2 = q - v * loop.period_s, q - 2 * v * loop.period_s
    for k in range(N):
        dq_est = v if estimate == "exact" else (q - q1) / loop.period_s
        if estimate == "two_sample_mean":
            dq_est = (q - q2) / (2 * loop.period_s)
        error, speed = R @ (q_ref[k] - q), R @ (loop.feedforward * dq_ref[k] - dq_est)
        u = loop.Kp * error + loop.Kd * speed
        if integrates:
            x = loop.position_share * error + (speed if loop.feedforward == 0.0 else 0.0)
            u = u + loop.Ki * (integral + x * loop.period_s)
        if limited:
            free, u = u, np.clip(u, -loop.saturation, loop.saturation)
            if (u != free).any():
                saturated += 1
        if integrates and (not limited or (u == free).all()):  # no wind-up while saturated
            integral = integral + x * loop.period_s
        q2, q1 = q1, q
        if loop.computed_torque:
            M, bias = model.inertia_and_bias(q, v)
            M = np.triu(M) + np.triu(M, 1).T
            tau = M @ (ddq_ref[k] + u) + bias + model.offset + V @ v
            tau = tau + S.T @ (up * (dq_ref[k] @ S.T > 0) - down * (dq_ref[k] @ S.T < 0))
        else:
            tau = RG @ u
        for sub in range(substeps):
            M, bias = model.inertia_and_bias(q, v)
            if one_sided:
                V = model.viscous + model.viscous_up * (v > 0) + model.viscous_down * (v < 0)
            A = M + h * V
            force = h * (tau - bias - model.offset - V @ v)
            slip = S @ v
            for _ in range(MODE_PASSES):
                stuck = mode == 0
                level = np.where(mode > 0, up, -down)
                if stuck.any():
                    level = np.where(stuck, middle + slope * slip, level)
                    B = A + h * (S.T * (slope * stuck)) @ S
                else:
                    B = A
                _, dv, info = lapack.dposv(B, force - h * (level @ S))
                if info:
                    return _stopped(
                        q_out, dq_out, ddq_out, tau_out, k, saturated, "the inertia matrix is not positive definite"
                    )
                after = slip + S @ dv
                found = np.where(stuck, np.where(np.abs(after) > v_s, np.sign(after), 0.0), mode)
                found = np.where(~stuck & (mode * after < 0) & resists, 0.0, found)
                if (found == mode).all():
                    break
                mode = found
            if sub == 0:
                q_out[k], dq_out[k], ddq_out[k], tau_out[k] = q, v, dv / h, tau
            q, v = q + h * v + 0.5 * h * dv, v + dv
        if k % _LOOK_EVERY == 0 and not (np.abs(q - q_ref[k]) < bound).all():
            j = int(np.argmin(np.abs(q - q_ref[k]) < bound))
            reason = f"the simulated robot leaves its reference at joint {j + 1}, {k * loop.period_s:.3f} s"
            return _stopped(q_out, dq_out, ddq_out, tau_out, k, saturated, reason)
    return Simulated(q=q_out, dq=dq_out, ddq=ddq_out, tau=tau_out, saturated=saturated, reason=None)


def _stopped(q: Vector, dq: Vector, ddq: Vector, tau: Vector, k: int, saturated: int, reason: str) -> Simulated:
    return Simulated(q=q[:k], dq=dq[:k], ddq=ddq[:k], tau=tau[:k], saturated=saturated, reason=reason)
