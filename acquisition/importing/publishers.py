"""Two publishers of one topic: states that alternate between two sources."""

import numpy as np

from ..arrays import Array
from ..errors import Place
from ..files import BLOCK_ROWS, by_rows
from .stamps import smallest_difference

WINDOW = 16  # rows; a divisor of `BLOCK_ROWS`
# of energies at and at half the Nyquist frequency; noise and motion rarely exceed it
MIN_NYQUIST_RATIO = 100.0
# of the windows, of the rows; more are of two publishers
MAX_ALTERNATING, MAX_WITHOUT_EFFORT = 0.1, 0.01
ONE_PUBLISHER = "one publisher: record the topic of the arm's own driver, or stop the other node"
MIN_PUBLISHER_QUANTA = 3.0  # smallest difference of two publishers


def refuse_several_publishers(
    position: Array, effort: Array, joints: list[str], place: Place
) -> None:
    """Refuse alternating states of two publishers: single rows without effort, or every other row
    far from its neighbours.
    """
    least = MIN_PUBLISHER_QUANTA * smallest_difference(effort)
    zero = np.asarray(~effort.any(axis=1))
    large = by_rows(lambda x: (np.abs(x) > least).any(axis=1), effort) > 0
    single = zero[1:-1] & large[:-2] & large[2:]
    if single.sum() > MAX_WITHOUT_EFFORT * len(effort):
        problem = (
            f"{100 * single.mean():.2g} % of the rows have no effort, but both neighbours have"
        )
        place.refuse("effort", expected=ONE_PUBLISHER, text=problem)
    for key, x in (("position", position), ("effort", effort)):
        share = _alternating_share(x)
        if share.max() > MAX_ALTERNATING:
            problem = (
                f"every other row differs from its neighbours in {100 * share.max():.2g} % of "
                "the time"
            )
            place.refuse(
                f"{key} of joint {joints[int(share.argmax())]}",
                expected=ONE_PUBLISHER,
                text=problem,
            )


def _alternating_share(x: Array) -> Array:
    """Share (n,) of windows of x (N, n) whose second differences have far more energy at the
    Nyquist frequency than at half.

    Rounded values sometimes alternate by one quantum, so several quanta are required. Values held
    for a row, as of an encoder slower than the log, do not alternate.
    """
    least, rows = smallest_difference(x), max(0, len(x) - 2) // WINDOW * WINDOW
    found = [
        _alternating(x[first : min(first + BLOCK_ROWS, rows) + 2], least)
        for first in range(0, rows, BLOCK_ROWS)
    ]
    # two may be chance
    return np.maximum(sum(found, np.zeros(x.shape[1])) - 2, 0) / max(1, rows // WINDOW)


def _alternating(x: Array, least: Array) -> Array:
    """Number (n,) of the windows in x (N + 2, n) that alternate."""
    steps, windows = (
        np.diff(x, n=n, axis=0)[: len(x) - 2].reshape(-1, WINDOW, x.shape[1]) for n in (1, 2)
    )
    energy = np.abs(np.fft.rfft(windows * np.hanning(WINDOW)[:, None], axis=1)) ** 2
    half = energy[:, WINDOW // 4 - 1 : WINDOW // 4 + 2].sum(axis=1)
    large = np.abs(windows).max(axis=1) > 4 * MIN_PUBLISHER_QUANTA * least
    alternating = (
        large
        & ((steps == 0).mean(axis=1) < 0.4)
        & (energy[:, -2:].sum(axis=1) > MIN_NYQUIST_RATIO * half)
    )
    return np.asarray(alternating.sum(axis=0))
