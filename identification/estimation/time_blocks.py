"""Normal matrices of equal blocks of time: what intervals of a long recording follow from, whose rows are not held."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from .confidence import TIME_BLOCKS, Intervals, Scores, cosines, intervals_of_scores
from .estimators import Estimate


@dataclass(frozen=True, kw_only=True, eq=False)
class TimeBlocks:
    """Normal matrices of a recording's equal blocks of time, from which the scores of any estimate follow.

    Attributes:
        products: (K, n, b, b + 1) of block and joint, Z'[W Y] of the rows that count; Z is W for least squares.
        grams: (K, n, b, b) of block and joint, Z'Z; None where Z is W.
        instants: T, how many the blocks share.
        names: (b,) parameters.
    """

    products: Array
    grams: Array | None
    instants: int
    names: tuple[str, ...]

    @classmethod
    def none_yet(cls, instants: int, n: int, names: tuple[str, ...], *, instruments: bool = False) -> "TimeBlocks":
        """Blocks to which `add` brings the rows of so many instants of n joints, with instruments or without."""
        b = len(names)
        products = np.zeros((min(TIME_BLOCKS, instants), n, b, b + 1))
        grams = np.zeros((*products.shape[:-1], b)) if instruments else None
        return cls(products=products, grams=grams, instants=instants, names=names)

    def add(self, first: int, W: Array, Y: Array, counts: NDArray[np.bool_], Z: Array | None = None) -> None:
        """Add the instants from `first` on: W, Z (n, b, rows), Y (n, rows), and which of them count (rows, n)."""
        K = len(self.products)
        block = np.arange(first, first + len(counts)) * K // self.instants
        for k in np.unique(block):
            for j in range(len(W)):
                rows = np.flatnonzero((block == k) & counts[:, j])
                Z_k = (W if Z is None else Z)[j][:, rows]
                self.products[k, j] += Z_k @ np.c_[W[j][:, rows].T, Y[j, rows]]
                if self.grams is not None:
                    self.grams[k, j] += Z_k @ Z_k.T

    def weighted(self, estimate: Estimate) -> tuple[Array, Array]:
        """Z'[W Y] (K, b, b + 1) and Z'Z (K, b, b) of the parameters estimated, joints weighted as the estimate was."""
        among = [self.names.index(name) for name in estimate.names]
        products = np.tensordot(estimate.weights**2, self.products, axes=(0, 1))[:, among][..., [*among, -1]]
        if self.grams is None:
            return products, products[..., :-1]
        return products, np.tensordot(estimate.weights**2, self.grams, axes=(0, 1))[:, among][..., among]


def intervals_of_blocks(estimate: Estimate, recordings: Sequence[TimeBlocks]) -> Intervals:
    """Intervals of an estimate by least squares or instruments, of all parameters or some, from the blocks of recordings.

    Scores are (Z'W)^-1 Z'rho; an orthonormal basis of Z is Q = Z R^-1 with Z'Z = R'R.
    """
    each = [blocks.weighted(estimate) for blocks in recordings]
    if recordings[0].grams is None:
        basis = bread = estimate.bread  # Q = W bread
        toward = bread @ bread.T  # (W'W)^-1
    else:
        gram = np.sum([grams.sum(axis=0) for _, grams in each], axis=0)
        d = np.sqrt(np.diag(gram))
        basis = np.linalg.inv(np.linalg.cholesky(gram / np.outer(d, d))).T / d[:, None]
        ztw = np.sum([products.sum(axis=0) for products, _ in each], axis=0)[:, :-1]
        scale = np.linalg.norm(ztw, axis=0)
        toward = np.linalg.solve((ztw / scale) / d[:, None], np.diag(1 / d)) / scale[:, None]
        bread = toward @ np.linalg.inv(basis).T  # beta - beta_true = bread Q'rho
    found = [
        Scores(
            scores=(products[..., -1] - products[..., :-1] @ estimate.beta) @ toward.T,
            grams=basis.T @ grams @ basis,
            cosines=cosines(blocks.instants),
        )
        for blocks, (products, grams) in zip(recordings, each, strict=True)
    ]
    return intervals_of_scores(estimate, found, bread)
