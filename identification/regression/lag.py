"""The delay L of the recorded torque, equation (G).

    tau(t - L) = tau(t) - L dtau/dt     to first order

L is the coefficient of the column -dtau/dt. Column and instrument are those of the simulated
torque, so that position noise does not bias it; least squares would find a false delay. The
estimate is combined by variances with prior knowledge: the effort timing of the recording, and a
given control law.

The delay has rows of its own. Near a reversal friction rises smoothly where the model has a step,
which looks like a delay, so only rows faster than a fifth of the peak speed count. Position noise
grows with frequency and hides a delay, so the rows of joint j are whitened along time by 1 - a_1 B
- ... - a_6 B^6, an autoregression of its residual; B is the row before. If joints reverse so often
that few rows would be left, four rows before are used, or two. Drive gains are held in these rows,
as the recorded torque is noise in whitened rows.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ..arrays import Array, Bools, Ints
from ..errors import NoFitError
from ..estimation import (
    LEVEL,
    WHITE_COSINES,
    SpanRows,
    System,
    autoregression,
    instrumental_variables,
    intervals_of,
    t_quantile,
    weights_of,
)
from .blocks import MotionBlock
from .motion import Lag
from .problem import Problem

MIN_ROWS = 20  # left by the filter at each joint that moves; with fewer the next order is used
MIN_LAG_SPEED_PERCENT = 20.0  # of the peak speed; only faster rows are used
# Orders of the whitening filter, in the order of preference. With a short filter model errors look
# like a delay; a long one leaves few rows if moves between reversals are short.
LAG_ORDERS = (6, 4, 2)
# Probability of a larger difference to a true prior; below it only the data count.
CHANCE = 0.003


def combined_lag(prior: Lag, found: tuple[float, float, int]) -> Lag:
    """Combine the prior delay of a group with the estimated one, by variances.

    If both differ significantly at a level of 0.3 % (Student's t, degrees of freedom by Welch
    1947), only the data count. A delay given by the user is used as it is. `found` is as in `Lag`.
    """
    value, sd, freedom = found
    if prior.stated:
        return replace(prior, prior=prior, found=found)
    data, both = (
        replace(prior, value_s=value, sd_s=sd, source="data"),
        float(np.hypot(sd, prior.sd_s)),
    )
    far = abs(value - prior.value_s) > t_quantile(1 - CHANCE / 2, freedom * (both / sd) ** 4) * both
    counted, reach = data if far else prior.with_other(data), t_quantile(0.5 + LEVEL / 2, freedom)
    return replace(counted, reach=reach, prior=prior, found=found)


def lags_in(late: tuple[System, Array, int], now_s: Array, lags: Sequence[Lag]) -> list[Lag]:
    """Solve the rows of the delay by instrumental variables; combine with prior knowledge.

        tau(t - L) = tau(t) - L dtau/dt                                                  (G)

    Parameters
    ----------
    late : the rows of the delay and their instruments (r, p), both whitened, by a filter of this
        order.
    now_s : (K,) delays about which the rows are, s.
    lags : (K,) delay of each group with its prior knowledge, which is returned if the rows do not
        determine the delays.
    """
    (system, Z, order), known = late, [lag.prior or lag for lag in lags]
    # If the rows do not determine the delays, or the fit is exact, only prior knowledge is left.
    with suppress(NoFitError):
        if system.Y.any():
            step = instrumental_variables(system, Z, weights_of(system, system.Y))
            within, last = intervals_of(system, step, most=WHITE_COSINES), slice(-len(lags), None)
            found = (now_s + step.beta[last]).tolist(), within.sigma[last].tolist()
            return [
                replace(combined_lag(lag, (value, sd, within.freedom)), order=order)
                for lag, value, sd in zip(known, *found, strict=True)
            ]
    return known


class LagFilters:
    """The filters that whiten the rows of a recording that show its delay.

    Attributes:
        of: places in x of the unknowns that have columns in these rows, delays last.
        order: order of the filters.
    """

    def __init__(self, problem: Problem, of: Ints, share: Array, left: Array, speed: Array) -> None:
        """Make the filters of a recording.

        Parameters
        ----------
        problem : the recording.
        of : places in x of the unknowns with columns in the rows, delays last.
        share : (T, n) weights of the rows.
        left : (T, n) residuals, which set the filters.
        speed : (T, n) measured speeds.
        """
        self.of, self._sliding = of, np.abs(speed @ problem.model.coulomb_directions.T).max(axis=0)
        used = [
            _fast_by_speed(problem, speed, self._sliding, k) & (share.T > 0) for k in LAG_ORDERS
        ]
        rows = np.array([_behind(*one).sum(axis=1) for one in zip(used, LAG_ORDERS, strict=True)])
        # The first order that leaves enough rows of each joint that has any, or else at least one.
        enough = [(rows[:, rows[-1] > 0] >= least).all(axis=1) for least in (MIN_ROWS, 1)]
        at = int(np.argmax(enough[0] if enough[0].any() else enough[1]))
        self.order, each = LAG_ORDERS[at], zip(left.T, used[at], strict=True)
        self._filters = [np.r_[1.0, -autoregression(r * fast, self.order)] for r, fast in each]

    def whitened(self, rows: Array, z: MotionBlock) -> tuple[Array, Array]:
        """Return the whitened rows [Z J r] (n, columns, T) of a block, and their weights (n, T).

        A row has zero weight if it, or a row that its filter reaches, is not fast along z.
        """
        used = fast_for_lag(z, self._sliding, self.order) & (z.share > 0)
        white, T = np.zeros_like(rows), rows.shape[2]
        for k in range(self.order + 1):
            h = np.array([own[k] for own in self._filters])[:, None, None]
            white[..., k:] += h * rows[..., : T - k]
        return white, z.share * _behind(used, self.order)

    def system(
        self, rows: SpanRows, share: Array, names: Sequence[str]
    ) -> tuple[System, Array, int]:
        """Return the system of whitened rows, its instruments (r, columns), and the filter order.

        `share` (T, n) are the weights of the rows, `names` those of x.
        """
        A, _, followed = rows.rows(share)
        Z, J, r = np.split(A, [len(self.of), 2 * len(self.of)], axis=1)
        own = tuple(names[i] for i in self.of)
        return System(W=J, Y=r[:, 0], names=own, **followed), Z, self.order


def fast_for_lag(motion: MotionBlock, peak: Array, order: int = LAG_ORDERS[0]) -> Bools:
    """Return a mask (n, T) of the rows of a motion in which a delay shows.

    `peak` (c,) are the peak speeds along the directions of Coulomb friction, `order` that of the
    whitening filter.
    """
    speed = motion.dq[motion.decimation.instants(len(motion.dq))]
    return _fast_by_speed(motion.problem, speed, peak, order)[:, motion.inside]


def _fast_by_speed(problem: Problem, speed: Array, peak: Array, order: int) -> Bools:
    """Return a mask (n, T) of rows in which a delay shows, by their speeds (T, n).

    In each direction of Coulomb friction that acts on the joint, such a row is faster than a share
    of the peak.
    """
    percent = max(MIN_LAG_SPEED_PERCENT, problem.settings.low_speed_percent or 0.0)
    directions = problem.model.coulomb_directions
    slow = np.abs(speed @ directions.T) < 0.01 * percent * peak
    fast = ~(slow @ (directions != 0)).T
    # Zero-phase decimation spreads a reversal both ways, so rows shortly before a slow one do not
    # count either. The whitening filter excludes rows shortly after one.
    for _ in range(order):
        fast = fast & np.c_[fast[:, 1:], fast[:, -1:]]
    return np.asarray(fast)


def _behind(used: Bools, order: int) -> Bools:
    """Return a mask (n, T) of the rows whose filter reaches only rows of `used` (n, T)."""
    found, T = used.copy(), used.shape[1]
    found[:, :order] = False
    for k in range(1, order + 1):
        found[:, order:] &= used[:, order - k : T - k]
    return found
