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
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace as replace_keys
from numpy.typing import NDArray

from acquisition.robot import Controller

from ..arrays import Array
from ..errors import NoFitError
from ..estimation import System, intervals_of, ordinary_least_squares
from .motor_paths import MAX_RESIDUAL_PERCENT, LawSolution, MotorPaths, motor_paths, scaled_solution
from .settings import KnownLag

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
        velocity_estimate, period_s: of the controller.
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
    gains: Array
    gains_half: Array
    delay_s: Array
    delay_half_s: Array
    lag_s: Array
    lag_sd_s: Array
    residual_percent: Array
    clear: NDArray[np.bool_]
    described: Array | None

    @property
    def used(self) -> NDArray[np.bool_]:
        """(3,) the gains that the structure has."""
        return np.array([True, True, "i" in STRUCTURES[self.structure]])

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
    described = "pd" if controller.structure == "cascade_p_p" else controller.structure
    if signals.q_ref is None or described == "computed_torque":
        return None
    with suppress(NoFitError):  # too few samples to filter
        motors, rate_hz = motor_paths(problem)
        if min(len(motor.u) for motor in motors) >= MIN_ROWS:
            return _told(problem, motors, rate_hz, described)
    return None


def _told(
    problem: "Problem", motors: list[MotorPaths], rate_hz: float, described: str | None
) -> Law:
    signals, controller, known = (
        problem.signals,
        problem.signals.robot.controller,
        problem.settings.known_lag,
    )
    period_s = 1 / (controller.sample_rate_hz or signals.sample_rate_hz)
    # Of a controller that is not described the period is anything up to that of the samples.
    unknown_s = 0.0 if controller.sample_rate_hz else 0.25 * period_s
    known = replace(
        known, value_s=(known.value_s + 0.5 * period_s) * rate_hz, sd_s=known.sd_s * rate_hz
    )

    def solved(letters: str, estimates: Iterable[str]) -> dict[str, list[LawSolution]]:
        found = dict[str, list[LawSolution]]()
        near: list[LawSolution | None] = [None] * len(motors)
        for one in estimates:
            clock = (SPEED_DELAYS[one] * period_s * rate_hz, (period_s - 2 * unknown_s) * rate_hz)
            found[one] = [
                motor.solve(letters, known, clock, solution)
                for motor, solution in zip(motors, near, strict=True)
            ]
            near = [*found[one]]
        return found

    # Without the reference's speed a delay of the measured one is one of the reference and a lag.
    tried = {
        name: solved(letters, SPEED_DELAYS if {"f", "w"} & set(letters) else ("exact",))
        for name, letters in LAWS.items()
    }
    percent = {
        name: np.min([_percents(one) for one in of.values()], axis=0) for name, of in tried.items()
    }
    valid = {name: percent[name] <= MAX_RESIDUAL_PERCENT for name in LAWS}
    for name in STRUCTURES:
        valid[name] = valid[name] & np.array(
            [(one.x[: len(LAWS[name])] > 0).all() for one in tried[name]["exact"]]
        )
    clear = {name: valid[name] & _is_clear(name, percent) for name in LAWS}
    best = max(
        LAWS, key=lambda name: (clear[name].sum(), valid[name].sum(), -float(percent[name].max()))
    )
    name = described or (best if best in STRUCTURES else "pd")
    reason = None
    if not valid[name].all():
        reason = f"no linear law fits motor {signals.robot.motors[int(valid[name].argmin())].name}"
    elif best != name:
        reason = f"{best} fits better"
    elif not clear[name].any():
        reason = "several laws fit alike"
    ways = tried[name] if len(tried[name]) > 1 else solved(STRUCTURES[name], SPEED_DELAYS)
    estimate = _estimate(ways, known, controller.velocity_estimate)
    stated = described_gains(controller)
    values = [_values(one, known, name, rate_hz) for one in ways[estimate]]
    gains, half, times = (np.array(x).T for x in zip(*values, strict=True))
    half[0] = np.hypot(half[0], unknown_s * gains[2])
    if stated is not None:
        lags = [
            _lag_of(one, x, name, rate_hz) for one, x in zip(ways[estimate], stated.T, strict=True)
        ]
        times[2:] = np.array(lags).T
    law = Law(
        structure=name,
        reason=reason,
        rival=best if best != name and clear[best].any() else None,
        velocity_estimate=estimate,
        period_s=period_s,
        gains=gains,
        gains_half=half,
        delay_s=times[0],
        delay_half_s=times[1],
        lag_s=times[2],
        lag_sd_s=times[3],
        residual_percent=_percents(ways[estimate]),
        clear=clear[name],
        described=stated,
    )
    # By the speed that is taken, and determined at all.
    positive = law.reason is not None or (gains[law.used] > 0).all()
    return (
        law
        if positive
        else replace(law, reason=f"gains of {name} are undetermined, or not positive")
    )


def _estimate(tried: dict[str, list[LawSolution]], known: KnownLag, described: str | None) -> str:
    """The controller's estimate of the speed: the described one unless another fits better, else of
    those that fit alike the one with the smallest delay and lag.
    """
    left = {one: _floored(_percents(found)) for one, found in tried.items()}
    least = np.min(list(left.values()), axis=0)
    alike = [one for one in tried if (left[one] < MIN_RATIO * least).all()]
    alike = alike or [min(left, key=lambda one: float(left[one].sum()))]
    if described in alike:
        return described
    within = math.hypot(known.sd_s, 0.25)  # samples
    return min(
        alike,
        key=lambda one: sum(x.d**2 + ((x.L - known.value_s) / within) ** 2 for x in tried[one]),
    )


def _percents(found: list[LawSolution]) -> Array:
    return np.array([one.percent for one in found])


def described_gains(controller: Controller) -> Array | None:
    """Kp, Kd, Ki (3, n) of the described law u = Kp e + ...; None where it
    is not described whole.
    """
    position, velocity, integral = (
        controller.position_gain,
        controller.velocity_gain,
        controller.integral_gain,
    )
    integrates = controller.structure in ("cascade_p_pi", "pid")
    if (
        controller.structure is None
        or position is None
        or velocity is None
        or (integrates and integral is None)
    ):
        return None
    kp, kd = np.array(position), np.array(velocity)
    ki = np.array(integral) if integrates else np.zeros_like(kp)
    cascade = kd if controller.structure.startswith("cascade") else 1.0
    return np.array([kp * cascade, kd, ki * cascade])


def _is_clear(name: str, percent: dict[str, Array]) -> NDArray[np.bool_]:
    """By motor whether a structure is better than those that it is no part of, and no worse than
    those that contain it.
    """
    own, found = _floored(percent[name]), list[NDArray[np.bool_]]()
    for other in LAWS.keys() - {name}:
        letters, left = set(LAWS[other]), _floored(percent[other])
        contained = set(LAWS[name]) <= letters | set("f" if {"v", "w"} <= letters else "")
        found.append(MIN_RATIO * left > own if contained else left >= MIN_RATIO * own)
    return np.asarray(np.all(found, axis=0))


def _floored(percent: Array) -> Array:
    return np.maximum(percent, LEAST_RESIDUAL_PERCENT)


def _values(
    one: LawSolution, known: KnownLag, name: str, rate_hz: float
) -> tuple[Array, Array, Array]:
    """Of a motor Kp, Kd, Ki (3,), their half-widths, and delay, its half-width, lag, its deviation,
    s; NaN if undetermined.
    """
    letters, rows = STRUCTURES[name], np.zeros(len(one.rho), dtype=np.intp)
    names = tuple(map(str, range(one.J.shape[1])))
    unit = np.array([1.0, 1 / rate_hz, 1.0 if "q" in letters else rate_hz])
    with suppress(NoFitError):
        whole = System.whole(one.J, one.rho, rows, names)
        free = ordinary_least_squares(whole)
        sd_L = 1 / math.hypot(1 / intervals_of(whole, free).sigma[-1], 1 / max(known.sd_s, 1e-9))
        sd_L = math.hypot(sd_L, LEAST_LAG_SD)
        whole = whole.with_columns(np.arange(len(names) - 1))
        held = ordinary_least_squares(whole)
        within = intervals_of(whole, held)
        # An unknown lag widens all; an unknown period of the sum of rectangles widens Kp.
        half = within.reach * np.hypot(within.sigma, held.bread @ (held.Q.T @ one.J[:, -1]) * sd_L)
        at = [
            letters.find(one)
            for one in ("e", "f" if "f" in letters else "v", "q" if "q" in letters else "i")
        ]
        gains, widths = (np.where(np.array(at) < 0, 0.0, x[at]) * unit for x in (one.x, half))
        times = np.array([one.d, half[-1], one.L, sd_L]) / rate_hz
        return gains, widths, times
    return np.full(3, np.nan), np.full(3, np.nan), np.full(4, np.nan)


def _lag_of(one: LawSolution, gains: Array, name: str, rate_hz: float) -> tuple[float, float]:
    """The lag of the effort and its deviation, s, if the gains (3,) are those of the law,
    up to a common factor.
    """
    letters, (Kp, Kd, Ki) = STRUCTURES[name], gains
    error = Ki * Kp / Kd if "q" in letters else Ki
    stated = {"e": Kp, "f": Kd * rate_hz, "v": Kd * rate_hz, "i": error / rate_hz, "q": Ki}
    x, k = np.array([stated[letter] for letter in letters]), len(letters)
    A = np.c_[one.J[:, :k] @ x, one.J[:, k:]]
    y = one.rho + one.J[:, :k] @ (one.x[:k] - x)
    scale = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    moves = scaled_solution(A, y)
    sd = float(
        (y - A @ moves).std()
        * np.sqrt(np.linalg.pinv((A / scale).T @ (A / scale))[-1, -1])
        / scale[-1]
    )
    return (one.L + float(moves[-1])) / rate_hz, sd / rate_hz
