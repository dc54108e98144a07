"""Rows of a log that is faster than its robot: each repeats the row before until the next is new.

A staircase spoils speeds before any filter or weight. So only rows with new positions are kept, at
the instants of their source: the log has them within a period of the log after these. A coarse
encoder repeats positions, too, but only where its joint is slow, and then steps by a quantum.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..arrays import Array, Bools
from ..errors import Location
from ..files import by_rows, taken
from .stamps import smallest_difference
from .time_base import POSITION, GridValues, interpolate, resample, roundest_rate_hz

# In a log that is faster than its robot, at most this share of the rows with fast motion is new.
MAX_NEW = 0.85
MIN_QUANTA = 3.0  # typical step of a new position, in quanta
AHEAD = 8  # rows to each side over which speeds are compared
# A step of more usual ones between new rows is a pause, or has lost rows.
MAX_PAUSE = 2.5
# The rate is sought in so many rows, within this range of multiples of their mean rate.
FIRST, TRIED = 1000, (0.95, 1.4)
MAX_RATE = 0.95  # of the rate of the log; a faster source is the log itself
# The delays of a regular source differ by at most this share of its period.
MAX_LATE = 0.8
# A quantity is held like the positions if at most this share of its changes is where none is new.
MAX_ODD = 0.05


def grid_of_new_rows(
    time_s: Array,
    parts: Mapping[str, Array],
    place: Location,
    rate_hz: float | None = None,
    largest_gap_periods: float | None = None,
) -> GridValues | None:
    """Return the rows with new positions on a grid of their source's rate.

    Parameters
    ----------
    time_s : (N,) growing times in s.
    parts : values (N, n) by name.
    place : name of the log in errors.
    rate_hz : a lower rate of the grid in Hz.
    largest_gap_periods : longest accepted step, as in `resample`.

    Returns
    -------
    The grid; None if the log is not faster than its robot.

    Raises
    ------
    BadInputError : as `resample`.
    """
    q = parts[POSITION]
    if len(q) <= 4 * AHEAD or not (np.diff(time_s) > 0).all():
        return None
    steps = by_rows(lambda x: np.abs(np.diff(x, axis=0)), q, beside=1)
    per_span = 1 / np.maximum(np.ptp(q, axis=0), 1e-300)
    travel = by_rows(lambda x: np.abs(x[2 * AHEAD :] - x[: -2 * AHEAD]) @ per_span, q, beside=16)
    fast = np.flatnonzero(travel > np.median(travel)) + AHEAD
    new = np.asarray(steps.any(axis=1))
    if not len(fast) or new[fast].mean() > MAX_NEW:
        return None
    quanta = steps[fast[new[fast]]] / smallest_difference(q)
    if not np.median(quanta.max(axis=1)) >= MIN_QUANTA:
        return None
    rows = np.flatnonzero(np.r_[True, new])
    at_s, own_hz = _times_of_source(time_s[rows], float(np.median(np.diff(time_s))))
    text = (
        f"the log is faster than the robot: it repeats each position {len(q) / len(rows):.2g} "
        f"times (new ones come at {own_hz:.6g} Hz), so only {len(rows)} of {len(q)} rows are kept"
    )
    return replace(
        resample(
            at_s,
            {
                name: taken(x, rows) if _alike(x, new) else interpolate(time_s, x, at_s)
                for name, x in parts.items()
            },
            rate_hz=min(rate_hz or own_hz, own_hz),
            largest_gap_periods=largest_gap_periods,
            place=place,
        ),
        warnings=(text,),
    )


def _times_of_source(seen_s: Array, log_s: float) -> tuple[Array, float]:
    """Estimate the times (K,) of rows from a regular source, and its rate.

    A log with rows every `log_s` has them up to `log_s` late. If the source is not regular, return
    the times at which the log has them, and their mean rate. The rate is that at which the times
    have the same phase. It is sought at the beginning, where few rates must be distinguished; each
    longer part then refines it.
    """
    since, apart = seen_s - seen_s[0], np.diff(seen_s)
    mean_hz = 1 / float(apart[apart < MAX_PAUSE * np.median(apart)].mean())
    until_s = float(since[min(FIRST, len(since) - 1)])
    early = since[since <= until_s]
    tried_hz = mean_hz * np.arange(*TRIED, 0.1 / (mean_hz * until_s))
    # All rows are in phase at the rate of the log itself, so it is not tried.
    tried_hz = tried_hz[tried_hz < MAX_RATE / log_s]
    hz = float(tried_hz[np.argmax([abs(np.exp(2j * np.pi * f * early).sum()) for f in tried_hz])])
    while True:
        early = since[since <= until_s]
        number = np.rint(early * hz - np.angle(np.exp(2j * np.pi * hz * early).sum()) / 2 / np.pi)
        hz = float(np.polyfit(early, number, 1)[0])
        if until_s >= since[-1]:
            break
        until_s *= 1.5
    own_hz = roundest_rate_hz(early, number - number[0])
    late = early - number / own_hz
    if (np.diff(number) > 0).all() and np.ptp(late) < MAX_LATE / own_hz:
        return seen_s[0] + np.mean(late) + number / own_hz, own_hz
    return seen_s, roundest_rate_hz(seen_s)


def _alike(x: Array, new: Bools) -> bool:
    """Test whether x (N, n) hardly changes except where positions are `new` (N - 1,)."""
    changes = by_rows(lambda part: (np.diff(part, axis=0) != 0).any(axis=1), x, beside=1)
    return bool((changes & ~new).sum() <= MAX_ODD * changes.sum())
