"""Rows of their own for the lag of the torque, equation (G): fast ones, whitened.

To first order tau(t - L) = tau(t) - L d/dt tau(t): the column -d/dt tau takes the coefficient L. It
is that of the simulated torque, as column and as instrument, so that position noise does not bias
it; least squares would find a false lag. Near a reversal friction rises smoothly where the model
has a step, which looks like a lag, so only rows faster than a fifth of the peak speed count.
Position noise grows with frequency and hides a lag: the rows of joint j are filtered along time by
1 - a_1 B ... - a_6 B^6, B the row before, of its residual. Drive gains are held in them, as the
recorded torque is noise in whitened rows.
"""

import numpy as np

from ..arrays import Array
from ..estimation import System, autoregression
from .problem import MotionBlock, Problem
from .spans import SpanRows
from .states import LAG_ORDER, fast_for_lag, fast_for_lag_by


class LagCollector:
    """Collects the rows of a recording that show its lag, block by block."""

    def __init__(self, problem: Problem, share: Array, left: Array, speed: Array) -> None:
        """Of a recording with the weights `share`, whose residuals `left` set the filters, by the
        measured `speed`; all (T, n).
        """
        self._problem, self._share = problem, share
        self._sliding = np.abs(speed @ problem.model.coulomb_directions.T).max(axis=0)
        used = fast_for_lag_by(problem, speed, self._sliding) & (share.T > 0)
        self._filters = [
            np.r_[1.0, -autoregression(r * fast, LAG_ORDER)]
            for r, fast in zip(left.T, used, strict=True)
        ]
        self._collected = SpanRows(*share.shape)

    def add(self, rows: Array, z: MotionBlock) -> None:
        """Add the rows [Z J r] (n, columns, T) of a block, of those that are fast along z."""
        at = z.at
        share = self._share[at.first : at.last]
        used = fast_for_lag(self._problem, z, z.decimation, self._sliding)[:, at.inside]
        used = used & (share.T > 0)
        white, counts, T = np.zeros_like(rows), used.copy(), rows.shape[2]
        counts[:, :LAG_ORDER] = False
        for k in range(LAG_ORDER + 1):
            h = np.array([own[k] for own in self._filters])[:, None, None]
            white[..., k:] += h * rows[..., : T - k]
            counts[:, LAG_ORDER:] &= used[:, LAG_ORDER - k : T - k]
        self._collected.add(at.first, white, share * counts.T)

    def rows(self, names: tuple[str, ...]) -> tuple[System, Array]:
        """The residual by the columns of the base parameters with these `names`, and last of the
        lag; and their instruments (r, b + 1).
        """
        A, _, followed = self._collected.rows()
        b = len(names) + 1
        Z, W, Y = np.split(A, [b, 2 * b], axis=1)
        return System(W=W, Y=Y[:, 0], names=(*names, "lag"), **followed), Z
