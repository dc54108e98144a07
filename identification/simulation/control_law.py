"""The control law of the simulated robot: the described controller, the one found in the
recording, or a surrogate.

Control acts on motor positions q_m = R q, once per controller period, and is held in
between (sample and hold):

    u = Kp (R (q_r - q)) + Kd (R (phi dq_r - dq)) + Ki integral(alpha R (q_r - q) - R dq (1 - phi)),
    tau = Rᵀ G u

| structure | Kp | Kd | phi | integral of |
|---|---|---|---|---|
| `pd` | position_gain | velocity_gain | 0 | - |
| `pd_velocity_feedforward` | position_gain | velocity_gain | 1 | - |
| `cascade_p_p` | position_gain · velocity_gain | velocity_gain | 0 | - |
| `cascade_p_pi` | position_gain · velocity_gain | velocity_gain | 0 | velocity error, Ki =
velocity_gain · integral_gain | | `pid` | position_gain | velocity_gain | 1 | position
error, Ki = integral_gain |
| `computed_torque` | position_gain | velocity_gain | 1 | -; u is a motor acceleration,
Kp in 1/s², Kd in 1/s |

| with `gravity_feedforward` | as above | as above | as above | as above; gravity of the model at
the measured q is added |

With a surrogate controller or reference, the model's gravity along the reference minus the known
torque is added: a real loop compensates gravity by an integral or a model, and a measured position
already contains the remaining sag.

Recorded feed-forward is added to u. Known torques act on the joints in addition
to those of the drives.

Computed torque gives tau = IDM(q, dq, ddq_r + R⁻¹ u). The saturation limits motor
efforts in every structure.
"""

from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np

from acquisition.robot import Robot

from ..arrays import Array
from ..errors import BadInputError
from ..model import DirectModel
from ..regression import described_gains

SURROGATE_DAMPING = 0.8


@dataclass(frozen=True, kw_only=True, eq=False)
class Encoder:
    """An imperfect encoder: `noise` (N, n) at the controller's instants and `step`, 0 for none, in
    rad or m at the joints.
    """

    noise: Array
    step: float

    def seen(self, q: Array, at: int | slice = slice(None)) -> Array:
        """Readings (N, n) of positions q, or (n,) of one instant."""
        q = q + self.noise[at]
        return np.asarray(np.rint(q / self.step) * self.step) if self.step else q


@dataclass(frozen=True, eq=False)
class Reference:
    """The inputs of a loop at its instants: the reference q, dq, ddq (N, n) and any further inputs.

    `known_torque` (N, n) acts on the joints, each held to the next instant; `feedforward` (N,
    n) is added to the controller's output, in its units; `encoder` gives the positions that
    the controller acts on.
    """

    q: Array
    dq: Array
    ddq: Array
    _: KW_ONLY
    known_torque: Array | None = None
    feedforward: Array | None = None
    encoder: Encoder | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlLaw:
    """A position loop in discrete time; gains (n,) per motor in recorded
    effort per motor rad (or m).
    """

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
    gravity: bool = False  # adds the model's gravity along the reference
    gravity_at_q: bool = False  # the same at the measured position

    def scaled(self, factor: Array) -> "ControlLaw":
        """The gain update: the loop for other inertias, with gains and
        saturation times `factor` (n,).

        Gains of computed torque act on accelerations and stay: the model in the
        loop has the new inertias.
        """
        gains = np.ones_like(factor) if self.computed_torque else factor
        Kp, Kd, Ki = (own * gains for own in (self.Kp, self.Kd, self.Ki))
        return replace(self, Kp=Kp, Kd=Kd, Ki=Ki, saturation=self.saturation * factor)

    def inertias(self, bandwidth_hz: float) -> Array:
        """Inertias J (n,) for which Kp gives the bandwidth w: w² J is the diagonal of Rᵀ G Kp R.

        Ones for computed torque, whose gains do not depend on inertias.
        """
        if self.computed_torque:
            return np.ones(len(self.Kp))
        return np.asarray(
            ((self.R**2).T @ (np.abs(self.G) * self.Kp)) / (2 * np.pi * bandwidth_hz) ** 2
        )


def recorded_loop(robot: Robot) -> ControlLaw | None:
    """The loop of the description's `[controller]`, None if it states none.

    Raises `BadInputError` naming missing keys.
    """
    c = robot.controller
    integrates = c.structure in ("cascade_p_pi", "pid")
    needed = [
        "structure",
        "sample_rate_hz",
        "position_gain",
        "velocity_gain",
        *["integral_gain"] * integrates,
    ]
    stated = {
        key: getattr(c, key) for key in (*needed, "integral_gain") if getattr(c, key) is not None
    }
    if not stated:
        return None
    if missing := [key for key in needed if key not in stated]:
        raise BadInputError(
            place=f"robot {robot.name}",
            key=f"controller: {', '.join(missing)}",
            value=None,
            expected=f"all of {', '.join(needed)}, or none of them (then a PD of bandwidth_hz "
            "is simulated)",
        )
    structure, gains = stated["structure"], described_gains(c)
    assert gains is not None
    Kp, Kd, Ki = gains
    cascade = structure.startswith("cascade")
    return ControlLaw(
        period_s=1.0 / stated["sample_rate_hz"],
        R=robot.R,
        G=robot.gain,
        Kp=Kp,
        Kd=Kd,
        Ki=Ki,
        position_share=np.array(stated["position_gain"]) if cascade else np.ones(robot.n),
        feedforward=0.0 if cascade or structure == "pd" else 1.0,
        saturation=np.array(
            [m.saturation if m.saturation is not None else np.inf for m in robot.motors]
        ),
        velocity_estimate=c.velocity_estimate or "backward_difference",
        computed_torque=structure == "computed_torque",
        gravity_at_q=c.gravity_feedforward,
    )


def surrogate_loop(bandwidth_hz: float, J: Array, rate_hz: float) -> ControlLaw:
    """A PD at the joints with velocity feed-forward and gravity: w_n = 2 pi bandwidth,
    zeta 0.8, inertias J (n,).
    """
    w, n = 2 * np.pi * bandwidth_hz, len(J)
    return ControlLaw(
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


class Control:
    """The control law with its state: the integral and the previous positions."""

    def __init__(self, model: DirectModel, loop: ControlLaw, q: Array, v: Array) -> None:
        """`q`, `v` (n,) are the initial position and speed."""
        self._model, self._loop, self._T = model, loop, loop.period_s
        self._to_joints = loop.R.T * loop.G
        self._limited, self._integrates = (
            bool(np.isfinite(loop.saturation).any()),
            bool(loop.Ki.any()),
        )
        self._q1, self._q2 = q - self._T * v, q - 2 * self._T * v
        self._start = q
        self._integral: Any = np.zeros(len(loop.Kp))  # of a lone joint a float
        self._integral_unset = self._integrates
        self._P, self._D = loop.Kp[:, None] * loop.R, loop.Kd[:, None] * loop.R

    def take(self, reference: Reference) -> None:
        """Set the reference, or its next span; instants are counted from its start."""
        loop, self._reference = self._loop, reference
        self._reference_part = reference.q @ self._P.T + loop.feedforward * (
            reference.dq @ self._D.T
        )
        if loop.gravity and not loop.computed_torque:
            self._reference_part = (
                self._reference_part + self._motor_effort(self._gravity(reference.q).T).T
            )
        self._added = reference.feedforward if loop.computed_torque else None
        if reference.feedforward is not None and not loop.computed_torque:
            self._reference_part = self._reference_part + reference.feedforward
        if self._integral_unset:
            self._integral, self._integral_unset = self._initial_integral(), False

    def _initial_integral(self) -> Array:
        """The initial integral: it balances gravity at rest."""
        # Speeds and accelerations of a single instant would add their noise.
        loop, reference = self._loop, self._reference
        held = self._motor_effort(self._gravity(self._start[None])[0])
        if loop.gravity_at_q:
            held = held - self._motor_effort(self._model.gravity(self._start[None])[0])
        elif loop.gravity:
            held = held - self._motor_effort(self._gravity(reference.q[:1])[0])
        if reference.feedforward is not None:
            held = held - reference.feedforward[0]
        held = np.clip(held, -loop.saturation, loop.saturation)
        return np.divide(held, loop.Ki, out=np.zeros_like(held), where=loop.Ki > 0)

    def torque(self, k: int, q: Any, v: Any) -> Any:
        """The controller's joint torques (n,) at its instant k, at which the encoder
        reads the positions q.
        """
        if self._reference.encoder is not None:
            q = self._reference.encoder.seen(q, k)
        loop, dq = self._loop, v
        if loop.velocity_estimate == "backward_difference":
            dq = (q - self._q1) / self._T
        elif loop.velocity_estimate == "two_sample_mean":
            dq = (q - self._q2) / (2 * self._T)
        self._q2, self._q1 = self._q1, q
        u = self._reference_part[k] - self._P.dot(q) - self._D.dot(dq)
        if loop.gravity_at_q:
            u = u + self._motor_effort(self._model.gravity(q[None])[0])
        if self._integrates:
            x = loop.position_share * loop.R.dot(self._reference.q[k] - q)
            if loop.feedforward == 0.0:  # a cascade integrates the velocity error
                x = x - loop.R.dot(dq)
            before, self._integral = self._integral, self._integral + x * self._T
            u = u + loop.Ki * self._integral
        if loop.computed_torque:
            ddq = self._reference.ddq[k] + np.linalg.solve(loop.R, u)
            tau = self._model.torque(q[None], v[None], ddq[None], self._reference.dq[k : k + 1])[0]
            if not self._limited and self._added is None:
                return np.asarray(tau)
            u = self._motor_effort(tau)
            if self._added is not None:
                u = u + self._added[k]
        if self._limited:
            # np.clip takes three times as long
            limited = np.minimum(np.maximum(u, -loop.saturation), loop.saturation)
            if self._integrates:
                self._integral = np.where(limited != u, before, self._integral)  # no wind-up
            u = limited
        return np.asarray(self._to_joints.dot(u))

    def _gravity(self, q: Array) -> Array:
        """Drive torques (N, n) that hold the robot at positions q (N, n)
        at the first N instants.
        """
        known = self._reference.known_torque
        gravity = self._model.gravity(q)
        return gravity if known is None else gravity - known[: len(q)]

    def _motor_effort(self, tau: Array) -> Array:
        """Motor efforts (n, ...) that give the joint torques (n, ...)."""
        return np.asarray(np.linalg.solve(self._to_joints, tau))


class LoneControl(Control):
    """`Control` of a lone joint in Python floats; not of computed torque."""

    def __init__(self, model: DirectModel, loop: ControlLaw, q: Array, v: Array) -> None:
        """See `Control`."""
        super().__init__(model, loop, q, v)
        self._lone_P, self._lone_D, self._lone_G = (
            x.item() for x in (self._P, self._D, self._to_joints)
        )
        self._lone_R, self._Ki, self._share = (
            loop.R.item(),
            loop.Ki.item(),
            loop.position_share.item(),
        )
        self._limit, self._offset, self._bias = (
            loop.saturation.item(),
            model.offset.item(),
            model.lone_bias(),
        )
        samples = {"exact": 0, "backward_difference": 1, "two_sample_mean": 2}[
            loop.velocity_estimate
        ]
        self._before, self._lag_s = [self._q1.item(), self._q2.item()][:samples], samples * self._T

    def take(self, reference: Reference) -> None:
        """See `Control`."""
        super().take(reference)
        self._feed, self._target = self._reference_part[:, 0].tolist(), reference.q[:, 0].tolist()
        self._integral = np.asarray(self._integral).item()

    def torque(self, k: int, q: Any, v: Any) -> Any:
        """See `Control`."""
        loop, dq = self._loop, v
        if self._reference.encoder is not None:
            q = self._reference.encoder.seen(q, k).item()
        if self._before:
            dq = (q - self._before.pop()) / self._lag_s
            self._before.insert(0, q)
        u = self._feed[k] - self._lone_P * q - self._lone_D * dq
        if loop.gravity_at_q:
            u += (self._bias(q) + self._offset) / self._lone_G
        if self._integrates:
            x = self._share * (self._lone_R * (self._target[k] - q))
            if loop.feedforward == 0.0:
                x -= self._lone_R * dq
            before, self._integral = self._integral, self._integral + x * self._T
            u += self._Ki * self._integral
        if self._limited:
            limited = min(max(u, -self._limit), self._limit)
            if self._integrates and limited != u:
                self._integral = before
            u = limited
        return self._lone_G * u
