"""Which PDO answers which SYNC.

An interval is the time from one SYNC frame to the next. A drive answers every SYNC once and in
order, some answers after the next SYNC. The order assigns answers to SYNCs as long as none is lost:
a lost one shifts all later ones of its drive. So the frames are divided at places where no answer
is pending, and what lies between gives rows only if every PDO came as often as SYNC:

    SYNC         0    1    2    3    4    5    6    7    8    9    10   11   12   13   14   15   16
    drive A      |0   |1   |    |3   |4   |5   |6   |7   |8   |    |9 10|11  |12  |13  |14  |15  |16
    drive B      |0   |1   |2   |3   |4   |5   |6   |7   |8   |9   |10  |11  |12  |13  |14  |15  |16
    A behind by  0    0    0    1    1    1    1    1    1    1    2    1    1    1    1    1    1
    proven edges ^                   ^    ^    ^    ^    ^    ^              ^    ^    ^    ^    ^
    rows         0    1              4    5    6    7    8              11   12   13   14   15   16

- **Proven edges**: the ends of three intervals in a row with one PDO of every drive each, at its
  usual time after SYNC, unless a drive catches up later with pending answers. Where drives are late
  (10), the first of such intervals (3) prove nothing.
- **Stretches**: from such an edge to the next place at which the PDOs since then
  are as many as the SYNCs.
- **Doubtful**: A is late at 9, or 9 is lost and 10 came twice. Within `MAX_RUN_SYNCS` of a PDO
  that is missing or doubled (2 of A) late answers prove nothing, so 9 and 10 give no rows; without
  the loss of 2 they do.
"""

from collections.abc import Callable, Sequence

import numpy as np

from ..arrays import Bools, Ints
from ..files import kept
from .rows import Rows
from .sync_grid import (
    MAX_ANSWER_PERIODS,
    MAX_RUN_SYNCS,
    Intervals,
    interval_of,
    minimum_ahead,
    minimum_behind,
)

MAX_LATE_USUAL = 11  # intervals in a row that late drives answer at their usual time
# intervals in a row that prove the order; at most so many more if PDOs are late
MIN_IN_ORDER, MAX_LATE_IN_ORDER = 3, 8


def associate(
    pdos: Sequence[Rows],
    repeats: Sequence[Rows],
    sync_rows: Rows,
    times_of: Callable[[Rows], Ints],
    intervals: Intervals,
    period: float,
) -> tuple[Rows, Bools, list[Rows], list[dict[str, int]], float]:
    """Assign the frames of `pdos` to SYNCs where the order is proven.

    Parameters
    ----------
    repeats : frames that `without_repeats` left out.
    times_of : times of frames, ns.
    period : of SYNC, ns.

    Returns
    -------
    (N,) grid indices of the SYNCs whose answers are all known, also SYNCs that were not recorded.
    (N,) whether PDOs are late: one missing or doubled within the next `MAX_RUN_SYNCS` makes the row
        doubtful.
    For each PDO the (N,) frames that answer.
    Late, duplicate, missing frames of each PDO; missing: where all drives answer.
    The largest share of missing ones of a PDO there.
    """
    steps, torn, edges = intervals.steps, intervals.torn, _sums(intervals.steps)
    behind = [
        kept(edges - _sums(np.bincount(interval_of(pdo, sync_rows), minlength=len(steps))))
        for pdo in pdos
    ]
    # not as many answers as SYNCs in an interval
    uneven = np.logical_or.reduce([np.diff(x) != 0 for x in behind])
    # edges at which a drive is late: it is less behind both before and later
    caught_up = np.logical_or.reduce(
        [
            (x > minimum_ahead(x, MAX_RUN_SYNCS)) & (x > minimum_behind(x, MAX_RUN_SYNCS))
            for x in behind
        ]
    )
    alone = ~uneven & (steps == 1) & ~torn
    proven = _in_order(alone, caught_up, intervals.unusual)
    # The recording may begin while answers are pending: then there are more answers than SYNCs.
    begin, unknown = int(np.argmax(np.append(proven[:-1], True))), np.zeros(len(edges), np.int32)
    unknown[0] = any(x[: begin + 1].min() < 0 for x in behind)
    proven[[0, -1]] = True
    if all(x[-1] == 0 for x in behind) and any(x.max() > 0 for x in behind):
        # nothing is lost, and some PDOs are late: so may the last ones be
        torn = np.append(torn[:-1], False)
    # In a pause drives catch up: one that has not done so answers a SYNC that was not recorded.
    torn = torn | intervals.paused & caught_up[1:]
    # a torn interval is in no stretch
    cuts, whole = _stretches([*behind, unknown, _sums(torn)], proven)
    first, end = np.searchsorted(sync_rows, [max(p[0] for p in pdos), min(p[-1] for p in pdos)])
    span = np.clip(cuts, first - 1, max(first - 1, end))
    grown = np.array([np.diff(x[span]) for x in behind]) * ~whole
    losses = [{"duplicate": -int(x[x < 0].sum()), "missing": int(x[x > 0].sum())} for x in grown]
    share = max(lost["missing"] for lost in losses) / max(1, int(edges[span[-1]] - edges[span[0]]))
    damaged = np.repeat(grown.any(axis=0), np.diff(cuts)) | intervals.swapped
    damaged[: begin * unknown[0]] = damaged[cuts[-2] :] = False  # answers are pending
    # A drive that is late, again and again at its usual time: rather a PDO was lost,
    # and another came twice.
    sums = _sums(alone & ~intervals.unusual & caught_up[1:] & caught_up[:-1])
    damaged[np.flatnonzero(sums[MAX_LATE_USUAL:] - sums[:-MAX_LATE_USUAL] == MAX_LATE_USUAL)] = True
    damaged[interval_of(np.concatenate(repeats), sync_rows)] = True
    late, doubtful = (  # of stretches
        np.logical_or.reduceat(x, cuts[:-1])
        for x in _late(uneven | intervals.unusual, proven, damaged)
    )
    keep = np.repeat(whole & ~doubtful, np.diff(cuts))
    late = np.repeat(np.repeat(late, np.diff(cuts))[keep], steps[keep])
    del behind, grown, edges, uneven, proven, damaged  # large in a long session
    # the interval of each of the SYNCs
    asked = kept(np.repeat(np.flatnonzero(keep).astype(np.int32), steps[keep]))
    rows = []
    for pdo, lost in zip(pdos, losses, strict=True):
        interval = interval_of(pdo, sync_rows)
        used = keep[interval]
        rows.append(kept(pdo[used]))
        late_rows = np.flatnonzero(interval[used] != asked)
        came = times_of(rows[-1][late_rows]) - times_of(sync_rows[asked[late_rows]])
        # else SYNCs came in a burst, and the drive is in time
        lost["late"] = int(np.count_nonzero(came > MAX_ANSWER_PERIODS * period))
    answered = kept(np.flatnonzero(np.repeat(keep, steps)).astype(np.int32))
    return answered, late, rows, losses, share


def _in_order(alone: Bools, caught_up: Bools, unusual: Bools) -> Bools:
    """Edges at which no answer is pending: in runs of `alone`, intervals with one PDO of every
    drive, none of them unusual.

    Late drives, too, have one PDO in each of some intervals, and a lost one may hide that they
    catch up: the longest such run that is seen, and one interval more, proves nothing.
    """
    late, alone = caught_up.any() or unusual.any(), alone & ~unusual
    both = alone & caught_up[1:] & caught_up[:-1]
    ends = np.flatnonzero(np.diff(both, prepend=False, append=False))
    longest = int((ends[1::2] - ends[::2]).max(initial=0))
    hidden = min(longest + 1, MAX_LATE_IN_ORDER) if late else 0
    in_order, sums = np.zeros(len(caught_up), np.bool_), _sums(alone)
    runs = np.flatnonzero(
        sums[MIN_IN_ORDER + hidden :] - sums[: -MIN_IN_ORDER - hidden] == MIN_IN_ORDER + hidden
    )
    for k in range(hidden, MIN_IN_ORDER + hidden + 1):
        in_order[runs + k] = True
    return in_order & ~caught_up


def _stretches(balances: Sequence[Rows], proven: Bools) -> tuple[Rows, Bools]:
    """Edges between stretches, and which stretches have as many PDOs as SYNCs:
    no balance has changed.
    """
    starts = np.flatnonzero(proven).astype(np.int32)
    unchanged = np.ones(len(proven), np.bool_)
    for balance in balances:
        # below the start: an unnoticed loss of a SYNC or repeat of a PDO
        lowest = np.minimum.reduceat(balance, starts)
        lowest[:-1] = np.minimum(lowest[:-1], balance[starts[1:]])
        level = np.where(lowest < balance[starts], np.iinfo(np.int32).max, balance[starts])
        unchanged &= balance == np.repeat(level, np.diff(starts, append=len(proven)))
    cuts = kept(np.flatnonzero(unchanged | proven).astype(np.int32))
    return cuts, np.logical_and.reduce([np.diff(balance[cuts]) == 0 for balance in balances])


def _late(uneven: Bools, proven: Bools, damaged: Bools) -> tuple[Bools, Bools]:
    """Intervals from the first uneven one between two proven edges to the last, and those within
    reach of a damaged one.
    """
    sums, at = _sums(damaged), np.arange(len(damaged), dtype=np.int32)
    near = (
        sums[np.minimum(at + 1 + MAX_RUN_SYNCS, len(damaged))]
        > sums[np.maximum(at - MAX_RUN_SYNCS, 0)]
    )
    starts, sums = np.flatnonzero(proven).astype(np.int32), _sums(uneven)
    count = np.diff(starts)
    late = (sums[1:] > np.repeat(sums[starts[:-1]], count)) & (
        sums[:-1] < np.repeat(sums[starts[1:]], count)
    )
    return late, late & np.repeat(np.logical_or.reduceat(near, starts[:-1]), count)


def _sums(values: Bools | Rows | Ints) -> Rows:
    """Sum of all values before each, then the sum of all."""
    return kept(np.append(np.int32(0), np.cumsum(values, dtype=np.int32)))
