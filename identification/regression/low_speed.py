"""Which rows count: those at low speed are left out, of least squares and of instrumental variables by the same rule.

Joints that stick and slip, and the sign of a noisy velocity, are not what the model describes. Least squares goes by the
measured speed behind the low-pass; instrumental variables go by the simulated one, which is exogenous. Of either speed it is
the lowest within the time that the low-pass blurs W by.
"""

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import IdentificationError
from .motion import BLOCK_SAMPLES
from .problem import Problem

LOW_SPEED_PERCENT = 4.0  # of the peak: slower joints stick and slip, which sign(dq) does not describe
LOW_SPEED_DEVIATIONS = 4.0  # of the speed's noise: rows slower than this are left out


def fast_rows(
    slip: Array, noise: Array, directions: Array, percent: float | None, peak: Array | None = None
) -> NDArray[np.bool_]:
    """Which rows (rows, n) of each joint count, from the speeds `slip` (rows, c) of the directions (c, n) of Coulomb friction.

    A row is slow where a direction that acts on its joint is slower than `percent` of that direction's peak. None takes
    4 % of the peak, or 4 deviations of the `noise` (c,) that the regressor's own speed carries where that is more. The `peak`
    (c,) is that of the rows, where it is not given.
    """
    peak = np.abs(slip).max(axis=0, initial=0.0) if peak is None else peak
    if percent is None:
        threshold = np.maximum(0.01 * LOW_SPEED_PERCENT * peak, LOW_SPEED_DEVIATIONS * noise)
    else:
        threshold = 0.01 * percent * peak
    slow = np.abs(slip) < threshold
    return np.asarray(slow.astype(float) @ (directions != 0) == 0)


def measured_slip(problem: Problem, directions: Array) -> tuple[Array, Array]:
    """Lowest speeds (rows, c) of the directions (c, n) of Coulomb friction, and the noise (n,) of the regressor's joint speeds.

    Filtered by the fit's own low-pass, or by the rule's where the fit goes without or with a higher one: the noise is what
    that leaves out, zero behind the rule's filter. The low-pass blurs a speed by half a period of its cut-off, so that a joint
    that sticks for a moment seems to creep: a row has the lowest speed within that time of its instant.
    """
    signals, settings = problem.signals, problem.settings
    fs, start, stop = signals.sample_rate_hz, settings.start, settings.stop
    cutoff_hz = problem.slip_cutoff_hz
    blur = round(0.5 * fs / cutoff_hz)
    kept = start + settings.decimator.instants(stop - start)
    slip = np.empty((len(kept), len(directions)))
    total, squares = np.zeros((2, signals.robot.n))
    for a in range(start, stop, BLOCK_SAMPLES):
        b = min(stop, a + BLOCK_SAMPLES)
        low, high = max(start, a - blur), min(stop, b + blur)
        wide = problem.motion.between(low, high, cutoff_hz).dq
        here = (kept >= a) & (kept < b)
        slip[here] = lowest_nearby(np.abs(wide @ directions.T), kept[here] - low, blur)
        if not settings.filtered:
            off = problem.motion.between(a, b, settings.cutoff_hz).dq - wide[a - low : b - low]
            total += off.sum(axis=0)
            squares += (off**2).sum(axis=0)
    N = stop - start
    return slip, np.sqrt(np.maximum(squares / N - (total / N) ** 2, 0.0))


def lowest_nearby(speed: Array, at: NDArray[np.intp], reach: int) -> Array:
    """The lowest of each speed (N, c) within `reach` samples of the samples `at` (K,): (K, c)."""
    windows = np.stack([at - reach, at + reach + 1], axis=1).clip(0, len(speed))
    return np.asarray(np.minimum.reduceat(np.concatenate([speed, speed[-1:]]), windows.ravel())[::2])


def measured_fast_rows(problem: Problem) -> tuple[NDArray[np.bool_], Array]:
    """Which rows (rows, n) count for least squares, by the measured speed; the noise (c,) of the directions' speeds."""
    directions = problem.model.coulomb_directions
    slip, noise = measured_slip(problem, directions)
    slip_noise = noise @ np.abs(directions.T)
    fast = fast_rows(slip, slip_noise, directions, problem.settings.low_speed.ls)
    return fast, slip_noise


def refuse_slow_joints(fast: NDArray[np.bool_], joints: tuple[str, ...], place: str) -> None:
    """Every joint of these names must have rows (rows, n) that count; `place` names the recordings."""
    for j, name in enumerate(joints):
        if not fast[:, j].any():
            raise IdentificationError(
                f"joint {name} is never faster than the noise of its speed",
                place=place,
                expected="a lower --cutoff-hz, or --low-speed-percent",
            )
