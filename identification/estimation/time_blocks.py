"""Long recordings by equal blocks of time: sums over the rows, from which intervals and the estimates of parts follow."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from .confidence import TIME_BLOCKS, Intervals, Scores, cosines, estimate_deviations, intervals_from
from .estimators import Estimate


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockSums:
    """Sums over the rows of each of K equal blocks of time, with the orthonormal columns Q (r, b) of an estimate.

    Attributes:
        QQ, QW: (K, b, b) Q'Q and Q'W, rows weighted as the estimate was; `QY`: (K, b) Q'Y.
        WW: (K, b, b) W'W of the same rows in the unit of the torque; `WY`: (K, b) W'Y.
        edges: (K + 1,) the first instant of each block and the end of the last.
    """

    QQ: Array
    QW: Array
    QY: Array
    WW: Array
    WY: Array
    edges: NDArray[np.intp]

    def between(self, first: int, last: int) -> "BlockSums":
        """The blocks that lie between these instants, of which both are edges."""
        a, z = np.searchsorted(self.edges, (first, last))
        QQ, QW, QY, WW, WY = (x[a:z] for x in (self.QQ, self.QW, self.QY, self.WW, self.WY))
        return BlockSums(QQ=QQ, QW=QW, QY=QY, WW=WW, WY=WY, edges=self.edges[a : z + 1])

    def scores(self, beta: Array, bread: Array, T: Array) -> Scores:
        """Scores bread T'Q'(Y - W beta) of an estimate beta (b,) with the orthonormal columns Q T."""
        scores = (self.QY - self.QW @ beta) @ T @ bread.T
        return Scores(scores=scores, grams=T.T @ self.QQ @ T, cosines=cosines(int(self.edges[-1] - self.edges[0])))


def _edges(K: int, T: int) -> NDArray[np.intp]:
    """First instants of K blocks of T instants, instant t being in block t K // T; and T."""
    return np.asarray(-(-np.arange(K + 1) * T // K))


@dataclass(frozen=True, kw_only=True, eq=False)
class TimeBlocks:
    """Normal matrices of a recording's equal blocks of time, from which the scores of any least squares follow.

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
        return cls(products=np.zeros((min(TIME_BLOCKS, instants), n, b, b + 1)), instants=instants, names=names)

    def add(self, first: int, W: Array, Y: Array, counts: NDArray[np.bool_]) -> None:
        """Add the instants from `first` on: W (n, b, rows), Y (n, rows), and which of them count (rows, n)."""
        K = len(self.products)
        block = np.arange(first, first + len(counts)) * K // self.instants
        for k in np.unique(block):
            for j in range(len(W)):
                rows = np.flatnonzero((block == k) & counts[:, j])
                W_k = W[j][:, rows]
                self.products[k, j] += W_k @ np.c_[W_k.T, Y[j, rows]]

    def sums(self, estimate: Estimate, T: Array) -> BlockSums:
        """Sums of the parameters estimated; W T are the estimate's orthonormal columns."""
        among = [self.names.index(name) for name in estimate.names]
        weighted = np.tensordot(estimate.weights**2, self.products, axes=(0, 1))[:, among]
        plain, gram = self.products.sum(axis=1)[:, among], weighted[..., among]
        return BlockSums(
            QQ=T.T @ gram @ T,
            QW=T.T @ gram,
            QY=weighted[..., -1] @ T,
            WW=plain[..., among],
            WY=plain[..., -1],
            edges=_edges(len(plain), self.instants),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class InstrumentBlocks:
    """The same of instruments Z, for an estimate by instrumental variables.

    Attributes:
        products: (K, b, 2b + 1) of block, Z'[Z W Y] of the weighted rows that count.
        plain: (K, b, b + 1) of block, W'[W Y] of the same rows without weights.
        instants: T, how many the blocks share.
        names: (b,) parameters.
    """

    products: Array
    plain: Array
    instants: int
    names: tuple[str, ...]

    @classmethod
    def none_yet(cls, instants: int, names: tuple[str, ...]) -> "InstrumentBlocks":
        """Blocks to which `add` brings the rows of so many instants."""
        b, K = len(names), min(TIME_BLOCKS, instants)
        products, plain = np.zeros((K, b, 2 * b + 1)), np.zeros((K, b, b + 1))
        return cls(products=products, plain=plain, instants=instants, names=names)

    def add(self, first: int, columns: Array, weights: Array, counts: NDArray[np.bool_]) -> None:
        """Add the instants from `first` on: Z W Y (n, 2b + 1, rows), the `weights` (n,) of the joints, and which of the rows
        count (rows, n).
        """
        K, b = len(self.products), len(self.names)
        block = np.arange(first, first + len(counts)) * K // self.instants
        for k in np.unique(block):
            for j, weight in enumerate(weights):
                own = columns[j][:, (block == k) & counts[:, j]]
                self.products[k] += weight**2 * (own[:b] @ own.T)
                self.plain[k] += own[b:-1] @ own[b:].T

    def sums(self, estimate: Estimate, T: Array) -> BlockSums:
        """Sums of the parameters estimated; Z T are the estimate's orthonormal columns."""
        b, among = len(self.names), np.array([self.names.index(name) for name in estimate.names])
        products, plain = self.products[:, among], self.plain[:, among]
        return BlockSums(
            QQ=T.T @ products[..., among] @ T,
            QW=T.T @ products[..., b + among],
            QY=products[..., -1] @ T,
            WW=plain[..., among],
            WY=plain[..., -1],
            edges=_edges(len(plain), self.instants),
        )


def sums_of_blocks(
    estimate: Estimate, recordings: Sequence[TimeBlocks | InstrumentBlocks], basis: Array | None = None
) -> tuple[BlockSums, ...]:
    """The blocks of recordings with the columns Q of an estimate, of all parameters or some.

    `basis` T (b, b) makes Z T the estimate's orthonormal Q, by default its `bread`: W bread is that of least squares.
    """
    T = estimate.bread if basis is None else basis
    return tuple(blocks.sums(estimate, T) for blocks in recordings)


def intervals_of_blocks(estimate: Estimate, recordings: Sequence[BlockSums]) -> Intervals:
    """Intervals of an estimate from the sums over the blocks of recordings."""
    one = np.eye(len(estimate.beta))
    found = [blocks.scores(estimate.beta, estimate.bread, one) for blocks in recordings]
    return intervals_from(estimate, *estimate_deviations(estimate.bread, found))
