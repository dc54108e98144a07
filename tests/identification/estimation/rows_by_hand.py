"""Systems of rows made by hand."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from identification.estimation import System


def of_instants(
    W: np.ndarray, Y: np.ndarray, joint: np.ndarray, parts: Sequence[int], used: np.ndarray
) -> System:
    """Rows (r, b) and (r,) of the instants of recordings, one span each, stacked by joint; of those
    that are `used` (r,).
    """
    whole = System.whole(W, Y, joint, tuple("abcdefgh"[: W.shape[1]]))
    instant = np.tile(np.arange(sum(parts)), joint[-1] + 1)
    spans = tuple(np.arange(part + 1) for part in parts)
    rows = np.bincount(joint, weights=used)
    return replace(whole, rows=rows, span=instant, spans=spans).part(used)
