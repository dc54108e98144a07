"""Checks of a recording before it is simulated: a reference of another recording, drives that are
at their limits.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from acquisition.files import release_pages
from acquisition.robot import Joint

from .. import regression
from ..arrays import Array
from ..errors import BadInputError
from ..regression import BLOCK_SAMPLES, Problem

MAX_DEVIATION = 0.5  # of a joint's travel, of a simulation or a reference from the recording
MIN_TRAVEL = 0.01  # of the largest travel of a joint of the same type: a joint with less is held
MIN_INSTANTS = 30  # of the controller
MAX_STEPS = 2e7  # to simulate: more is a mistake in the description
MIN_SATURATED_PERCENT = 5.0  # of saturated samples that explains a deviation from the reference
# An effort leaves its peaks soon, but not a limit: shares of the samples in ranges of these widths,
# thousandths of the peak
MIN_HELD, MIN_HELD_RATIO, HELD_WIDTHS = 0.01, 3.0, np.array([20, 40, 80])


def position_scales(travel: Array, joints: Sequence[Joint]) -> tuple[Array, NDArray[np.bool_]]:
    """Return scales (n,) of position errors, from the `travel` (n,) of the reference; and
    which joints are held.
    """
    # A held joint is pushed by its neighbours: its own travel is no scale.
    largest = regression.largest_of_type(travel, joints)
    held = travel < MIN_TRAVEL * largest
    return np.where(held, largest, travel), held


def refuse_foreign_reference(problem: Problem) -> None:
    """Refuse a reference far from the measured position: of another
    recording, or in other units.
    """
    signals, used = problem.signals, slice(problem.settings.start, problem.settings.stop)
    if signals.q_ref is None:
        return
    joints, first, N = signals.robot.joints, signals.q_ref[used.start], used.stop - used.start
    total, squares, squared_error = np.zeros((3, len(joints)))
    for a in range(used.start, used.stop, BLOCK_SAMPLES):
        block = slice(a, min(used.stop, a + BLOCK_SAMPLES))
        x = signals.q_ref[block] - first
        total, squares = total + x.sum(axis=0), squares + (x**2).sum(axis=0)
        squared_error += ((signals.q_ref[block] - signals.q[block]) ** 2).sum(axis=0)
        release_pages(signals.q)
        release_pages(signals.q_ref)
    spreads, errors = (
        np.sqrt(np.maximum(squares / N - (total / N) ** 2, 0.0)),
        np.sqrt(squared_error / N),
    )
    for joint, scale, error in zip(
        joints, position_scales(spreads, joints)[0], errors, strict=True
    ):
        if error <= MAX_DEVIATION * scale:
            continue
        if max(saturated_percents(problem).values(), default=0.0) > MIN_SATURATED_PERCENT:
            return  # a drive at its limit does not follow
        what = (
            f"{error:.3g} {joint.position_unit} rms from the measured position, with a travel "
            f"of {scale:.3g}"
        )
        place, expected = (
            f"{signals.recording}: reference of joint {joint.name}",
            "the reference of this recording",
        )
        if unstated := unstated_limits(problem):
            what, expected = "; ".join([what, *unstated]), "saturation of the motor in robot.toml"
        raise BadInputError(what, place=place, expected=expected)


def saturated_percents(problem: Problem) -> dict[str, float]:
    """Percentage of the recorded samples at each motor's limit, by motor and limit;
    empty if none is stated.
    """
    robot, settings = problem.signals.robot, problem.settings
    limits = {
        m: motor.saturation for m, motor in enumerate(robot.motors) if motor.saturation is not None
    }
    count = dict.fromkeys(limits, 0)
    for effort in _motor_efforts(problem):
        for m, limit in limits.items():
            count[m] += int((np.abs(effort[:, m]) >= 0.995 * limit).sum())
    N = settings.stop - settings.start
    return {
        f"{robot.motors[m].name} ({limits[m]:.4g} {robot.motors[m].recorded_unit})": 100.0 * k / N
        for m, k in count.items()
    }


def unstated_limits(problem: Problem) -> list[str]:
    """Drives that saturate, below a stated limit or without one, in words."""
    found, motors, counts = list[str](), problem.signals.robot.motors, np.zeros(())
    peaks = np.max([np.abs(effort).max(axis=0) for effort in _motor_efforts(problem)], axis=0)
    for effort in _motor_efforts(problem):
        each = zip(np.abs(effort).T, peaks, strict=True)
        counts = counts + [np.histogram(x, 1000, (0, peak or 1.0))[0][::-1] for x, peak in each]
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
        if ratio[k] > MIN_HELD_RATIO and limit < 0.99 * (motor.saturation or math.inf):
            at = f"{limit:.3g} {motor.recorded_unit} in {100 * held[k]:.2g} % of the rows"
            found.append(f"drive of {motor.name} saturates at {at}")
    return found


def _motor_efforts(problem: Problem) -> Iterator[Array]:
    """The recorded efforts (K, n) of the motors in the span used, in blocks."""
    # corrected for a lag, an effort overshoots its limit
    signals, settings = problem.signals, problem.settings
    for a in range(settings.start, settings.stop, BLOCK_SAMPLES):
        yield signals.robot.motor_effort(signals.effort[a : min(settings.stop, a + BLOCK_SAMPLES)])
        release_pages(signals.effort)


def refuse_instants(problem: Problem, period_s: float, instants: int, steps: float) -> None:
    """Refuse a controller whose period gives too few instants, or too many steps to simulate."""
    signals, used = problem.signals, problem.settings.stop - problem.settings.start
    hz, used_s = signals.robot.bandwidth_hz, used / signals.sample_rate_hz
    many = f"{steps:.2g} steps to simulate with bandwidth_hz = {hz:g}"
    few = f"{instants} instants in the {used_s:.3g} s of {signals.recording}"
    for wrong, what, expected in (
        (steps > MAX_STEPS, many, f"at most {MAX_STEPS:.2g} steps"),
        (instants < MIN_INSTANTS, few, f"at least {MIN_INSTANTS} instants"),
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
