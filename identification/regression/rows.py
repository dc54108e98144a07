"""Selection of the rows of a recording, and some rows to evaluate link torque and friction power at.

Rows at low speed are left out of least squares and instrumental variables by the same rule: the model does not describe stick
and slip, nor the sign of a noisy speed. Least squares uses the measured speed behind the low-pass; instrumental variables use
the simulated one, which is exogenous. The minimum speed within ± half a cut-off period is used, because the low-pass smears
reversals.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import IdentificationError
from ..model import direct_model, friction_power, shaped_states
from .motion import BLOCK_SAMPLES
from .problem import Problem, motion_blocks

LOW_SPEED_PERCENT = 4.0  # of the peak: slower joints stick and slip, which sign(dq) does not describe
LOW_SPEED_DEVIATIONS = 4.0  # of the noise of the speed: slower rows are left out
STATES = 300  # rows of a recording to evaluate friction at


def moving_rows_of(
    sliding_speed: Array, noise: Array, directions: Array, percent: float | None, peak: Array | None = None
) -> NDArray[np.bool_]:
    """Rows (rows, n) of each joint to use, by the `sliding_speed` (rows, c) of the directions (c, n) of Coulomb friction.

    A row is slow if a direction that acts on its joint is slower than `percent` of the peak of that direction. None: 4 % of
    the peak, or 4 deviations of the `noise` (c,) of the regressor's speed if that is more. `peak` (c,): default is that of
    the rows.
    """
    peak = np.abs(sliding_speed).max(axis=0, initial=0.0) if peak is None else peak
    if percent is None:
        threshold = np.maximum(0.01 * LOW_SPEED_PERCENT * peak, LOW_SPEED_DEVIATIONS * noise)
    else:
        threshold = 0.01 * percent * peak
    slow = np.abs(sliding_speed) < threshold
    return np.asarray(slow.astype(float) @ (directions != 0) == 0)


def measured_sliding_speed(problem: Problem, directions: Array) -> tuple[Array, Array]:
    """Lowest speeds (rows, c) of the directions (c, n) of Coulomb friction, and noise (n,) of the regressor's joint speeds.

    Speeds have the low-pass of the fit, or of the rule if the fit has none or a higher one: the noise is the difference, zero
    with the rule's filter. The low-pass smears a speed by half a period of its cut-off, so a joint that sticks for a moment
    seems to creep: the lowest speed within that time is used.
    """
    signals, settings = problem.signals, problem.settings
    fs, start, stop = signals.sample_rate_hz, settings.start, settings.stop
    cutoff_hz = problem.slip_cutoff_hz
    blur = round(0.5 * fs / cutoff_hz)
    at = start + settings.decimator.instants(stop - start)
    lowest = np.empty((len(at), len(directions)))
    total, squares = np.zeros((2, directions.shape[1]))
    for a in range(start, stop, BLOCK_SAMPLES):
        b = min(stop, a + BLOCK_SAMPLES)
        low, high = max(start, a - blur), min(stop, b + blur)
        wide = problem.motion.between(low, high, cutoff_hz).dq
        here = (at >= a) & (at < b)
        lowest[here] = lowest_nearby(np.abs(wide @ directions.T), at[here] - low, blur)
        if not settings.filtered:
            off = problem.motion.between(a, b, settings.cutoff_hz).dq - wide[a - low : b - low]
            total += off.sum(axis=0)
            squares += (off**2).sum(axis=0)
    N = stop - start
    return lowest, np.sqrt(np.maximum(squares / N - (total / N) ** 2, 0.0))


def lowest_nearby(speed: Array, at: NDArray[np.intp], reach: int) -> Array:
    """The lowest of each speed (N, c) within `reach` samples of the samples `at` (K,): (K, c)."""
    windows = np.stack([at - reach, at + reach + 1], axis=1).clip(0, len(speed))
    return np.asarray(np.minimum.reduceat(np.concatenate([speed, speed[-1:]]), windows.ravel())[::2])


def measured_fast_rows(problem: Problem) -> tuple[NDArray[np.bool_], Array]:
    """Rows (rows, n) to use in least squares, by the measured speed; noise (c,) of the speeds of the directions."""
    directions = problem.model.coulomb_directions
    speed, noise = measured_sliding_speed(problem, directions)
    slip_noise = noise @ np.abs(directions.T)
    fast = moving_rows_of(speed, slip_noise, directions, problem.settings.low_speed.ls)
    return fast, slip_noise


def refuse_slow_joints(fast: NDArray[np.bool_], joints: tuple[str, ...], place: str) -> None:
    """Refuse recordings, named by `place`, in which a joint has no rows (rows, n) to use."""
    for j, name in enumerate(joints):
        if not fast[:, j].any():
            raise IdentificationError(
                f"joint {name} is never faster than the noise of its speed",
                place=place,
                expected="a lower --cutoff-hz, or low_speed_percent of [identification]",
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class RowStates:
    """Some rows (k,) of a recording, and the motion q, dq, ddq (k, n) at their instants."""

    rows: NDArray[np.intp]
    q: Array
    dq: Array
    ddq: Array


def row_states(problem: Problem) -> RowStates:
    """About 300 rows of a recording, evenly spaced."""
    settings, parts, first = problem.settings, list[tuple[Array, ...]](), 0
    rows = settings.decimator.rows(settings.stop - settings.start)
    rows_wanted = np.arange(0, rows, max(1, rows // STATES))
    for motion, inside, _ in motion_blocks(problem):
        here = rows_wanted[(rows_wanted >= first) & (rows_wanted < first + inside.stop - inside.start)] - first
        parts.append(tuple(settings.decimator.kept(x)[inside][here] for x in (motion.q, motion.dq, motion.ddq)))
        first += inside.stop - inside.start
    q, dq, ddq = (np.concatenate([part[i] for part in parts]) for i in range(3))
    return RowStates(rows=rows_wanted, q=q, dq=dq, ddq=ddq)


def torque_of_links(problem: Problem, beta: Array, motion: RowStates) -> Array:
    """tau_rigid (k, n) of base parameters beta (b,) at states; needs no samples of the recording."""
    links = direct_model(problem.model, problem.base.standard_parameters(np.where(problem.base.links, beta, 0.0)))
    return links.torque(motion.q, motion.dq, motion.ddq)


def friction_states(problem: Problem, beta: Array, states: RowStates) -> tuple[Array, Array]:
    """Speeds and loads (m, n), by states of a recording, to evaluate the power of further friction terms at."""
    return shaped_states(problem.model, states.dq, np.abs(torque_of_links(problem, beta, states)))


def recorded_power(moved: Sequence[tuple[Problem, RowStates | None]], beta: Array) -> Array | None:
    """Friction power (m, p) per unit of the standard parameters at recorded speeds; None without further friction terms.

    `moved` are recordings and states in them; beta (b,), base parameters, gives the link torque.
    """
    found = [
        friction_power(problem.model, np.arange(problem.model.p), *friction_states(problem, beta, states))
        for problem, states in moved
        if states is not None
    ]
    return np.concatenate(found) if found else None


def rigid_torque_at_rows(problem: Problem, beta: Array) -> tuple[Array, Array]:
    """Speeds and tau_rigid (rows, n) at the rows; of a long recording, its first block."""
    motion, inside, _ = next(motion_blocks(problem))
    q, dq, ddq = (problem.settings.decimator.kept(x)[inside] for x in (motion.q, motion.dq, motion.ddq))
    return dq, torque_of_links(problem, beta, RowStates(rows=np.arange(len(q)), q=q, dq=dq, ddq=ddq))
