"""The frames of a CAN log, once each and in the order of their times.

Loggers with a queue for each way write lines out of order, with right times: those are sorted.
Where a counter of time wraps or the clock is set back, SYNC itself goes on below the time that it
had reached: from there on times are shifted.
"""

from collections.abc import Iterator

import numpy as np

from ..arrays import Ints
from ..errors import Place
from ..files import by_rows, field_of, kept, taken
from ..recording import FRAME, SENT, Block, Rows, Traffic
from ..robot import BusFile

# Times that begin again from 0 after so many ns.
_WRAPS = {60 * 10**9: "a minute", 2**32 * 1000: "2^32 µs", 86_400 * 10**9: "a day"}
_MAX_WRAP_NS = 10**9  # between the times before and after a wrap
_AROUND = 8  # rows before and after a step back, that tell whether it lasts
_MAX_OFF = 0.5  # periods: rows that are all earlier by more show a step back of the clock
_MAX_SET_NS, _MAX_SET_SHARE = 60 * 10**9, 0.8  # of the times so far: more is another session
_MAX_ECHO = 0.25  # periods between the two records of one frame
ONE_CLOCK = (
    "one session with one clock: a clock was set back, or the file holds two sessions; split it "
    "there, and import each"
)


def in_order(frames: Block, bus: BusFile, place: str) -> tuple[Block, tuple[str, ...]]:
    """Rows of `FRAME` (m,) in the order of their times, those of equal times in that of the file,
    without echoes; and what the user has to know of it, one line each.

    Wraps and steps back of the clock are taken out of the times. Raises `BadInputError`: the times
    begin again, as those of two sessions in one file do.
    """
    time_ns, warnings, rows = field_of(frames, "time_ns"), list[str](), frames
    if (np.diff(time_ns) < 0).any():
        time_ns = kept(time_ns)
        warnings += _go_on(time_ns, Traffic(frames).rows_of(bus.sync_can_id), Place(place))
        if back := int(np.count_nonzero(np.diff(time_ns) < 0)):
            warnings.append(
                f"times step back at {back} frames: all are put in the order of their times"
            )
        order = np.argsort(time_ns, kind="stable")
        rows = by_rows(lambda some: frames[some], order)
        rows["time_ns"] = time_ns[order]
    echoes = _echoes(rows, bus)
    if len(echoes):
        warnings.append(f"{len(echoes)} frames recorded as sent and again as received count once")
        rows = taken(rows, np.delete(np.arange(len(rows)), echoes))
    return rows, tuple(warnings)


def _go_on(time_ns: Ints, syncs: Rows, place: Place) -> Iterator[str]:
    """Shift the times (m,) in place where they wrap, or the clock was set back by the SYNCs of
    these rows; and say so.
    """
    size = np.diff(time_ns)
    jumps = np.flatnonzero(np.abs(size) > min(_WRAPS) - _MAX_WRAP_NS)
    size = size[jumps]
    for wrap_ns, text in _WRAPS.items():
        wraps = np.abs(np.abs(size) - wrap_ns) < _MAX_WRAP_NS
        if wraps.any() and time_ns.max() < wrap_ns + _MAX_WRAP_NS:
            before = np.append(0, np.cumsum(np.sign(size[wraps])))
            rows = np.diff(jumps[wraps] + 1, prepend=0, append=len(time_ns))
            time_ns -= np.repeat(before * wrap_ns, rows)
            yield f"times wrapped after {text}: later ones are shifted forward"
    for k, by_ns, since_ns in steps_back(time_ns[syncs]):
        row = syncs[k] + 1 + int(np.argmin(np.diff(time_ns[syncs[k] : syncs[k + 1] + 1])))
        step = f"back by {by_ns * 1e-9:.3g} s at {since_ns * 1e-9:.4g} s"
        place.require(
            by_ns <= min(_MAX_SET_NS, _MAX_SET_SHARE * since_ns),
            text=f"times step {step}, at frame {row + 1}",
            expected=ONE_CLOCK,
        )
        time_ns[row:] += by_ns
        yield f"the clock was set {step}: later times are shifted forward"


def steps_back(time_ns: Ints) -> Iterator[tuple[int, int, int]]:
    """Rows of periodic times (m,) after which the clock was set back; by how much, and when since
    the first one, in ns.

    Rows out of order do not last: those before and after them are as late for their number.
    """
    back = np.flatnonzero(np.diff(time_ns) < 0)
    if not len(back):
        return
    since_ns = time_ns - time_ns[0]
    period = float(np.median(np.diff(np.sort(since_ns))))
    late = since_ns - period * np.arange(len(time_ns))
    for k in back:
        before, after = late[max(0, k + 1 - _AROUND) : k + 1], late[k + 1 : k + 1 + _AROUND]
        if before.min() - after.max() > _MAX_OFF * period:
            yield int(k), round(float(np.median(before) - np.median(after))), int(since_ns[k])


def _echoes(frames: Block, bus: BusFile) -> Ints:
    """Rows that were received and repeat one sent within a quarter of a period, equal in all else,
    as echoes and requests do.
    """
    sent = frames["flags"] & SENT > 0
    both = np.intersect1d(frames["can_id"][sent], frames["can_id"][~sent])
    rows = np.flatnonzero(np.isin(frames["can_id"], both))
    some = frames[rows]
    some["time_ns"] = 0
    some["flags"] |= SENT
    order = np.argsort(some.view(f"V{FRAME.itemsize}"), kind="stable")  # equal ones by time
    rows, some = rows[order], some[order]
    near = np.diff(frames["time_ns"][rows]) < _MAX_ECHO * 1e9 * bus.sync_period_s
    again = near & (some[1:] == some[:-1]) & (sent[rows[1:]] != sent[rows[:-1]])
    pairs = np.stack([rows[:-1], rows[1:]])[:, again]
    return np.unique(pairs[~sent[pairs]])
