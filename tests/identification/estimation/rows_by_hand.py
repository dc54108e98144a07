"""Systems of rows made by hand."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from identification.estimation import Spans, System
from identification.regression.spans import SpanRows


def of_instants(
    W: np.ndarray, Y: np.ndarray, joint: np.ndarray, parts: Sequence[int], used: np.ndarray
) -> System:
    """Rows (r, b) and (r,) of the instants of recordings, one span each, stacked by joint; of those
    that are `used` (r,).
    """
    whole = System.whole(W, Y, joint, tuple("abcdefgh"[: W.shape[1]]))
    instant = np.tile(np.arange(sum(parts)), joint[-1] + 1)
    spans = tuple(Spans(instants=part, count=part) for part in parts)
    rows = np.bincount(joint, weights=used)
    return replace(whole, rows=rows, span=instant, spans=spans).part(used)


def collected(W: np.ndarray, Y: np.ndarray, share: np.ndarray, ends: Sequence[int]) -> System:
    """The system of columns W (n, b, T) and Y (n, T) of a recording, in pieces that end there."""
    rows = SpanRows(*share.shape)
    for a, z in pairwise((0, *ends, len(share))):
        rows.add(a, np.concatenate([W, Y[:, None]], axis=1)[..., a:z], share[a:z])
    A, _, followed = rows.rows()
    return System(W=A[:, :-1], Y=A[:, -1], names=tuple("abcdefgh"[: W.shape[1]]), **followed)
