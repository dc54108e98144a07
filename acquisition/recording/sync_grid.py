"""The grid of SYNC: the time of each SYNC, and the intervals between them.

**Times.** Drives sample at SYNC. The time of a SYNC that this master sends is the time of sending.
Another producer sends SYNC by its own timer. Its receive times contain delays of reception, which
are never negative and do not last. So a SYNC came no later than each later SYNC minus the whole
periods between them. A step that lasts remains in the times: a pause of the producer is a gap. If
all later SYNCs would make many in a row late, the timer of the producer began again, or it sent an
additional SYNC.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Bools, Ints
from ..files import kept
from .rows import MAX_PERIOD_OFFSET, Rows

Number = TypeVar("Number", np.int32, np.int64, np.float64)

MIN_PAUSE_PERIODS = 1.5  # a longer step between SYNCs is a pause
# Late PDOs must end within so many SYNCs. If more are lost in a row, the silence is a pause.
MAX_RUN_SYNCS = 255
# A SYNC of another producer is a repeat if it follows one in time by less than so many periods.
MAX_REPEAT_PERIODS = 0.65
# A PDO that comes later after SYNC may answer a SYNC that was not recorded.
MAX_ANSWER_PERIODS = 0.75
# The time of a PDO after SYNC is usual if it deviates from the median by less than so many periods,
# plus so many median deviations: the first number if it never came twice in an interval.
_MAX_USUAL_PERIODS = 0.05
_MAX_USUAL_RATIO = (5.0, 1.5)
# SYNCs with a delay of more than so many usual ones are not used for the period.
_MAX_DELAY_RATIO = 4.0
# A lasting step by so many periods to later, or to earlier times, is not a delay.
_MIN_LASTING_PERIODS, _MIN_SOONER_PERIODS = 0.6, 0.4
_MAX_EVEN_PERIODS = 1.25  # without a longer step, no SYNC was lost
# So many SYNCs around a repeat show whether one was late, and what drives answered.
_NEAR_SYNCS = 7
# So many later SYNCs bound the delay of one, in the first and second iteration.
_LOOKAHEAD_SYNCS = (15, 127)


@dataclass(frozen=True, kw_only=True, eq=False)
class Syncs:
    """Recorded SYNC frames.

    Attributes:
        rows: (k,) rows of the frames.
        times: (k,) times in ns.
        ours: whether this master sent all of them.
        period: approximate period in ns.
    """

    rows: Rows
    times: Ints
    ours: bool
    period: float


@dataclass(frozen=True, kw_only=True, eq=False)
class SyncTimes:
    """The grid of SYNC in time.

    Attributes:
        stamps: (grid,) time of each SYNC in ns, strictly growing; interpolated for SYNCs that were
            not recorded.
        period_s: period in s, without pauses.
        jitter_s: standard and largest deviation of the recorded times from uniform ones, between
            pauses.
        pauses: grid indices before a pause of more than 1.5 periods.
        set_back: grid index and size in s of each step back of the clock; such a step counts as one
            period.
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


def sync_times(syncs: Syncs, index_of: Ints, grid: int, nominal_ns: int) -> SyncTimes:
    """Compute the times of all `grid` SYNCs.

    Parameters
    ----------
    syncs : the recorded SYNCs.
    index_of : (k,) their grid indices.
    grid : number of SYNCs.
    nominal_ns : period in robot.toml in ns.
    """
    times, set_back = _remove_set_back(syncs.times, index_of)
    since = kept((times - times[0]).astype(np.float64))
    freed, run, within = _remove_delays(index_of, since, syncs.period)
    overall = _slope(index_of, since, np.zeros_like(run)) if run[-1] else within
    # Pauses lengthen the second estimate, and delays may disturb the first. A wrong period in
    # robot.toml changes neither, so the nearer one is right.
    period = min((within, overall), key=lambda p: abs(p - nominal_ns))
    deviation = kept(since - index_of * within)
    deviation -= _mean_of_run(deviation, run)
    k, after_last = kept(np.arange(grid)), since[-1] + (grid - index_of[-1]) * period
    ends = (
        kept(np.append(index_of, grid)),
        kept(np.append(since if syncs.ours else freed, after_last)),
    )
    stamps = int(times[0]) + np.rint(kept(np.interp(k, *ends))).astype(np.int64)
    stamps = kept(np.maximum.accumulate(np.maximum(stamps, 0) - k) + k)
    return SyncTimes(
        stamps=stamps,
        period_s=period * 1e-9,
        jitter_s=(float(deviation.std()) * 1e-9, float(np.abs(deviation).max()) * 1e-9),
        pauses=np.flatnonzero(np.diff(stamps) > MIN_PAUSE_PERIODS * period),
        set_back=set_back,
    )


def _remove_set_back(times: Ints, index_of: Ints) -> tuple[Ints, tuple[tuple[int, float], ...]]:
    """Replace each step back in the times by one period; also return the steps back."""
    steps = np.diff(times)
    usual = int(np.median(steps[steps >= 0])) if (steps >= 0).any() else 1
    jumps = np.where(steps < 0, usual - steps, 0)
    return (
        kept(times + np.append(0, np.cumsum(jumps))),
        tuple((int(index_of[k + 1]), float(jumps[k]) * 1e-9) for k in np.flatnonzero(steps < 0)),
    )


def _remove_delays(index: Ints, since: Array, period: float) -> tuple[Array, Ints, float]:
    """Remove delays, which do not last, from the times.

    Also return the run between pauses to which each SYNC belongs, and the period within runs.
    """
    # The second iteration has a better period, and uses more SYNCs.
    for ahead in _LOOKAHEAD_SYNCS:
        freed, run = _freed(since - index * period, period, ahead)
        delay = kept(since - index * period - freed)
        usual = delay <= min(_MAX_DELAY_RATIO * float(np.median(delay)), MAX_PERIOD_OFFSET * period)
        # A slope needs two SYNCs.
        period = (
            _slope(kept(index[usual]), kept(since[usual]), kept(run[usual]))
            if np.count_nonzero(usual) >= 2
            else period
        )
    freed, run = _freed(since - index * period, period, _LOOKAHEAD_SYNCS[1])
    return kept(freed + index * period), run, period


def _freed(deviation: Array, period: float, ahead: int) -> tuple[Array, Ints]:
    """Remove the delays that the next `ahead` SYNCs reveal; also return the run of each SYNC.

    The delays are removed from the deviations. After a step that lasts there is another run. A step
    to later times is a pause, or a SYNC was not recorded. A step to earlier times, which would make
    all SYNCs before it late, is an additional SYNC or another timer.
    """
    (few, most), least = _LOOKAHEAD_SYNCS, minimum_ahead(deviation, ahead)
    # The last SYNCs before a pause keep their delays, because no later SYNC of the run bounds them.
    rises = least[1:] - minimum_behind(least, 3)[:-1] > _MIN_LASTING_PERIODS * period
    paused = kept(np.append(0, np.cumsum(rises & (np.diff(least) > 0.25 * period))))
    if not (np.diff(deviation) < -_MIN_SOONER_PERIODS * period).any():
        return least, paused
    falls = np.diff(minimum_behind(deviation, most, paused)) < -_MIN_SOONER_PERIODS * period
    # The first SYNCs of a run may all be late, so a fall among them shows nothing.
    known = np.append(np.full(few + 1, -1), paused)[1 : len(paused)] == paused[1:]
    run = np.append(0, np.cumsum(falls & known))
    return minimum_ahead(deviation, ahead, run), paused + run


def _mean_of_run(values: Array | Ints, run: Ints) -> Array | float:
    """Compute the mean of each value's run."""
    return (
        np.asarray((np.bincount(run, values) / np.maximum(np.bincount(run), 1))[run])
        if run[-1]
        else float(values.mean())
    )


def _slope(index: Ints, since: Array, run: Ints) -> float:
    """Fit the slope over the index by least squares, one for all runs.

    Each run has its own offset.
    """
    k = index - _mean_of_run(index, run)
    square = float(k @ k)
    return (
        float(k @ (since - _mean_of_run(since, run))) / square
        if square > 0
        else float(np.median(np.diff(since)))
    )


def minimum_ahead(values: NDArray[Number], ahead: int, run: Ints | None = None) -> NDArray[Number]:
    """Compute the minimum of each value and the next `ahead` of the same run.

    `ahead` is a power of two minus one.
    """
    least = kept(values)
    step = 1
    while step <= ahead:
        np.minimum(
            least[:-step],
            least[step:],
            out=least[:-step],
            where=True if run is None else run[:-step] == run[step:],
        )
        step *= 2
    return least


def minimum_behind(
    values: NDArray[Number], behind: int, run: Ints | None = None
) -> NDArray[Number]:
    """Compute the minimum of each value and the `behind` before it, as `minimum_ahead`."""
    return minimum_ahead(values[::-1], behind, None if run is None else run[::-1])[::-1]


def interval_of(rows: Rows, sync_rows: Rows) -> Rows:
    """Return the interval of each frame, -1 before the first.

    It is not stored, because the intervals of all PDOs need much memory.
    """
    return np.searchsorted(sync_rows, rows).astype(np.int32) - 1


def usual_period(times: Ints, nominal_ns: int) -> float:
    """Estimate the period of recorded SYNCs in ns.

    It is the median of single steps, of some in a row or of the whole, whichever is nearest to the
    nominal period. Lost SYNCs and pauses lengthen long steps, and bursts make single steps short.
    """
    found = (
        float(np.median(times[n:] - times[:-n])) / n
        for n in sorted({min(n, len(times) - 1) for n in (1, *_LOOKAHEAD_SYNCS, len(times))})
    )
    return min(found, key=lambda period: abs(period - nominal_ns)) or 1.0


def recorded_syncs(syncs: Syncs, pdos: Iterable[Rows]) -> Syncs:
    """Swap SYNC frames back that changed places, and remove repeats by another producer.

    A repeat comes too early, although the one before it was not late, and the two have one set of
    answers between them. One of these signs is enough if the other is uncertain: a SYNC that is
    read late makes the next one early, and PDOs may be lost, late or duplicate.

    Parameters
    ----------
    syncs : the SYNC frames.
    pdos : frames by PDO.
    """
    times, period = syncs.times, syncs.period
    back = np.flatnonzero(np.diff(times[:-1]) < 0)
    # Two SYNCs changed places only if the time goes on after them; otherwise the clock was set
    # back.
    back = back[(back > 0) & (times[back + 2] - times[back - 1] > 2.5 * period)]
    times[back], times[back + 1] = times[back + 1], times[back]
    # A step back is not the step of a repeat.
    steps = np.append(-1, np.diff(times))
    early = (steps >= 0) & (steps < MAX_REPEAT_PERIODS * period)
    if syncs.ours or not early.any():
        return syncs
    deviation = times - period * np.arange(len(times))
    level = minimum_behind(deviation, _NEAR_SYNCS, _freed(deviation, period, _NEAR_SYNCS)[1])
    fewer = np.array([_fewer_answers(pdo, syncs.rows, early) for pdo in pdos])[:, 1:]
    alone = (early & ~np.roll(early, 1) & ~np.roll(early, -1))[1:]
    pairs = np.append(times[2:] - times[:-2], 0)
    # If there are two sets of answers in two periods, the SYNC after the repeat was not recorded.
    # At the beginning of a recording the SYNC before may be late instead.
    two = (
        alone & (pairs > (1 + MAX_REPEAT_PERIODS) * period) & (np.arange(len(pairs)) > _NEAR_SYNCS)
    )
    falls = (np.diff(level) < (MAX_REPEAT_PERIODS - 1) * period) & (fewer.any(axis=0) | two)
    repeats = early & np.append(False, falls | alone & (fewer == 2).all(axis=0))
    # The SYNC after a repeat is only early with respect to the repeat.
    repeats[2:] &= ~repeats[1:-1] | (pairs[:-1] < MAX_REPEAT_PERIODS * period)
    return replace(syncs, rows=syncs.rows[~repeats], times=times[~repeats])


def _fewer_answers(pdo: Rows, sync_rows: Rows, early: Bools) -> Rows:
    """Count the signs of a repeat in the answers of a drive, 0 to 2 per SYNC.

    A group is a SYNC with the `early` ones behind it. One sign is that the drive stays behind by
    more answers after the group; another is that it is behind by more right after the group.
    """
    first = np.append(np.flatnonzero(~early), len(early))
    behind = first - np.searchsorted(pdo, np.append(sync_rows, np.iinfo(np.int32).max)[first])
    lasting = minimum_ahead(behind, _NEAR_SYNCS)[1:] > minimum_behind(behind, _NEAR_SYNCS)[:-1]
    return np.repeat(lasting + (np.diff(behind) > 0).astype(np.int32), np.diff(first))


def without_repeats(rows: Rows, sync_rows: Rows, data: NDArray[np.uint8]) -> tuple[Rows, Rows]:
    """Split the frames of a PDO after the first SYNC into those without repeats, and the repeats.

    A frame repeats the one before if both are in one interval, have equal bytes, and differ from
    the frames before and after.

    Parameters
    ----------
    rows : frames of the PDO.
    sync_rows : frames of SYNC.
    data : (len(rows), 8) bytes of the frames.
    """
    interval = interval_of(rows, sync_rows)
    again = np.flatnonzero((np.diff(interval) == 0) & (interval[1:] >= 0)) + 1
    after = np.minimum(again + 1, len(rows) - 1)
    again = again[
        (data[again] == data[again - 1]).all(axis=1)
        & ((again < 2) | (data[again - 1] != data[again - 2]).any(axis=1))
        & ((again == len(rows) - 1) | (data[after] != data[again]).any(axis=1))
    ]
    used = interval >= 0
    used[again] = False
    return rows[used], rows[again]


def sync_steps(syncs: Syncs, pdos: Sequence[Rows], times_of: Callable[[Rows], Ints]) -> Intervals:
    """Find the intervals between SYNC frames, and the SYNCs lost in them.

    If another producer sends SYNC, a step of whole periods contains as many SYNCs. This master may
    have sent SYNC late (`ours`): then, and after the last SYNC, SYNCs count as lost if most drives
    answered each of them. Whole periods without an answer are a pause.

    Parameters
    ----------
    syncs : the recorded SYNCs.
    pdos : frames by PDO.
    times_of : function that returns the times of frames in ns.
    """
    times, period = syncs.times, syncs.period
    steps = np.ones(len(times), np.int32)
    end = max(int(times_of(pdo[-1:])[0]) for pdo in pdos)
    after_last = 1 + int((end - times[-1]) / period + 1 - MAX_ANSWER_PERIODS)
    periods = np.diff(times) / period
    # For even SYNCs the median of single steps is the better measure. In bursts it is too short.
    usual = max(period, float(np.median(np.diff(times))))
    even = syncs.ours or periods.max() <= _MAX_EVEN_PERIODS
    periods = np.append(periods if even else _lasting_periods(times, period), after_last)
    long = np.flatnonzero(periods > MIN_PAUSE_PERIODS)
    lost = np.rint(periods[long]).astype(np.int64) - 1
    ahead = kept(np.append(np.diff(times), np.iinfo(np.int64).max))
    after: list[Ints] = []
    paused, torn, busy, unusual, swapped = np.zeros((5, len(times)), np.bool_)
    for pdo in pdos:
        interval = interval_of(pdo, syncs.rows)
        came = kept(times_of(pdo) - times[interval])
        after.append(
            np.bincount(interval[came > MAX_ANSWER_PERIODS * period], minlength=len(times))[long]
        )
        swapped[interval[(came >= ahead[interval]) & (ahead[interval] > 0)]] = True
        busy[interval[came > 0.5 * period * periods[interval]]] = True
        two = bool(
            (np.bincount(interval, minlength=len(times))[periods <= MIN_PAUSE_PERIODS] > 1).any()
        )
        off = np.abs(came - np.median(came))
        unusual[
            interval[off > _MAX_USUAL_PERIODS * usual + _MAX_USUAL_RATIO[two] * np.median(off)]
        ] = True
    most = np.sort(after, axis=0)[(len(pdos) - 1) // 2]
    known = (
        np.where(
            syncs.ours | (long == len(times) - 1),
            most >= lost,
            np.abs(periods[long] - lost - 1) <= MAX_PERIOD_OFFSET,
        )
        & (lost < MAX_RUN_SYNCS)
        # Without any answer nothing was on the bus, so no SYNC was lost.
        & ((lost == 1) | (most > 0) | busy[long])
    )
    steps[long[known]] += lost[known]
    paused[long], torn[long] = ~known, ~known & np.any(after, axis=0)
    return Intervals(
        steps=steps,
        paused=paused,
        torn=torn,
        swapped=swapped,
        unusual=unusual & (steps == 1),
    )


def _lasting_periods(times: Ints, period: float) -> Array:
    """Compute the lasting periods from each SYNC to the next.

    A delay does not last, because the next steps make up for it.
    """
    index = np.arange(len(times))
    even, _ = _remove_set_back(times, index)
    freed, run, period = _remove_delays(index, (even - times[0]).astype(np.float64), period)
    later = freed - index * period
    steps = later[1:] - minimum_behind(later, _LOOKAHEAD_SYNCS[1], run)[:-1]
    return np.where(np.diff(run) > 0, 1 + steps / period, 1.0)


def counted_steps(counter: NDArray[np.uint8]) -> Rows:
    """Count the periods from each SYNC frame to the next by the counter in the frames.

    The counter (object 1019h) runs from 1 to its overflow value.
    """
    top, steps = int(counter.max()), np.ones(len(counter), np.int32)
    if top > 1:
        steps[:-1] = np.mod(np.diff(counter.astype(np.int64)) - 1, top) + 1
    return steps
