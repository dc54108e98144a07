"""Which rows count: those at low speed are left out, of least squares and of instrumental variables by the same rule.

Joints that stick and slip, and the sign of a noisy velocity, are not what the model describes. Least squares goes by the
measured speed behind the low-pass; instrumental variables go by the simulated one, which is exogenous.
"""

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..data import Signals
from ..errors import IdentificationError
from ..model import InverseModel
from .filtering import motion_between
from .settings import Settings, rule_cutoff_hz

LOW_SPEED_PERCENT = 4.0  # of the peak: slower joints stick and slip, which sign(dq) does not describe
LOW_SPEED_DEVIATIONS = 4.0  # of the speed's noise: rows slower than this are left out
_BLOCK = 200_000  # samples filtered at a time


def fast_rows(slip: Array, noise: Array, directions: Array, percent: float | None) -> NDArray[np.bool_]:
    """Which rows (rows, n) of each joint count, from the speeds `slip` (rows, c) of the directions (c, n) of Coulomb friction.

    A row is slow where a direction that acts on its joint is slower than `percent` of that direction's peak. None takes
    4 % of the peak, or 4 deviations of the `noise` (c,) that the regressor's own speed carries where that is more.
    """
    peak = np.abs(slip).max(axis=0, initial=0.0)
    if percent is None:
        threshold = np.maximum(0.01 * LOW_SPEED_PERCENT * peak, LOW_SPEED_DEVIATIONS * noise)
    else:
        threshold = 0.01 * percent * peak
    slow = np.abs(slip) < threshold
    return np.asarray(slow.astype(float) @ (directions != 0) == 0)


def measured_speed(signals: Signals, plan: Settings) -> tuple[Array, Array]:
    """Filtered joint speeds (rows, n) at the instants of the decimated rows, and the noise (n,) of those in the regressor.

    Filtered by the fit's own low-pass, or by the rule's where the fit goes without or with a higher one: the noise is what
    that leaves out, zero behind the rule's filter.
    """
    fs, n_d = signals.sample_rate_hz, plan.decimation
    cutoff_hz = plan.cutoff_hz if plan.filtered else rule_cutoff_hz(signals.robot.controller.bandwidth_hz, fs)
    kept = np.arange((plan.stop - 1 - plan.start) % n_d + plan.start, plan.stop, n_d)
    speed = np.empty((len(kept), signals.robot.n))
    total, squares = np.zeros((2, signals.robot.n))
    for a in range(plan.start, plan.stop, _BLOCK):
        b = min(plan.stop, a + _BLOCK)
        dq = motion_between(signals.q, signals.effort, cutoff_hz=cutoff_hz, sample_rate_hz=fs, start=a, stop=b).dq
        here = (kept >= a) & (kept < b)
        speed[here] = dq[kept[here] - a]
        if not plan.filtered:
            used = motion_between(
                signals.q, signals.effort, cutoff_hz=plan.cutoff_hz, sample_rate_hz=fs, start=a, stop=b
            )
            off = used.dq - dq
            total += off.sum(axis=0)
            squares += (off**2).sum(axis=0)
    N = plan.stop - plan.start
    return speed, np.sqrt(np.maximum(squares / N - (total / N) ** 2, 0.0))


def measured_fast_rows(signals: Signals, plan: Settings, dynamics: InverseModel) -> NDArray[np.bool_]:
    """Which rows (rows, n) count for least squares: by the measured speed."""
    directions = dynamics.coulomb_directions
    speed, noise = measured_speed(signals, plan)
    fast = fast_rows(speed @ directions.T, noise @ np.abs(directions.T), directions, plan.low_speed.ls)
    for j, joint in enumerate(signals.robot.joints):
        if not fast[:, j].any():
            raise IdentificationError(
                f"{signals.recording}: joint {joint.name} is never faster than the noise of its speed: expected a lower "
                "--cutoff-hz, or --low-speed-percent"
            )
    return fast
