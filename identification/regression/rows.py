"""Some rows of a recording to evaluate link torque and friction power at, and rows in which joints are fast."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..model import direct_model, friction_power, shaped_states
from .problem import Problem, motion_blocks

STATES = 300  # rows of a recording to evaluate friction at


def fast_rows(speed: Array, directions: Array, percent: float) -> NDArray[np.bool_]:
    """Rows (rows, n) in which each joint is fast, by the joint speeds (rows, n).

    A row is slow if a direction (c, n) of Coulomb friction that acts on its joint is slower than `percent` of its peak.
    """
    sliding = np.abs(speed @ directions.T)
    slow = sliding < 0.01 * percent * sliding.max(axis=0, initial=0.0)
    return np.asarray(~(slow @ (directions != 0)))


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
