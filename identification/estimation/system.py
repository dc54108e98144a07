"""The over-determined system of the estimators: its rows by joint and time block, and factors.

The rows have one form for a short recording and for an hour.
"""

import ctypes
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from ..arrays import Array, Bools, Ints
from ..errors import NoFitError

# Time blocks of a long recording. They end at its half and at each fifth, and a half period of the
# fastest cosine has 7.5 of them. A short recording has more, because a cosine in steps lets in
# noise that grows with frequency: on the EMPS with 20 µm of added position noise (mean of 40
# draws), intervals are 25 % wider with 120 blocks than with one block per instant, 11 % with 240
# and 8.5 % with 480.
SPANS, FINE_SPANS = 120, 240
SHORT = 12_000  # instants; the rows of a shorter recording are kept as they are
_BLOCK_ROWS, _BLOCKS = 1024, 16  # rows of a factored block; blocks at a time, which are copied
_MAX_CONDITION = 1e3  # largest condition number for which A R⁻¹ is orthonormal to 1e-12
_LARGE = 2**24  # bytes; beside a smaller array, freed memory does not matter
_RELEASED = 100  # factors that are copied before their memory is returned
RANK_TOLERANCE = 1e-8  # of the largest singular value of the column-scaled W


def equal_spans(instants: int) -> Ints:
    """Return the first instant (count + 1,) of each time block, and the end of the last one.

    Instant t is in block t count // instants. Each block has at least one instant.
    """
    count = min(FINE_SPANS if instants <= SHORT else SPANS, instants)
    return np.asarray(-(-np.arange(count + 1) * instants // count))


def spans_at(spans: Sequence[Ints], instants: Sequence[Ints]) -> Ints:
    """Return the time block of each of the `instants` (K,) of recordings with these `spans`.

    Blocks are counted through all recordings. Instants after the end are in the last block.
    """
    first = np.cumsum([0, *(len(own) - 1 for own in spans)])
    return np.concatenate(
        [
            np.searchsorted(own[1:-1], at, side="right") + k
            for own, at, k in zip(spans, instants, first, strict=False)
        ]
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class System:
    """Y = W beta + rho, equations (5) and (6) of Janot2014.

    It holds the weighted rows that count, stacked joint by joint, or the R factors of the rows of
    each time block, which have the same products.

    Attributes:
        W: (r, b) regressor.
        Y: (r,) torques, N m or N.
        joint_of_row: (r,) joint index of each row, ascending.
        names: (b,) parameters.
        rows: (n,) effective samples per joint, the sums of the squares of their weights.
        span: (r,) time block of each row, counted through all recordings.
        spans: first instant of the time blocks of each recording, and the end of the last one.
    """

    W: Array
    Y: Array
    joint_of_row: Ints
    names: tuple[str, ...]
    rows: Array
    span: Ints
    spans: tuple[Ints, ...]

    @classmethod
    def whole(cls, W: Array, Y: Array, joint_of_row: Ints, names: tuple[str, ...]) -> "System":
        """Make a system of samples, which are one instant after the other at each joint."""
        rows = np.bincount(joint_of_row)
        spans = equal_spans(int(rows.max()))
        return cls(
            W=W,
            Y=Y,
            joint_of_row=joint_of_row,
            names=names,
            rows=rows.astype(float),
            span=np.searchsorted(
                spans, np.concatenate([np.arange(count) for count in rows]), side="right"
            )
            - 1,
            spans=(spans,),
        )

    def part(self, rows: Bools) -> "System":
        """Return the system of the rows in a mask (r,)."""
        return replace(
            self,
            **{name: getattr(self, name)[rows] for name in ("W", "Y", "joint_of_row", "span")},
        )

    def with_columns(self, columns: Ints) -> "System":
        """Return the system of some of the parameters, by their `columns`."""
        return (
            self
            if len(columns) == len(self.names)
            else replace(self, W=self.W[:, columns], names=tuple(self.names[i] for i in columns))
        )

    def weighted(self, weights: Array) -> tuple[Array, Array]:
        """Return W (r, b) and Y (r,) with the rows of joint j times `weights` (n,)."""
        w = weights[self.joint_of_row]
        return self.W * w[:, None], self.Y * w


class SpanRows(dict[tuple[int, int], tuple[Array, Ints]]):
    """Rows of a recording, such as [Z J r], by joint and time block.

    The keys are joint and place, the values rows and twice their block, plus one for fast rows.
    Blocks of samples are computed one by one and then added.

    If a time block has more rows than columns, it keeps their R factor, A = Q R. This has the same
    products of columns, hence the same least squares and instrumental variables, and avoids the
    loss of digits of squared sums. Half a recording is half of its time blocks; several recordings
    are stacked.
    """

    @classmethod
    def of_block(
        cls, instants: int, first: int, A: Array, share: Array, fast: Bools | None = None
    ) -> "SpanRows":
        """Make the rows of a block of samples.

        Parameters
        ----------
        instants : number of instants of the whole recording.
        first : first instant of the block.
        A : (n, columns, K) rows by joint.
        share : (n, K) weights, 0 for rows that do not count.
        fast : (n, K) mask of the rows that get factors of their own; None for none.
        """
        at, found = np.arange(first, first + A.shape[2]), cls()
        span = np.searchsorted(equal_spans(instants), at, side="right") - 1
        fast = np.zeros(share.shape, dtype=bool) if fast is None else fast
        for j, (own, counts) in enumerate(zip(A, share > 0, strict=True)):
            rows, kind = own[:, counts].T, 2 * span[counts] + fast[j, counts]
            if instants <= SHORT:
                found[j, first] = rows, kind
                continue
            # A joint without any row that counts needs an entry too.
            found[j, 2 * int(span[0])] = rows[:0], kind[:0]
            for k in np.unique(kind).tolist():
                R = _reduced(rows[kind == k])
                found[j, k] = R, np.full(len(R), k)
        return found

    def add(self, block: "SpanRows") -> None:
        """Add the rows of the next block."""
        for key, (rows, kind) in block.items():
            if key in self:
                rows = _reduced(np.r_[self[key][0], rows])
                kind = np.full(len(rows), key[1])
            self[key] = rows, kind

    def rows(self, share: Array) -> tuple[Array, Bools, dict[str, Any]]:
        """Return the rows (r, columns), a mask (r,) of fast rows, and further fields of a `System`.

        Rows are ordered by joint and then by time. This can be called only once.
        """
        each = sorted(self)
        lengths, columns = [len(self[key][1]) for key in each], self[each[0]][0].shape[1]
        rows, kind = np.empty((sum(lengths), columns)), np.empty(sum(lengths), dtype=np.intp)
        # Each block is removed when it is copied, so that the rows are never in memory twice.
        for key, (first, last) in zip(each, pairwise(np.cumsum([0, *lengths])), strict=True):
            rows[first:last], kind[first:last] = self.pop(key)
            if len(self) % _RELEASED == 0:
                release_memory(rows)
        span, fast = np.divmod(kind, 2)
        followed = {
            "joint_of_row": np.repeat(np.array([j for j, _ in each], dtype=np.intp), lengths),
            "span": span,
            "rows": (share**2).sum(axis=0),
            "spans": (equal_spans(len(share)),),
        }
        return rows, fast.astype(bool), followed


def _reduced(rows: Array) -> Array:
    """Return the rows (r, columns) of a joint, or their R factor if that has fewer rows.

    A joint depends on some of the columns only.
    """
    own = rows.any(axis=0)
    if len(rows) <= own.sum():
        return rows
    R = r_factor(rows[:, own])
    found = np.zeros((len(R), rows.shape[1]))
    found[:, own] = R
    return found


def by_joint(systems: Sequence[System]) -> Ints:
    """Return the order (r,) that stacks the rows of several recordings joint by joint."""
    return np.argsort(np.concatenate([s.joint_of_row for s in systems]), kind="stable")


def stacked(systems: Sequence[System]) -> System:
    """Stack the rows of several recordings of the same parameters, joint by joint."""
    order, ends = by_joint(systems), np.cumsum([sum(len(x) - 1 for x in s.spans) for s in systems])
    W, Y, joint_of_row, span = (
        np.concatenate([getattr(s, name) for s in systems])[order]
        for name in ("W", "Y", "joint_of_row", "span")
    )
    before = np.repeat([0, *ends[:-1]], [len(s.span) for s in systems])
    return replace(
        systems[0],
        W=W,
        Y=Y,
        joint_of_row=joint_of_row,
        rows=np.sum([s.rows for s in systems], axis=0),
        span=span + before[order],
        spans=tuple(own for s in systems for own in s.spans),
    )


def r_factor(A: Array) -> Array:
    """Return R (c, c) of A (r, c) = Q R, by blocks that fit into the cache.

    This is TSQR: Demmel, Grigori, Hoemmen, Langou, SIAM J. Sci. Comput. 34 (2012). It is three
    times as fast for long A.
    """
    r, c = A.shape
    blocks = r // _BLOCK_ROWS
    if blocks < 2 or c >= _BLOCK_ROWS:
        return np.asarray(np.linalg.qr(A, mode="r"))
    end, some = blocks * _BLOCK_ROWS, _BLOCKS * _BLOCK_ROWS
    each = (A[k : min(end, k + some)].reshape(-1, _BLOCK_ROWS, c) for k in range(0, end, some))
    factors = [np.asarray(np.linalg.qr(few, mode="r")).reshape(-1, c) for few in each]
    return r_factor(np.concatenate([*factors, A[end:]]))


def release_memory(beside: Array) -> None:
    """Return freed memory to the system if there is a large array `beside` it.

    Between the arrays of a long recording the allocator keeps hundreds of MB. Only glibc can return
    them.
    """
    if beside.nbytes > _LARGE:
        with suppress(AttributeError, TypeError):
            ctypes.CDLL(None).malloc_trim(0)


def orthonormal(A: Array) -> Array:
    """Return orthonormal columns (r, c) that span the independent columns of A (r, c): A R⁻¹."""
    if len(A) < 2 * _BLOCK_ROWS:
        return np.asarray(np.linalg.qr(A)[0])
    release_memory(A)
    inverse, condition = inverse_factor(A)
    Q = np.asarray(A @ inverse)
    # If R is ill-conditioned, a second step is needed for orthonormality to rounding.
    return Q if condition < _MAX_CONDITION else np.asarray(Q @ inverse_factor(Q)[0])


def inverse_factor(A: Array) -> tuple[Array, float]:
    """Return R⁻¹ (c, c) of A (r, c) = Q R, and cond(R) with columns of norm one."""
    R = r_factor(A)
    d = np.maximum(np.linalg.norm(R, axis=0), 1e-300)
    return np.asarray(np.linalg.pinv(R / d) / d[:, None]), float(np.linalg.cond(R / d))


def refuse_rank_deficiency(W: Array, names: tuple[str, ...]) -> Array:
    """Return the singular values of the column-scaled W (r, b); refuse W if one is zero.

    Raises
    ------
    NoFitError : the text names the parameters that are not excited or not distinguishable.
    """
    unexcited, collinear, singular = _undetermined(W, names)
    if unexcited:
        raise NoFitError(
            "they have no effect on the torque along this trajectory",
            key="parameters",
            value=unexcited,
            shown=", ".join(unexcited),
            advice="Use a trajectory that excites them; `robot-identify excite` designs one",
        )
    if collinear:
        rank = int((singular >= RANK_TOLERANCE * singular[0]).sum())
        raise NoFitError(
            f"the trajectory cannot distinguish {', '.join(collinear)}: the rank is {rank} for "
            f"{len(names)} parameters",
            advice="Use a trajectory that excites them; `robot-identify excite` designs one",
        )
    return singular


def undetermined_parameters(W: Array, names: tuple[str, ...]) -> list[str]:
    """Return the parameters that the rows W (r, b) do not excite or cannot distinguish."""
    unexcited, collinear, _ = _undetermined(W, names)
    return [name for name in names if name in (*unexcited, *collinear)]


def _undetermined(W: Array, names: tuple[str, ...]) -> tuple[list[str], list[str], Array]:
    """Return parameters not excited, parameters not distinguishable, and singular values.

    The singular values are those of the column-scaled W.
    """
    R = r_factor(W)
    norms = np.linalg.norm(R, axis=0)
    excited = norms > 1e-12 * norms.max()
    _, singular, Vt = np.linalg.svd(R[:, excited] / norms[excited])
    involved = np.abs(Vt[singular < RANK_TOLERANCE * singular[:1]]).max(axis=0, initial=0.0) > 0.05
    every = np.array(names)
    unexcited, collinear = every[~excited].tolist(), every[excited][involved].tolist()
    return unexcited, collinear, np.asarray(singular)
