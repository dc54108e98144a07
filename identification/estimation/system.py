"""The over-determined system of the estimators, and QR factors of its rows for long recordings."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import IdentificationError

_BLOCK_ROWS = 1024  # of a block that is factored at a time
_MAX_CONDITION = 1e3  # condition up to which A R⁻¹ is orthonormal to 1e-12
RANK_TOLERANCE = 1e-8  # of the largest singular value of the column-scaled W


@dataclass(frozen=True, kw_only=True, eq=False)
class System:
    """Y = W beta + rho, equations (5) and (6) of Janot2014: rows stacked joint by joint.

    Attributes:
        W: (r, b) regressor.
        Y: (r,) torques.
        joint_of_row: (r,) joint index of each row, ascending.
        names: (b,) parameters.
        used: (r,) 1 for used rows, 0 for others.
        rows: (n,) used samples per joint; more than rows of W where these are QR factors.
    """

    W: Array
    Y: Array
    joint_of_row: NDArray[np.intp]
    names: tuple[str, ...]
    used: Array
    rows: NDArray[np.intp]

    def __post_init__(self) -> None:
        r, b = self.W.shape
        if {self.Y.shape, self.joint_of_row.shape, self.used.shape} != {(r,)} or len(self.names) != b:
            raise ValueError(f"shapes do not agree: W {self.W.shape}, Y {self.Y.shape}, {len(self.names)} parameters")

    @classmethod
    def whole(cls, W: Array, Y: Array, joint_of_row: NDArray[np.intp], names: tuple[str, ...]) -> "System":
        """A system all of whose rows are samples that count."""
        rows = np.bincount(joint_of_row)
        return cls(W=W, Y=Y, joint_of_row=joint_of_row, names=names, used=np.ones(len(Y)), rows=rows)

    def with_rows(self, used: Array) -> "System":
        """The same system with other `used` rows (r,), 1 and 0."""
        counts = np.bincount(self.joint_of_row, weights=used, minlength=len(self.rows))
        return replace(self, used=used, rows=counts.astype(np.intp))

    def with_columns(self, columns: NDArray[np.intp]) -> "System":
        """The same system for some of its parameters."""
        if len(columns) == len(self.names):
            return self
        return replace(self, W=self.W[:, columns], names=tuple(self.names[i] for i in columns))

    def weighted(self, weights: Array) -> tuple[Array, Array]:
        """W (r, b) and Y (r,) with rows of joint j times `weights` (n,), zero where unused."""
        w = weights[self.joint_of_row] * self.used
        return self.W * w[:, None], self.Y * w


def spans_of(parts: Sequence[int]) -> list[slice]:
    """The instants of each recording within those of all."""
    edges = np.cumsum([0, *parts])
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]


class Factors:
    """R factor of the rows [Z W Y], or [W Y], of each joint so far, and their number.

    The factor has the same column products AᵀB as the rows, hence the same least squares and instrumental variables, and avoids
    the loss of digits of squared sums.
    """

    def __init__(self, n: int, columns: int) -> None:
        """Of n joints, without any rows yet."""
        self._R: list[Array] = [np.empty((0, columns)) for _ in range(n)]
        self.rows = np.zeros(n, dtype=np.intp)

    def add(self, j: int, rows: Array, count: int | None = None) -> None:
        """Add rows (r, columns) of joint j, or a factor of `count` rows."""
        stack = np.concatenate([self._R[j], rows])
        own = stack.any(axis=0)  # a joint depends on some parameters only
        R = r_factor(stack[:, own])
        self._R[j] = np.zeros((len(R), stack.shape[1]))
        self._R[j][:, own] = R
        self.rows[j] += len(rows) if count is None else count

    def add_block(self, columns: Array, counts: NDArray[np.bool_]) -> None:
        """Add instants: columns (n, columns, T), and `counts` (T, n), the rows used."""
        for j, own in enumerate(columns):
            self.add(j, own[:, counts[:, j]].T)

    def system(self, names: tuple[str, ...]) -> tuple[System, Array | None]:
        """W and Y as a system, and Z in the same rows; None for rows [W Y]."""
        stack, b = np.concatenate(self._R), len(names)
        system = System(
            W=np.ascontiguousarray(stack[:, -b - 1 : -1]),
            Y=np.ascontiguousarray(stack[:, -1]),
            joint_of_row=np.repeat(np.arange(len(self._R)), [len(R) for R in self._R]),
            names=names,
            used=np.ones(len(stack)),
            rows=self.rows.copy(),
        )
        return system, np.ascontiguousarray(stack[:, :b]) if stack.shape[1] > b + 1 else None


def condensed(system: System) -> System:
    """Per joint the QR factor of the used rows of [W Y]: at most b + 1 rows with the same least squares."""
    return combined([(system, None)])[0]


def combined(parts: Iterable[tuple[System, Array | None]]) -> tuple[System, Array | None]:
    """One system, with its instruments if any, equivalent to all parts."""
    found: Factors | None = None
    names: tuple[str, ...] = ()
    for system, Z in parts:
        stack = np.c_[system.W, system.Y] if Z is None else np.c_[Z, system.W, system.Y]
        found, names = found or Factors(len(system.rows), stack.shape[1]), system.names
        for j, count in enumerate(system.rows):
            found.add(j, stack[(system.joint_of_row == j) & (system.used > 0)], int(count))
    assert found is not None
    return found.system(names)


def r_factor(A: Array) -> Array:
    """R (c, c) of A (r, c) = Q R, by blocks that fit into the cache (TSQR: Demmel, Grigori, Hoemmen, Langou, SIAM J. Sci.
    Comput. 34 (2012)): three times as fast for long A.
    """
    r, c = A.shape
    blocks = r // _BLOCK_ROWS
    if blocks < 2 or c >= _BLOCK_ROWS:
        return np.asarray(np.linalg.qr(A, mode="r"))
    whole = A[: blocks * _BLOCK_ROWS].reshape(blocks, _BLOCK_ROWS, c)
    each: Array = np.asarray(np.linalg.qr(whole, mode="r"))
    return r_factor(np.concatenate([each.reshape(-1, c), A[blocks * _BLOCK_ROWS :]]))


def orthonormal(A: Array) -> Array:
    """Orthonormal columns (r, c) that span the independent columns of norm one A (r, c): A R⁻¹."""
    if len(A) < 2 * _BLOCK_ROWS:
        return np.asarray(np.linalg.qr(A)[0])
    R = r_factor(A)
    Q = np.asarray(A @ np.linalg.inv(R))
    # A second time where R is ill-conditioned, for orthonormality to rounding.
    return Q if np.linalg.cond(R) < _MAX_CONDITION else np.asarray(Q @ np.linalg.inv(r_factor(Q)))


def refuse_rank_deficiency(W: Array, names: tuple[str, ...]) -> Array:
    """Singular values of the column-scaled W; an error names the parameters that are not excited or not distinguishable."""
    unexcited, collinear, singular = _undetermined(W, names)
    if unexcited:
        raise IdentificationError(
            "no torque depends on them", key="parameters not excited", value=unexcited, shown=", ".join(unexcited)
        )
    if collinear:
        rank = int((singular >= RANK_TOLERANCE * singular[0]).sum())
        raise IdentificationError(
            f"the trajectory excites too little: rank {rank} for {len(names)} parameters; "
            f"not distinguishable: {', '.join(collinear)}"
        )
    return singular


def undetermined_parameters(W: Array, names: tuple[str, ...]) -> list[str]:
    """Names of the parameters that the rows W (r, b) do not determine: not excited or not distinguishable."""
    unexcited, collinear, _ = _undetermined(W, names)
    return [name for name in names if name in (*unexcited, *collinear)]


def _undetermined(W: Array, names: tuple[str, ...]) -> tuple[list[str], list[str], Array]:
    """Parameters not excited, parameters not distinguishable, and the singular values of the column-scaled W."""
    norms = np.linalg.norm(W, axis=0)
    excited = norms > 1e-12 * norms.max()
    _, singular, Vt = np.linalg.svd(r_factor(W[:, excited] / norms[excited]))
    lost = singular < RANK_TOLERANCE * singular[:1]
    involved = np.abs(Vt[lost]).max(axis=0, initial=0.0) > 0.05
    known = [name for name, s in zip(names, excited, strict=True) if s]
    unexcited = [name for name, s in zip(names, excited, strict=True) if not s]
    return unexcited, [name for name, i in zip(known, involved, strict=True) if i], np.asarray(singular)
