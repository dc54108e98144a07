"""The model as a sum of terms, equation (C): known torque = sum of the torques of all terms + r.

A term is asked two things along a motion, measured or simulated: `torque`, the torque (n, rows)
that it explains, and `columns` (n, p, rows), the derivatives of that torque by the unknowns x (p,);
all are weighted and decimated, in N m or N. The torques of `Drives` are negative, as they stand on
the other side. J and Z are the same columns along two motions. The term `Arm` of links, rotors,
friction and payload stands in `unknowns`. What links and friction do is told at some rows, too.

The lag of the recorded torque, equation (G): by rows of its own, fast ones, whitened, combined
by variances with what is known (effort timing of the recording, the described control law).

To first order tau(t - L) = tau(t) - L d/dt tau(t): the column -d/dt tau takes the coefficient L. It
is that of the simulated torque, as column and as instrument, so that position noise does not bias
it; least squares would find a false lag. Near a reversal friction rises smoothly where the model
has a step, which looks like a lag, so only rows faster than a fifth of the peak speed count.
Position noise grows with frequency and hides a lag: the rows of joint j are filtered along time by
1 - a_1 B ... - a_6 B^6, B the row before, of its residual; with four rows before or two where
joints reverse so often that few rows would be left. Drive gains are held in them, as the
recorded torque is noise in whitened rows.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array, Bools, Ints
from ..errors import NoFitError
from ..estimation import (
    LEVEL,
    WHITE_COSINES,
    SpanRows,
    System,
    autoregression,
    instrumental_variables,
    intervals_of,
    t_quantile,
    weights_of,
)
from ..model import (
    SHAPES,
    direct_model_of_base,
    friction_power,
    shaped_states,
    why_not_positive,
)
from .blocks import MotionBlock, motion_blocks
from .motion import Lag
from .problem import Problem
from .unknowns import Arm

STATES = 300  # rows of a recording to evaluate friction at
MIN_LAG_ROWS = 20  # of a joint that moves, behind the filter; with fewer the next order is taken
MIN_LAG_SPEED_PERCENT = 20.0  # of the peak speed; a lag is looked for in faster rows
# of its whitening filter: shorter, model error looks like a lag; longer, few rows are left, so that
# where moves between reversals are short the next one is taken
LAG_ORDERS = (6, 4, 2)
CHANCE = 0.003  # of data that a true prior differs from by more: only the data are used then


@dataclass(frozen=True, kw_only=True, eq=False)
class Drives:
    """The torque of the drives, -sum_m kappa_m E_m(t + L), equation (I): factors kappa on the
    described gains and the lag L are unknowns.

    E_m is the torque at the joints of motor m by its described gain.

    Attributes:
        gains: (n,) places of kappa in x; -1 for a gain that is described.
        lag: place of L in x, in s; positive: the torque is recorded late.
    """

    gains: Ints
    lag: int

    def factors(self, x: Array) -> Array | None:
        """Return kappa (n,) by the unknowns x (p,); None where all gains are described."""
        of = self.gains >= 0
        return np.where(of, x[self.gains], 1.0) if of.any() else None

    def with_gains_and_lag(self, x: Array, motion: MotionBlock) -> MotionBlock:
        """Return a measured motion with the torque sum_m kappa_m E_m(t + L) (N, n), N m or N, of
        equation (I) in place of the recorded one.
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
        """Return the derivatives (n, p, rows): -F[w E_m(t + L)] by kappa_m, and by L
        -F[w d/dt sum_m kappa_m E_m(t + L)], equation (G).
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
    """Load friction, equation (H): mu_j |tau_links| sign(dq_j), with tau_links the torque of the
    links alone on the motion's own grid, before any decimation.

    About x its columns are |tau_links| sign(dq) of mu_j, and mu_j s W of the links' parameters,
    s = sign(tau_links) sign(dq): the residual is that of the model itself, so steps converge to
    the best fit, and intervals are valid for mu and the links together.

    Attributes:
        arm: whose base parameters have it.
        joints, places: the joints (k,) with load friction, and the places of their mu in beta.
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
        """Return the derivatives (n, p, rows) by mu_j, and those by the links' parameters that load
        friction adds to their own.
        """
        beta, W, links = self.arm.beta(x), np.zeros_like(motion.W), motion.problem.base.links
        sizes = self._sizes(beta, motion)
        for j, place, size, s in zip(self.joints, self.places, *sizes, strict=True):
            W[j, links] = beta[place] * s * motion.W[j, links]
            W[j, place] = size
        return np.asarray(self.arm.P.T @ W)

    def _sizes(self, beta: Array, motion: MotionBlock) -> tuple[Array, Array]:
        """F[w |tau_links| sign(dq)] and s at the rows, (k, rows) each."""
        joints, q, dq, ddq = self.joints, motion.q, motion.dq, motion.ddq
        links = torque_of_links(motion.problem, beta, q, dq, ddq)[:, joints]
        sign = np.sign(dq[:, joints])
        # s is only a derivative: without the filter it does not move the solution.
        s = motion.kept(np.sign(links) * sign).T
        return motion.weighted((np.abs(links) * sign).T, joints), s


def load_of(problem: Problem, arm: Arm) -> tuple[Load, ...]:
    """Return the load friction of a robot; none if it has none."""
    places = [i for i, kind in enumerate(problem.kinds) if kind == "load"]
    joints = [int(problem.term_of(problem.base.names[i]).rows[0]) for i in places]
    return (Load(arm=arm, joints=joints, places=places),) if places else ()


def torque_of_links(problem: Problem, beta: Array, q: Array, dq: Array, ddq: Array) -> Array:
    """Compute tau_links of equation (H), the torque (N, n) of the links alone, N m or N.

    Parameters
    ----------
    problem : has the robot and its b base parameters.
    beta : (b,) their values; those that are not of links have no part in it.
    q, dq, ddq : (N, n) motion of the joints, rad or m, per s and per s².
    """
    return direct_model_of_base(problem.model, problem.base, beta).torques_of_links(q, dq, ddq)


def why_not_simulated(problem: Problem, arm: Arm, x: Array) -> str | None:
    """Why the robot of x (p,) cannot be simulated in a recording; None if it can."""
    return why_not_positive(
        direct_model_of_base(problem.model, problem.base, arm.beta(x)).inertia(problem.poses)
    )


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
    if not any(j.one_sided or set(j.terms) & set(SHAPES) for j in problem.signals.robot.joints):
        return None
    _, *motion = row_states(problem)
    return shaped_states(problem.model, motion[1], np.abs(torque_of_links(problem, beta, *motion)))


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


def combined_lag(prior: Lag, found: tuple[float, float, int]) -> Lag:
    """Combine what is known of the lag of a group with what the data give, by variances.

    If both differ by more than chance in 0.3 % of cases (Student's t, degrees of freedom by Welch
    1947), only the data count. A stated lag is used as it is. `found` is as in `Lag`.
    """
    value, sd, freedom = found
    if prior.stated:
        return replace(prior, prior=prior, found=found)
    data, both = (
        replace(prior, value_s=value, sd_s=sd, source="data"),
        float(np.hypot(sd, prior.sd_s)),
    )
    far = abs(value - prior.value_s) > t_quantile(1 - CHANCE / 2, freedom * (both / sd) ** 4) * both
    counted, reach = data if far else prior.with_other(data), t_quantile(0.5 + LEVEL / 2, freedom)
    return replace(counted, reach=reach, prior=prior, found=found)


def lags_in(late: tuple[System, Array, int], now_s: Array, lags: Sequence[Lag]) -> list[Lag]:
    """Solve rows of the lag by instrumental variables, and combine each lag with what is known.

        tau(t - L) = tau(t) - L dtau/dt                                                  (G)

    Parameters
    ----------
    late : the rows of the lag and their instruments (r, p), both whitened, by this order.
    now_s : (K,) lags about which the rows are, s.
    lags : (K,) of each group, with what is known; only that is used where the rows do not
        determine a lag.
    """
    (system, Z, order), known = late, [lag.prior or lag for lag in lags]
    with suppress(NoFitError):  # the rows do not determine them
        if system.Y.any():  # else the fit is exact
            step = instrumental_variables(system, Z, weights_of(system, system.Y))
            within, last = intervals_of(system, step, most=WHITE_COSINES), slice(-len(lags), None)
            found = (now_s + step.beta[last]).tolist(), within.sigma[last].tolist()
            return [
                replace(combined_lag(lag, (value, sd, within.freedom)), order=order)
                for lag, value, sd in zip(known, *found, strict=True)
            ]
    return known


class LagFilters:
    """The filters that whiten the rows of a recording that show its lag; `of` are the places in x
    of the unknowns that have columns in them, the lags last.
    """

    def __init__(self, problem: Problem, of: Ints, share: Array, left: Array, speed: Array) -> None:
        """Of a recording with the weights `share`, whose residuals `left` set the filters, by the
        measured `speed`; all (T, n).
        """
        self.of, self._sliding = of, np.abs(speed @ problem.model.coulomb_directions.T).max(axis=0)
        used = [
            _fast_by_speed(problem, speed, self._sliding, k) & (share.T > 0) for k in LAG_ORDERS
        ]
        rows = np.array([_behind(*one).sum(axis=1) for one in zip(used, LAG_ORDERS, strict=True)])
        # the first that leaves enough of all joints of which any does, or else some
        enough = [(rows[:, rows[-1] > 0] >= least).all(axis=1) for least in (MIN_LAG_ROWS, 1)]
        at = int(np.argmax(enough[0] if enough[0].any() else enough[1]))
        self.order, each = LAG_ORDERS[at], zip(left.T, used[at], strict=True)
        self._filters = [np.r_[1.0, -autoregression(r * fast, self.order)] for r, fast in each]

    def whitened(self, rows: Array, z: MotionBlock) -> tuple[Array, Array]:
        """The rows [Z J r] (n, columns, T) of a block, filtered, and their weights (n, T): none
        where a row, or one that its filter reaches, is not fast along z.
        """
        used = fast_for_lag(z, self._sliding, self.order) & (z.share > 0)
        white, T = np.zeros_like(rows), rows.shape[2]
        for k in range(self.order + 1):
            h = np.array([own[k] for own in self._filters])[:, None, None]
            white[..., k:] += h * rows[..., : T - k]
        return white, z.share * _behind(used, self.order)

    def system(
        self, rows: SpanRows, share: Array, names: Sequence[str]
    ) -> tuple[System, Array, int]:
        """The system, its instruments (r, columns), and the order of the filter, from whitened rows
        with the weights `share` (T, n); `names` are those of x.
        """
        A, _, followed = rows.rows(share)
        Z, J, r = np.split(A, [len(self.of), 2 * len(self.of)], axis=1)
        own = tuple(names[i] for i in self.of)
        return System(W=J, Y=r[:, 0], names=own, **followed), Z, self.order


def fast_for_lag(motion: MotionBlock, peak: Array, order: int = LAG_ORDERS[0]) -> Bools:
    """Rows (n, T) of a motion in which a lag shows, by the `peak` speeds (c,) along the
    directions of Coulomb friction, behind a whitening filter of this order.
    """
    speed = motion.dq[motion.decimation.instants(len(motion.dq))]
    return _fast_by_speed(motion.problem, speed, peak, order)[:, motion.inside]


def _fast_by_speed(problem: Problem, speed: Array, peak: Array, order: int) -> Bools:
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


def _behind(used: Bools, order: int) -> Bools:
    """Rows (n, T) that are used with those that a filter of this order reaches, before them."""
    found, T = used.copy(), used.shape[1]
    found[:, :order] = False
    for k in range(1, order + 1):
        found[:, order:] &= used[:, order - k : T - k]
    return found
