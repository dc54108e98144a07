"""Time of each SYNC: the send time where we produce it, else the receive time corrected for delays of reception.

Drives sample at SYNC. The time of a SYNC that we send is the time of sending. Another producer sends SYNC by the timer of
its controller: its receive times are uneven by delays of reception, which are never negative and do not last. So a SYNC came
no later than each SYNC after it minus the whole periods between them. A pause of the producer lasts, and stays in the
times as a gap.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Ints

Rows = NDArray[np.int32]  # of frames or SYNCs: half the memory of Ints
Number = TypeVar("Number", np.int32, np.float64)

PAUSE = 1.5  # periods: a longer step between SYNCs is a pause
_MUCH_DELAYED = 4.0  # times the usual delay: such SYNCs are not used for the period
_LOOKED_AHEAD = (15, 127)  # SYNCs by which the delay of one is removed, in the first and the second pass


@dataclass(frozen=True, kw_only=True, eq=False)
class SyncTimes:
    """The grid of SYNC in time.

    Attributes:
        stamps: (grid,) time of each SYNC in ns, strictly growing; interpolated for SYNCs that were not recorded.
        period_s: between SYNCs, pauses left out.
        jitter_s: standard deviation and worst deviation of the recorded times from even ones, between pauses.
        pauses: grid indices after which a pause of more than 1.5 periods follows.
        set_back: grid index and seconds of each time that the clock was set back; the step there counts as one period.
    """

    stamps: Ints
    period_s: float
    jitter_s: tuple[float, float]
    pauses: Ints
    set_back: tuple[tuple[int, float], ...]


def sync_times(times: Ints, index_of: Ints, grid: int, *, ours: bool, nominal_ns: int) -> SyncTimes:
    """Times of all `grid` SYNCs from those of the recorded ones, ns, and their index on the grid.

    `ours`: we sent them. Of two estimates of the period the one nearer to the nominal one is used.
    """
    index = index_of.astype(np.float64)
    times, set_back = _without_set_back(times, index_of)
    since = (times - times[0]).astype(np.float64)
    freed, run, within = _even(index, since)
    overall = _slope(index, since, np.zeros_like(run)) if run[-1] else within
    # Pauses lengthen the second estimate, delays may disturb the first; a wrong description changes neither.
    period = min((within, overall), key=lambda p: abs(p - nominal_ns))
    deviation = since - index * within
    deviation -= _mean_of_run(deviation, run)
    if not ours:
        since = freed
    at = np.rint(np.interp(np.arange(grid), index, since)).astype(np.int64)
    beyond = np.arange(grid) > index_of[-1]
    at[beyond] = at[index_of[-1]] + np.rint((np.arange(grid)[beyond] - index_of[-1]) * period).astype(np.int64)
    stamps = int(times[0]) + at
    k = np.arange(grid)
    stamps = np.maximum.accumulate(np.maximum(stamps, 0) - k) + k
    return SyncTimes(
        stamps=stamps,
        period_s=period * 1e-9,
        jitter_s=(float(deviation.std()) * 1e-9, float(np.abs(deviation).max()) * 1e-9),
        pauses=np.flatnonzero(np.diff(stamps) > PAUSE * period),
        set_back=set_back,
    )


def _without_set_back(times: Ints, index_of: Ints) -> tuple[Ints, tuple[tuple[int, float], ...]]:
    """Times with each step back replaced by one period, and where the steps back are."""
    steps = np.diff(times)
    back = np.flatnonzero(steps < 0)
    if not len(back):
        return times, ()
    usual = int(np.median(steps[steps >= 0])) if (steps >= 0).any() else 1
    jumps = np.zeros(len(times), np.int64)
    jumps[back + 1] = usual - steps[back]
    found = tuple((int(index_of[k + 1]), float(usual - steps[k]) * 1e-9) for k in back)
    return times + np.cumsum(jumps), found


def _even(index: Array, since: Array) -> tuple[Array, Ints, float]:
    """Times without delays, the run between pauses that each SYNC belongs to, and the period within runs.

    A delay does not last: a lateness that the next SYNCs keep is a pause.
    """
    period = float(np.median(np.diff(since) / np.diff(index)))
    ahead, run = 0, np.zeros(len(since), np.int64)
    for ahead in _LOOKED_AHEAD:  # with a better period, over more SYNCs
        freed = least_ahead(since - index * period, ahead) + index * period
        paused = np.diff(freed) - np.diff(index) * period > (PAUSE - 1) * period
        run = np.concatenate([[0], np.cumsum(paused)])
        delay = since - freed
        usual = delay <= _MUCH_DELAYED * np.median(delay)
        if np.count_nonzero(usual) >= 2:
            period = _slope(index[usual], since[usual], run[usual])
    return least_ahead(since - index * period, ahead) + index * period, run, period


def _mean_of_run(values: Array, run: Ints) -> Array | float:
    """For each value the mean of its run."""
    if not run[-1]:
        return float(values.mean())
    found: Array = (np.bincount(run, values) / np.maximum(np.bincount(run), 1))[run]
    return found


def _slope(index: Array, since: Array, run: Ints) -> float:
    """Least-squares slope over the index, one for all runs, each with an offset of its own."""
    k = index - _mean_of_run(index, run)
    square = float(k @ k)
    return float(k @ (since - _mean_of_run(since, run))) / square if square > 0 else float(np.median(np.diff(since)))


def least_ahead(values: NDArray[Number], ahead: int) -> NDArray[Number]:
    """Least of each value and the next `ahead`, a power of two less one."""
    least = values.copy()
    step = 1
    while step <= ahead:
        least[:-step] = np.minimum(least[:-step], least[step:])
        step *= 2
    return least
