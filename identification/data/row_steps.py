"""Missing and repeated rows, found from the steps of positions.

The times of a table without timestamps do not show them. A robot's speed changes little from row to
row, so each step x of the positions is compared with m, the median of its four neighbours, two on
either side:

    row lost        | 1.0  1.0  1.1  2.2  1.1  1.2  1.2 |   x = 2 m: one row is missing
    row repeated    | 1.0  1.0  0.0  1.1  1.1  1.2  1.2 |   x = 0: a row is repeated
    late, then both | 1.0  1.0  0.0  2.1  1.1  1.2  1.2 |   0, then 2 m: compensated, nothing lost

- **All joints together**: the ratio x/m is the least-squares solution of x by m over the joints,
  each divided by its standard deviation. A whole multiple of m, within `MAX_ERROR`, counts.
- **Standard deviation** of a joint: the scatter of x about m, by its median in blocks of rows. It
  is at least that of rounding, which shows in the smallest changes of a step (encoder quanta).
- **Alike**: a ratio counts only if three of the four neighbours are near m. Next to a lost or
  repeated row two are enough, if the others are 0 or 2 m.
- **Joint by joint**: if steps are above the noise but only a few quanta long, rounding hides
  multiples from the sum, so double and zero steps are counted for each joint.
"""

import numpy as np

from acquisition.files import release_pages

from ..arrays import Array, Bools

# Standard deviations; smaller steps cannot be distinguished from double or zero steps.
MIN_DEVIATIONS = 10.0
MAX_ERROR = 0.15  # of a step, largest distance from a multiple
# Of a step, largest distance of a neighbour from the median of all four.
MAX_DIFFERENCE = 0.25
QUANTUM_DEVIATION = 0.41  # standard deviation of the step between two rounded positions, in quanta
MAX_MULTIPLE = 4  # of its neighbours; a longer step does not count as lost rows
ROUNDING = 1e-9  # of the largest position; smaller steps count as none
# Rows for an estimate of noise and quantum; rows in memory.
_BLOCK_ROWS, _ROWS_AT_ONCE = 256, 25_600


def position_steps(q: Array) -> tuple[Array, Array]:
    """Count the missing and repeated rows of positions q (N, n), nominally equidistant in time.

    Each step is compared with the median of its four neighbours.

    Returns
    -------
    Four counts of all joints together: missing rows, whose step is a multiple of its neighbours;
    rows without a step; rows without a step that the next step compensates; and all steps far above
    noise and quanta. And three counts by joint (n, 3): steps above its noise; of those within a few
    quanta, the double steps and the zero steps.
    """
    whole, coarse = np.zeros(4, dtype=int), np.zeros((q.shape[1], 3), dtype=int)
    for start in range(0, max(1, len(q) - 5), _ROWS_AT_ONCE):
        of_block, of_joints = _count(q[start : start + _ROWS_AT_ONCE + 5])
        whole, coarse = whole + of_block, coarse + of_joints
        release_pages(q)
    return whole, coarse


def _count(q: Array) -> tuple[Array, Array]:
    n, blocks = q.shape[1], max(1, (len(q) - 5) // _BLOCK_ROWS)
    rows = (len(q) - 5) // blocks * blocks
    if rows < _BLOCK_ROWS // 4:
        return np.zeros(4), np.zeros((n, 3))
    steps = np.diff(q, axis=0)
    around = np.stack([steps[k : k + rows] for k in (0, 1, 3, 4)])
    low, high = (of(around[:2], around[2:]) for of in (np.minimum, np.maximum))
    x, m = steps[2 : 2 + rows], 0.5 * (np.maximum(*low) + np.minimum(*high))  # the median of four
    change = np.abs(np.diff(steps[2 : 3 + rows], axis=0))
    rounding = ROUNDING * np.abs(q).max(axis=0)
    noise = np.maximum(1.4826 * _medians(np.abs(x - m), np.abs(m) > rounding, blocks), rounding)
    quantum = _medians(change, change > rounding, blocks)
    deviation = np.maximum(noise, QUANTUM_DEVIATION * np.where(np.isfinite(quantum), quantum, 0.0))
    return _count_of_all(around, x, m, deviation), _count_by_joint(x, m, noise, deviation)


def _count_of_all(around: Array, x: Array, m: Array, deviation: Array) -> Array:
    """Count (4,) for all joints together, because a missing row is missing for all of them."""
    weight = np.divide(1.0, deviation, out=np.zeros_like(m), where=deviation > 0)
    size = np.linalg.norm(m * weight, axis=1)
    none, once, twice = (
        np.linalg.norm((around - k * m) * weight, axis=2) < MAX_DIFFERENCE * size for k in (0, 1, 2)
    )
    alike = (once.sum(axis=0) >= 3) | ((once.sum(axis=0) == 2) & (none | once | twice).all(axis=0))
    moving = (size > MIN_DEVIATIONS) & alike
    ratio = np.divide((x * m * weight**2).sum(axis=1), size**2, out=np.ones(len(x)), where=moving)
    multiple = np.rint(ratio)
    near = np.abs(ratio - multiple) < MAX_ERROR
    extra = np.where(near & (multiple >= 0) & (multiple <= MAX_MULTIPLE), multiple - 1, 0)
    odd = extra != 0
    # Neighbouring odd steps form a group, in which they may compensate each other.
    group = np.cumsum(odd & ~np.concatenate([[False], odd[:-1]]))[odd]
    net, without = np.bincount(group, extra[odd]), np.bincount(group, extra[odd] < 0)
    held = np.minimum(without, without + net)
    return np.array((net[net > 0].sum(), -net[net < 0].sum(), held.sum(), moving.sum())).astype(int)


def _count_by_joint(x: Array, m: Array, noise: Array, deviation: Array) -> Array:
    """Count (n, 3) for each joint alone, whose steps may be too few quanta for a common count."""
    above = np.abs(m) > MIN_DEVIATIONS * noise
    coarse = above & (np.abs(m) <= MIN_DEVIATIONS * deviation)
    parts = np.divide(x, m, out=np.ones_like(x), where=coarse)
    double, zero = np.abs(parts - 2) < MAX_ERROR, np.abs(parts) < MAX_ERROR
    return np.stack([part.sum(axis=0) for part in (above, double, zero)], axis=1)


def _medians(x: Array, counts: Bools, blocks: int) -> Array:
    """Return medians (rows, n) in each of the blocks of x (rows, n), of the numbers that count."""
    parts = np.where(counts, x, np.inf).reshape(blocks, -1, x.shape[1])
    place = np.isfinite(parts).sum(axis=1, keepdims=True) // 2
    return np.repeat(
        np.take_along_axis(np.sort(parts, axis=1), place, axis=1)[:, 0], parts.shape[1], axis=0
    )
