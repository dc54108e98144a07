"""Rows of a recording: those that count, and some at which the torque of the links and the power of friction are looked at.

Rows at low speed are left out, of least squares and of instrumental variables by the same rule: joints that stick and slip, and
the sign of a noisy velocity, are not what the model describes. Least squares goes by the measured speed behind the low-pass;
instrumental variables go by the simulated one, which is exogenous. Of either speed it is the lowest within the time that the
low-pass blurs W by.
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
LOW_SPEED_DEVIATIONS = 4.0  # of the speed's noise: rows slower than this are left out
STATES = 300  # of a recording at which its friction is looked at


def moving_rows_of(
    slip: Array, noise: Array, directions: Array, percent: float | None, peak: Array | None = None
) -> NDArray[np.bool_]:
    """Which rows (rows, n) of each joint count, from the speeds `slip` (rows, c) of the directions (c, n) of Coulomb friction.

    A row is slow where a direction that acts on its joint is slower than `percent` of that direction's peak. None takes
    4 % of the peak, or 4 deviations of the `noise` (c,) that the regressor's own speed carries where that is more. The `peak`
    (c,) is that of the rows, where it is not given.
    """
    peak = np.abs(slip).max(axis=0, initial=0.0) if peak is None else peak
    if percent is None:
        threshold = np.maximum(0.01 * LOW_SPEED_PERCENT * peak, LOW_SPEED_DEVIATIONS * noise)
    else:
        threshold = 0.01 * percent * peak
    slow = np.abs(slip) < threshold
    return np.asarray(slow.astype(float) @ (directions != 0) == 0)


def measured_slip(problem: Problem, directions: Array) -> tuple[Array, Array]:
    """Lowest speeds (rows, c) of the directions (c, n) of Coulomb friction, and the noise (n,) of the regressor's joint speeds.

    Filtered by the fit's own low-pass, or by the rule's where the fit goes without or with a higher one: the noise is what
    that leaves out, zero behind the rule's filter. The low-pass blurs a speed by half a period of its cut-off, so that a joint
    that sticks for a moment seems to creep: a row has the lowest speed within that time of its instant.
    """
    signals, settings = problem.signals, problem.settings
    fs, start, stop = signals.sample_rate_hz, settings.start, settings.stop
    cutoff_hz = problem.slip_cutoff_hz
    blur = round(0.5 * fs / cutoff_hz)
    kept = start + settings.decimator.instants(stop - start)
    slip = np.empty((len(kept), len(directions)))
    total, squares = np.zeros((2, directions.shape[1]))
    for a in range(start, stop, BLOCK_SAMPLES):
        b = min(stop, a + BLOCK_SAMPLES)
        low, high = max(start, a - blur), min(stop, b + blur)
        wide = problem.motion.between(low, high, cutoff_hz).dq
        here = (kept >= a) & (kept < b)
        slip[here] = lowest_nearby(np.abs(wide @ directions.T), kept[here] - low, blur)
        if not settings.filtered:
            off = problem.motion.between(a, b, settings.cutoff_hz).dq - wide[a - low : b - low]
            total += off.sum(axis=0)
            squares += (off**2).sum(axis=0)
    N = stop - start
    return slip, np.sqrt(np.maximum(squares / N - (total / N) ** 2, 0.0))


def lowest_nearby(speed: Array, at: NDArray[np.intp], reach: int) -> Array:
    """The lowest of each speed (N, c) within `reach` samples of the samples `at` (K,): (K, c)."""
    windows = np.stack([at - reach, at + reach + 1], axis=1).clip(0, len(speed))
    return np.asarray(np.minimum.reduceat(np.concatenate([speed, speed[-1:]]), windows.ravel())[::2])


def measured_fast_rows(problem: Problem) -> tuple[NDArray[np.bool_], Array]:
    """Which rows (rows, n) count for least squares, by the measured speed; the noise (c,) of the directions' speeds."""
    directions = problem.model.coulomb_directions
    slip, noise = measured_slip(problem, directions)
    slip_noise = noise @ np.abs(directions.T)
    fast = moving_rows_of(slip, slip_noise, directions, problem.settings.low_speed.ls)
    return fast, slip_noise


def refuse_slow_joints(fast: NDArray[np.bool_], joints: tuple[str, ...], place: str) -> None:
    """Every joint of these names must have rows (rows, n) that count; `place` names the recordings."""
    for j, name in enumerate(joints):
        if not fast[:, j].any():
            raise IdentificationError(
                f"joint {name} is never faster than the noise of its speed",
                place=place,
                expected="a lower --cutoff-hz, or --low-speed-percent",
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class RowStates:
    """Some rows (k,) of a recording, and the motion q, dq, ddq (k, n) at their instants."""

    rows: NDArray[np.intp]
    q: Array
    dq: Array
    ddq: Array


def row_states(problem: Problem) -> RowStates:
    """Some 300 rows of a recording, evenly spaced."""
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
    """tau_rigid (k, n) of base parameters beta (b,) at states; samples of the recording are not needed."""
    links = direct_model(problem.model, problem.base.standard_parameters(np.where(problem.base.links, beta, 0.0)))
    return links.torque(motion.q, motion.dq, motion.ddq)


def friction_states(problem: Problem, beta: Array, states: RowStates) -> tuple[Array, Array]:
    """Speeds and loads (m, n) at which friction of further terms is asked for its power, from states of a recording."""
    return shaped_states(problem.model, states.dq, np.abs(torque_of_links(problem, beta, states)))


def recorded_power(moved: Sequence[tuple[Problem, RowStates | None]], beta: Array) -> Array | None:
    """What friction takes (m, p) per unit of the standard parameters at recorded speeds; None where it has no further terms.

    `moved` are recordings and states in them, beta (b,) the base parameters that their links' torque goes by.
    """
    found = [
        friction_power(problem.model, np.arange(problem.model.p), *friction_states(problem, beta, states))
        for problem, states in moved
        if states is not None
    ]
    return np.concatenate(found) if found else None


def rigid_torque_at_rows(problem: Problem, beta: Array) -> tuple[Array, Array]:
    """Speeds and tau_rigid (rows, n) at the instants of the rows; of a long recording the first."""
    motion, inside, _ = next(motion_blocks(problem))
    q, dq, ddq = (problem.settings.decimator.kept(x)[inside] for x in (motion.q, motion.dq, motion.ddq))
    return dq, torque_of_links(problem, beta, RowStates(rows=np.arange(len(q)), q=q, dq=dq, ddq=ddq))
