"""The association of PDOs with SYNCs.

An interval is the time from one SYNC frame to the next. A drive answers every SYNC once and in
order, some answers after the next SYNC. The order assigns answers to SYNCs as long as no answer is
lost: a lost one shifts all later ones of its drive. So the frames are divided at places where no
answer is pending, and a part gives rows only if every PDO came as often as SYNC:

    SYNC         0    1    2    3    4    5    6    7    8    9    10   11   12   13   14   15   16
    drive A      |0   |1   |    |3   |4   |5   |6   |7   |8   |    |9 10|11  |12  |13  |14  |15  |16
    drive B      |0   |1   |2   |3   |4   |5   |6   |7   |8   |9   |10  |11  |12  |13  |14  |15  |16
    A behind by  0    0    0    1    1    1    1    1    1    1    2    1    1    1    1    1    1
    proven edges ^                   ^    ^    ^    ^    ^    ^              ^    ^    ^    ^    ^
    rows         0    1              4    5    6    7    8              11   12   13   14   15   16

- **Proven edges** are the ends of three intervals in a row with one PDO of every drive each, at its
  usual time after SYNC, unless a drive catches up later with pending answers. If drives are late
  (10), the first of such intervals (3) prove nothing.
- **Stretches** reach from such an edge to the next place at which there are as many PDOs as SYNCs
  since then.
- **Doubtful**: A is late at 9, or 9 is lost and 10 came twice. Within `MAX_RUN_SYNCS` of a PDO
  that is missing or duplicate (2 of A) late answers prove nothing, so 9 and 10 give no rows;
  without the loss of 2 they do.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Ints
from ..files import kept
from .rows import Rows
from .sync_grid import (
    MAX_ANSWER_PERIODS,
    MAX_RUN_SYNCS,
    Intervals,
    Syncs,
    interval_of,
    minimum_ahead,
    minimum_behind,
)

# Late drives answer at their usual time in at most so many intervals in a row.
MAX_LATE_USUAL = 11
# So many intervals in a row prove the order; at most so many more are needed if PDOs are late.
MIN_IN_ORDER, MAX_LATE_IN_ORDER = 3, 8


@dataclass(frozen=True, kw_only=True, eq=False)
class Answers:
    """The frames that answer SYNCs, where the order is proven.

    Attributes:
        answered: (N,) grid indices of the SYNCs whose answers are all known, including SYNCs that
            were not recorded.
        late: (N,) whether PDOs are late, so that one missing or duplicate within the next
            `MAX_RUN_SYNCS` makes the row doubtful.
        rows: for each PDO the (N,) frames that answer.
        losses: late, duplicate and missing frames of each PDO; missing ones are counted where all
            drives answer.
        missing_share: largest share of missing frames of a PDO there.
    """

    answered: Rows
    late: Bools
    rows: list[Rows]
    losses: list[dict[str, int]]
    missing_share: float


@dataclass(frozen=True, kw_only=True, eq=False)
class _Progress:
    """How the drives keep up with SYNC.

    Attributes:
        behind: for each PDO the (k + 1,) answers that are pending at an edge between two intervals.
        uneven: (k,) whether the number of answers in an interval differs from the number of SYNCs.
        caught_up: (k + 1,) edges at which a drive is late: it is less behind both before and later.
        alone: (k,) intervals of one SYNC with one PDO of every drive.
    """

    behind: list[Rows]
    uneven: Bools
    caught_up: Bools
    alone: Bools


def associate(
    pdos: Sequence[Rows],
    repeats: Sequence[Rows],
    syncs: Syncs,
    times_of: Callable[[Rows], Ints],
    intervals: Intervals,
) -> Answers:
    """Assign the frames of `pdos` to SYNCs where the order is proven.

    Parameters
    ----------
    pdos : for each PDO its frames, without repeats.
    repeats : for each PDO the frames that `without_repeats` removed.
    syncs : the recorded SYNCs.
    times_of : function that returns the times of frames in ns.
    intervals : the intervals between the SYNCs.
    """
    steps = intervals.steps
    progress = _progress(pdos, syncs.rows, intervals)
    proven, cuts, whole, pending = _stretches(progress, intervals)

    # Count what is lost while all drives answer.
    first, end = np.searchsorted(syncs.rows, [max(p[0] for p in pdos), min(p[-1] for p in pdos)])
    span = np.clip(cuts, first - 1, max(first - 1, end))
    grown = np.array([np.diff(x[span]) for x in progress.behind]) * ~whole
    losses = [
        {"duplicate": len(again) - int(x[x < 0].sum()), "missing": int(x[x > 0].sum())}
        for again, x in zip(repeats, grown, strict=True)
    ]
    asked = max(1, int(steps[span[0] : span[-1]].sum()))

    # Keep the stretches that are whole and not doubtful.
    damaged = np.repeat(grown.any(axis=0), np.diff(cuts)) | intervals.swapped
    # At both ends answers are pending, so missing ones are not damage.
    damaged[:pending] = damaged[cuts[-2] :] = False
    again = interval_of(np.concatenate(repeats), syncs.rows)
    late, doubtful = _late(progress, intervals.unusual, proven, cuts, damaged, again)
    keep = np.repeat(whole & ~doubtful, np.diff(cuts))
    late = np.repeat(np.repeat(late, np.diff(cuts))[keep], steps[keep])
    # These arrays are large in a long session, and not needed any more.
    del progress, proven, cuts, whole, grown, damaged
    return Answers(
        answered=kept(np.flatnonzero(np.repeat(keep, steps)).astype(np.int32)),
        late=late,
        rows=_answers(pdos, keep, syncs, times_of, steps, losses),
        losses=losses,
        missing_share=max(lost["missing"] for lost in losses) / asked,
    )


def _progress(pdos: Sequence[Rows], sync_rows: Rows, intervals: Intervals) -> _Progress:
    asked = _sums(intervals.steps)  # before each edge
    behind = [
        kept(asked - _sums(np.bincount(interval_of(pdo, sync_rows), minlength=len(asked) - 1)))
        for pdo in pdos
    ]
    uneven = np.logical_or.reduce([np.diff(x) != 0 for x in behind])
    caught_up = np.logical_or.reduce(
        [
            (x > minimum_ahead(x, MAX_RUN_SYNCS)) & (x > minimum_behind(x, MAX_RUN_SYNCS))
            for x in behind
        ]
    )
    return _Progress(
        behind=behind,
        uneven=uneven,
        caught_up=caught_up,
        alone=~uneven & (intervals.steps == 1) & ~intervals.torn,
    )


def _stretches(progress: _Progress, intervals: Intervals) -> tuple[Bools, Rows, Bools, int]:
    """Divide the intervals into stretches.

    Returns proven edges (k + 1,), the cuts between stretches, which stretches are whole, and the
    number of intervals at the beginning in which answers are pending.
    """
    behind, torn = progress.behind, intervals.torn
    proven = _in_order(progress, intervals.unusual)
    # The recording may begin while answers are pending: then there are more answers than SYNCs.
    begin = int(np.argmax(np.append(proven[:-1], True)))
    unknown = np.zeros(len(proven), np.int32)
    unknown[0] = any(x[: begin + 1].min() < 0 for x in behind)
    proven[[0, -1]] = True
    if all(x[-1] == 0 for x in behind) and any(x.max() > 0 for x in behind):
        # Nothing is lost, and some PDOs are late, so the last ones may be late, too.
        torn = np.append(torn[:-1], False)
    # Drives catch up in a pause. A drive that does not answers a SYNC that was not recorded.
    torn = torn | intervals.paused & progress.caught_up[1:]
    # The sums of torn intervals make each of them a cut, so that no stretch contains one.
    cuts, whole = _cuts([*behind, unknown, _sums(torn)], proven)
    return proven, cuts, whole, begin * int(unknown[0])


def _answers(
    pdos: Sequence[Rows],
    keep: Bools,
    syncs: Syncs,
    times_of: Callable[[Rows], Ints],
    steps: Rows,
    losses: Sequence[dict[str, int]],
) -> list[Rows]:
    """Return for each PDO the frames in the intervals to keep; add the late ones to its losses."""
    # This is the interval of each SYNC.
    asked = kept(np.repeat(np.flatnonzero(keep).astype(np.int32), steps[keep]))
    rows = []
    for pdo, lost in zip(pdos, losses, strict=True):
        interval = interval_of(pdo, syncs.rows)
        used = keep[interval]
        rows.append(kept(pdo[used]))
        late = np.flatnonzero(interval[used] != asked)
        came = times_of(rows[-1][late]) - times_of(syncs.rows[asked[late]])
        # If SYNCs came in a burst, the drive is in time although its PDO came in a later interval.
        lost["late"] = int(np.count_nonzero(came > MAX_ANSWER_PERIODS * syncs.period))
    return rows


def _in_order(progress: _Progress, unusual: Bools) -> Bools:
    """Find edges at which no answer is pending.

    They are in runs of intervals with one PDO of every drive, none of which is unusual. Late
    drives, too, have one PDO in each of some intervals, and a lost one may hide that they catch up.
    So the longest such run that is seen, and one interval more, proves nothing.
    """
    caught_up, alone = progress.caught_up, progress.alone & ~unusual
    both = alone & caught_up[1:] & caught_up[:-1]
    ends = np.flatnonzero(np.diff(both, prepend=False, append=False))
    longest = int((ends[1::2] - ends[::2]).max(initial=0))
    hidden = min(longest + 1, MAX_LATE_IN_ORDER) if caught_up.any() or unusual.any() else 0
    in_order = np.zeros(len(caught_up), np.bool_)
    starts = _in_a_row(alone, MIN_IN_ORDER + hidden)
    for k in range(hidden, MIN_IN_ORDER + hidden + 1):
        in_order[starts + k] = True
    return in_order & ~caught_up


def _in_a_row(values: Bools, count: int) -> Ints:
    """Return the first of each `count` true ones in a row."""
    sums = _sums(values)
    return np.flatnonzero(sums[count:] - sums[:-count] == count)


def _cuts(balances: Sequence[Rows], proven: Bools) -> tuple[Rows, Bools]:
    """Return the edges between stretches, and which stretches have as many PDOs as SYNCs.

    These have as many because no balance has changed.
    """
    starts = np.flatnonzero(proven).astype(np.int32)
    unchanged = np.ones(len(proven), np.bool_)
    for balance in balances:
        # A balance below that at the start shows an unnoticed loss of a SYNC or repeat of a PDO.
        lowest = np.minimum.reduceat(balance, starts)
        lowest[:-1] = np.minimum(lowest[:-1], balance[starts[1:]])
        level = np.where(lowest < balance[starts], np.iinfo(np.int32).max, balance[starts])
        unchanged &= balance == np.repeat(level, np.diff(starts, append=len(proven)))
    cuts = kept(np.flatnonzero(unchanged | proven).astype(np.int32))
    return cuts, np.logical_and.reduce([np.diff(balance[cuts]) == 0 for balance in balances])


def _late(
    progress: _Progress, unusual: Bools, proven: Bools, cuts: Rows, damaged: Bools, again: Rows
) -> tuple[Bools, Bools]:
    """Find stretches in which PDOs are late between two proven edges.

    Also find those of them within reach of an interval (k,) that is `damaged`, or in which a PDO
    came `again`.
    """
    # If a drive seems to be late but answers at its usual time again and again, it is more likely
    # that one PDO was lost and another came twice.
    behind = progress.caught_up[1:] & progress.caught_up[:-1]
    damaged[_in_a_row(progress.alone & ~unusual & behind, MAX_LATE_USUAL)] = True
    damaged[again] = True
    sums, at = _sums(damaged), np.arange(len(damaged), dtype=np.int32)
    near = (
        sums[np.minimum(at + 1 + MAX_RUN_SYNCS, len(damaged))]
        > sums[np.maximum(at - MAX_RUN_SYNCS, 0)]
    )
    # A late part reaches from the first uneven interval between two proven edges to the last.
    starts = np.flatnonzero(proven).astype(np.int32)
    sums, count = _sums(progress.uneven | unusual), np.diff(starts)
    late = (sums[1:] > np.repeat(sums[starts[:-1]], count)) & (
        sums[:-1] < np.repeat(sums[starts[1:]], count)
    )
    doubtful = late & np.repeat(np.logical_or.reduceat(near, starts[:-1]), count)
    return np.logical_or.reduceat(late, cuts[:-1]), np.logical_or.reduceat(doubtful, cuts[:-1])


def _sums(values: Bools | Rows | Ints) -> Rows:
    """Return the sum of all values before each, then the sum of all."""
    return kept(np.append(np.int32(0), np.cumsum(values, dtype=np.int32)))
