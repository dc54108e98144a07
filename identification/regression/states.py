"""Some rows of a recording to evaluate link torque and friction power at, and rows in
which joints are fast.
"""

from collections.abc import Sequence

import numpy as np

from ..arrays import Array, Bools, Ints
from ..model import SHAPES, friction_power, shaped_states
from .blocks import MotionBlock, motion_blocks
from .problem import Problem
from .terms import torque_of_links

MIN_LAG_SPEED_PERCENT = 20.0  # of the peak speed; a lag is looked for in faster rows
# of its whitening filter: shorter, model error looks like a lag; longer, few rows are left, so that
# where moves between reversals are short the next one is taken
LAG_ORDERS = (6, 4, 2)
STATES = 300  # rows of a recording to evaluate friction at


def row_states(problem: Problem) -> tuple[Ints, Array, Array, Array]:
    """About 300 rows (k,) of a recording, evenly spaced; q, dq, ddq (k, n) at their instants."""
    rows, blocks = len(problem.settings.instants), motion_blocks(problem.with_samples())
    wanted = np.arange(0, rows, max(1, rows // STATES))
    parts = [[motion.kept(x) for x in (motion.q, motion.dq, motion.ddq)] for motion in blocks]
    q, dq, ddq = (np.concatenate(x)[wanted] for x in zip(*parts, strict=True))
    return wanted, q, dq, ddq


def friction_states(problem: Problem, beta: Array) -> tuple[Array, Array] | None:
    """Speeds and loads (m, n), by states of a recording and base parameters beta (b,), to evaluate
    the power of further friction terms at; None where there is viscous and Coulomb friction only.
    """
    joints = problem.signals.robot.joints
    if not any(joint.one_sided or set(joint.terms) & set(SHAPES) for joint in joints):
        return None
    _, *motion = row_states(problem)
    rigid = torque_of_links(problem, beta, *motion)
    return shaped_states(problem.model, motion[1], np.abs(rigid))


def recorded_power(problems: Sequence[Problem], beta: Array) -> Array | None:
    """Friction power (m, p) per unit of the standard parameters at recorded speeds, by the link
    torque of base parameters beta (b,); None without further friction terms.
    """
    found = [
        friction_power(problem.model, np.arange(problem.model.p), *states)
        for problem in problems
        if (states := friction_states(problem, beta)) is not None
    ]
    return np.concatenate(found) if found else None


def rigid_torque_at_rows(problem: Problem, beta: Array) -> tuple[Array, Array]:
    """Speeds and tau_rigid (rows, n) at the rows; of a long recording, its first block."""
    motion = next(motion_blocks(problem.with_samples()))
    q, dq, ddq = (motion.kept(x) for x in (motion.q, motion.dq, motion.ddq))
    return dq, torque_of_links(problem, beta, q, dq, ddq)


def fast_for_lag(motion: MotionBlock, peak: Array, order: int = LAG_ORDERS[0]) -> Bools:
    """Rows (n, T) of a motion in which a lag shows, by the `peak` speeds (c,) along the
    directions of Coulomb friction, behind a whitening filter of this order.
    """
    fast = fast_for_lag_by(
        motion.problem, motion.dq[motion.decimation.instants(len(motion.dq))], peak, order
    )
    return fast[:, motion.inside]


def fast_for_lag_by(problem: Problem, speed: Array, peak: Array, order: int) -> Bools:
    """Rows (n, T) in which a lag shows, by their speeds (T, n): no direction of Coulomb friction
    that acts on the joint is slower than a share of its peak.
    """
    percent = max(MIN_LAG_SPEED_PERCENT, problem.settings.low_speed_percent or 0.0)
    directions = problem.model.coulomb_directions
    slow = np.abs(speed @ directions.T) < 0.01 * percent * peak
    fast = ~(slow @ (directions != 0)).T
    # Not soon before a slow row, as zero-phase decimation spreads a reversal both ways; the
    # whitening leaves out rows soon after one.
    for _ in range(order):
        fast = fast & np.c_[fast[:, 1:], fast[:, -1:]]
    return np.asarray(fast)
