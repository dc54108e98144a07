"""Which PDO answers which SYNC: SYNC frames that were not recorded, and PDOs that are late, doubled or missing.

An interval is the time from one SYNC frame to the next. A drive answers every SYNC once and in order, some answers after the
next SYNC. Order alone assigns answers to SYNCs as long as all of them are there: one that is lost shifts all later ones of its
drive. So the frames are cut into stretches at places where nothing is pending, and a stretch gives rows only where every PDO
came as often as SYNC did. Nothing is pending

- between intervals with one PDO of every drive each, three in a row, unless a drive catches up later with what it was behind;
- as often as the PDOs since such a place are as many as the SYNCs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Ints
from .rows import WHOLE
from .sync_times import PAUSE, Rows, least_ahead

Bools = NDArray[np.bool_]
LONGEST_RUN = 255  # SYNCs within which late PDOs must end, and SYNCs lost in a row; a longer silence is a pause
IN_ORDER, LATE_IN_ORDER = 3, 8  # intervals in a row that prove the order; at most so many more where drives are late
_IN_TIME = 0.75  # periods after SYNC: a later PDO may answer one that was not recorded


@dataclass(frozen=True, kw_only=True, eq=False)
class PdoFrames:
    """The frames of one PDO after the first SYNC: rows, those of SYNC; and how many repeat the frame before."""

    rows: Rows
    sync_rows: Rows
    repeats: int

    @property
    def interval(self) -> Rows:
        """Interval of each frame; made anew each time, because those of all PDOs are much memory."""
        return np.searchsorted(self.sync_rows, self.rows).astype(np.int32) - 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Association:
    """The PDOs on the grid of all SYNCs, those included that were not recorded.

    Attributes:
        answered: (N,) grid indices of the SYNCs whose answers are all known.
        rows: of each PDO the (N,) frames that answer them.
        counts: of each PDO the late, duplicate and missing ones, these in the span in which all drives answer.
        missing_share: of the PDO of which most are missing, in that span.
    """

    answered: Rows
    rows: tuple[Rows, ...]
    counts: tuple[Mapping[str, int], ...]
    missing_share: float


def pdo_frames(rows: Rows, sync_rows: Rows, data: NDArray[np.uint8]) -> PdoFrames:
    """Assign frames `rows` with the bytes `data` (len(rows), 8) to intervals.

    A frame with the bytes of the one before in its interval repeats it, if the drive's bytes change before and after.
    """
    interval = (np.searchsorted(sync_rows, rows) - 1).astype(np.int32)
    again = np.flatnonzero((np.diff(interval) == 0) & (interval[1:] >= 0)) + 1
    same = (data[again] == data[again - 1]).all(axis=1)
    changed = (again < 2) | (data[again - 1] != data[again - 2]).any(axis=1)
    after = np.minimum(again + 1, len(rows) - 1)
    changed &= (again == len(rows) - 1) | (data[after] != data[again]).any(axis=1)
    used = interval >= 0
    used[again[same & changed]] = False
    return PdoFrames(rows=rows[used], sync_rows=sync_rows, repeats=int(np.count_nonzero(same & changed)))


def sync_steps(
    times: Ints, pdos: Sequence[PdoFrames], times_of: Callable[[Rows], Ints], *, ours: bool
) -> tuple[Rows, Bools, Bools]:
    """Periods from each SYNC frame to the next; whether it was a pause, and one with late PDOs in it; (k,) each.

    A step of whole periods of another producer is as many SYNCs. We may have sent SYNC late: then SYNCs are lost if most
    drives have an answer to each of them, as after the last SYNC. `times_of` gives the times of frames.
    """
    steps, paused, torn = np.ones(len(times), np.int32), np.zeros(len(times), np.bool_), np.zeros(len(times), np.bool_)
    period = float(np.median(np.diff(times))) or 1.0
    end = max(int(times_of(pdo.rows[-1:])[0]) for pdo in pdos)
    after_last = 1 + int((end - times[-1]) / period + 1 - _IN_TIME)
    periods = np.append(np.diff(times) / period, after_last)
    long = np.flatnonzero(periods > PAUSE)
    lost = np.rint(periods[long]).astype(np.int64) - 1
    after = np.empty((len(pdos), len(long)), np.int64)
    for count, pdo in zip(after, pdos, strict=True):
        interval = pdo.interval
        here = np.isin(interval, long)
        interval = interval[here]
        interval = interval[times_of(pdo.rows[here]) - times[interval] > _IN_TIME * period]
        count[:] = np.bincount(interval, minlength=len(times))[long]
    known = np.sort(after, axis=0)[(len(pdos) - 1) // 2] >= lost
    if not ours:
        known |= (np.abs(periods[long] - lost - 1) <= WHOLE) & (long < len(times) - 1)
    known &= lost < LONGEST_RUN
    steps[long[known]] += lost[known]
    paused[long], torn[long] = ~known, ~known & after.any(axis=0)
    return steps, paused, torn


def counted_steps(counter: NDArray[np.uint8]) -> Rows:
    """Periods from each SYNC frame to the next by the counter in them (object 1019h): from 1 to its overflow value."""
    top, steps = int(counter.max()), np.ones(len(counter), np.int32)
    if top > 1:
        steps[:-1] = np.mod(np.diff(counter.astype(np.int64)) - 1, top) + 1
    return steps


def associate(pdos: Sequence[PdoFrames], steps: Rows, paused: Bools, torn: Bools) -> Association:
    """Assign PDOs to SYNCs where the order is proven; `steps`, `paused`, `torn` as of `sync_steps`."""
    edges = _sums(steps)
    alone, caught_up = (steps == 1) & ~torn, np.zeros(len(edges), np.bool_)
    behind = []  # of each PDO: SYNCs without an answer so far
    for pdo in pdos:
        count = np.bincount(pdo.interval, minlength=len(steps))
        alone &= count == 1
        behind.append(edges - _sums(count))
        del count
        later, before = (least_ahead(x, LONGEST_RUN) for x in (behind[-1], behind[-1][::-1]))
        # A drive that is less behind both before and later is late here.
        caught_up |= (behind[-1] > later) & (behind[-1] > before[::-1])
    if all(x[-1] == 0 for x in behind) and any(x.max() > 0 for x in behind):
        torn = np.append(torn[:-1], False)  # nothing is lost, and some PDOs are late: so may the last ones be
    # In a pause drives catch up: one that has not done so answers a SYNC that was not recorded.
    torn = torn | paused & caught_up[1:]
    # Late drives, too, have one PDO in each of some intervals, and a lost one may hide that they catch up.
    hidden = min(_longest_run(alone & caught_up[1:] & caught_up[:-1]) + 1, LATE_IN_ORDER) if caught_up.any() else 0
    in_order, sums = np.zeros(len(edges), np.bool_), _sums(alone)
    runs = np.flatnonzero(sums[IN_ORDER + hidden :] - sums[: -IN_ORDER - hidden] == IN_ORDER + hidden)
    for k in range(hidden, IN_ORDER + hidden + 1):
        in_order[runs + k] = True
    proven = in_order & ~caught_up
    # The recording may have begun while answers were pending: then there are more of them than SYNCs.
    begin = int(np.argmax(proven)) if proven.any() else len(edges) - 1
    unknown = np.zeros(len(edges), np.int32)
    unknown[0] = any(x[: begin + 1].min() < 0 for x in behind)
    proven[[0, -1]] = True
    starts = np.flatnonzero(proven).astype(np.int32)
    balances = [*behind, unknown, _sums(torn)]  # an interval that is torn is in no stretch
    unchanged = np.ones(len(edges), np.bool_)
    for balance in balances:
        lowest = np.minimum.reduceat(balance, starts)  # below the start: a SYNC was lost, or a PDO doubled, unnoticed
        lowest[:-1] = np.minimum(lowest[:-1], balance[starts[1:]])
        level = np.where(lowest < balance[starts], np.iinfo(np.int32).max, balance[starts])
        unchanged &= balance == np.repeat(level, np.diff(starts, append=len(edges)))
    cuts = np.flatnonzero(unchanged | proven).astype(np.int32)
    whole = np.ones(len(cuts) - 1, np.bool_)
    for balance in balances:
        whole &= np.diff(balance[cuts]) == 0
    first, end = np.searchsorted(pdos[0].sync_rows, [max(p.rows[0] for p in pdos), min(p.rows[-1] for p in pdos)])
    span = np.clip(cuts, first - 1, max(first - 1, end))
    counts: list[dict[str, int]] = []
    for pdo, balance in zip(pdos, behind, strict=True):
        grown = np.diff(balance[span])[~whole]
        duplicate = pdo.repeats - int(grown[grown < 0].sum())
        counts.append({"duplicate": duplicate, "missing": int(grown[grown > 0].sum())})
    share = max(losses["missing"] for losses in counts) / max(1, int(edges[span[-1]] - edges[span[0]]))
    keep = np.repeat(whole, np.diff(cuts))
    del behind, balances, balance, edges, sums, span  # of a long session these are much memory
    asked = np.repeat(np.flatnonzero(keep).astype(np.int32), steps[keep])  # the interval of each of the SYNCs
    rows = []
    for pdo, losses in zip(pdos, counts, strict=True):
        interval = pdo.interval
        used = keep[interval]
        rows.append(pdo.rows[used])
        losses["late"] = int(np.count_nonzero(interval[used] != asked))
    answered = np.flatnonzero(np.repeat(keep, steps)).astype(np.int32)
    return Association(answered=answered, rows=tuple(rows), counts=tuple(counts), missing_share=share)


def _sums(values: NDArray[Any]) -> Rows:
    """Sum of all values before each, and of all."""
    found = np.zeros(len(values) + 1, np.int32)
    np.cumsum(values, out=found[1:])
    return found


def _longest_run(true: Bools) -> int:
    ends = np.flatnonzero(np.diff(true, prepend=False, append=False))
    return int((ends[1::2] - ends[::2]).max(initial=0))
