"""Rows that nobody measured: efforts that a bus lost, rows that somebody interpolated, and gaps.

A lost effort is exactly 0 in all motors, or exactly the last value, while the positions go on. So
is, by chance, that of a coarse ammeter: a stretch of repeats counts where the robot moves, where
chance makes none as long, by how often efforts repeat, and where it ends in a jump. Rows that were
filled lie on one cubic for longer than noise lets measured rows do; a straight line and a row that
is held are cubics too.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Ints
from ..files import by_rows
from ..robot import Robot

MAX_GAP = 3.0  # periods between two rows, ± half a period; a longer step is a gap
CHANCE = 1e-6  # that efforts of a recording repeat by chance for as long
MIN_TRAVEL = 0.05  # of the typical step, times the length of a stretch: less is standstill
# of the largest effort of a motor, between equal ones; of its usual step, at an end of a stretch
ROUNDING, MIN_JUMP = 1e-13, 2.0
# of the largest value, fourth differences that are rounding; times that, typically, in so many rows
# beside those that were filled, so many in sequence
CUBIC, MIN_NOISE, BESIDE, MIN_FILLED = 1e-12, 1e3, 20, 10
MAX_OFF = 0.5  # of the steps beside it: a step over which the clock went on, not the robot

Bools = NDArray[np.bool_]


def gaps_after(times: Array | Ints) -> Bools:
    """Whether a gap follows a row (N - 1,), by growing `times` (N,)."""
    steps = np.diff(times)
    return np.asarray(steps > (MAX_GAP + 0.5) * np.median(steps))


def in_gaps(times: Array | Ints, grid: Array) -> Bools:
    """Whether instants `grid` (M,) lie in a gap between rows at growing `times` (N,)."""
    after = np.minimum(np.searchsorted(times, grid), len(times) - 1)
    return np.asarray(gaps_after(times)[np.maximum(after - 1, 0)] & (grid < times[after]))


def measured_rows(stamps: Ints, q: Array, effort: Array, robot: Robot) -> tuple[Bools, str]:
    """Which rows (N,) were measured, and in words how many were not, or are missing, and why.

    By growing `stamps` (N,), ns, positions and efforts (N, n) at the joints. The words are empty
    where all were measured, without a gap.
    """
    lost, filled = lost_efforts(q, effort, robot), filled_rows(q, effort)
    t_s, gaps = 1e-9 * (stamps - stamps[0]), np.flatnonzero(gaps_after(stamps))
    period_s = float(np.median(np.diff(t_s)))
    found = {
        "{} have lost efforts": _runs(lost),
        "{} are interpolated": _runs(filled & ~lost),
        "{} are missing": np.stack([gaps, gaps + np.rint(np.diff(t_s)[gaps] / period_s) - 1], 1),
    }
    stretches = np.concatenate(list(found.values())).astype(int)
    if not len(stretches):
        return np.ones(len(q), dtype=bool), ""
    parts = [
        f"{words.format(int(np.diff(runs).sum()))} in {len(runs)} stretch(es)"
        for words, runs in found.items()
        if len(runs)
    ]
    first, last = stretches[np.diff(stretches)[:, 0].argmax()]
    text = f"of {len(q)}, {', '.join(parts)}; the longest lasts {(last - first) * period_s:.3g} s, "
    text += f"from {t_s[first]:.4g} s: what nobody measured weighs nothing"
    own, before, after = (
        q[np.clip(gaps + k + 1, 0, len(q) - 1)] - q[np.clip(gaps + k, 0, len(q) - 1)]
        for k in (0, -1, 1)
    )
    usual = 0.5 * np.linalg.norm(before + after, axis=1)
    stepped = gaps[np.linalg.norm(own - 0.5 * (before + after), axis=1) < MAX_OFF * usual]
    if len(stepped):
        text += f"; the clock steps at {', '.join(f'{x:.4g} s' for x in t_s[stepped[:5]])}"
        text += ": positions go on as if no row were missing"
    return ~(lost | filled), text


def lost_efforts(q: Array, effort: Array, robot: Robot) -> Bools:
    """Rows (N,) whose efforts (N, n), at the joints as the positions q (N, n), were lost."""
    lost, step = np.zeros(len(q), dtype=bool), _typical_step(q)
    motor, zero = by_rows(robot.motor_effort, effort), by_rows(lambda x: x == 0, effort)
    peak = by_rows(np.abs, motor).max(axis=0)
    steps = by_rows(lambda x: np.abs(np.diff(x, axis=0)), motor, beside=1)
    usual = np.array([np.median(x[x > 0]) if x.any() else 0.0 for x in steps.T])
    repeats, none = steps <= ROUNDING * peak, np.asarray(zero.all(axis=1))
    for motors in (list(range(robot.n)), *([m] for m in range(robot.n))):
        joints, same = (robot.R[motors] != 0).any(axis=0), repeats[:, motors].all(axis=1)
        least = math.log(CHANCE / len(q)) / min(math.log(max(same.mean(), 1 / len(q))), -1e-9)
        for first, last in (run for run in _runs(same) if run[1] - run[0] >= least):
            value = motor[first, motors]
            jumps = np.abs(motor[[max(first - 1, 0), min(last + 1, len(q) - 1)]][:, motors] - value)
            if (
                _travels(q[first : last + 1], step)[joints].any()
                and (jumps > MIN_JUMP * usual[motors]).any()
                and not (value.any() and (np.abs(value) >= peak[motors] * (1 - ROUNDING)).all())
            ):
                lost[first + bool(value.any()) : last + 1] = True
    # Motors that cross zero independently do not do so at once.
    if robot.n > 1 and not none.all() and len(q) * zero[~none].mean(axis=0).prod() < CHANCE:
        for first, last in _runs(none):
            lost[first:last] |= _travels(q[max(first - 1, 0) : last + 1], step).any()
    return lost


def filled_rows(q: Array, effort: Array) -> Bools:
    """Rows (N,) of positions and efforts (N, n) that lie on one cubic of the rows about them."""
    filled, step = np.zeros(len(q), dtype=bool), _typical_step(q)
    scale = CUBIC * np.maximum(np.r_[np.abs(q).max(axis=0), np.abs(effort).max(axis=0)], 1e-300)

    def off(*x: Array) -> NDArray[np.float32]:
        largest = (np.abs(np.diff(np.concatenate(x, axis=1), 4, axis=0)) / scale).max(axis=1)
        return np.asarray(largest, dtype=np.float32)

    rough = by_rows(off, q, effort, beside=4) if len(q) > 4 else np.ones(1)
    cubic = np.asarray(rough <= 1)
    # Where most rows are, the recording was interpolated as a whole.
    for first, last in _runs(cubic) if cubic.mean() < 0.5 else ():
        beside = np.r_[rough[max(first - BESIDE, 0) : first], rough[last : last + BESIDE]]
        if last - first >= MIN_FILLED and np.median(beside) > MIN_NOISE:
            moves = _travels(q[max(first - 1, 0) : last + 5], step).any()
            filled[first + 1 : last + 3] = moves
    return filled


def _typical_step(q: Array) -> Array:
    """Root mean square (n,) of the steps of q (N, n)."""
    squares = by_rows(lambda x: np.diff(x, axis=0) ** 2, q, beside=1)
    return np.asarray(np.sqrt(squares.mean(axis=0)))


def _travels(q: Array, step: Array) -> Bools:
    """Whether joints (n,) move in the rows q (k, n), for typical steps (n,)."""
    return np.asarray(np.ptp(q, axis=0) > MIN_TRAVEL * step * (len(q) - 1))


def _runs(x: Bools) -> NDArray[np.intp]:
    """First and last row, exclusive, of each stretch (k, 2) of true ones."""
    return np.flatnonzero(np.diff(np.pad(x, 1).astype(np.int8))).reshape(-1, 2)
