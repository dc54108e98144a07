"""Confidence intervals that hold for correlated residuals: equal-weighted cosines and Student's t.

Lazarus, Lewis, Stock and Watson, HAR Inference: Recommendations for Practice, Journal of Business & Economic Statistics 36
(2018). Only the low-frequency part of the residual matters for an estimate; the cosines of the lowest frequencies measure it.
"""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from .estimators import Estimate

LEVEL = 0.95
FEWEST, MOST = 4, 16  # cosines: with all that white residuals would bear, AR(0.98) is covered in 76 % instead of 92 %


@dataclass(frozen=True, kw_only=True, eq=False)
class Intervals:
    """95 % intervals of the parameters estimated.

    Attributes:
        low, high: (b,) their ends.
        sigma: (b,) deviations by equal-weighted cosines.
        freedom: degrees of freedom of Student's t.
    """

    low: Array
    high: Array
    sigma: Array
    freedom: int

    @property
    def half(self) -> Array:
        """(b,) half-widths."""
        return 0.5 * (self.high - self.low)


def intervals(estimate: Estimate, rho: Array, n: int) -> Intervals:
    """Intervals of an estimate from its weighted residuals rho (r,), stacked joint by joint, zero in rows that do not count."""
    scores = (estimate.Q * rho[:, None]).reshape(n, -1, len(estimate.names)).sum(axis=0)
    return intervals_of_scores(estimate, scores @ estimate.bread.T)


def intervals_of_scores(estimate: Estimate, scores: Array) -> Intervals:
    """Intervals from scores (T, b) in order of time, which add up to beta - beta_true."""
    from scipy.special import stdtrit

    T = len(scores)
    B = cosines(T)
    k, t = np.arange(1, B + 1)[:, None], np.arange(T)
    L = np.sqrt(2 / T) * np.cos(np.pi * k * (t + 0.5) / T) @ scores
    sigma = np.sqrt(T * (L**2).mean(axis=0) * estimate.rows / max(1, estimate.rows - len(estimate.names)))
    half = stdtrit(B, 0.5 + LEVEL / 2) * sigma
    return Intervals(low=estimate.beta - half, high=estimate.beta + half, sigma=sigma, freedom=B)


def cosines(T: int) -> int:
    """Their number for T instants: enough to tell the spread, few enough to stay at low frequencies."""
    return int(np.clip(np.floor(0.4 * T ** (2 / 3)), FEWEST, MOST))
