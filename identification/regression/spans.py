"""The rows of a recording by joint and span of time: one form for a short one and for an hour.

Where a span has more rows than columns it keeps their R factor, A = Q R: it has the same products
of columns, hence the same least squares and instrumental variables, and avoids the loss of digits
of squared sums. A half of a recording is half of its spans; several recordings stand one after the
other.
"""

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import Spans, r_factor


class SpanRows:
    """Collects the rows of a recording, such as [Z W Y], by joint and span of time.

    Where a span has more rows than columns it keeps their R factor, A = Q R: it has the same
    products of columns, hence the same least squares and instrumental variables, and avoids the
    loss of digits of squared sums.
    """

    def __init__(self, instants: int, n: int) -> None:
        """Of `instants` of n joints, without any rows yet."""
        self.spans = Spans.of(instants)
        self._rows, self._columns = np.zeros(n), 0
        self._parts = dict[tuple[int, int, bool], Array]()  # by joint, span, and whether fast

    def add(
        self, first: int, A: Array, share: Array, fast: NDArray[np.bool_] | None = None
    ) -> None:
        """Add the instants from `first` on: A (n, columns, T), and `share` (T, n), the weights, 0
        for rows that do not count. Rows that are `fast` (n, T) have factors of their own.
        """
        span = np.arange(first, first + len(share)) * self.spans.count // self.spans.instants
        self._rows, self._columns = self._rows + (share**2).sum(axis=0), A.shape[1]
        fast = np.zeros(share.T.shape, dtype=bool) if fast is None else fast
        for j, kind in product(range(len(A)), (False, True)):
            counts = (share[:, j] > 0) & (fast[j] == kind)
            rows, of_row = A[j][:, counts].T, span[counts]
            first_rows = np.flatnonzero(np.diff(of_row, prepend=-1))
            for k, own in zip(of_row[first_rows], np.split(rows, first_rows)[1:], strict=True):
                before = self._parts.get(key := (j, int(k), kind))
                self._parts[key] = _reduced(own if before is None else np.r_[before, own])

    def rows(self) -> tuple[Array, NDArray[np.bool_], dict[str, Any]]:
        """The rows (r, columns), joint by joint in the order of time, which are fast (r,), and how
        they follow: the further attributes of a `System`. Once only.
        """
        each = sorted(self._parts)
        lengths = [len(self._parts[key]) for key in each]
        rows = np.concatenate([np.zeros((0, self._columns)), *map(self._parts.pop, each)])
        joint, span, fast = np.repeat(np.array(each, dtype=np.intp).reshape(-1, 3), lengths, 0).T
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
