"""The control law: given in robot.toml, estimated from the recording, or a default PD controller.

It acts on motor positions q_m = R q once per period of the loop, and holds its output in between
(sample and hold):

    u = Kp (R (q_r - q)) + Kd (R (phi dq_r - dq)) + Ki integral(alpha R (q_r - q) - R dq (1 - phi)),
    tau = R' G u

| structure | Kp | Kd | phi | Ki, integral of |
|---|---|---|---|---|
| `pd` | p | v | 0 | - |
| `pd_velocity_feedforward` | p | v | 1 | - |
| `cascade_p_p` | p v | v | 0 | - |
| `cascade_p_pi` | p v | v | 0 | v i, velocity error, alpha = p |
| `pid` | p | v | 1 | i, position error, alpha = 1 |
| `computed_torque` | p | v | 1 | - |

p, v, i are the keys `position_gain`, `velocity_gain`, `integral_gain`. With computed torque u is a
motor acceleration, p in 1/s², v in 1/s, and tau = IDM(q, dq, ddq_r + R⁻¹ u). With
`gravity_feedforward` the model's gravity at the measured q is added to u, as motor efforts.

The period is that of the controller. If the instruments of a fit have a control law that runs at
200 times the bandwidth or faster, a simulated period has several instants of the controller. It is
as long as the fastest speed loop allows, but at most a hundredth of a period of the bandwidth
(`ControlLaw.slower`).

With a default controller, or without a recorded reference, the model's gravity along the reference
minus the external torque is added: a real loop compensates gravity by an integral or a model, and a
measured position already contains the remaining sag.

Recorded feed-forward is added to u. External torques act on the joints in addition to those of the
drives. The saturation limits motor efforts in every structure.
"""

import operator
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from acquisition.robot import Controller, Robot

from ..arrays import Array
from ..errors import BadInputError
from ..model import DirectModel

ControllerKind = Literal["described", "found", "surrogate"]
# Structures with an integral, and structures whose position gain acts on a speed loop.
INTEGRATING, CASCADES = ("cascade_p_pi", "pid"), ("cascade_p_p", "cascade_p_pi")
# Delay of each estimate of the speed, in controller periods.
SPEED_DELAYS = {"exact": 0.0, "backward_difference": 0.5, "two_sample_mean": 1.0}
SURROGATE_DAMPING = 0.8
MAX_DECAY = 0.6  # of a speed in a step, by the fastest speed loop; 1 or more would overshoot


class Numbers(NamedTuple):
    """Operations that a step needs beside sums and products, of vectors (n,) and matrices (n, n).

    A single joint uses Python's floats instead, which take a fifth of the time.
    """

    own: Callable[[Array], Any]  # an array as such a number
    each: Callable[[Array], Any]  # rows (N, n) as a sequence of such numbers
    dot: Callable[[Any, Any], Any]
    reverses: Callable[[Any, Any], bool]  # True if any of A x is negative
    within: Callable[[Any, Any], Any]  # a vector, limited on both sides


ARRAYS = Numbers(
    own=np.asarray,
    each=np.asarray,
    dot=np.ndarray.dot,
    reverses=lambda A, x: min(A.dot(x).tolist(), default=0.0) < 0.0,
    # np.clip takes three times as long
    within=lambda x, limit: np.minimum(np.maximum(x, -limit), limit),
)
FLOATS = Numbers(
    own=lambda x: x.sum().item(),  # without a direction of friction zero
    each=lambda x: x[:, 0].tolist(),
    dot=operator.mul,
    reverses=lambda a, x: a * x < 0.0,
    within=lambda x, limit: min(max(x, -limit), limit),
)


@dataclass(frozen=True, eq=False)
class Reference:
    """The inputs of a loop at its instants.

    Attributes:
        q, dq, ddq: (N, n) reference, rad or m, per s, per s².
        known_torque: (N, n) external torque on the joints, each held to the next instant, N m or N;
            None for none.
        feedforward: (N, n) added to the controller's output, in its units; None for none.
        seen: function that returns the position that an imperfect encoder shows, of the true one
            (n,) at an instant; None for a perfect encoder.
    """

    q: Array
    dq: Array
    ddq: Array
    _: KW_ONLY
    known_torque: Array | None = None
    feedforward: Array | None = None
    seen: Callable[[Array, int], Array] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlLaw:
    """A position loop in discrete time, with gains (n,) in recorded effort per motor rad (or m).

    Attributes:
        kind: `described` in robot.toml, `found` in a recording, or `surrogate`, a default PD
            controller.
        structure: structure as in `[controller]`.
        period_s: period of a step, s.
        R: (n, n) motor matrix, q_m = R q.
        G: (n,) drive gains, tau = R' G u.
        Kp, Kd, Ki: (n,) gains of the control law.
        position_share: (n,) alpha, the factor of the position error in the integral.
        saturation: (n,) limits of the motor efforts.
        velocity_estimate: the controller's estimate of the speed.
        gravity: where the model's gravity is added: along the reference, at the measured position,
            or not at all.
        periods: number of controller periods in `period_s`.
    """

    kind: ControllerKind
    structure: str
    period_s: float
    R: Array
    G: Array
    Kp: Array
    Kd: Array
    Ki: Array
    position_share: Array
    saturation: Array
    velocity_estimate: str
    gravity: Literal["none", "reference", "measured"] = "none"
    periods: int = 1

    @property
    def feedforward(self) -> float:
        """Share phi of the reference's speed."""
        return 0.0 if self.structure in ("pd", *CASCADES) else 1.0

    @property
    def computed_torque(self) -> bool:
        """True if the loop has a model, and gains that act on accelerations."""
        return self.structure == "computed_torque"

    @property
    def keys(self) -> dict[str, Any]:
        """Keys of `[controller]` that describe it, as `described_law` reads them."""
        by = self.Kd if self.structure in CASCADES else np.ones(len(self.Kd))
        return {
            "structure": self.structure,
            "sample_rate_hz": 1 / self.period_s,
            "position_gain": (self.Kp / by).tolist(),
            "velocity_gain": self.Kd.tolist(),
            **({"integral_gain": (self.Ki / by).tolist()} if self.integrates else {}),
            "velocity_estimate": self.velocity_estimate,
        }

    @property
    def integrates(self) -> bool:
        """True if its structure has an integral."""
        return self.structure in INTEGRATING

    @property
    def middle(self) -> float:
        """Middle of the controller's instants in a step, in steps from its beginning."""
        return 0.5 * (self.periods - 1) / self.periods

    def slower(self, M: Array, rate_hz: float) -> "ControlLaw":
        """Return the loop with every m-th of its instants, at a rate of at least `rate_hz`.

        Steps of a simulation cost the same at any rate. u of the m instants in a step is that of
        their middle, to first order, with the delay of the controller's speed estimate. That holds
        while a step is short compared with the fastest speed loop, the largest eigenvalue of M⁻¹ R'
        G Kd R (`MAX_DECAY`); M (P, n, n) are inertia matrices of the robot. Computed torque keeps
        its instants.
        """
        if self.computed_torque:
            return self
        loops = np.linalg.solve(M, (self.R.T * self.G * self.Kd) @ self.R)
        slowest_hz = max(rate_hz, float(np.abs(np.linalg.eigvals(loops)).max()) / MAX_DECAY)
        m = max(1, int(1 / (slowest_hz * self.period_s) + 1e-9))
        return replace(self, period_s=m * self.period_s, periods=m)

    def scaled(self, factor: Array) -> "ControlLaw":
        """Apply the gain update (E): return the loop with gains and saturation times `factor` (n,).

        Gains of computed torque act on accelerations and stay, because the model in the loop has
        the new inertias.
        """
        gains = np.ones_like(factor) if self.computed_torque else factor
        return replace(
            self,
            Kp=gains * self.Kp,
            Kd=gains * self.Kd,
            Ki=gains * self.Ki,
            saturation=factor * self.saturation,
        )

    def inertias(self, bandwidth_hz: float) -> Array:
        """Return inertias J (n,) for which Kp gives the bandwidth w: diag(R' G Kp R) = w² J.

        They are ones for computed torque, whose gains do not depend on inertias.
        """
        if self.computed_torque:
            return np.ones(len(self.Kp))
        return np.asarray(
            ((self.R**2).T @ (np.abs(self.G) * self.Kp)) / (2 * np.pi * bandwidth_hz) ** 2
        )


def described_gains(controller: Controller) -> Array | None:
    """Return Kp, Kd, Ki (3, n) of the given control law; None if it is incomplete."""
    given = [
        controller.position_gain,
        controller.velocity_gain,
        *[controller.integral_gain] * (controller.structure in INTEGRATING),
    ]
    if controller.structure is None or None in given:
        return None
    kp, kd, *ki = map(np.array, given)
    cascade = kd if controller.structure in CASCADES else 1.0
    return np.array([kp * cascade, kd, ki[0] * cascade if ki else 0.0 * kp])


def described_law(robot: Robot) -> ControlLaw | None:
    """Return the control law of `[controller]` in the description; None if it gives none.

    Raises
    ------
    BadInputError : keys are missing; the text names them.
    """
    c, needed = robot.controller, ["structure", "sample_rate_hz", "position_gain", "velocity_gain"]
    gains = described_gains(c)
    if gains is None or c.sample_rate_hz is None:
        if all(getattr(c, key) is None for key in (*needed, "integral_gain")):
            return None
        needed += ["integral_gain"] * (c.structure in INTEGRATING)
        missing = [key for key in needed if getattr(c, key) is None]
        raise BadInputError(
            place=f"robot {robot.name}",
            key=f"controller: {', '.join(missing)}",
            value=None,
            advice=f"Give all of {', '.join(needed)}, or none to simulate a default PD controller",
        )
    return ControlLaw(
        kind="described",
        structure=str(c.structure),
        period_s=1.0 / c.sample_rate_hz,
        R=robot.R,
        G=robot.gain,
        Kp=gains[0],
        Kd=gains[1],
        Ki=gains[2],
        position_share=np.array(c.position_gain) if c.structure in CASCADES else np.ones(robot.n),
        saturation=robot.saturation,
        velocity_estimate=c.velocity_estimate or "backward_difference",
        gravity="measured" if c.gravity_feedforward else "none",
    )


def default_law(bandwidth_hz: float, J: Array, rate_hz: float) -> ControlLaw:
    """Return a default PD controller at the joints, with velocity feed-forward and gravity.

        Kp = J w²,     Kd = 2 zeta w J,     w = 2 pi bandwidth,     zeta = 0.8

    Parameters
    ----------
    bandwidth_hz : bandwidth of the position loop, Hz.
    J : (n,) inertias of the joints, kg m² or kg.
    rate_hz : rate at which it acts, Hz.
    """
    w, n = 2 * np.pi * bandwidth_hz, len(J)
    return ControlLaw(
        kind="surrogate",
        structure="pd_velocity_feedforward",
        period_s=1.0 / rate_hz,
        R=np.eye(n),
        G=np.ones(n),
        Kp=J * w**2,
        Kd=2 * SURROGATE_DAMPING * w * J,
        Ki=np.zeros(n),
        position_share=np.ones(n),
        saturation=np.full(n, np.inf),
        velocity_estimate="exact",
        gravity="reference",
    )


class Control:
    """The control law with its state: the integral and the previous positions."""

    def __init__(
        self, model: DirectModel, loop: ControlLaw, q: Array, v: Array, numbers: Numbers = ARRAYS
    ) -> None:
        """Begin at the position `q` and speed `v`, (n,); later ones are of the kind `numbers`."""
        self._model, self._loop, self._T, self._start = model, loop, loop.period_s, q[None]
        self._numbers, own, to_joints = numbers, numbers.own, loop.R.T * loop.G
        self._to_motors, self._R_inverse = np.linalg.inv(to_joints), np.linalg.inv(loop.R)
        self._to_joints, self._limit = own(to_joints), own(loop.saturation)
        self._limited, self._integrates = (
            bool((loop.saturation < np.inf).any()),
            bool(loop.Ki.any()),
        )
        self._computed, by_speed = loop.computed_torque, loop.feedforward == 0.0
        self._of_speed, self._at_q = by_speed, loop.gravity == "measured"
        # Factors of position and speed in u, and in the increase of its integral in a period. A
        # cascade integrates the speed error.
        summed = self._T * loop.Ki
        gains = loop.Kp, loop.Kd, summed * loop.position_share, summed * by_speed
        self._P, self._D, self._I, self._J = (own(gain[:, None] * loop.R) for gain in gains)
        self._integral: Any = None
        # The speed is estimated from the position twice as many periods ago.
        delay = SPEED_DELAYS[loop.velocity_estimate]
        self._before = [own(q - (k + 1) * self._T * v) for k in range(round(2 * delay))]
        self._v1, self._lead = own(v), loop.middle - delay / loop.periods
        self._ahead_s, self._summed = loop.middle * self._T, 1.0 - loop.middle
        self._late_s = 2 * delay * self._T

    def take(self, reference: Reference) -> None:
        """Set the reference, or its next part; instants are counted from its start."""
        loop, self._reference, each = self._loop, reference, self._numbers.each
        fed = 0.0 * reference.q if reference.feedforward is None else reference.feedforward
        held = self._held(reference.q) if loop.gravity == "reference" else 0.0 * fed
        r, speed = (x @ loop.R.T for x in (reference.q, loop.feedforward * reference.dq))
        u, x = loop.Kp * r + loop.Kd * speed, self._T * loop.Ki * loop.position_share * r
        self._u = each(u if self._computed else u + held + fed)
        self._x, self._fed = each(x), fed
        if self._integral is None:
            # The integral begins with the effort that balances gravity at rest: speed and
            # acceleration of a single instant would add their noise.
            known = self._model.gravity(self._start) @ self._to_motors.T if self._at_q else held[0]
            need = np.clip(
                self._held(self._start) - known - fed[0], -loop.saturation, loop.saturation
            )
            self._integral = self._numbers.own(np.where(loop.Ki > 0, need[0], 0.0))

    def torque(self, k: int, q: Any, v: Any) -> Any:
        """Return the controller's joint torques (n,) at its instant k, at the positions q (n,)."""
        loop, dot, dq, x = self._loop, self._numbers.dot, v, 0.0
        if self._reference.seen is not None:
            q = self._numbers.own(self._reference.seen(q, k))
        if loop.periods > 1:
            q, dq, self._v1 = q + self._ahead_s * v, v + self._lead * (v - self._v1), v
        elif before := self._before:
            dq = (q - before.pop()) / self._late_s
            before.insert(0, q)
        u = self._u[k] - dot(self._P, q) - dot(self._D, dq)
        if self._at_q:
            u = u + self._numbers.own(
                self._to_motors.dot(self._model.gravity(np.reshape(q, (1, -1)))[0])
            )
        if self._integrates:
            x = self._x[k] - dot(self._I, q)
            if self._of_speed:
                x = x - dot(self._J, dq)
            u = u + (self._integral + self._summed * x)
        if self._computed:
            ddq = self._reference.ddq[k] + self._R_inverse.dot(u)
            tau = self._model.torque(q[None], v[None], ddq[None], self._reference.dq[k : k + 1])[0]
            u = self._to_motors.dot(tau) + self._fed[k]
        if self._limited:
            wanted, u = u, self._numbers.within(u, self._limit)
            x = x * (u == wanted)  # no wind-up
        if self._integrates:
            self._integral = self._integral + x
        return dot(self._to_joints, u)

    def _held(self, q: Array) -> Array:
        """Return motor efforts (N, n) that hold the robot at the positions q (N, n).

        They balance gravity and the external torque of the first N instants.
        """
        known, gravity = self._reference.known_torque, self._model.gravity(q)
        return (gravity if known is None else gravity - known[: len(q)]) @ self._to_motors.T
