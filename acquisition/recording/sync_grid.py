"""The grid of SYNC: the time of each SYNC, and the intervals between them.

**Times.** Drives sample at SYNC. The time of a SYNC that this master sends is the time of sending.
Another producer sends SYNC by its own timer: the receive times contain delays of reception, which
are never negative and do not last. So a SYNC came no later than each later SYNC minus the whole
periods between them. A pause of the producer lasts, and remains in the times as a gap.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Ints
from ..files import kept
from .rows import MAX_PERIOD_OFFSET, Rows

Bools = NDArray[np.bool_]
Number = TypeVar("Number", np.int32, np.int64, np.float64)

MIN_PAUSE_PERIODS = 1.5  # periods: a longer step between SYNCs is a pause
MAX_RUN_SYNCS = 255  # within which late PDOs must end; lost in a row, a longer silence is a pause
MAX_REPEAT_PERIODS = 0.75  # after a SYNC of another producer: an earlier one may be a repeat
_MAX_ANSWER_PERIODS = 0.75  # after SYNC: a later PDO may answer a SYNC that was not recorded
# from a PDO's median time after SYNC, and so many median deviations from that:
_MAX_USUAL_PERIODS = 0.05
_MAX_USUAL_RATIO = (5.0, 1.5)  # if it never came twice in an interval; else
_MAX_DELAY_RATIO = 4.0  # times the usual delay; SYNCs with more are not used for the period
# later SYNCs that bound the delay of one, in the first and second pass
_LOOKAHEAD_SYNCS = (15, 127)


@dataclass(frozen=True, kw_only=True, eq=False)
class SyncTimes:
    """The grid of SYNC in time.

    Attributes:
        stamps: (grid,) time of each SYNC in ns, strictly growing; interpolated for SYNCs
            that were not recorded.
        period_s: between SYNCs, pauses left out.
        jitter_s: standard and largest deviation of the recorded times from
            uniform ones, between pauses.
        pauses: grid indices before a pause of more than 1.5 periods.
        set_back: grid index and size in s of each step back of the clock; such a
            step counts as one period.
    """

    stamps: Ints
    period_s: float
    jitter_s: tuple[float, float]
    pauses: Ints
    set_back: tuple[tuple[int, float], ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Intervals:
    """Intervals from each SYNC frame to the next, (k,) each."""

    steps: Rows  # periods
    paused: Bools
    torn: Bools  # a pause with late PDOs
    swapped: Bools  # a PDO came after the next SYNC, but was recorded before it
    unusual: Bools  # a PDO at an unusual time after SYNC


def sync_times(times: Ints, index_of: Ints, grid: int, *, ours: bool, nominal_ns: int) -> SyncTimes:
    """Times of all `grid` SYNCs from those recorded, in ns, and their grid indices; `ours`:
    this master sent them.
    """
    index = kept(index_of.astype(np.float64))
    times, set_back = _remove_set_back(times, index_of)
    since = kept((times - times[0]).astype(np.float64))
    freed, run, within = _remove_delays(index, since)
    overall = _slope(index, since, np.zeros_like(run)) if run[-1] else within
    # Pauses lengthen the second estimate, delays may disturb the first; a wrong
    # description changes neither.
    period = min((within, overall), key=lambda p: abs(p - nominal_ns))
    deviation = kept(since - index * within)
    deviation -= _mean_of_run(deviation, run)
    if not ours:
        since = freed
    k = kept(np.arange(grid))
    at = kept(np.rint(np.interp(k, index, since)).astype(np.int64))
    beyond = k > index_of[-1]
    at[beyond] = at[index_of[-1]] + np.rint((k[beyond] - index_of[-1]) * period).astype(np.int64)
    stamps = int(times[0]) + at
    stamps = np.maximum.accumulate(np.maximum(stamps, 0) - k) + k
    return SyncTimes(
        stamps=stamps,
        period_s=period * 1e-9,
        jitter_s=(float(deviation.std()) * 1e-9, float(np.abs(deviation).max()) * 1e-9),
        pauses=np.flatnonzero(np.diff(stamps) > MIN_PAUSE_PERIODS * period),
        set_back=set_back,
    )


def _remove_set_back(times: Ints, index_of: Ints) -> tuple[Ints, tuple[tuple[int, float], ...]]:
    """Times with each step back replaced by one period, and the steps back."""
    steps = np.diff(times)
    back = np.flatnonzero(steps < 0)
    if not len(back):
        return times, ()
    usual = int(np.median(steps[steps >= 0])) if (steps >= 0).any() else 1
    jumps = np.zeros(len(times), np.int64)
    jumps[back + 1] = usual - steps[back]
    set_back = tuple((int(index_of[k + 1]), float(usual - steps[k]) * 1e-9) for k in back)
    return times + np.cumsum(jumps), set_back


def _remove_delays(index: Array, since: Array) -> tuple[Array, Ints, float]:
    """Times without delays, which do not last, the run between pauses that each SYNC belongs to,
    and the period within runs.
    """
    period = float(np.median(np.diff(since) / np.diff(index)))
    ahead, run = 0, np.zeros(len(since), np.int64)
    for ahead in _LOOKAHEAD_SYNCS:  # the second with a better period, over more SYNCs
        freed = kept(minimum_ahead(since - index * period, ahead) + index * period)
        paused = np.diff(freed) - np.diff(index) * period > (MIN_PAUSE_PERIODS - 1) * period
        run = kept(np.concatenate([[0], np.cumsum(paused)]))
        delay = kept(since - freed)
        usual = delay <= _MAX_DELAY_RATIO * np.median(delay)
        if np.count_nonzero(usual) >= 2:
            period = _slope(kept(index[usual]), kept(since[usual]), kept(run[usual]))
    return minimum_ahead(since - index * period, ahead) + index * period, run, period


def _mean_of_run(values: Array, run: Ints) -> Array | float:
    """The mean of each value's run."""
    if not run[-1]:
        return float(values.mean())
    return np.asarray((np.bincount(run, values) / np.maximum(np.bincount(run), 1))[run])


def _slope(index: Array, since: Array, run: Ints) -> float:
    """Least-squares slope over the index, one for all runs; each run has its own offset."""
    k = index - _mean_of_run(index, run)
    square = float(k @ k)
    return (
        float(k @ (since - _mean_of_run(since, run))) / square
        if square > 0
        else float(np.median(np.diff(since)))
    )


def minimum_ahead(values: NDArray[Number], ahead: int) -> NDArray[Number]:
    """Minimum of each value and the next `ahead`, a power of two minus one."""
    least = values.copy()
    step = 1
    while step <= ahead:
        least[:-step] = np.minimum(least[:-step], least[step:])
        step *= 2
    return least


def interval_of(rows: Rows, sync_rows: Rows) -> Rows:
    """Interval of each frame, -1 before the first; not stored, because those of all
    PDOs need much memory.
    """
    return np.searchsorted(sync_rows, rows).astype(np.int32) - 1


def recorded_syncs(rows: Rows, times: Ints, *, ours: bool) -> tuple[Rows, Ints]:
    """SYNC frames and their times: two that changed places are set right, and repeats by another
    producer are left out.

    A repeat comes too early, and the next SYNC a whole number of periods after the one before
    it. So does a SYNC with too early a time: as one that was not recorded, it gets the time
    between its neighbours.
    """
    period = float(np.median(np.diff(times))) or 1.0
    back = np.flatnonzero(np.diff(times[:-1]) < 0)
    # else the clock was set back
    back = back[(back > 0) & (times[back + 2] - times[back - 1] > 2.5 * period)]
    times[back], times[back + 1] = times[back + 1], times[back]
    if ours:
        return rows, times
    # the last one has no neighbour
    skipped = np.append(times[2:] - times[:-2], period)[: len(times) - 1] / period
    whole = (np.abs(skipped - np.rint(skipped)) < 1 - MAX_REPEAT_PERIODS) & (skipped > 0.5)
    repeats = np.flatnonzero(whole & (np.diff(times) < MAX_REPEAT_PERIODS * period)) + 1
    return np.delete(rows, repeats), np.delete(times, repeats)


def without_repeats(rows: Rows, sync_rows: Rows, data: NDArray[np.uint8]) -> tuple[Rows, Rows]:
    """Frames of a PDO after the first SYNC without repeats, and the repeats; `data`
    (len(rows), 8): their bytes.

    A frame repeats the one before if both are of one interval, have equal bytes, and differ from
    the frames before and after.
    """
    interval = interval_of(rows, sync_rows)
    again = np.flatnonzero((np.diff(interval) == 0) & (interval[1:] >= 0)) + 1
    same = (data[again] == data[again - 1]).all(axis=1)
    changed = (again < 2) | (data[again - 1] != data[again - 2]).any(axis=1)
    after = np.minimum(again + 1, len(rows) - 1)
    changed &= (again == len(rows) - 1) | (data[after] != data[again]).any(axis=1)
    used = interval >= 0
    used[again[same & changed]] = False
    return rows[used], rows[again[same & changed]]


def sync_steps(
    sync_rows: Rows,
    times: Ints,
    pdos: Sequence[Rows],
    times_of: Callable[[Rows], Ints],
    *,
    ours: bool,
) -> Intervals:
    """Intervals between SYNC frames.

    A step of whole periods of another producer is as many SYNCs. This master may have sent SYNC
    late (`ours`): then, as after the last SYNC, SYNCs count as lost if most drives answered
    each of them. Whole periods without an answer are a pause, too. `pdos`: frames by PDO;
    `times_of`: their times.
    """
    steps = np.ones(len(times), np.int32)
    period = float(np.median(np.diff(times))) or 1.0
    end = max(int(times_of(pdo[-1:])[0]) for pdo in pdos)
    after_last = 1 + int((end - times[-1]) / period + 1 - _MAX_ANSWER_PERIODS)
    periods = kept(np.append(np.diff(times) / period, after_last))
    long = np.flatnonzero(periods > MIN_PAUSE_PERIODS)
    lost = np.rint(periods[long]).astype(np.int64) - 1
    ahead = kept(np.append(np.diff(times), np.iinfo(np.int64).max))
    after: list[Ints] = []
    paused, torn, busy, unusual, swapped = np.zeros((5, len(times)), np.bool_)
    for pdo in pdos:
        interval = interval_of(pdo, sync_rows)
        came = kept(times_of(pdo) - times[interval])
        after.append(
            np.bincount(interval[came > _MAX_ANSWER_PERIODS * period], minlength=len(times))[long]
        )
        swapped[interval[(came >= ahead[interval]) & (ahead[interval] > 0)]] = True
        busy[interval[came > 0.5 * period * periods[interval]]] = True
        two = bool(
            (np.bincount(interval, minlength=len(times))[periods <= MIN_PAUSE_PERIODS] > 1).any()
        )
        off = np.abs(came - np.median(came))
        unusual[
            interval[off > _MAX_USUAL_PERIODS * period + _MAX_USUAL_RATIO[two] * np.median(off)]
        ] = True
    most = np.sort(after, axis=0)[(len(pdos) - 1) // 2]
    known = most >= lost
    if not ours:
        whole = np.abs(periods[long] - lost - 1) <= MAX_PERIOD_OFFSET
        known = np.where(long < len(times) - 1, whole, known)
    # else nothing was on the bus
    known &= (lost < MAX_RUN_SYNCS) & ((lost == 1) | (most > 0) | busy[long])
    steps[long[known]] += lost[known]
    paused[long], torn[long] = ~known, ~known & np.any(after, axis=0)
    return Intervals(
        steps=steps, paused=paused, torn=torn, swapped=swapped, unusual=unusual & (steps == 1)
    )


def counted_steps(counter: NDArray[np.uint8]) -> Rows:
    """Periods from each SYNC frame to the next by the counter in them (object 1019h): from 1
    to its overflow value.
    """
    top, steps = int(counter.max()), np.ones(len(counter), np.int32)
    if top > 1:
        steps[:-1] = np.mod(np.diff(counter.astype(np.int64)) - 1, top) + 1
    return steps
