"""Errors in the times of rows, and steps back of a clock.

Errors are found by the motion, as an error of time shifts a position off its path by speed x error.
"""

from collections.abc import Iterator
from itertools import permutations

import numpy as np

from ..arrays import Array, Bools, Ints
from ..errors import Location
from ..files import by_rows, taken

MIN_GAP_STEP = 1.5  # a longer step in periods is a gap with missing rows
# Errors of time by timestamps that are more than this multiple of those by row numbers give a
# warning.
MIN_ROUGHNESS_RATIO = 2.0
MIN_SCATTER = 0.02  # timestamps that scatter by fewer periods are not checked
MAX_REMAINING_STEP = 3.0  # no row is left out if a longer step in periods would remain
# Rows with an error of time of more periods, and of more standard deviations, are left out.
MIN_STAMP_ERROR, MIN_STAMP_DEVIATIONS = 0.05, 6.0
# Timestamps between steps as even as the first share of a period are not wrong. Between steps as
# regular as the second share, they are wrong by a period at most.
MAX_EVEN_DEVIATION, MAX_REGULAR_DEVIATION = 1e-3, 0.25
# A timestamp is only wrong if a joint moves by so many quanta in the error of time.
MIN_QUANTA = 3.0
# Ticks can be counted if a joint moves by so many standard deviations of the noise in a tick.
MIN_TICK_DEVIATIONS = 5.0
# Timestamps come in bursts if there are so many, of at most so many rows each, with this share of
# steps below half the mean.
MIN_BURSTS, MAX_BURST_ROWS, MIN_SHORT_STEPS = 30, 100, 0.4
# Missing rows would be late by the whole time between bursts, so a smaller drift is accepted.
MAX_BURST_DRIFT = 0.5
_PASSES = 4  # iterations, because a wrong timestamp hides its neighbours
_AROUND = 8  # so many rows before and after a step back show whether it lasts
_MAX_OFF = 0.5  # rows that are all earlier by more periods show a step back of the clock
ONE_CLOCK = (
    "Split the file there and import each part: a clock was set back, or the file has two sessions"
)


def stamps_warning(time_s: Array, q: Array, way_out: str) -> str | None:
    """Return a warning if growing times jitter more than the motion does.

    Each position is compared with the cubic through two rows before and two after it, once by the
    times and once by the row numbers. The deviation divided by the speed is an error of time. Rows
    at uniform times, with timestamps of a clock that was read late, are much smoother by their
    numbers.

    Parameters
    ----------
    time_s : (N,) growing times in s.
    q : (N, n) positions in rad or m.
    way_out : end of the warning, what to do.
    """
    steps = np.diff(time_s)
    period = float(np.median(steps))
    if len(time_s) < 20 or np.std(steps[steps <= MIN_GAP_STEP * period]) < MIN_SCATTER * period:
        return None
    speed = np.sqrt(np.mean((np.diff(q, axis=0) / period) ** 2, axis=0))
    moving = speed > 0
    if not moving.any():
        return None
    by_stamp, by_row = (
        _time_error_s(t, q[:, moving], speed[moving])
        for t in (time_s, row_numbers(time_s) * period)
    )
    joint = int(np.argmin(by_row))
    if by_stamp[joint] <= max(MIN_ROUGHNESS_RATIO * by_row[joint], MIN_SCATTER * period):
        return None
    return (
        f"timestamps jitter by {1e3 * np.std(steps):.3g} ms, but the motion does not: positions "
        f"lie on a smooth path within {1e3 * by_row[joint]:.2g} ms at even times, but within "
        f"{1e3 * by_stamp[joint]:.2g} ms at their timestamps, so speeds are noisy; {way_out}"
    )


def bursts(stamp_s: Array) -> tuple[float, float]:
    """Return the step of rows with timestamps (N,), and the time between bursts.

    The time between bursts is 0 if there are none. The step is the median one, or the mean one if
    timestamps come in bursts.
    """
    steps = np.diff(stamp_s)
    longer = steps[steps > steps.mean()]
    several = len(longer) >= max(MIN_BURSTS, len(steps) / MAX_BURST_ROWS) and steps.min() >= 0
    if not several or np.mean(steps < 0.5 * steps.mean()) < MIN_SHORT_STEPS:
        return float(np.median(steps)), 0.0
    return (
        float(np.polyfit(np.arange(len(stamp_s)), stamp_s - stamp_s[0], 1)[0]),
        float(np.median(longer)),
    )


def even_times(
    stamp_s: Array, q: Array, rate_hz: float, place: Location
) -> tuple[Array, float | None]:
    """Return times at the given rate if timestamps come in bursts while positions move evenly.

    Rows of a packet have the timestamp of its arrival.

    Parameters
    ----------
    stamp_s : (N,) timestamps in s.
    q : (N, n) positions.
    rate_hz : rate of the rows in Hz.
    place : name of the map in errors.

    Returns
    -------
    Times (N,) in s, and the scatter of the timestamps about them; the timestamps and None if they
        do not come in bursts.

    Raises
    ------
    BadInputError : the rate is not that of the rows, as where packets are missing.
    """
    step_s, between_s = bursts(stamp_s)
    even_s = stamp_s[0] + np.arange(len(stamp_s)) / rate_hz
    first = np.flatnonzero(np.diff(stamp_s) > step_s) + 1  # first row of each burst

    def share(x: Array) -> float:
        """Compute the part of the way from burst to burst that is covered before the first row."""
        whole, step = np.diff(x[first], axis=0), (x[first] - x[first - 1])[1:]
        return float((whole * step).sum() / max((whole**2).sum(), 1e-300))

    if not between_s or share(q) > 0.5 * (share(stamp_s) + share(even_s)):
        return stamp_s, None
    parts = np.array_split(stamp_s - even_s, max(2, int(np.ptp(stamp_s) / between_s / 10)))
    place.require(
        np.ptp([part.min() for part in parts]) <= MAX_BURST_DRIFT * between_s,
        "time.resample_hz",
        rate_hz,
        text="timestamps come in bursts, and the number of rows between them does not fit this "
        "rate",
        advice=f"Set it to {1 / step_s:.7g}, the mean rate of the rows, or record without missing "
        "packets",
    )
    return even_s, float(np.std(stamp_s - even_s))


def rows_in_time(time_s: Array, q: Array) -> Bools:
    """Find rows whose positions q (N, n) fit their neighbours at their growing times (N,).

    A timestamp that is wrong by a tick moves all joints off their path by their speed times the
    tick. A row is removed if its positions show an error of time above a twentieth of a period and
    far above the scatter of the others; only one of two neighbours, and none if a gap would remain.
    A slow arm that settles leaves its path, too, but by more time than between the neighbouring
    timestamps, by few quanta, or at uniform timestamps: such rows remain.
    """
    rows, quantum = np.arange(len(time_s)), smallest_difference(q)
    for _ in range(_PASSES):
        t, x = time_s[rows], taken(q, rows)
        if len(t) < 20:
            break
        deviations, late = _late(t, x, quantum)
        around = np.concatenate([[0.0], np.where(late, deviations, 0.0), [0.0]])
        late &= (deviations >= around[:-2]) & (deviations > around[2:])
        if not late.any():
            break
        rows = np.delete(rows, np.flatnonzero(late) + 2)
    return np.isin(np.arange(len(time_s)), rows)


def _late(t: Array, x: Array, quantum: Array) -> tuple[Array, Bools]:
    """Measure the errors of timestamps of rows (N - 4,) with two neighbours on both sides.

    Returns by how many standard deviations they are wrong, and whether they count as wrong.
    """
    period = float(np.median(np.diff(t)))
    found = by_rows(lambda *rows: np.column_stack(_neighbour_deviation(*rows)), t, x, beside=4)
    typical_size = np.median(found[:, -1])
    scatter = np.array([np.median(np.abs(off)) for off in found.T[:-1]]) / 0.6745
    weight = np.divide(1.0, scatter**2, out=np.zeros_like(scatter), where=scatter > 0)

    def judged(t: Array, x: Array, found: Array) -> Array:
        off, size, steps = found[: len(t) - 4, :-1], found[: len(t) - 4, -1], np.diff(t)
        between = t[3:-1] - t[1:-3]
        speed = (x[3:-1] - x[1:-3]) / between[:, None]
        information = speed**2 @ weight
        error_s = np.divide(
            (speed * off) @ weight, information, out=np.zeros(len(off)), where=information > 0
        )
        # Beside a wrong timestamp, nodes are so close together that errors grow.
        deviations = np.abs(error_s) * np.sqrt(information) / size * typical_size
        deviation = np.abs(steps - period)
        regular = np.maximum(deviation[1:-2], deviation[2:-1]) < MAX_REGULAR_DEVIATION * period
        uneven = np.abs(steps / period - np.rint(steps / period)) > MAX_EVEN_DEVIATION
        late = (
            (deviations > MIN_STAMP_DEVIATIONS)
            & (np.abs(error_s) > MIN_STAMP_ERROR * period)
            & (between < MAX_REMAINING_STEP * period)
            & (np.abs(error_s) < np.where(regular, period, between))
            & (uneven[:-3] | uneven[1:-2] | uneven[2:-1] | uneven[3:])
            & (np.abs(speed * error_s[:, None]) >= MIN_QUANTA * quantum).any(axis=1)
        )
        return np.column_stack([deviations, late])

    deviations, late = by_rows(judged, t, x, found, beside=4).T
    return deviations, late > 0


def ticks_from_velocity(stamp_s: Array, q: Array, v: Array, tick_s: float) -> Array:
    """Count the ticks (N,) of rows: steps of q (N, n) divided by speeds v.

    Each stretch of motion is shifted to its timestamps; ticks are uniform at rest.
    """
    by_stamp, step, of_tick = stamp_s / tick_s, np.diff(q, axis=0), 0.5 * tick_s * (v[1:] + v[:-1])
    weighted = of_tick / np.maximum(np.ptp(q, axis=0), 1e-300) ** 2
    size = (weighted * of_tick).sum(axis=1)
    count = np.rint(
        np.divide((weighted * step).sum(axis=1), size, out=np.ones(len(size)), where=size > 0)
    )
    noise, smallest = (
        1.4826 * np.median(np.abs(step - count[:, None] * of_tick), axis=0),
        smallest_difference(q),
    )
    noise = np.maximum(noise, np.where(np.isfinite(smallest), 0.3 * smallest, 1e300))
    known = (np.sqrt(((of_tick / noise) ** 2).sum(axis=1)) > MIN_TICK_DEVIATIONS) & (count >= 0)
    ticks, counted = (
        np.rint(by_stamp),
        np.concatenate([[0.0], np.cumsum(np.where(known, count, 0.0))]),
    )
    for first, last in np.flatnonzero(np.diff(known, prepend=False, append=False)).reshape(-1, 2):
        run = slice(first, last + 1)
        ticks[run] = counted[run] + np.rint(np.median(by_stamp[run] - counted[run]))
    anchors = np.unique(
        np.concatenate([[0], np.flatnonzero(known), np.flatnonzero(known) + 1, [len(q) - 1]])
    )
    return np.maximum.accumulate(np.rint(np.interp(np.arange(len(q)), anchors, ticks[anchors])))


def smallest_difference(q: Array) -> Array:
    """Return the smallest difference (n,) of two positions q (N, n) above rounding.

    It is infinite for joints that do not move.
    """
    return np.array(
        [
            min(steps[steps > 1e-9 * np.abs(q).max()], default=np.inf)
            for steps in (np.diff(np.unique(x)) for x in q.T)
        ]
    )


def row_numbers(time_s: Array) -> Array:
    """Number rows at growing times (N,), including missing ones.

    Three steps about a late timestamp sum to three periods.
    """
    steps = np.diff(time_s)
    period = float(np.median(steps))
    padded = np.concatenate([[period], steps, [period]])
    together = padded[:-2] + padded[1:-1] + padded[2:]
    missing = (steps > MIN_GAP_STEP * period) & (together > (2 + MIN_GAP_STEP) * period)
    return np.concatenate([[0.0], np.cumsum(np.where(missing, np.rint(steps / period), 1.0))])


def _time_error_s(time_s: Array, q: Array, speed: Array) -> Array:
    """Compute the error of time (n,) that explains how far q (N, n) is off its path.

    The path is given by the cubics through four neighbours. The distance from them is an rms value.
    """
    off, size = _neighbour_deviation(time_s, q)
    return np.asarray(np.sqrt(np.mean(off**2, axis=0) / np.mean(size**2)) / speed)


def _neighbour_deviation(time_s: Array, q: Array) -> tuple[Array, Array]:
    """Compute the distance of q (N, n) from the cubic through two rows before and two after.

    Also return its standard deviation for unit noise.
    """
    nodes = np.stack([time_s[:-4], time_s[1:-3], time_s[3:-1], time_s[4:]]) - time_s[2:-2]
    weights = np.ones_like(nodes)
    for i, j in permutations(range(4), 2):
        weights[i] *= nodes[j] / (nodes[j] - nodes[i])
    off = q[2:-2] - np.einsum("ik,ikn->kn", weights, np.stack([q[:-4], q[1:-3], q[3:-1], q[4:]]))
    return off, np.sqrt(1 + (weights**2).sum(axis=0))


def steps_back(time_ns: Ints) -> Iterator[tuple[int, int, int]]:
    """Yield rows of periodic times (m,) after which the clock was set back.

    With each row come the step, and the time since the first row, in ns. Rows out of order do not
    last: those before and after them are as late for their number.
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
