"""Checks of a recording before it is simulated: a reference of another recording, drives that are
at their limits.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from acquisition.files import release_pages
from acquisition.robot import Joint

from ..arrays import Array, Bools
from ..control import SATURATED
from ..errors import BadInputError
from ..regression import BLOCK_SAMPLES, Problem, largest_of_type

MAX_DEVIATION = 0.5  # of a joint's travel, of a simulation or a reference from the recording
MIN_TRAVEL = 0.01  # of the largest travel of a joint of the same type: a joint with less is held
MIN_INSTANTS = 30  # of the controller
MAX_STEPS = 2e7  # to simulate: more is a mistake in the description
MIN_SATURATED_PERCENT = 5.0  # of saturated samples that explains a deviation from the reference
# An effort leaves its peaks soon, but not a limit: shares of the samples in ranges of these widths,
# thousandths of the peak
MIN_HELD, MIN_HELD_RATIO, HELD_WIDTHS = 0.01, 3.0, np.array([20, 40, 80])


def position_scales(travel: Array, joints: Sequence[Joint]) -> tuple[Array, Bools]:
    """Return scales (n,) of position errors, from the `travel` (n,) of the reference; and
    which joints are held.
    """
    # A held joint is pushed by its neighbours: its own travel is no scale.
    largest = largest_of_type(travel, joints)
    held = travel < MIN_TRAVEL * largest
    return np.where(held, largest, travel), held


def refuse_foreign_reference(problem: Problem, saturated: dict[str, float]) -> None:
    """Refuse a reference far from the measured position: of another recording, or in other units;
    `saturated`: as of `saturated_percents`.
    """
    signals, joints = problem.signals, problem.signals.robot.joints
    if signals.q_ref is None:
        return
    first, blocks = (
        signals.q_ref[problem.settings.used.start],
        _blocks(problem, signals.q, signals.q_ref),
    )
    sums = [
        [x.sum(axis=0) for x in (q_ref - first, (q_ref - first) ** 2, (q_ref - q) ** 2)]
        for q, q_ref in blocks
    ]
    mean, square, of_error = np.sum(sums, axis=0) / len(problem.settings.used)
    error = np.sqrt(of_error)
    scale, _ = position_scales(np.sqrt(np.maximum(square - mean**2, 0.0)), joints)
    far = ~(error <= MAX_DEVIATION * scale)
    # a drive at its limit does not follow
    if far.any() and max(saturated.values(), default=0) <= MIN_SATURATED_PERCENT:
        j, unstated = int(far.argmax()), unstated_limits(problem)
        raise BadInputError(
            f"{error[j]:.3g} {joints[j].position_unit} rms from the measured position, with a "
            f"travel of {scale[j]:.3g}{''.join(f'; {limit}' for limit in unstated)}",
            place=f"{signals.recording}: reference of joint {joints[j].name}",
            expected="saturation of the motor in robot.toml"
            if unstated
            else "the reference of this recording",
        )


def saturated_percents(problem: Problem) -> dict[str, float]:
    """Percentage of the recorded samples at each motor's limit, by motor and limit;
    empty if none is stated.
    """
    robot, N = problem.signals.robot, len(problem.settings.used)
    limits = SATURATED * robot.saturation
    at = [(np.abs(effort) >= limits).sum(axis=0) for effort in _motor_efforts(problem)]
    return {
        f"{motor.name} ({motor.saturation:.4g} {motor.recorded_unit})": 100.0 * float(k) / N
        for motor, k in zip(robot.motors, np.sum(at, axis=0), strict=True)
        if motor.saturation is not None
    }


def unstated_limits(problem: Problem) -> list[str]:
    """Drives that saturate, below a stated limit or without one, in words."""
    found, motors = list[str](), problem.signals.robot.motors
    peaks = np.max([np.abs(effort).max(axis=0) for effort in _motor_efforts(problem)], axis=0)
    counts = np.sum(
        [
            [
                np.histogram(x, 1000, (0, peak or 1.0))[0][::-1]
                for x, peak in zip(np.abs(effort).T, peaks, strict=True)
            ]
            for effort in _motor_efforts(problem)
        ],
        axis=0,
    )
    for motor, peak, share in zip(motors, peaks, counts / counts[0].sum(), strict=True):
        held, *below = np.diff(np.r_[0.0, share.cumsum()][np.outer(range(4), HELD_WIDTHS)], axis=0)
        ratio = (
            held
            / np.maximum(np.max(below, axis=0), 1e-9)
            * (held > MIN_HELD)
            * (np.min(below, axis=0) > 0)
        )
        k = int(ratio.argmax())
        limit = peak * (
            1
            - 1e-3 * np.average(np.arange(HELD_WIDTHS[k]), weights=share[: HELD_WIDTHS[k]] + 1e-300)
        )
        if ratio[k] > MIN_HELD_RATIO and limit < 0.99 * (motor.saturation or np.inf):
            found.append(
                f"drive of {motor.name} saturates at {limit:.3g} {motor.recorded_unit} in "
                f"{100 * held[k]:.2g} % of the rows"
            )
    return found


def _motor_efforts(problem: Problem) -> Iterator[Array]:
    """The recorded efforts (K, n) of the motors in the span used, in blocks."""
    # As recorded: a spline that corrects a lag would overshoot the limit.
    for (effort,) in _blocks(problem, problem.signals.effort):
        yield problem.signals.robot.motor_effort(effort)


def _blocks(problem: Problem, *series: Array) -> Iterator[list[Array]]:
    """The rows (K, n) of series in the span used, in blocks."""
    start, stop = problem.settings.start, problem.settings.stop
    for a in range(start, stop, BLOCK_SAMPLES):
        yield [x[a : min(stop, a + BLOCK_SAMPLES)] for x in series]
        if stop - start > BLOCK_SAMPLES:
            for x in series:
                release_pages(x)


def refuse_instants(problem: Problem, period_s: float, duration_s: float, substeps: int) -> None:
    """Refuse a controller whose period gives too few instants, or too many steps to simulate."""
    signals, periods = problem.signals, duration_s / period_s
    hz, steps, instants = (
        signals.robot.bandwidth_hz,
        periods * substeps,
        int(periods + 1e-6) + 1,
    )
    for wrong, what, expected in (
        (
            steps > MAX_STEPS,
            f"{steps:.2g} steps to simulate with bandwidth_hz = {hz:g}",
            f"at most {MAX_STEPS:.2g} steps",
        ),
        (
            instants < MIN_INSTANTS,
            f"{instants} instants in the {duration_s:.3g} s of {signals.recording}",
            f"at least {MIN_INSTANTS} instants",
        ),
    ):
        if wrong:
            raise BadInputError(
                what,
                place=f"robot {signals.robot.name}",
                key="controller.sample_rate_hz",
                value=1 / period_s,
                shown=f"{1 / period_s:g}",
                expected=expected,
            )
