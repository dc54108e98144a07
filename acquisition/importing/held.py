"""Rows of a log that is faster than its robot: each repeats the row before until the next is new.

A staircase spoils speeds before any filter or weight, so only rows with new positions are kept, at
the instants of their source: logged within a period of the log after them. A coarse encoder repeats
positions too, but where its joint is slow, and then steps by a quantum.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..errors import Place
from ..files import by_rows, taken
from ..recording import Bools
from .stamps import smallest_difference
from .time_base import POSITION, GridValues, interpolate, resample, roundest_rate_hz

MAX_NEW = 0.85  # of the rows in which the robot is fast, in a log that is faster than its robot
MIN_QUANTA = 3.0  # that a position steps by, typically, where it is new
AHEAD = 8  # rows to each side, over which speeds are compared
MAX_PAUSE = 2.5  # usual steps between new rows: a longer one is a pause, or has lost rows
MAX_ODD = 0.05  # of the changes of a quantity where no position is new: it is held alike


def grid_of_new_rows(
    time_s: Array, parts: Mapping[str, Array], rate_hz: float | None, place: Place
) -> GridValues | None:
    """Return the rows with new positions on a grid of their source's rate, or of a lower `rate_hz`;
    None where the log is no faster. By growing times (N,) and values (N, n); raises as `resample`.
    """
    q = parts[POSITION]
    span = np.maximum(np.ptp(q, axis=0), 1e-300)
    if len(q) <= 4 * AHEAD or not (np.diff(time_s) > 0).all():
        return None
    steps = by_rows(lambda x: np.abs(np.diff(x, axis=0)), q, beside=1)
    travel = by_rows(lambda x: np.abs(x[2 * AHEAD :] - x[: -2 * AHEAD]) @ (1 / span), q, beside=16)
    fast = np.flatnonzero(travel > np.median(travel)) + AHEAD
    new = np.asarray(steps.any(axis=1))
    share = float(new[fast].mean()) if len(fast) else 1.0
    if share > MAX_NEW:
        return None
    quanta = steps[fast[new[fast]]] / smallest_difference(q)
    if not np.median(quanta.max(axis=1)) >= MIN_QUANTA:
        return None
    rows = np.flatnonzero(np.r_[True, new])
    since = time_s[rows] - time_s[0]
    apart, log_s = np.diff(since), float(np.median(np.diff(time_s)))
    period_s = float(apart[apart < MAX_PAUSE * np.median(apart)].mean())
    # Each is logged up to a period of the log late.
    most_s = max(1.5 * period_s, period_s + 0.99 * log_s)
    number = np.r_[0, np.cumsum(1 + np.maximum(0, np.ceil((apart - most_s) / period_s)))]
    own_hz = roundest_rate_hz(since, number)
    at_s = time_s[0] + np.mean(since - number / own_hz) + number / own_hz
    kept = {
        name: taken(x, rows) if _alike(x, new) else interpolate(time_s, x, at_s)
        for name, x in parts.items()
    }
    grid = resample(at_s, kept, rate_hz=min(rate_hz or own_hz, own_hz), place=place)
    text = f"the log is faster than its robot: each row stands {1 / log_s / own_hz:.3g} times, as "
    text += (
        f"positions are new at {own_hz:.6g} Hz; of {len(q)} rows only these {len(rows)} are kept"
    )
    return replace(grid, warnings=(text,))


def _alike(x: Array, new: Bools) -> bool:
    """Whether x (N, n) changes hardly but where positions are `new` (N - 1,)."""
    changes = by_rows(lambda part: (np.diff(part, axis=0) != 0).any(axis=1), x, beside=1)
    return bool((changes & ~new).sum() <= MAX_ODD * changes.sum())
