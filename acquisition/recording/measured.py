"""Rows that were not measured: efforts that a bus lost, rows that were interpolated, and gaps.

Efforts were lost where those of all motors are exactly 0, or where that of one motor repeats
exactly for long, while the robot moves. Efforts that were filled in lie on one cubic, as a straight
line does. Coarse ammeters repeat randomly, and logs that are faster than their drives repeat
regularly: a stretch of repeats counts only if it is longer than random ones and if the rows beside
it differ. A simulation without noise has constant and cubic efforts where its motion is simple, so
only zeros count there.
"""

from collections.abc import Mapping

import numpy as np

from ..arrays import Array, Bools
from ..files import by_rows
from ..robot import Robot
from .rows import Block

# A step between two rows of more periods, ± half a period, is a gap. Efforts of a recording repeat
# randomly for as long as a lost stretch with this probability.
MAX_GAP, CHANCE = 3.0, 1e-6
# Changes and fourth differences below these shares of the largest effort are rounding. So many
# fourth differences in sequence show efforts that were filled in.
EQUAL, CUBIC, MIN_FILLED = 1e-13, 1e-12, 10
# Beside a stretch, this share of so many rows must change by so many times the rounding.
MIN_NOISE, MOST, BESIDE = 1e3, 0.9, 20
# Efforts are noisy if typical fourth differences in so many rows are at least this share of third
# ones. A robot that moves travels more than this share of the typical step, times the length of a
# stretch. Over a step of the clock, a position changes by the step before it, to this share of it.
MIN_ROUGH, MOST_ROWS, MIN_TRAVEL, MAX_OFF = 0.5, 100_000, 0.02, 0.5


def in_gaps(times: Array, grid: Array) -> Bools:
    """Test which instants `grid` (M,) lie in a gap between rows at growing `times` (N,)."""
    steps, after = np.diff(times), np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    return np.asarray(
        (steps[after - 1] > (MAX_GAP + 0.5) * np.median(steps)) & (grid < times[after])
    )


def measured_rows(rows: Block | Mapping[str, Array], robot: Robot) -> tuple[Bools, str]:
    """Find the rows that were measured.

    Parameters
    ----------
    rows : growing `stamp_ns` (N,), and `position` and `effort` (N, n) at the joints.
    robot : the robot.

    Returns
    -------
    A mask (N,) of the measured rows; and in words how many were not measured or are missing, and
        why. The words are empty if all rows were measured, without a gap.
    """
    t_s, q = 1e-9 * (rows["stamp_ns"] - rows["stamp_ns"][0]), rows["position"]
    lost, filled = _lost_and_filled(q, rows["effort"], robot)
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
            f", of {len(q)} rows: they have zero weight; the longest stretch lasts "
            f"{lasts_s:.3g} s, from {t_s[first]:.4g} s"
        )
    return ~(lost | filled), text


def _lost_and_filled(q: Array, effort: Array, robot: Robot) -> tuple[Bools, Bools]:
    """Find rows (N,) whose efforts were lost, and rows that were filled in.

    The efforts (N, n) are given at the joints, as are the positions q (N, n).
    """
    to_motors, lost = np.linalg.inv(robot.R), np.zeros(len(q), dtype=bool)
    motor, zero = by_rows(lambda x: x @ to_motors, effort), by_rows(lambda x: x == 0, effort)
    top, low = motor.max(axis=0), motor.min(axis=0)
    unit = np.maximum(np.maximum(top, -low), 1e-300)
    once, third, fourth = (
        np.median(
            np.abs(np.diff(motor[:MOST_ROWS], k, axis=0, append=np.zeros((4, q.shape[1])))), axis=0
        )
        # The appended rows allow a recording of few rows, too.
        for k in (1, 3, 4)
    )
    noisy = (fourth > np.maximum(MIN_ROUGH * third, MIN_NOISE * CUBIC * unit)) & (once > 0)
    typical = np.sqrt(by_rows(lambda x: np.diff(x, axis=0) ** 2, q, beside=1).mean(axis=0))
    changes = by_rows(
        lambda x: np.where(
            noisy & ((x[1:] < top - EQUAL * unit) & (x[1:] > low + EQUAL * unit) | (x[1:] == 0)),
            np.abs(np.diff(x, axis=0)) / (EQUAL * unit),
            # Without noise, and at a limit, repeats show nothing, so they count as changes.
            MIN_NOISE,
        ),
        motor,
        beside=1,
    )
    begun = ((changes[1:] <= 1) & (changes[:-1] > 1)).sum(axis=0) / len(q)
    for m, often in enumerate(np.clip(begun, 1 / len(q), 1 - 1e-9)):
        joints, least = robot.R[m] != 0, np.log(CHANCE / len(q)) / np.log(often)
        lost[1:] |= _alike(changes[:, m], least, q[:, joints], typical[joints])
    lost[:-1] |= lost[1:] & zero[:-1].any(axis=1)
    none = np.asarray(zero.all(axis=1))
    # Efforts of motors that cross zero independently do not do so at the same time.
    if q.shape[1] > 1 and len(q) * (zero & ~none[:, None]).mean(axis=0).prod() < CHANCE:
        for first, last in _runs(none):
            lost[first:last] |= _moves(q[max(first - 1, 0) : last + 1], typical)
    bends = by_rows(
        lambda x: np.abs(np.diff(x, 4, axis=0) / (CUBIC * unit)).max(axis=1), motor, beside=4
    )
    filled = np.pad(_alike(bends, MIN_FILLED, q, typical) & noisy.any(), 2)
    return lost, np.asarray(np.convolve(filled, np.ones(3), "same") > 0)[: len(q)]


def _alike(differences: Array, least: float, q: Array, typical: Array) -> Bools:
    """Find stretches in which `differences` (N - k,), in units of rounding, are zero.

    A stretch counts if it has at least `least` of them, the robot moves in it, by its positions q
    (N, n), and most differences beside it are not zero.
    """
    found, order = np.zeros(len(differences), dtype=bool), len(q) - len(differences)
    for first, last in _runs(differences <= 1, least):
        beside = np.r_[differences[max(first - BESIDE, 0) : first], differences[last:][:BESIDE]]
        found[first:last] = np.sum(beside > MIN_NOISE) > MOST * len(beside) and _moves(
            q[first : last + order + 1], typical
        )
    return found


def _moves(q: Array, typical: Array) -> bool:
    """Test whether a joint moves in the rows q (k, n), compared with `typical` steps (n,)."""
    return bool((np.ptp(q, axis=0) > MIN_TRAVEL * typical * (len(q) - 1)).any())


def _runs(x: Bools, least: float = 1) -> list[list[int]]:
    """Return first and last place, exclusive, of each run of at least `least` true ones."""
    runs = np.flatnonzero(np.diff(np.pad(x, 1).astype(np.int8))).reshape(-1, 2)
    return list(runs[np.diff(runs)[:, 0] >= least].tolist())
