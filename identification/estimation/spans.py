"""Collects rows of a recording by joint and span of time: one form for a short one and an hour.

Where a span has more rows than columns it keeps their R factor, A = Q R: it has the same products
of columns, hence the same least squares and instrumental variables, and avoids the loss of digits
of squared sums. A half of a recording is half of its spans; several recordings stand one after the
other.
"""

from typing import Any

import numpy as np

from ..arrays import Array, Bools, Ints
from .system import equal_spans, is_short, r_factor, spans_of


class SpanRows:
    """Collects the rows of a recording, such as [Z J r], by joint and span of time."""

    def __init__(self, instants: int, n: int, *, one: bool = False) -> None:
        """Of `instants` of n joints, without any rows yet; `one`: a single span, for products of
        all the rows of a joint.
        """
        self.spans = np.array([0, instants]) if one else equal_spans(instants)
        self._short = is_short(instants) and not one
        self._rows, self._columns = np.zeros(n), 0
        # by joint and place: rows, and twice their span, one more for fast ones
        self._parts = dict[tuple[int, int], tuple[Array, Ints]]()

    def add(self, first: int, A: Array, share: Array, fast: Bools | None = None) -> None:
        """Add the instants from `first` on: A (n, columns, T), and `share` (T, n), the weights, 0
        for rows that do not count. Rows that are `fast` (n, T) have factors of their own.
        """
        instant = np.arange(first, first + len(share))
        span = np.searchsorted(self.spans, instant, side="right") - 1
        self._rows, self._columns = self._rows + (share**2).sum(axis=0), A.shape[1]
        fast = np.zeros(share.T.shape, dtype=bool) if fast is None else fast
        for j, own in enumerate(A):
            counts = share[:, j] > 0
            rows, kind = own[:, counts].T, 2 * span[counts] + fast[j, counts]
            if self._short:
                self._parts[j, first] = rows, kind
                continue
            for k in np.unique(kind).tolist():
                before, _ = self._parts.get((j, k), (rows[:0], kind))
                R = _reduced(np.r_[before, rows[kind == k]])
                self._parts[j, k] = R, np.full(len(R), k)

    def rows(self) -> tuple[Array, Bools, dict[str, Any]]:
        """The rows (r, columns), joint by joint in the order of time, which are fast (r,), and how
        they follow: the further attributes of a `System`. Once only.
        """
        each = sorted(self._parts)
        lengths = [len(self._parts[key][1]) for key in each]
        rows, kind = np.empty((sum(lengths), self._columns)), np.empty(sum(lengths), dtype=np.intp)
        for key, at in zip(each, spans_of(lengths), strict=True):  # never twice in memory
            rows[at], kind[at] = self._parts.pop(key)
        joint = np.repeat(np.array([j for j, _ in each], dtype=np.intp), lengths)
        span, fast = np.divmod(kind, 2)
        followed = {"joint_of_row": joint, "span": span, "rows": self._rows, "spans": (self.spans,)}
        return rows, fast.astype(bool), followed


def _reduced(rows: Array) -> Array:
    """The rows (r, columns) of a joint, which depends on some columns only, or their R factor."""
    own = rows.any(axis=0)
    if len(rows) <= own.sum():
        return rows
    R = r_factor(rows[:, own])
    found = np.zeros((len(R), rows.shape[1]))
    found[:, own] = R
    return found
