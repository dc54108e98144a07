"""The frames of a CAN log, once each and in the order of their times.

Loggers with a queue for each way write lines out of order, with right times: those are sorted.
Where a counter of time wraps or the clock is set back, SYNC itself goes on below the time that it
had reached: from there on times are shifted.
"""

from collections.abc import Iterator

import numpy as np

from ..arrays import Ints
from ..errors import Place
from ..files import GrowingBytes, field_of, kept
from ..recording import ERROR, EXTENDED, FRAME, REMOTE_REQUEST, SENT, Block
from ..robot import BusFile

# Times that begin again from 0 after so many ns.
_WRAPS = {60 * 10**9: "a minute", 2**32 * 1000: "2^32 µs", 86_400 * 10**9: "a day"}
_MAX_WRAP_NS = 10**9  # between the times before and after a wrap
_SYNCS = 8  # before and after a step back, that tell whether it lasts
_MAX_OFF = 0.5  # periods: SYNCs that are all earlier by more show a step back of the clock
_MAX_SET_NS, _MAX_SET_SHARE = 60 * 10**9, 0.8  # of the times so far: more is another session
_MAX_ECHO = 0.25  # periods between the two records of one frame
_AT_ONCE = 100_000  # frames


def in_order(frames: Block, bus: BusFile, place: str) -> tuple[Block, list[str]]:
    """Rows of `FRAME` (m,) in the order of their times, those of equal times in that of the file;
    and what the user has to know of it, one line each.

    Wraps and steps back of the clock are taken out of the times. Raises `BadInputError`: the times
    begin again, as those of two sessions in one file do.
    """
    time_ns, warnings = field_of(frames, "time_ns"), list[str]()
    size = np.diff(time_ns)
    if (size >= 0).all():
        return frames, warnings
    jumps = np.flatnonzero((size < 0) | (size > min(_WRAPS) - _MAX_WRAP_NS))
    size = size[jumps]
    for wrap_ns, text in _WRAPS.items():
        near = np.abs(np.abs(size) - wrap_ns) < _MAX_WRAP_NS
        if near.any() and time_ns.max() < wrap_ns + _MAX_WRAP_NS:
            time_ns = _shifted(time_ns, jumps[near] + 1, -np.sign(size[near]) * wrap_ns)
            warnings.append(f"times wrapped after {text}: later ones are shifted forward")
    plain = frames["flags"] & (EXTENDED | ERROR | REMOTE_REQUEST) == 0
    syncs = np.flatnonzero(plain & (frames["can_id"] == bus.sync_can_id))
    for k, by_ns, since_ns in list(_set_back(time_ns[syncs])):
        row = syncs[k] + 1 + int(np.argmin(np.diff(time_ns[syncs[k] : syncs[k + 1] + 1])))
        step = f"back by {by_ns * 1e-9:.3g} s at {since_ns * 1e-9:.4g} s"
        if by_ns > min(_MAX_SET_NS, _MAX_SET_SHARE * since_ns):
            expected = "one session with one clock: a clock was set back, or the file holds two "
            expected += "sessions; split it there, and import each"
            Place(place).refuse(text=f"times step {step}, at frame {row + 1}", expected=expected)
        warnings.append(f"the clock was set {step}: later times are shifted forward")
        time_ns = _shifted(time_ns, np.array([row]), np.array([by_ns]))
    if back := int(np.count_nonzero(np.diff(time_ns) < 0)):
        warnings.append(
            f"times step back at {back} frames: all are put in the order of their times"
        )
    return _taken(frames, np.argsort(time_ns, kind="stable"), time_ns), warnings


def _shifted(time_ns: Ints, rows: Ints, by_ns: Ints) -> Ints:
    """Times that are shifted from each of these rows on."""
    counts = np.diff(rows, prepend=0, append=len(time_ns))
    return kept(time_ns + np.repeat(np.append(0, np.cumsum(by_ns)), counts))


def _set_back(time_ns: Ints) -> Iterator[tuple[int, int, int]]:
    """SYNCs after which the clock was set back, by how much, and when since the first one, in ns.

    Lines out of order do not last: SYNCs before and after them are as late for their number.
    """
    size, since_ns = np.diff(time_ns), time_ns - time_ns[:1]
    period = float(np.median(np.diff(np.sort(since_ns)))) if len(size) else 1.0
    late = since_ns - period * np.arange(len(time_ns))
    for k in np.flatnonzero(size < 0):
        before, after = late[max(0, k + 1 - _SYNCS) : k + 1], late[k + 1 : k + 1 + _SYNCS]
        by_ns = round(float(np.median(before) - np.median(after)))
        if before.min() - after.max() > _MAX_OFF * period:
            yield int(k), by_ns, int(since_ns[k])


def once(frames: Block, bus: BusFile) -> tuple[Block, list[str]]:
    """Rows of `FRAME` in the order of their times, without those received that repeat one sent, as
    echoes and requests do: equal in all else, within a quarter of a period; and a warning.
    """
    sent = frames["flags"] & SENT > 0
    doubtful = ~sent & np.isin(frames["can_id"], np.unique(frames["can_id"][sent]))
    if not doubtful.any():
        return frames, []
    rows = np.flatnonzero(np.isin(frames["can_id"], np.unique(frames["can_id"][doubtful])))
    some, time_ns = frames[rows], frames["time_ns"][rows]
    some["time_ns"], some["flags"] = 0, some["flags"] | SENT
    order = np.argsort(some.view(f"V{FRAME.itemsize}"), kind="stable")  # equal ones by time
    near = (some[order][1:] == some[order][:-1]) & (
        np.diff(time_ns[order]) < _MAX_ECHO * 1e9 * bus.sync_period_s
    )
    ours = sent[rows[order]]
    again = np.append(near & ours[1:], False) | np.append(False, near & ours[:-1])
    again &= ~ours
    if not again.any():
        return frames, []
    warning = f"{again.sum()} frames recorded as sent and again as received count once"
    others = np.delete(np.arange(len(frames)), rows[order[again]])
    return _taken(frames, others, frames["time_ns"]), [warning]


def _taken(frames: Block, rows: Ints, time_ns: Ints) -> Block:
    """These rows of frames, with the times (m,) of all; on disk if they are large."""
    store = GrowingBytes()
    for first in range(0, len(rows), _AT_ONCE):
        part = rows[first : first + _AT_ONCE]
        some = frames[part]
        some["time_ns"] = time_ns[part]
        store.extend(some.tobytes())
    return np.frombuffer(store.whole(), FRAME)
