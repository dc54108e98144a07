"""Which PDO answers which SYNC: SYNC frames that were not recorded, and PDOs that are late, duplicate or missing.

An interval is the time from one SYNC frame to the next. A drive answers every SYNC once and in order, so an interval without
an answer is matched with a later interval that has two. Answers beyond that show a SYNC that was not recorded, if every drive
has one and the interval lasts about as long as several periods.
"""

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Ints
from ..recording import Block

LONGEST_LATE = 3  # SYNCs by which one PDO may be late; a later one counts as missing and duplicate
LONGEST_RUN = 200  # SYNCs within which late PDOs must end; after more, one PDO counts as missing


@dataclass(frozen=True, kw_only=True, eq=False)
class SyncGrid:
    """All SYNCs of a session in order, those included that were not recorded.

    Attributes:
        before: (len(frames),) SYNC frames up to and with each frame.
        index_of: (k,) grid index of each of the k SYNC frames.
        size: SYNCs in all.
    """

    before: Ints
    index_of: Ints
    size: int


@dataclass(frozen=True, kw_only=True)
class Answers:
    """The PDOs of one identifier on the grid of SYNC.

    Attributes:
        slot: (grid,) row of the frame that answers each SYNC, -1 where there is none.
        late: frames received after the next SYNC.
        duplicate: frames that answer a SYNC which has its answer already.
        missing: SYNCs without an answer between the first and the last that have one.
    """

    slot: Ints
    late: int
    duplicate: int
    missing: int


def sync_steps(syncs: Block, times: Ints, drives: list[Ints], before: Ints, frames: Block) -> Ints:
    """Periods from each SYNC frame to the next: 1, or more where SYNCs were not recorded. One more entry for the last.

    A counter in the SYNC frames (object 1019h) tells how many are missing. `drives` has the rows of each PDO in `frames`, all
    frames, and `before` the number of SYNC frames up to and with each of them.
    """
    steps = np.ones(len(times), np.int64)
    if (syncs["length"] >= 1).all():
        counter = syncs["data"][:, 0].astype(np.int64)
        top = int(counter.max())  # the counter goes from 1 to its overflow value
        steps[:-1] = (np.diff(counter) - 1) % top + 1 if top > 1 else 1
        return steps
    if not drives:
        return steps
    gaps = np.diff(times)
    periods = np.rint(gaps / (float(np.median(gaps)) or 1.0)).astype(np.int64)
    long = np.flatnonzero(periods >= 2)
    if not len(long):
        return steps
    found = [_surplus(_after_first_sync(rows, before), len(times), frames) for rows in drives]
    for k in long.tolist():
        near = slice(k, k + LONGEST_LATE + 1)
        lost = min(int(surplus.late_or_lost[near].sum()) for surplus in found)
        if not lost and all(surplus.count[k] >= 2 for surplus in found):
            # One drive has more answers than SYNCs; the others lost an answer earlier.
            lost = int(any(surplus.lost[near].any() for surplus in found))
        lost = min(lost, int(periods[k]) - 1)
        steps[k] += lost
        for surplus in found:
            surplus.take(k, lost)
    return steps


def answers(rows: Ints, grid: SyncGrid, frames: Block) -> Answers:
    """Assign the frames `rows` of one PDO to the SYNCs of the grid."""
    rows, interval = _after_first_sync(rows, grid.before)
    first = np.searchsorted(interval, interval)  # place of the first PDO in the same interval
    place = np.arange(len(rows)) - first
    # Where SYNCs were not recorded, the PDOs of one interval answer as many SYNCs.
    span = np.append(np.diff(grid.index_of), 1)[interval]
    on_time = grid.index_of[interval] + np.minimum(place, span - 1)
    count = np.bincount(on_time, minlength=grid.size)
    made_up, extra = _paired(rows, on_time, count, frames)
    # Answers come in order: the first SYNC that has one gets the first frame, and so on.
    answered = np.flatnonzero((count > 0) | made_up)
    used = ~extra
    slot = np.full(grid.size, -1, np.int64)
    slot[answered] = rows[used]
    missing = int(answered[-1] - answered[0] + 1 - len(answered)) if len(answered) else 0
    late = int(np.count_nonzero(answered != on_time[used]))
    return Answers(slot=slot, late=late, duplicate=int(np.count_nonzero(extra)), missing=missing)


def _after_first_sync(rows: Ints, before: Ints) -> tuple[Ints, Ints]:
    """Rows and their intervals; frames before the first SYNC answer none and are left out."""
    interval = before[rows] - 1
    return rows[interval >= 0], interval[interval >= 0]


def _paired(rows: Ints, at: Ints, count: Ints, frames: Block) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Empty intervals that a later frame fills (grid,), and frames that answer no SYNC (len(rows),)."""
    made_up, extra = np.zeros(len(count), np.bool_), np.zeros(len(rows), np.bool_)
    for place, _, empty in _more_than_one(rows, at, count, frames):
        if empty is None:
            extra[place] = True
        else:
            made_up[empty] = True
    return made_up, extra


def _more_than_one(rows: Ints, at: Ints, count: Ints, frames: Block) -> list[tuple[int, bool, int | None]]:
    """Frames beyond one for each interval, as (place in `rows`, no sign of a lost SYNC, empty interval that it fills).

    A frame is no sign of a lost SYNC if it repeats the one before or is too late. It fills the nearest empty interval before
    it; None if there is none near enough.
    """
    found: list[tuple[int, bool, int | None]] = []
    crowded = np.flatnonzero(count >= 2).tolist()
    if not crowded:
        return found
    empty = np.flatnonzero(count == 0).tolist()
    waiting: deque[int] = deque(maxlen=LONGEST_LATE)  # a PDO is late by no more than these
    seen = 0
    for k, begin in zip(crowded, np.searchsorted(at, crowded).tolist(), strict=True):
        until = bisect_left(empty, k)
        waiting.extend(empty[max(seen, until - LONGEST_LATE) : until])
        too_late = until - seen > LONGEST_LATE
        seen = until
        places = range(begin, begin + int(count[k]))
        repeats = [place for place in places[1:] if _repeats(frames, rows, place)]
        found += [(place, True, None) for place in repeats]
        single = [place for place in places if place not in repeats]
        made_up: list[int] = []
        while len(made_up) < len(single) - 1 and waiting and k - waiting[-1] <= LONGEST_RUN:
            made_up.append(waiting.pop())
        # Of duplicates the first is used; after a silence longer than a PDO may be late, the last ones are.
        spare = len(single) - 1 - len(made_up)
        own = len(single) - spare
        surplus = single[:spare] if too_late else single[own:]
        found += [(place, too_late, None) for place in surplus]
        beyond_first = (single[spare:] if too_late else single[:own])[1:]
        found += [(place, False, slot) for place, slot in zip(beyond_first, made_up, strict=True)]
    return found


def _repeats(frames: Block, rows: Ints, place: int) -> bool:
    """Whether a frame repeats the one before: the same bytes, from a drive whose bytes change before and after."""
    data = frames["data"][rows[max(place - 2, 0) : place + 2]]
    here = min(place, 2)
    if place < 2 or not (data[here] == data[here - 1]).all() or (data[here - 1] == data[here - 2]).all():
        return False
    return len(data) == here + 1 or bool((data[here + 1] != data[here]).any())


@dataclass(kw_only=True)
class _Surplus:
    """Frames of one PDO that came beyond one for each SYNC, by interval.

    Attributes:
        count: frames in each interval.
        lost: those that fill no empty interval: there were more answers than SYNCs.
        late_or_lost: those, and frames whose empty interval lies so far back that its answer may be missing, not late.
    """

    count: Ints
    lost: Ints
    late_or_lost: Ints

    def take(self, k: int, lost: int) -> None:
        """Count `lost` frames from interval `k` on as answers to SYNCs that were not recorded."""
        for field in (self.lost, self.late_or_lost):
            left = lost
            for j in range(k, min(k + LONGEST_LATE + 1, len(field))):
                taken = min(left, int(field[j]))
                field[j] -= taken
                left -= taken


def _surplus(found: tuple[Ints, Ints], syncs: int, frames: Block) -> _Surplus:
    rows, interval = found
    count = np.bincount(interval, minlength=syncs)
    lost, late_or_lost = np.zeros(syncs, np.int64), np.zeros(syncs, np.int64)
    for place, repeats, empty in _more_than_one(rows, interval, count, frames):
        k = int(interval[place])
        if repeats:
            continue
        if empty is None:
            lost[k] += 1
        if empty is None or k - empty > LONGEST_LATE:
            late_or_lost[k] += 1
    return _Surplus(count=count, lost=lost, late_or_lost=late_or_lost)
