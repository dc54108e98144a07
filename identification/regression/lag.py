"""The lag of the recorded torque, equation (G): by rows of its own, fast ones, whitened, combined
by variances with what is known (effort timing of the recording, the described control law).

To first order tau(t - L) = tau(t) - L d/dt tau(t): the column -d/dt tau takes the coefficient L. It
is that of the simulated torque, as column and as instrument, so that position noise does not bias
it; least squares would find a false lag. Near a reversal friction rises smoothly where the model
has a step, which looks like a delay, so only rows faster than a fifth of the peak speed count.
Position noise grows with frequency and hides a delay: the rows of joint j are filtered along time
by 1 - a_1 B ... - a_6 B^6, B the row before, of its residual; with four rows before or two where
joints reverse so often that few rows would be left. Drive gains are held in them, as the recorded
torque is noise in whitened rows.
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

MIN_ROWS = 20  # of a joint that moves, behind the filter; with fewer the next order is taken
MIN_LAG_SPEED_PERCENT = 20.0  # of the peak speed; a lag is looked for in faster rows
# of its whitening filter: shorter, model error looks like a lag; longer, few rows are left, so that
# where moves between reversals are short the next one is taken
LAG_ORDERS = (6, 4, 2)
CHANCE = 0.003  # of data that a true prior differs from by more: only the data are used then


def combined_lag(prior: Lag, found: tuple[float, float, int]) -> Lag:
    """Combine the known delay of a group with the one estimated from the data, by variances.

    If both differ significantly at a level of 0.3 % (Student's t, degrees of freedom by Welch
    1947), only the data count. A given delay is used as it is. `found` is as in `Lag`.
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
    """Solve rows of the delay by instrumental variables, and combine each delay with what is known.

        tau(t - L) = tau(t) - L dtau/dt                                                  (G)

    Parameters
    ----------
    late : the rows of the delay and their instruments (r, p), both whitened, by this order.
    now_s : (K,) delays about which the rows are, s.
    lags : (K,) of each group, with what is known; only that is used if the rows do not determine a
        delay.
    """
    (system, Z, order), known = late, [lag.prior or lag for lag in lags]
    with suppress(NoFitError):  # the rows do not determine them
        if system.Y.any():  # else the fit is exact
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

    `of`: places in x of the unknowns that have columns in them, the delays last.
    """

    def __init__(self, problem: Problem, of: Ints, share: Array, left: Array, speed: Array) -> None:
        """Make the filters of a recording with the weights `share`.

        The residuals `left` set the filters, by the measured `speed`; all (T, n).
        """
        self.of, self._sliding = of, np.abs(speed @ problem.model.coulomb_directions.T).max(axis=0)
        used = [
            _fast_by_speed(problem, speed, self._sliding, k) & (share.T > 0) for k in LAG_ORDERS
        ]
        rows = np.array([_behind(*one).sum(axis=1) for one in zip(used, LAG_ORDERS, strict=True)])
        # the first that leaves enough of all joints of which any does, or else some
        enough = [(rows[:, rows[-1] > 0] >= least).all(axis=1) for least in (MIN_ROWS, 1)]
        at = int(np.argmax(enough[0] if enough[0].any() else enough[1]))
        self.order, each = LAG_ORDERS[at], zip(left.T, used[at], strict=True)
        self._filters = [np.r_[1.0, -autoregression(r * fast, self.order)] for r, fast in each]

    def whitened(self, rows: Array, z: MotionBlock) -> tuple[Array, Array]:
        """Return the filtered rows [Z J r] (n, columns, T) of a block, and their weights (n, T).

        A row has no weight if it, or one that its filter reaches, is not fast along z.
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
        """Return the system, its instruments (r, columns), and the order of the filter.

        They are made from whitened rows with the weights `share` (T, n); `names` are those of x.
        """
        A, _, followed = rows.rows(share)
        Z, J, r = np.split(A, [len(self.of), 2 * len(self.of)], axis=1)
        own = tuple(names[i] for i in self.of)
        return System(W=J, Y=r[:, 0], names=own, **followed), Z, self.order


def fast_for_lag(motion: MotionBlock, peak: Array, order: int = LAG_ORDERS[0]) -> Bools:
    """Return a mask (n, T) of the rows of a motion in which a delay shows.

    It is computed from the `peak` speeds (c,) along the directions of Coulomb friction, after a
    whitening filter of this order.
    """
    speed = motion.dq[motion.decimation.instants(len(motion.dq))]
    return _fast_by_speed(motion.problem, speed, peak, order)[:, motion.inside]


def _fast_by_speed(problem: Problem, speed: Array, peak: Array, order: int) -> Bools:
    """Return a mask (n, T) of rows in which a delay shows, by their speeds (T, n).

    No direction of Coulomb friction that acts on the joint is slower than a share of its peak.
    """
    percent = max(MIN_LAG_SPEED_PERCENT, problem.settings.low_speed_percent or 0.0)
    directions = problem.model.coulomb_directions
    slow = np.abs(speed @ directions.T) < 0.01 * percent * peak
    fast = ~(slow @ (directions != 0)).T
    # Not soon before a slow row, as zero-phase decimation spreads a reversal both ways; the
    # whitening leaves out rows soon after one.
    for _ in range(order):
        fast = fast & np.c_[fast[:, 1:], fast[:, -1:]]
    return np.asarray(fast)


def _behind(used: Bools, order: int) -> Bools:
    """Extend a mask (n, T) of rows by those before them that a filter of this order reaches."""
    found, T = used.copy(), used.shape[1]
    found[:, :order] = False
    for k in range(1, order + 1):
        found[:, order:] &= used[:, order - k : T - k]
    return found
