"""The control law of the drives from what was recorded: the effort u of each motor, its
reference r and its position q.

    u(t + L) = Kp (r(t - d) - q(t)) + Kd (phi dr(t - d) - v(t)) + Ki integral(...) + offset

The law is linear and acts on the measured position, whose noise is thus no error in the
variables: least squares is right, whatever the robot. r, q and u pass one low-pass, which
commutes with derivatives, integrals and delays; the delay d of the reference and the delay L of the
effort are found by Gauss-Newton steps beside the gains. The speed v is dq, or dq half a period or
a period ago, by the controller's estimate. The data determine only d + L: the estimate with the
smallest d and L is taken. A controller's integral is a sum of rectangles: that of the path and
half a period of its integrand.

A given control law that gives the effort at its own instants tells the delay of the recorded torque
too.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from acquisition.robot import Robot

from ..arrays import Array, Bools
from ..data import Signals
from ..errors import NoFitError
from ..estimation import System, intervals_of, ordinary_least_squares
from ..regression import NOTHING, Lag, Problem
from .control_law import SPEED_DELAYS, ControlLaw, described_gains, described_law
from .motor_paths import (
    MAX_RESIDUAL_PERCENT,
    Found,
    MotorPaths,
    motor_paths,
    scaled_solution,
)

# Columns of u: the error e, its rate f = w - v, speeds v measured and w of the reference, the
# error's integral i, position q.
STRUCTURES = {"pd": "ev", "pd_velocity_feedforward": "ef", "pid": "efi", "cascade_p_pi": "eviq"}
LAWS = STRUCTURES | {  # rivals of no structure
    "speed fed forward in part": "evw",
    "an integral without it": "evi",
    "both": "evwi",
}
LEAST_RESIDUAL_PERCENT = 0.1  # of the effort's variation; below, all are equal
MIN_RATIO = 1.5  # of residuals, for one structure to be better than another
MIN_ROWS = 60
# samples: no instant of a record is known better; those of the real EMPS are off by 0.006
LEAST_LAG_SD = 4e-3
MAX_LAW_PERCENT = 5.0  # of the effort's variation that a law does not give, where it tells the lag
DRIVE_DELAY_S = 0.0005  # deviation of the delay from command to torque


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundLaw:
    """The control law of each motor as a recording shows it, by one structure.

    Attributes:
        law: the control law of its gains, whatever they are; of the given structure if there is
            one, and
            `pd` also for `cascade_p_p`.
        reason: why it is not to be used; None if it is.
        rival: the structure that fits better than the given one; None for none.
        gains_half: (3, n) half-widths of the 95 % intervals of Kp, Kd, Ki.
        delay_s, delay_half_s: (n,) delay of the reference.
        lag_s, lag_sd_s: (n,) delay of the effort after the control law's instant.
        residual_percent: (n,) of the effort's variation.
        clear: (n,) motors that determine the structure by themselves.
        described: (3, n) the given gains; None without. `lag_s` and `lag_sd_s` are then those with
            these gains.
    """

    law: ControlLaw
    reason: str | None
    rival: str | None
    gains_half: Array
    delay_s: Array
    delay_half_s: Array
    lag_s: Array
    lag_sd_s: Array
    residual_percent: Array
    clear: Bools
    described: Array | None

    @property
    def gains(self) -> Array:
        """Kp, Kd, Ki, (3, n)."""
        return np.array([self.law.Kp, self.law.Kd, self.law.Ki])

    @property
    def used(self) -> Bools:
        """Mask (3,) of the gains that the structure has."""
        return np.array([True, True, self.law.integrates])

    @property
    def common_delay_s(self) -> float:
        """Delay of the reference, the median of the motors, s; 0 if it may be 0, or if the control
        law does not fit.
        """
        delay_s, half_s = float(np.median(self.delay_s)), float(np.median(self.delay_half_s))
        fits = (self.residual_percent <= MAX_RESIDUAL_PERCENT).all()
        return delay_s if fits and abs(delay_s) > half_s else 0.0


def law_of_recording(robot: Robot, signals: Signals, found: FoundLaw | None) -> ControlLaw | None:
    """Return the control law given in the description or, without one, the estimated one; None for
    neither.

    Along a measured position it has the model's gravity, as the position has the sag.

    Raises
    ------
    BadInputError : the description is incomplete.
    """
    law = described_law(robot)
    if law is None and found is not None and found.reason is None:
        law = replace(found.law, G=robot.gain)  # those that a fit identified
    if law is None or signals.q_ref is not None or law.gravity == "measured":
        return law
    return replace(law, gravity="reference")


def law_of(problem: Problem) -> FoundLaw | None:
    """Estimate the control law from the recording, by the given structure if there is one.

    It is None without a reference, or if the given control law is not linear. A control law is
    accepted if every motor's residual is small and its gains are positive, and if the structure is
    clearly better at some motor than all that it is no part of, while none that contains it is.
    """
    signals, controller = problem.signals, problem.signals.robot.controller
    if signals.q_ref is None or controller.structure == "computed_torque":
        return None
    period_s = 1 / (controller.sample_rate_hz or signals.sample_rate_hz)
    # Of a controller that is not described the period is anything up to that of the samples.
    unknown_s = 0.0 if controller.sample_rate_hz else 0.25 * period_s
    lag = problem.settings.lag
    with suppress(NoFitError):  # too few samples to filter
        motors = motor_paths(
            problem,
            replace(lag, value_s=lag.value_s + 0.5 * period_s),
            period_s - 2 * unknown_s,
        )
        if min(len(motor.u) for motor in motors) >= MIN_ROWS:
            return _select_law(signals.robot, motors, period_s, unknown_s)
    return None


def _solver(motors: list[MotorPaths], period_s: float) -> Callable[[str, str], list[Found]]:
    """Return a least-squares solver of all motors by columns and the controller's estimate of the
    speed, each done once.
    """

    @cache
    def solved(letters: str, estimate: str) -> list[Found]:
        late_s, k = SPEED_DELAYS[estimate] * period_s, list(SPEED_DELAYS).index(estimate)
        near = solved(letters, list(SPEED_DELAYS)[k - 1]) if k else [None] * len(motors)
        return [one.solve(letters, late_s, found) for one, found in zip(motors, near, strict=True)]

    return solved


def _select_law(
    robot: Robot, motors: list[MotorPaths], period_s: float, unknown_s: float
) -> FoundLaw:
    """Select the control law by the given structure or, without one, the structure that fits
    best.
    """
    solved = _solver(motors, period_s)
    percent = {
        name: np.min(
            [
                _percents(solved(letters, one))
                # without the reference's speed a delay of the measured one is one of it and a lag
                for one in (SPEED_DELAYS if {"f", "w"} & set(letters) else ("exact",))
            ],
            axis=0,
        )
        for name, letters in LAWS.items()
    }
    valid = {name: percent[name] <= MAX_RESIDUAL_PERCENT for name in LAWS}
    for name, letters in STRUCTURES.items():
        valid[name] &= [(x[: len(letters)] > 0).all() for _, x in solved(letters, "exact")]
    clear = {name: valid[name] & _is_clear(name, percent) for name in LAWS}
    best = max(
        LAWS, key=lambda name: (clear[name].sum(), valid[name].sum(), -float(percent[name].max()))
    )
    name = robot.controller.structure or (best if best in STRUCTURES else "pd")
    name = "pd" if name == "cascade_p_p" else name
    found = _with_values(robot, motors, solved, name, (period_s, unknown_s))
    unlike = robot.motors[int(valid[name].argmin())].name
    reasons = (
        (not valid[name].all(), f"no linear law fits motor {unlike}"),
        (best != name, f"{best} fits better"),
        (not clear[name].any(), "several laws fit alike"),
        # by the speed that is taken, and determined at all
        (
            not (found.gains[found.used] > 0).all(),
            f"gains of {name} are undetermined, or not positive",
        ),
    )
    return replace(
        found,
        reason=next((reason for holds, reason in reasons if holds), None),
        rival=best if best != name and clear[best].any() else None,
        clear=clear[name],
    )


def _with_values(
    robot: Robot,
    motors: list[MotorPaths],
    solved: Callable[[str, str], list[Found]],
    name: str,
    period_s: tuple[float, float],
) -> FoundLaw:
    """Return the control law of a structure, with its estimate of the speed.

    `period_s`: of the controller, and how much of it is unknown.
    """
    letters, described = STRUCTURES[name], described_gains(robot.controller)
    ways = {one: solved(letters, one) for one in SPEED_DELAYS}
    estimate = _estimate(ways, motors[0], robot.controller.velocity_estimate)
    late_s = SPEED_DELAYS[estimate] * period_s[0]
    known = [None] * len(motors) if described is None else described.T
    # a step further: the search ends once steps are small
    found = [
        motor.solve(letters, late_s, one) for motor, one in zip(motors, ways[estimate], strict=True)
    ]
    each = [
        _values(motor, x, gains, name, late_s)
        for motor, (_, x), gains in zip(motors, found, known, strict=True)
    ]
    gains, half, times = np.split(np.array(each).T, [3, 6])
    half[0] = np.hypot(half[0], period_s[1] * gains[2])
    with np.errstate(divide="ignore", invalid="ignore"):
        law = ControlLaw(
            kind="found",
            structure=name,
            period_s=period_s[0],
            R=robot.R,
            G=robot.gain,
            Kp=gains[0],
            Kd=gains[1],
            Ki=gains[2],
            position_share=gains[0] / gains[1] if "q" in letters else np.ones(robot.n),
            saturation=robot.saturation,
            velocity_estimate=estimate,
            gravity="measured" if robot.controller.gravity_feedforward else "none",
        )
    return FoundLaw(
        law=law,
        reason=None,
        rival=None,
        gains_half=half,
        delay_s=times[0],
        delay_half_s=times[1],
        lag_s=times[2],
        lag_sd_s=times[3],
        residual_percent=_percents(found),
        clear=np.ones(len(motors), dtype=bool),
        described=described,
    )


def _estimate(tried: dict[str, list[Found]], motor: MotorPaths, described: str | None) -> str:
    """Select the controller's estimate of the speed: the given one unless another fits better.

    Of those that fit alike the one with the smallest delays is taken.
    """
    left = {one: _floored(_percents(found)) for one, found in tried.items()}
    limit = MIN_RATIO * np.min(list(left.values()), axis=0)
    alike = [one for one in tried if (left[one] < limit).all()] or [
        min(left, key=lambda one: float(left[one].sum()))
    ]
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


def _is_clear(name: str, percent: dict[str, Array]) -> Bools:
    """Test by motor whether a structure is better than those that it is no part of, and no worse
    than those that contain it.
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
    """Return Kp, Kd, Ki of a motor, their half-widths, and both delays with their uncertainty, s,
    (10,).

    Undetermined values are NaN. If gains are given (`stated`, (3,)), the delay of the effort is
    that with these.
    """
    letters, found = STRUCTURES[name], np.full(10, np.nan)
    _, rho, J = motor.solved(letters, late_s, *x[-2:])
    rows, names = np.zeros(len(rho), dtype=np.intp), tuple(map(str, range(J.shape[1])))
    with suppress(NoFitError):
        whole = System.whole(J, rho, rows, names)
        sd_L = intervals_of(whole, ordinary_least_squares(whole)).sigma[-1]
        sd_L = 1 / math.hypot(1 / sd_L, 1 / max(motor.known.sd_s, 1e-12))
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
    """Return the delay of the effort and its standard error, s, if the gains (3,) are those of the
    control law, up to a common factor.
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


def _lag_by_law(problem: Problem, found: FoundLaw | None) -> Lag | None:
    """Return the delay of the torque without an estimate, where the given control law gives the
    effort.

    Drives have loops that a description does not contain. A command acts from its tick to the next
    one, on average half a period later; the drive's own delay is not included.
    """
    if found is None or found.described is None or problem.signals.of_drives:
        return None
    similar = found.residual_percent <= MAX_LAW_PERCENT
    if not similar.any():
        return None
    return replace(
        problem.settings.lag,
        value_s=float(found.lag_s[similar].mean()) - 0.5 * found.law.period_s,
        sd_s=float(np.hypot(found.lag_sd_s[similar].max(), DRIVE_DELAY_S)),
        source="the described control law",
    )


def lag_without_fit(group: Sequence[tuple[Problem, FoundLaw | None]]) -> Lag:
    """Return the delay of a group of recordings as known without an estimate.

    It is the mean of the delays by user, recording and control law, with the smallest standard
    error.
    """
    each, by_law_s = list[Lag](), None
    for problem, found in group:
        known, by_law = problem.settings.lag, _lag_by_law(problem, found)
        if by_law is not None:
            by_law_s = by_law.value_s if by_law_s is None else by_law_s
            if not known.stated:
                known = by_law if known.source == NOTHING else known.with_other(by_law)
        each.append(known)
    return replace(
        min(each, key=lambda known: known.sd_s),
        value_s=float(np.mean([known.value_s for known in each])),
        by_law_s=by_law_s,
    )
