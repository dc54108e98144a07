"""Collects rows of a recording by joint and span of time: one form for a short one and an hour.

Where a span has more rows than columns it keeps their R factor, A = Q R: it has the same products
of columns, hence the same least squares and instrumental variables, and avoids the loss of digits
of squared sums. A half of a recording is half of its spans; several recordings stand one after the
other.
"""

from typing import Any

import numpy as np

from ..arrays import Array, Bools, Ints
from .system import equal_spans, is_short, r_factor, release_memory, spans_of

_RELEASED = 100  # factors that are copied before their memory is given back


class SpanRows(dict[tuple[int, int], tuple[Array, Ints]]):
    """Rows of a recording, such as [Z J r], by joint and span of time: by joint and place the rows,
    and twice their span, one more for fast ones. Those of blocks are made apart, and then added.
    """

    @classmethod
    def of_block(
        cls, instants: int, first: int, A: Array, share: Array, fast: Bools | None = None
    ) -> "SpanRows":
        """The rows A (n, columns, K) of the instants from `first` on, of so many `instants` in all,
        by their weights `share` (n, K), 0 for rows that do not count. Rows that are `fast` (n, K)
        have factors of their own.
        """
        at, found = np.arange(first, first + A.shape[2]), cls()
        span = np.searchsorted(equal_spans(instants), at, side="right") - 1
        fast = np.zeros(share.shape, dtype=bool) if fast is None else fast
        for j, (own, counts) in enumerate(zip(A, share > 0, strict=True)):
            rows, kind = own[:, counts].T, 2 * span[counts] + fast[j, counts]
            if is_short(instants):
                found[j, first] = rows, kind
                continue
            found[j, 2 * int(span[0])] = rows[:0], kind[:0]  # where no row counts
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
        """The rows (r, columns), joint by joint in the order of time, which are fast (r,), and how
        they follow: the further attributes of a `System`. Once only.
        """
        each = sorted(self)
        lengths, columns = [len(self[key][1]) for key in each], self[each[0]][0].shape[1]
        rows, kind = np.empty((sum(lengths), columns)), np.empty(sum(lengths), dtype=np.intp)
        for key, at in zip(each, spans_of(lengths), strict=True):  # never twice in memory
            rows[at], kind[at] = self.pop(key)
            if len(self) % _RELEASED == 0:
                release_memory(rows)
        joint = np.repeat(np.array([j for j, _ in each], dtype=np.intp), lengths)
        span, fast = np.divmod(kind, 2)
        followed = {
            "joint_of_row": joint,
            "span": span,
            "rows": (share**2).sum(axis=0),
            "spans": (equal_spans(len(share)),),
        }
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
