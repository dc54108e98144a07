"""The model as a sum of terms, equation (C): external torque = sum of the terms + r.

Each term has two functions of a motion, measured or simulated: `torque`, the torque (n, rows) that
it explains, and `columns` (n, p, rows), the derivatives of that torque by the unknowns x (p,). Both
are weighted and decimated, in N m or N. The torques of `Drives` are negative, as they are on the
other side of the equation. J and Z are the same columns along two motions. The term `Arm` of links,
rotors, friction and payload is in `unknowns`.

This module also evaluates torques of links and powers of friction at some rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Ints
from ..model import (
    SHAPES,
    direct_model_of_base,
    friction_power,
    shaped_states,
    why_not_positive,
)
from .blocks import MotionBlock, motion_blocks
from .problem import Problem
from .unknowns import Arm

STATES = 300  # rows of a recording at which friction is evaluated


@dataclass(frozen=True, kw_only=True, eq=False)
class Drives:
    """The torque of the drives, -sum_m kappa_m E_m(t + L), equation (I).

    Factors kappa on the given drive gains and the delay L are unknowns. E_m is the torque of motor
    m at the joints by its given gain.

    Attributes:
        gains: (n,) places of kappa in x; -1 for a given gain.
        lag: place of L in x, s; positive if the torque is recorded late.
    """

    gains: Ints
    lag: int

    def factors(self, x: Array) -> Array | None:
        """Return kappa (n,) of the unknowns x (p,); None if all gains are given."""
        of = self.gains >= 0
        return np.where(of, x[self.gains], 1.0) if of.any() else None

    def with_gains_and_lag(self, x: Array, motion: MotionBlock) -> MotionBlock:
        """Return a measured motion with the torque sum_m kappa_m E_m(t + L), equation (I).

        It replaces the recorded torque, (N, n) in N m or N.
        """
        problem, t_s = motion.problem, motion.t_s
        first = round(t_s[0] * problem.signals.sample_rate_hz)
        return motion.with_torque(
            problem.drives(first, first + len(t_s), x[self.lag], self.factors(x))
        )

    def torque(self, x: Array, motion: MotionBlock) -> Array:
        """Return -F[w sum_m kappa_m E_m(t + L)], (n, rows)."""
        return -motion.weighted(motion.tau.T)

    def columns(self, x: Array, motion: MotionBlock) -> Array:
        """Return the derivatives (n, p, rows) by kappa_m, and by L, equation (G).

        by kappa_m:  -F[w E_m(t + L)],     by L:  -F[w d/dt sum_m kappa_m E_m(t + L)]
        """
        tau, R = motion.tau, motion.problem.signals.robot.R
        found = np.zeros((len(R), len(x), len(motion.share.T)))
        if (kappa := self.factors(x)) is not None:
            E = np.linalg.solve(R.T, tau.T) / kappa[:, None]
            for m in np.flatnonzero(self.gains >= 0):
                acts = np.flatnonzero(R[m])
                found[acts, self.gains[m]] = -motion.weighted(R[m, acts, None] * E[m], acts)
        found[:, self.lag] = -motion.weighted(motion.rate(tau).T)
        return found


@dataclass(frozen=True, kw_only=True, eq=False)
class Load:
    """Load-dependent friction, equation (H): mu_j |tau_links| sign(dq_j).

    tau_links is the torque of the links alone on the grid of the motion, before any decimation. At
    x its columns are |tau_links| sign(dq) of mu_j, and mu_j s W of the links' parameters, with s =
    sign(tau_links) sign(dq). The residual is that of the model itself, so steps converge to the
    best fit, and intervals are valid for mu and the links together.

    Attributes:
        arm: term with the base parameters.
        joints: (k,) joints with load-dependent friction.
        places: (k,) places of their mu in beta.
    """

    arm: Arm
    joints: list[int]
    places: list[int]

    def torque(self, x: Array, motion: MotionBlock) -> Array:
        """Return F[w mu_j |tau_links| sign(dq_j)], (n, rows), equation (H)."""
        beta, found = self.arm.beta(x), np.zeros_like(motion.share)
        found[self.joints] = beta[self.places, None] * self._sizes(beta, motion)[0]
        return found

    def columns(self, x: Array, motion: MotionBlock) -> Array:
        """Return the derivatives (n, p, rows) by mu_j, and by the links' parameters.

        The latter are added to the links' own columns.
        """
        beta, W, links = self.arm.beta(x), np.zeros_like(motion.W), motion.problem.base.links
        sizes = self._sizes(beta, motion)
        for j, place, size, s in zip(self.joints, self.places, *sizes, strict=True):
            W[j, links] = beta[place] * s * motion.W[j, links]
            W[j, place] = size
        return np.asarray(self.arm.P.T @ W)

    def _sizes(self, beta: Array, motion: MotionBlock) -> tuple[Array, Array]:
        """Return F[w |tau_links| sign(dq)] and s at the rows, (k, rows) each."""
        links = torque_of_links(motion.problem, beta, motion.q, motion.dq, motion.ddq)
        links, sign = links[:, self.joints], np.sign(motion.dq[:, self.joints])
        # s is only a derivative, so leaving out the filter does not change the solution.
        s = motion.kept(np.sign(links) * sign).T
        return motion.weighted((np.abs(links) * sign).T, self.joints), s


def load_of(problem: Problem, arm: Arm) -> tuple[Load, ...]:
    """Return the load-dependent friction of a robot; empty if it has none."""
    places = [i for i, kind in enumerate(problem.kinds) if kind == "load"]
    joints = [int(problem.term_of(problem.base.names[i]).rows[0]) for i in places]
    return (Load(arm=arm, joints=joints, places=places),) if places else ()


def torque_of_links(problem: Problem, beta: Array, q: Array, dq: Array, ddq: Array) -> Array:
    """Compute tau_links of equation (H), the torque (N, n) of the links alone, N m or N.

    Parameters
    ----------
    problem : the robot and its b base parameters.
    beta : (b,) their values; only those of links count.
    q, dq, ddq : (N, n) motion of the joints, rad or m, per s and per s².
    """
    return direct_model_of_base(problem.model, problem.base, beta).torques_of_links(q, dq, ddq)


def why_not_simulated(problem: Problem, arm: Arm, x: Array) -> str | None:
    """Return why the robot of x (p,) cannot be simulated in a recording; None if it can."""
    return why_not_positive(
        direct_model_of_base(problem.model, problem.base, arm.beta(x)).inertia(problem.poses)
    )


def row_states(problem: Problem) -> tuple[Ints, Array, Array, Array]:
    """Return about 300 evenly spaced rows (k,) of a recording, and their q, dq, ddq (k, n)."""
    rows, blocks = len(problem.settings.instants), motion_blocks(problem.with_samples())
    wanted = np.arange(0, rows, max(1, rows // STATES))
    parts = [[motion.kept(x) for x in (motion.q, motion.dq, motion.ddq)] for motion in blocks]
    q, dq, ddq = (np.concatenate(x)[wanted] for x in zip(*parts, strict=True))
    return wanted, q, dq, ddq


def friction_states(problem: Problem, beta: Array) -> tuple[Array, Array] | None:
    """Return speeds and loads (m, n) at which the power of further friction is evaluated.

    They follow from states of a recording and base parameters beta (b,). None is returned if there
    is viscous and Coulomb friction only.
    """
    if not any(j.one_sided or set(j.terms) & set(SHAPES) for j in problem.signals.robot.joints):
        return None
    _, *motion = row_states(problem)
    return shaped_states(problem.model, motion[1], np.abs(torque_of_links(problem, beta, *motion)))


def recorded_power(problems: Sequence[Problem], beta: Array) -> Array | None:
    """Return the friction power (m, p) per unit of the standard parameters at recorded speeds.

    The torque of links is that of base parameters beta (b,). None is returned without further
    friction terms.
    """
    found = [
        friction_power(problem.model, np.arange(problem.model.p), *states)
        for problem in problems
        if (states := friction_states(problem, beta)) is not None
    ]
    return np.concatenate(found) if found else None


def rigid_torque_at_rows(problem: Problem, beta: Array) -> tuple[Array, Array]:
    """Return speeds and torques of links (rows, n) at the rows.

    Of a long recording only the first block is evaluated.
    """
    motion = next(motion_blocks(problem.with_samples()))
    q, dq, ddq = (motion.kept(x) for x in (motion.q, motion.dq, motion.ddq))
    return dq, torque_of_links(problem, beta, q, dq, ddq)
