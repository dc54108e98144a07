"""The torque of the links, tau_rigid, at rows of a recording: what load friction goes by; and the power of friction there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..model import direct_model, friction_power, shaped_states
from .problem import Problem, motion_blocks

STATES = 300  # of a recording at which its friction is looked at


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


def links_at_rows(problem: Problem, beta: Array) -> tuple[Array, Array]:
    """Speeds and tau_rigid (rows, n) at the instants of the rows; of a long recording the first."""
    motion, inside, _ = next(motion_blocks(problem))
    q, dq, ddq = (problem.settings.decimator.kept(x)[inside] for x in (motion.q, motion.dq, motion.ddq))
    return dq, torque_of_links(problem, beta, RowStates(rows=np.arange(len(q)), q=q, dq=dq, ddq=ddq))
