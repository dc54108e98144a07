"""The control law of the drives from what was recorded: the effort u of each motor, its
reference r and its position q.

    u(t + L) = Kp (r(t - d) - q(t)) + Kd (phi dr(t - d) - v(t)) + Ki integral(...) + offset

The law is linear and acts on the measured position, whose noise is thus no error in the
variables: least squares is right, whatever the robot. r, q and u pass one low-pass, which
commutes with derivatives, integrals and delays; the delay d of the reference and the lag L of the
effort are found by Gauss-Newton steps beside the gains. The speed v is dq, or dq half a period or
a period ago, by the controller's estimate. The data determine only d + L: the estimate with the
smallest d and L is taken. A controller's integral is a sum of rectangles: that of the path and
half a period of its integrand.
"""

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace as replace_keys

from acquisition.robot import Controller, Robot

from ..arrays import Array, Bools
from ..errors import NoFitError
from ..estimation import System, intervals_of, ordinary_least_squares
from .motor_paths import MAX_RESIDUAL_PERCENT, Found, MotorPaths, motor_paths, scaled_solution

if TYPE_CHECKING:
    from .problem import Problem

# Columns of u: the error e, its rate f = w - v, speeds v measured and w of the reference, the
# error's integral i, position q.
STRUCTURES = {"pd": "ev", "pd_velocity_feedforward": "ef", "pid": "efi", "cascade_p_pi": "eviq"}
# of no structure
RIVALS = {"speed fed forward in part": "evw", "an integral without it": "evi", "both": "evwi"}
LAWS = STRUCTURES | RIVALS
# Of estimates, in controller's periods.
SPEED_DELAYS = {"exact": 0.0, "backward_difference": 0.5, "two_sample_mean": 1.0}
LEAST_RESIDUAL_PERCENT = 0.1  # of the effort's variation; below, all are equal
MIN_RATIO = 1.5  # of residuals, for one structure to be better than another
MIN_ROWS = 60
# samples: no instant of a record is known better; those of the real EMPS are off by 0.006
LEAST_LAG_SD = 4e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Law:
    """The control law of each motor by one structure; gains in recorded
    effort per motor rad (or m).

    Attributes:
        structure: as of `[controller]`, the described one if there is one; `pd`
            also for `cascade_p_p`.
        reason: why no law is found; None if one is.
        rival: the structure that fits better than the described one; None for none.
        velocity_estimate, period_s: of the controller; `used`: (3,) the gains that it has.
        gains, gains_half: (3, n) Kp, Kd, Ki of the law above, and half-widths
            of their 95 % intervals.
        delay_s, delay_half_s: (n,) of the reference. `lag_s`, `lag_sd_s`: (n,) of the effort
            behind the law's instant.
        residual_percent: (n,) of the effort's variation.
        clear: (n,) motors that determine the structure by themselves.
        described: (3, n) the described gains; None without. `lag_s` and `lag_sd_s` are then
            those with these gains.
    """

    structure: str
    reason: str | None
    rival: str | None
    velocity_estimate: str
    period_s: float
    used: Bools
    gains: Array
    gains_half: Array
    delay_s: Array
    delay_half_s: Array
    lag_s: Array
    lag_sd_s: Array
    residual_percent: Array
    clear: Bools
    described: Array | None

    def controller(self, described: Controller) -> Controller:
        """`[controller]` with this law, which is found."""
        Kp, Kd, Ki = self.gains
        kp, ki = (Kp / Kd, Ki / Kd) if self.structure.startswith("cascade") else (Kp, Ki)
        return replace_keys(
            described,
            structure=self.structure,
            sample_rate_hz=1 / self.period_s,
            position_gain=tuple(kp.tolist()),
            velocity_gain=tuple(Kd.tolist()),
            integral_gain=tuple(ki.tolist()) if self.used[2] else None,
            velocity_estimate=self.velocity_estimate,
        )

    @property
    def common_delay_s(self) -> float:
        """The delay of the reference, the median of the motors, s; 0 if it may be 0,
        or the law does not fit.
        """
        delay_s, half_s = float(np.median(self.delay_s)), float(np.median(self.delay_half_s))
        fits = (self.residual_percent <= MAX_RESIDUAL_PERCENT).all()
        return delay_s if fits and abs(delay_s) > half_s else 0.0


def law_of(problem: "Problem") -> Law | None:
    """The control law found in the recording, by the described structure if there is one.

    None without a reference, or where the described law is not linear. A law is found if every
    motor's residual is small and its gains are positive, and if the structure is clearly better at
    some motor than all that it is no part of, while none that contains it is.
    """
    signals, controller = problem.signals, problem.signals.robot.controller
    if signals.q_ref is None or controller.structure == "computed_torque":
        return None
    period_s = 1 / (controller.sample_rate_hz or signals.sample_rate_hz)
    # Of a controller that is not described the period is anything up to that of the samples.
    unknown_s = 0.0 if controller.sample_rate_hz else 0.25 * period_s
    known = problem.settings.known_lag
    known = replace(known, value_s=known.value_s + 0.5 * period_s)
    with suppress(NoFitError):  # too few samples to filter
        motors = motor_paths(problem, known, period_s - 2 * unknown_s)
        if min(len(motor.u) for motor in motors) >= MIN_ROWS:
            return _told(signals.robot, motors, period_s, unknown_s)
    return None


def _told(robot: Robot, motors: list[MotorPaths], period_s: float, unknown_s: float) -> Law:
    controller, stated = robot.controller, described_gains(robot.controller)

    @cache
    def solved(letters: str, estimate: str) -> list[Found]:
        late_s, k = SPEED_DELAYS[estimate] * period_s, list(SPEED_DELAYS).index(estimate)
        near = solved(letters, list(SPEED_DELAYS)[k - 1]) if k else [None] * len(motors)
        return [one.solve(letters, late_s, found) for one, found in zip(motors, near, strict=True)]

    percent = dict[str, Array]()
    for name, letters in LAWS.items():
        # without the reference's speed a delay of the measured one is one of it and a lag
        estimates = SPEED_DELAYS if {"f", "w"} & set(letters) else ("exact",)
        percent[name] = np.min([_percents(solved(letters, one)) for one in estimates], axis=0)
    valid = {name: percent[name] <= MAX_RESIDUAL_PERCENT for name in LAWS}
    for name, letters in STRUCTURES.items():
        valid[name] &= [(x[: len(letters)] > 0).all() for _, x in solved(letters, "exact")]
    clear = {name: valid[name] & _is_clear(name, percent) for name in LAWS}
    best = max(
        LAWS, key=lambda name: (clear[name].sum(), valid[name].sum(), -float(percent[name].max()))
    )
    name = controller.structure or (best if best in STRUCTURES else "pd")
    name = "pd" if name == "cascade_p_p" else name
    ways = {one: solved(STRUCTURES[name], one) for one in SPEED_DELAYS}
    estimate = _estimate(ways, motors[0], controller.velocity_estimate)
    late_s = SPEED_DELAYS[estimate] * period_s
    known = [None] * len(motors) if stated is None else stated.T
    # a step further: the search ends once steps are small
    near = zip(motors, ways[estimate], strict=True)
    found = [motor.solve(STRUCTURES[name], late_s, one) for motor, one in near]
    each = [
        _values(motor, x, gains, name, late_s)
        for motor, (_, x), gains in zip(motors, found, known, strict=True)
    ]
    gains, half, times = np.split(np.array(each).T, [3, 6])
    half[0] = np.hypot(half[0], unknown_s * gains[2])
    reason, used = None, np.array([True, True, "i" in STRUCTURES[name]])
    if not valid[name].all():
        reason = f"no linear law fits motor {robot.motors[int(valid[name].argmin())].name}"
    elif best != name:
        reason = f"{best} fits better"
    elif not clear[name].any():
        reason = "several laws fit alike"
    elif not (gains[used] > 0).all():
        # by the speed that is taken, and determined at all
        reason = f"gains of {name} are undetermined, or not positive"
    return Law(
        structure=name,
        reason=reason,
        rival=best if best != name and clear[best].any() else None,
        velocity_estimate=estimate,
        period_s=period_s,
        used=used,
        gains=gains,
        gains_half=half,
        delay_s=times[0],
        delay_half_s=times[1],
        lag_s=times[2],
        lag_sd_s=times[3],
        residual_percent=_percents(found),
        clear=clear[name],
        described=stated,
    )


def _estimate(tried: dict[str, list[Found]], motor: MotorPaths, described: str | None) -> str:
    """The controller's estimate of the speed: the described one unless another fits better, else of
    those that fit alike the one with the smallest delay and lag.
    """
    left = {one: _floored(_percents(found)) for one, found in tried.items()}
    least = np.min(list(left.values()), axis=0)
    alike = [one for one in tried if (left[one] < MIN_RATIO * least).all()]
    alike = alike or [min(left, key=lambda one: float(left[one].sum()))]
    if described in alike:
        return described
    known, within_s = motor.known, math.hypot(motor.known.sd_s, 0.25 / motor.rate_hz)
    return min(
        alike,
        key=lambda one: sum(
            (motor.rate_hz * d) ** 2 + ((L - known.value_s) / within_s) ** 2
            for *_, d, L in (x for _, x in tried[one])
        ),
    )


def _percents(found: list[Found]) -> Array:
    return np.array([percent for percent, _ in found])


def described_gains(controller: Controller) -> Array | None:
    """Kp, Kd, Ki (3, n) of the described law u = Kp e + ...; None where it
    is not described whole.
    """
    integrates = controller.structure in ("cascade_p_pi", "pid")
    keys = ["position_gain", "velocity_gain", *["integral_gain"] * integrates]
    given = [getattr(controller, key) for key in keys]
    if controller.structure is None or None in given:
        return None
    kp, kd, *ki = map(np.array, given)
    cascade = kd if controller.structure.startswith("cascade") else 1.0
    return np.array([kp * cascade, kd, ki[0] * cascade if ki else 0.0 * kp])


def _is_clear(name: str, percent: dict[str, Array]) -> Bools:
    """By motor whether a structure is better than those that it is no part of, and no worse than
    those that contain it.
    """
    own, found = _floored(percent[name]), list[Bools]()
    for other in LAWS.keys() - {name}:
        letters, left = set(LAWS[other]), _floored(percent[other])
        contained = set(LAWS[name]) <= letters | set("f" if {"v", "w"} <= letters else "")
        found.append(MIN_RATIO * left > own if contained else left >= MIN_RATIO * own)
    return np.asarray(np.all(found, axis=0))


def _floored(percent: Array) -> Array:
    return np.maximum(percent, LEAST_RESIDUAL_PERCENT)


def _values(motor: MotorPaths, x: Array, stated: Array | None, name: str, late_s: float) -> Array:
    """Of a motor Kp, Kd, Ki, their half-widths, and delay, its half-width, lag, its deviation,
    s, (10,); NaN if undetermined. If gains are `stated` (3,), the lag is that with these.
    """
    letters, sd_s, found = STRUCTURES[name], motor.known.sd_s, np.full(10, np.nan)
    _, rho, J = motor.solved(letters, late_s, *x[-2:])
    rows, names = np.zeros(len(rho), dtype=np.intp), tuple(map(str, range(J.shape[1])))
    with suppress(NoFitError):
        whole = System.whole(J, rho, rows, names)
        sd_L = intervals_of(whole, ordinary_least_squares(whole)).sigma[-1]
        sd_L = 1 / math.hypot(1 / sd_L, 1 / max(sd_s, 1e-12))
        sd_L = math.hypot(sd_L, LEAST_LAG_SD / motor.rate_hz)
        whole = whole.with_columns(np.arange(len(names) - 1))
        held = ordinary_least_squares(whole)
        within = intervals_of(whole, held)
        # An unknown lag widens all; an unknown period of the sum of rectangles widens Kp.
        half = within.reach * np.hypot(within.sigma, held.bread @ (held.Q.T @ J[:, -1]) * sd_L)
        # with the integral of a speed's error its gain is that of q
        at = np.array([max(map(letters.find, of)) for of in ("e", "fv", "iq")])
        gains, widths = (np.where(at < 0, 0.0, of[at]) for of in (x, half))
        found = np.r_[gains, widths, x[-2], half[-1], x[-1], sd_L]
    if stated is not None:
        found[8:] = _lag_of(letters, x, rho, J, stated)
    return found


def _lag_of(letters: str, x: Array, rho: Array, J: Array, gains: Array) -> tuple[float, float]:
    """The lag of the effort and its deviation, s, if the gains (3,) are those of the law,
    up to a common factor.
    """
    Kp, Kd, Ki = gains
    of = {"e": Kp, "f": Kd, "v": Kd, "i": Ki * Kp / Kd if "q" in letters else Ki, "q": Ki}
    stated, k = np.array([of[letter] for letter in letters]), len(letters)
    A, y = np.c_[J[:, :k] @ stated, J[:, k:]], rho + J[:, :k] @ (x[:k] - stated)
    scale, moves = np.maximum(np.linalg.norm(A, axis=0), 1e-300), scaled_solution(A, y)
    sd = (
        (y - A @ moves).std()
        * np.sqrt(np.linalg.pinv((A / scale).T @ (A / scale))[-1, -1])
        / scale[-1]
    )
    return float(x[-1] + moves[-1]), float(sd)
