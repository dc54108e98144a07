"""Rows that nobody measured: efforts that a bus lost, rows that somebody interpolated, and gaps.

A lost effort is exactly 0, or exactly the last value, while the robot moves: in all motors, or for
longer in one. Rows that were filled lie on one cubic, as straight lines and held rows do. So do, by
chance, values of coarse sensors, and regularly those of a log that is faster than its sensors: such
stretches count where chance makes none as long, and where nothing beside them is alike.
"""

from collections.abc import Mapping

import numpy as np

from ..arrays import Array
from ..files import by_rows
from ..robot import Robot
from .rows import Block
from .sync_grid import Bools

MAX_GAP = 3.0  # periods between two rows, ± half a period; a longer step is a gap
CHANCE = 1e-6  # that efforts of a recording repeat by chance for as long
# of the largest value: efforts of a motor that are equal, fourth differences that are zero
EQUAL, CUBIC, MIN_FILLED = 1e-13, 1e-12, 10  # and differences in sequence
# times that, in most of so many rows to each side of a stretch
MIN_NOISE, MOST, BESIDE = 1e3, 0.9, 20
# of first differences of an effort, typical second ones of noise; of its smallest step, an effort
# that is not about to cross zero; rows that show both
MIN_ROUGH, MIN_QUANTA, MOST_ROWS = 0.3, 3.0, 100_000
# of the typical step, times the length of a stretch, in which a robot that moves travels more; of
# the step before it, by which one over a step of the clock differs less, and of the typical one
MIN_TRAVEL, MAX_OFF = 0.05, 0.5


def in_gaps(times: Array, grid: Array) -> Bools:
    """Whether instants `grid` (M,) lie in a gap between rows at growing `times` (N,)."""
    steps, after = np.diff(times), np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    return np.asarray(
        (steps[after - 1] > (MAX_GAP + 0.5) * np.median(steps)) & (grid < times[after])
    )


def measured_rows(rows: Block | Mapping[str, Array], robot: Robot) -> tuple[Bools, str]:
    """Which rows (N,) were measured, and in words how many were not, or are missing, and why.

    By growing `stamp_ns` (N,), `position` and `effort` (N, n) at the joints. The words are empty
    where all were measured, without a gap.
    """
    t_s, q = 1e-9 * (rows["stamp_ns"] - rows["stamp_ns"][0]), rows["position"]
    lost, filled = _lost_efforts(q, rows["effort"], robot), _filled_rows(q, rows["effort"])
    gaps = np.flatnonzero(in_gaps(t_s, 0.5 * (t_s[1:] + t_s[:-1])))
    periods = np.rint(np.diff(t_s)[gaps] / np.median(np.diff(t_s)))
    before, over = (q[k + 1] - q[k] for k in (np.maximum(gaps - 1, 0), gaps))
    off, step, usual = (
        np.linalg.norm(x, axis=1) for x in (over - before, before, np.diff(q[:MOST_ROWS], axis=0))
    )
    counts = {
        "have lost efforts": lost.sum(),
        "are interpolated": (filled & ~lost).sum(),
        f"are missing in {len(gaps)} gap(s)": (periods - 1).sum(),
        "of these gaps are steps of the clock, as positions go on": (
            (off < MAX_OFF * step) & (step > MAX_OFF * np.median(usual))
        ).sum(),
    }
    runs = [*_runs(lost | filled), *([k, k + 1] for k in gaps.tolist())]
    text = ", ".join(f"{count:.0f} {why}" for why, count in counts.items() if count)
    if text:
        lasts_s, first = max((t_s[min(b, len(q) - 1)] - t_s[a], a) for a, b in runs)
        text += (
            f", of {len(q)} rows: they weigh nothing; the longest stretch lasts {lasts_s:.3g} s, "
            f"from {t_s[first]:.4g} s"
        )
    return ~(lost | filled), text


def _lost_efforts(q: Array, effort: Array, robot: Robot) -> Bools:
    """Rows (N,) whose efforts (N, n), at the joints as the positions q (N, n), were lost."""
    to_motors, lost = np.linalg.inv(robot.R), np.zeros(len(q), dtype=bool)
    motor = by_rows(lambda x: x @ to_motors, effort)  # but for gains
    peak = np.maximum(by_rows(np.abs, motor).max(axis=0), 1e-300)
    # Without noise efforts are constant, too, where speeds are, and coarse ones cross zero slowly:
    # only those that jump to 0 were lost.
    once, twice = (np.abs(np.diff(motor[:MOST_ROWS], k, axis=0)) for k in (1, 2))
    noisy = np.median(twice, axis=0) > MIN_ROUGH * np.median(once, axis=0)
    quantum = np.where(once > EQUAL * peak, once, np.inf).min(axis=0, initial=np.inf)
    changes = by_rows(
        lambda x: np.where(
            np.abs(x[1:]) < (1 - EQUAL) * peak,
            np.where(
                noisy,
                np.minimum(np.abs(x[1:]), np.abs(np.diff(x, axis=0))) / (EQUAL * peak),
                np.abs(x[1:]) * (MIN_NOISE / MIN_QUANTA / quantum),
            ),
            MIN_NOISE,  # at a limit, where nothing tells
        ),
        motor,
        beside=1,
    )
    alone = (changes <= 1) & ((robot.n == 1) | (changes > 1).any(axis=1, keepdims=True))
    often = np.log(np.clip(alone.mean(axis=0), 1 / len(q), 1 - 1e-9))
    for motors in ([*range(robot.n)], *([m] for m in range(robot.n))):
        moved = q[:, (robot.R[motors] != 0).any(axis=0)]
        least = np.log(CHANCE / len(q)) / often[motors].sum()
        lost[1:] |= _alike(changes[:, motors].max(axis=1), least, moved)
    return lost


def _filled_rows(q: Array, effort: Array) -> Bools:
    """Rows (N,) of positions and efforts (N, n) that lie on one cubic of the rows about them."""
    zero = CUBIC * np.concatenate(
        [np.maximum(np.maximum(x.max(axis=0), -x.min(axis=0)), 1e-300) for x in (q, effort)]
    )
    bends = by_rows(
        lambda *x: np.abs(np.diff(np.hstack(x), 4, axis=0) / zero).max(axis=1), q, effort, beside=4
    )
    found = np.pad(_alike(bends, MIN_FILLED, q), 2)
    return np.asarray(np.convolve(found, np.ones(3), "same") > 0)[: len(q)]


def _alike(differences: Array, least: float, q: Array) -> Bools:
    """Which `differences` (N - k,), in units of rounding, are none in a stretch of at least so many
    in which the robot moves, by its positions q (N, n), and beside which they are some.
    """
    found, order = np.zeros(len(differences), dtype=bool), len(q) - len(differences)
    typical = np.sqrt(by_rows(lambda x: np.diff(x, axis=0) ** 2, q, beside=1).mean(axis=0))
    for first, last in _runs(differences <= 1, least):
        beside = np.r_[differences[max(first - BESIDE, 0) : first], differences[last:][:BESIDE]]
        part = q[first : last + order + 1]
        moves = (np.ptp(part, axis=0) > MIN_TRAVEL * typical * (len(part) - 1)).any()
        found[first:last] = moves and np.sum(beside > MIN_NOISE) > MOST * len(beside)
    return found


def _runs(x: Bools, least: float = 1) -> list[list[int]]:
    """First and last place, exclusive, of each stretch of at least so many true ones."""
    runs = np.flatnonzero(np.diff(np.pad(x, 1).astype(np.int8))).reshape(-1, 2)
    return list(runs[np.diff(runs)[:, 0] >= least].tolist())
