"""The over-determined system of the estimators, and QR factors of its rows for long recordings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import NoFitError

# of a long recording: halves and fifths of its time end where spans do; 7.5 per half period
# of the fastest cosine
SPANS = 120
_BLOCK_ROWS = 1024  # of a block that is factored at a time
_MAX_CONDITION = 1e3  # condition up to which A R⁻¹ is orthonormal to 1e-12
RANK_TOLERANCE = 1e-8  # of the largest singular value of the column-scaled W


@dataclass(frozen=True, kw_only=True)
class Spans:
    """The rows of a recording: `count` spans of equal time, each with `rows` rows of each
    joint, in all of `instants`.

    Held rows are spans of one instant and one row; those of a long recording are QR
    factors of a span's rows.
    """

    instants: int
    count: int
    rows: int = 1

    @property
    def edges(self) -> NDArray[np.intp]:
        """(count + 1,) the first instant of each span, and the end of the last: instant t is in
        span t count // instants.
        """
        return np.asarray(-(-np.arange(self.count + 1) * self.instants // self.count))

    def between(self, part: slice, start: int = 0) -> "Spans":
        """The spans of a part of the time, which ends where spans do; the recording
        starts at instant `start`.
        """
        first, last = np.clip((part.start - start, part.stop - start), 0, self.instants)
        count = int(np.subtract(*np.searchsorted(self.edges, (last, first))))
        return replace(self, instants=int(last - first), count=count)


@dataclass(frozen=True, kw_only=True, eq=False)
class System:
    """Y = W beta + rho, equations (5) and (6) of Janot2014: rows stacked joint by joint.

    Attributes:
        W: (r, b) regressor.
        Y: (r,) torques.
        joint_of_row: (r,) joint index of each row, ascending.
        names: (b,) parameters.
        share: (r,) weight of each row, at most 1, with which W and Y are multiplied; 0 for
            rows that do not count.
        rows: (n,) samples per joint, the sum of the squares of their weights; more than rows of W
            where these are QR factors.
        spans: by recording how its rows follow in time, the same for each joint;
            empty where they do not.
    """

    W: Array
    Y: Array
    joint_of_row: NDArray[np.intp]
    names: tuple[str, ...]
    share: Array
    rows: Array
    spans: tuple[Spans, ...] = ()

    def __post_init__(self) -> None:
        r, b = self.W.shape
        if {self.Y.shape, self.joint_of_row.shape, self.share.shape} != {(r,)} or len(
            self.names
        ) != b:
            raise ValueError(
                f"shapes do not agree: W {self.W.shape}, Y {self.Y.shape}, {len(self.names)} "
                "parameters"
            )

    @classmethod
    def whole(
        cls, W: Array, Y: Array, joint_of_row: NDArray[np.intp], names: tuple[str, ...]
    ) -> "System":
        """A system all of whose rows are samples that count."""
        rows = np.bincount(joint_of_row).astype(float)
        return cls(
            W=W, Y=Y, joint_of_row=joint_of_row, names=names, share=np.ones(len(Y)), rows=rows
        )

    @property
    def used(self) -> Array:
        """(r,) 1 for rows that count, else 0."""
        return (self.share > 0).astype(float)

    def with_rows(self, used: Array) -> "System":
        """The same system with fewer rows: of those that count the `used` ones (r,), 1 and 0."""
        share = self.share * used
        rows: Array = np.bincount(
            self.joint_of_row, weights=share**2, minlength=len(self.rows)
        ).astype(float)
        return replace(self, share=share, rows=rows)

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


class SpanFactors:
    """R factors of the used rows, such as [Z W Y], of each joint in each span of a long recording.

    A factor has the same column products AᵀB as its rows, hence the same least squares and
    instrumental variables, and avoids the loss of digits of squared sums.
    """

    def __init__(self, instants: int, n: int, spans: int = SPANS) -> None:
        """Of `instants` of n joints, without any rows yet."""
        self._instants, self._rows = instants, np.zeros(n)
        self._R: list[list[Array | None]] = [[None] * n for _ in range(min(spans, instants))]

    def add(self, first: int, columns: Array, share: Array) -> None:
        """Add the instants from `first` on: columns (n, columns, T), and `share` (T, n), 0 for
        rows that do not count.
        """
        span = np.arange(first, first + len(share)) * len(self._R) // self._instants
        for k in np.unique(span):
            for j, own in enumerate(columns):
                before, more = self._R[k][j], own[:, (span == k) & (share[:, j] > 0)].T
                self._R[k][j] = _factor(more if before is None else np.concatenate([before, more]))
        self._rows += (share**2).sum(axis=0)

    def rows(self) -> tuple[Array, dict[str, Any]]:
        """The rows (r, columns) of all joints and spans, and how they follow: the further
        attributes of a `System`. Once only.

        Spans with fewer rows end with zeros.
        """
        each = [[R for R in of_span if R is not None] for of_span in self._R]
        n, K, m = len(self._rows), len(each), max(len(R) for of_span in each for R in of_span)
        found = np.zeros((n, K, m, each[0][0].shape[1]))
        self._R.clear()  # as large as the rows
        for k in range(K):
            for j, R in enumerate(each[k]):
                found[j, k, : len(R)] = R
            each[k].clear()
        return found.reshape(n * K * m, -1), {
            "joint_of_row": np.repeat(np.arange(n), K * m),
            "share": np.ones(n * K * m),
            "rows": self._rows.copy(),
            "spans": (Spans(instants=self._instants, count=K, rows=m),),
        }


def stacked_columns(each: Sequence[Array], n: int) -> Array:
    """Columns (r, k) of several recordings, whose rows (r_i, k) are by joint of n,
    stacked joint by joint.
    """
    if len(each) == 1:
        return each[0]
    blocks = [x.reshape(n, len(x) // n, x.shape[1]) for x in each]
    return np.concatenate(blocks, axis=1).reshape(sum(map(len, each)), each[0].shape[1])


def stacked(systems: Sequence[System]) -> System:
    """The system of several recordings of the same parameters, rows stacked joint by
    joint, in the order given.
    """
    if len(systems) == 1:
        return systems[0]
    rows = [[s.joint_of_row == j for s in systems] for j in range(len(systems[0].rows))]

    def by_joint(name: str) -> Array:
        values = [getattr(s, name) for s in systems]
        return np.concatenate(
            [x[own] for indices in rows for x, own in zip(values, indices, strict=True)]
        )

    return replace(
        systems[0],
        W=by_joint("W"),
        Y=by_joint("Y"),
        joint_of_row=np.sort(np.concatenate([s.joint_of_row for s in systems])),
        share=by_joint("share"),
        rows=np.sum([s.rows for s in systems], axis=0),
        spans=tuple(spans for s in systems for spans in s.spans),
    )


def condensed(system: System) -> System:
    """Per joint the QR factor of the used rows of [W Y]: at most b + 1 rows with
    the same least squares.
    """
    rows = np.c_[system.W, system.Y]
    R = [
        _factor(rows[(system.joint_of_row == j) & (system.share > 0)])
        for j in range(len(system.rows))
    ]
    stack, joints = np.concatenate(R), np.repeat(np.arange(len(R)), [len(x) for x in R])
    W, Y = np.ascontiguousarray(stack[:, :-1]), np.ascontiguousarray(stack[:, -1])
    return replace(system, W=W, Y=Y, joint_of_row=joints, share=np.ones(len(stack)), spans=())


def _factor(rows: Array) -> Array:
    """The R factor of rows (r, columns) of a joint, which depends on some parameters only."""
    own = np.any(rows, axis=0)
    R = r_factor(rows[:, own])
    found = np.zeros((len(R), rows.shape[1]))
    found[:, own] = R
    return found


def r_factor(A: Array) -> Array:
    """R (c, c) of A (r, c) = Q R, by blocks that fit into the cache (TSQR: Demmel, Grigori,
    Hoemmen, Langou, SIAM J. Sci. Comput. 34 (2012)): three times as fast for long A.
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
    """Singular values of the column-scaled W; an error names the parameters that are not excited
    or not distinguishable.
    """
    unexcited, collinear, singular = _undetermined(W, names)
    if unexcited:
        raise NoFitError(
            "no torque depends on them",
            key="parameters not excited",
            value=unexcited,
            shown=", ".join(unexcited),
        )
    if collinear:
        rank = int((singular >= RANK_TOLERANCE * singular[0]).sum())
        raise NoFitError(
            f"the trajectory excites too little: rank {rank} for {len(names)} parameters; "
            f"not distinguishable: {', '.join(collinear)}"
        )
    return singular


def undetermined_parameters(W: Array, names: tuple[str, ...]) -> list[str]:
    """Names of the parameters that the rows W (r, b) do not determine: not excited
    or not distinguishable.
    """
    unexcited, collinear, _ = _undetermined(W, names)
    return [name for name in names if name in (*unexcited, *collinear)]


def _undetermined(W: Array, names: tuple[str, ...]) -> tuple[list[str], list[str], Array]:
    """Parameters not excited, parameters not distinguishable, and the singular values
    of the column-scaled W.
    """
    norms = np.linalg.norm(W, axis=0)
    excited = norms > 1e-12 * norms.max()
    _, singular, Vt = np.linalg.svd(r_factor(W[:, excited] / norms[excited]))
    lost = singular < RANK_TOLERANCE * singular[:1]
    involved = np.abs(Vt[lost]).max(axis=0, initial=0.0) > 0.05
    known = [name for name, s in zip(names, excited, strict=True) if s]
    unexcited = [name for name, s in zip(names, excited, strict=True) if not s]
    return (
        unexcited,
        [name for name, i in zip(known, involved, strict=True) if i],
        np.asarray(singular),
    )
