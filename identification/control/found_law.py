"""The control law of the drives, estimated from the recording.

Of each motor the effort u, the reference r and the position q are recorded:

    u(t + L) = Kp (r(t - d) - q(t)) + Kd (phi dr(t - d) - v(t)) + Ki integral(...) + offset

The control law is linear and acts on the measured position, so the noise of that position is not an
error in the variables, and least squares is unbiased for any robot. r, q and u pass one low-pass,
which commutes with derivatives, integrals and delays. The delay d of the reference and the delay L
of the effort are found by Gauss–Newton steps along with the gains. The speed v is dq, or dq half a
period or a period ago, by the controller's estimate. The data determine only d + L, so the estimate
with the smallest d and L is chosen. A controller's integral is a sum of rectangles: the integral of
the path plus half a period of its integrand.

A given control law that reproduces the effort at its own instants shows the delay of the recorded
torque too.
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

# Columns of u by structure: e the error, v the measured speed, w the speed of the reference,
# f = w - v, i the integral of the error, q the position.
STRUCTURES = {"pd": "ev", "pd_velocity_feedforward": "ef", "pid": "efi", "cascade_p_pi": "eviq"}
# Rivals that no structure of a description has.
LAWS = STRUCTURES | {
    "speed fed forward in part": "evw",
    "an integral without it": "evi",
    "both": "evwi",
}
LEAST_RESIDUAL_PERCENT = 0.1  # of the effort's variation; smaller residuals count as equal
MIN_RATIO = 1.5  # of two residuals; with less, neither structure is better
MIN_ROWS = 60
# Samples; the instants of a recording are not known better, those of the real EMPS are off by
# 0.006.
LEAST_LAG_SD = 4e-3
MAX_LAW_PERCENT = 5.0  # residual up to which a control law shows the delay, of the variation
DRIVE_DELAY_S = 0.0005  # standard deviation of the delay from command to torque


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundLaw:
    """The control law of each motor, estimated from a recording, with one structure.

    Attributes:
        law: control law with the estimated gains, whatever they are. It has the given structure if
            there is one, and `pd` for `cascade_p_p`.
        reason: why it is not used; None if it is.
        rival: structure that fits better than the given one; None for none.
        gains_half: (3, n) half-widths of the 95 % intervals of Kp, Kd, Ki.
        delay_s, delay_half_s: (n,) delay d of the reference and its half-width, s.
        lag_s, lag_sd_s: (n,) delay L of the effort after the control law's instant and its standard
            error, s; with the given gains if there are any.
        residual_percent: (n,) residual in percent of the effort's variation.
        clear: (n,) mask of the motors that determine the structure by themselves.
        described: (3, n) given gains; None without.
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
        """Delay of the reference, the median of the motors, s.

        It is 0 if it may be 0, or if the control law does not fit.
        """
        delay_s, half_s = float(np.median(self.delay_s)), float(np.median(self.delay_half_s))
        fits = (self.residual_percent <= MAX_RESIDUAL_PERCENT).all()
        return delay_s if fits and abs(delay_s) > half_s else 0.0


def law_of_recording(robot: Robot, signals: Signals, found: FoundLaw | None) -> ControlLaw | None:
    """Return the control law given in the description, else the estimated one, else None.

    Along a measured position it has the model's gravity, as this position contains the sag.

    Raises
    ------
    BadInputError : the description is incomplete.
    """
    law = described_law(robot)
    if law is None and found is not None and found.reason is None:
        law = replace(found.law, G=robot.gain)  # drive gains that a fit identified
    if law is None or signals.q_ref is not None or law.gravity == "measured":
        return law
    return replace(law, gravity="reference")


def law_of(problem: Problem) -> FoundLaw | None:
    """Estimate the control law from the recording, with the given structure if there is one.

    None is returned without a reference, or if the given control law is not linear. A control law
    is accepted if every motor has a small residual and positive gains. At some motor, its structure
    must be clearly better than all structures that do not contain it, and no structure that
    contains it may be better.
    """
    signals, controller = problem.signals, problem.signals.robot.controller
    if signals.q_ref is None or controller.structure == "computed_torque":
        return None
    period_s = 1 / (controller.sample_rate_hz or signals.sample_rate_hz)
    # The period of a controller that is not given may be anything up to the sample period.
    unknown_s = 0.0 if controller.sample_rate_hz else 0.25 * period_s
    lag = problem.settings.lag
    # There may be too few samples to filter.
    with suppress(NoFitError):
        motors = motor_paths(
            problem,
            replace(lag, value_s=lag.value_s + 0.5 * period_s),
            period_s - 2 * unknown_s,
        )
        if min(len(motor.u) for motor in motors) >= MIN_ROWS:
            return _select_law(signals.robot, motors, period_s, unknown_s)
    return None


def _solver(motors: list[MotorPaths], period_s: float) -> Callable[[str, str], list[Found]]:
    """Return a least-squares solver of all motors, by columns and estimate of the speed.

    Each combination is solved once.
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
    """Select the control law of the given structure, else of the structure that fits best."""
    solved = _solver(motors, period_s)
    percent = {
        name: np.min(
            [
                _percents(solved(letters, one))
                # Without the reference's speed, a delay of the measured one cannot be distinguished
                # from the delays of reference and effort.
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
        (not valid[name].all(), f"no linear control law fits motor {unlike}"),
        (best != name, f"{best} fits better"),
        (not clear[name].any(), "several control laws fit alike"),
        # With the selected estimate of the speed, gains may be negative or undetermined.
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

    `period_s` is the period of the controller, and how much of it is unknown.
    """
    letters, described = STRUCTURES[name], described_gains(robot.controller)
    ways = {one: solved(letters, one) for one in SPEED_DELAYS}
    estimate = _estimate(ways, motors[0], robot.controller.velocity_estimate)
    late_s = SPEED_DELAYS[estimate] * period_s[0]
    known = [None] * len(motors) if described is None else described.T
    # Solve once more, as the search ended when its steps were small, not zero.
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

    If several fit alike, the one with the smallest delays is selected.
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
    """Test by motor whether a structure is clearly better than its rivals.

    It must be better than those that do not contain it, and not worse than those that do.
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
    """Return Kp, Kd, Ki of a motor, their half-widths, and both delays with uncertainties, (10,).

    Delays are in s, and undetermined values NaN. If gains are given (`stated`, (3,)), the delay of
    the effort is that with them.
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
        # An unknown delay widens all intervals, an unknown period of the sum that of Kp.
        half = within.reach * np.hypot(within.sigma, held.bread @ (held.Q.T @ J[:, -1]) * sd_L)
        # The gain of an integral of the speed error is that of the column q.
        at = np.array([max(map(letters.find, of)) for of in ("e", "fv", "iq")])
        gains, widths = (np.where(at < 0, 0.0, of[at]) for of in (x, half))
        found = np.r_[gains, widths, x[-2], half[-1], x[-1], sd_L]
    if stated is not None:
        found[8:] = _lag_of(letters, x, rho, J, stated)
    return found


def _lag_of(letters: str, x: Array, rho: Array, J: Array, gains: Array) -> tuple[float, float]:
    """Return the delay of the effort and its standard error, s, with given gains (3,).

    The gains may differ from those of the controller by a common factor.
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
    """Return the delay of the torque by the given control law, if that reproduces the effort.

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
        source="the control law in robot.toml",
    )


def lag_without_fit(group: Sequence[tuple[Problem, FoundLaw | None]]) -> Lag:
    """Return the delay of a group of recordings by prior knowledge.

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
