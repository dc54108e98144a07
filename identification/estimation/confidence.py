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
LEAST_SHARE = 0.1  # of a recording too short to say more
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

    def intervals(self, estimate: Estimate) -> Intervals:
        """Intervals of a least squares estimate, of all parameters or some."""
        among = [self.names.index(name) for name in estimate.names]
        weighted = np.tensordot(estimate.weights**2, self.products, axes=(0, 1))[:, among]  # (K, b, all + 1)
        N, bread = weighted[..., among], estimate.bread
        scores = (weighted[..., -1] - N @ estimate.beta) @ bread @ bread.T  # (W'W)⁻¹ = bread bread'
        return _intervals(estimate, scores, bread.T @ N @ bread, cosines(self.instants))  # Q = W bread


def intervals(estimate: Estimate, rho: Array, n: int) -> Intervals:
    """Intervals of an estimate from its weighted residuals rho (r,), stacked joint by joint, zero in rows that do not count."""
    b = len(estimate.names)
    scores = (estimate.Q * rho[:, None]).reshape(n, -1, b).sum(axis=0) @ estimate.bread.T
    T = len(scores)
    blocks = np.array_split(estimate.Q.reshape(n, T, b).transpose(1, 0, 2), min(T, TIME_BLOCKS))
    grams = np.stack([Q.T @ Q for Q in (block.reshape(-1, b) for block in blocks)])
    return _intervals(estimate, scores, grams, cosines(T))


def _intervals(estimate: Estimate, scores: Array, grams: Array, B: int) -> Intervals:
    """Intervals from scores (T, b) of instants or blocks, which add up to beta - beta_true, and Q'Q of blocks (K, b, b)."""
    sigma = deviations(scores, B) / np.sqrt(_share(estimate.bread, grams, B))
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
    L = _family(B, len(scores)) @ scores
    return np.asarray(np.sqrt((L**2).mean(axis=0)))


def _share(bread: Array, grams: Array, B: int) -> Array:
    """(b,) of the variance that white noise gives an estimate, the share that the cosines find in the residuals.

    The estimate takes b directions out of the noise: rho = (I - Q Q')e. A cosine's L = a'rho, a being the cosine times the rows
    of Q bread', has the variance |a|² - |Q'a|². Regressors as slow as the cosines lose more of it than b of r rows: on the TX40
    up to a third of the deviation, where b/r is a fortieth.
    """
    cosine = _family(B, len(grams))
    of_block = ((bread @ grams) * bread).sum(axis=-1)  # (K, b), sum of squared rows of Q bread'
    lost = (bread @ np.tensordot(cosine, grams, axes=1)) ** 2  # (B, b, b)
    found = (cosine**2 @ of_block - lost.sum(axis=-1)).mean(axis=0)
    return np.asarray(np.maximum(found / of_block.sum(axis=0), LEAST_SHARE))


def _family(B: int, T: int) -> Array:
    """sqrt(2) cos(pi k (t + 1/2)/T), k = 1 to B: (B, T)."""
    k, t = np.arange(1, B + 1)[:, None], np.arange(T)
    return np.asarray(np.sqrt(2) * np.cos(np.pi * k * (t + 0.5) / T))


def cosines(T: int) -> int:
    """Their number for T instants: enough to tell the spread, few enough to stay at low frequencies."""
    return int(np.clip(np.floor(0.4 * T ** (2 / 3)), FEWEST, MOST))


def _reach(freedom: int) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 + LEVEL / 2))
