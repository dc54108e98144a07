"""Confidence intervals that hold for correlated residuals: equal-weighted cosines and Student's t.

Lazarus, Lewis, Stock and Watson, HAR Inference: Recommendations for Practice, Journal of Business & Economic Statistics 36
(2018). Only the low-frequency part of the residual matters for an estimate; the cosines of the lowest frequencies measure it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from .estimators import Estimate

LEVEL = 0.95
FEWEST, MOST = 4, 16  # cosines: with all that white residuals would bear, AR(0.98) is covered in 76 % instead of 92 %
TIME_BLOCKS = 8 * MOST  # of a long recording: a cosine of the highest frequency has eight of them in half a period


@dataclass(frozen=True, kw_only=True, eq=False)
class Intervals:
    """95 % intervals of the parameters estimated.

    Attributes:
        low, high: (b,) their ends.
        sigma: (b,) deviations by equal-weighted cosines.
        freedom: degrees of freedom of Student's t.
        covariance: (b, b) D R D, D the deviations `sigma`, R the formula's correlations. The cosines' own matrix has no more
            than `freedom` independent directions.
    """

    low: Array
    high: Array
    sigma: Array
    freedom: int
    covariance: Array

    @property
    def reach(self) -> float:
        """Deviations `sigma` that a half-width has, by Student's t."""
        return _reach(self.freedom)

    @property
    def half(self) -> Array:
        """(b,) half-widths."""
        return 0.5 * (self.high - self.low)


@dataclass(frozen=True, kw_only=True, eq=False)
class TimeBlocks:
    """Normal matrices of a recording's equal blocks of time, from which the scores of any least squares estimate follow.

    Attributes:
        products: (K, n, b, b + 1) of block and joint, W'[W Y] of the rows that count.
        instants: T, how many the blocks share.
        names: (b,) parameters.
    """

    products: Array
    instants: int
    names: tuple[str, ...]

    @classmethod
    def none_yet(cls, instants: int, n: int, names: tuple[str, ...]) -> "TimeBlocks":
        """Blocks to which `add` brings the rows of so many instants of n joints."""
        b = len(names)
        products = np.zeros((min(TIME_BLOCKS, instants), n, b, b + 1))
        return cls(products=products, instants=instants, names=names)

    def add(self, first: int, W: Array, Y: Array, counts: NDArray[np.bool_]) -> None:
        """Add the instants from `first` on: W (n, b, rows), Y (n, rows), and which of them count (rows, n)."""
        K = len(self.products)
        block = np.arange(first, first + len(counts)) * K // self.instants
        for k in np.unique(block):
            for j in range(len(W)):
                rows = np.flatnonzero((block == k) & counts[:, j])
                W_k = W[j][:, rows]
                self.products[k, j] += W_k @ np.c_[W_k.T, Y[j, rows]]

    def scores(self, estimate: Estimate) -> Array:
        """(K, b) shares of the blocks in beta - beta_true, as `intervals_of_scores` takes them, of a least squares estimate."""
        among = [self.names.index(name) for name in estimate.names]
        weighted = np.tensordot(estimate.weights**2, self.products, axes=(0, 1))[:, among]  # (K, b, all + 1)
        W_rho = weighted[..., -1] - weighted[..., among] @ estimate.beta
        return np.asarray(W_rho @ estimate.bread @ estimate.bread.T)  # (W'W)⁻¹ = bread bread'


def intervals(estimate: Estimate, rho: Array, n: int) -> Intervals:
    """Intervals of an estimate from its weighted residuals rho (r,), stacked joint by joint, zero in rows that do not count."""
    scores = (estimate.Q * rho[:, None]).reshape(n, -1, len(estimate.names)).sum(axis=0)
    return intervals_of_scores(estimate, scores @ estimate.bread.T)


def intervals_of_scores(estimate: Estimate, scores: Array, instants: int | None = None) -> Intervals:
    """Intervals from scores (T, b) in order of time, which add up to beta - beta_true.

    Scores may be sums over equal blocks of time; `instants` then says how many there are in all blocks.
    """
    B = cosines(instants or len(scores))
    sigma = deviations(scores, B) * np.sqrt(estimate.rows / max(1, estimate.rows - len(estimate.names)))
    half = _reach(B) * sigma
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(estimate.sigma > 0, sigma / estimate.sigma, 0.0)
    return Intervals(
        low=estimate.beta - half,
        high=estimate.beta + half,
        sigma=sigma,
        freedom=B,
        covariance=estimate.covariance * scale[:, None] * scale,
    )


def deviations(scores: Array, B: int) -> Array:
    """Standard deviations (b,) of the sums of scores (T, b) in order of time, by the B cosines of lowest frequency."""
    T = len(scores)
    k, t = np.arange(1, B + 1)[:, None], np.arange(T)
    L = np.sqrt(2 / T) * np.cos(np.pi * k * (t + 0.5) / T) @ scores
    return np.asarray(np.sqrt(T * (L**2).mean(axis=0)))


def cosines(T: int) -> int:
    """Their number for T instants: enough to tell the spread, few enough to stay at low frequencies."""
    return int(np.clip(np.floor(0.4 * T ** (2 / 3)), FEWEST, MOST))


def _reach(freedom: int) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 + LEVEL / 2))
