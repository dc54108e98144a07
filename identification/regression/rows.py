"""The rows of a recording about values of the unknowns, equations (5), (6) and (C): weighted,
decimated, stacked by joint and span of time.

    r(x) = F[w (known + drives(x) - arm(x) - load(x))]     the residual, along the measured motion
    J = -dr/dx                                             the columns of all terms, along it
    Z                                                      the same columns along another motion

Where a span has more rows than columns it has their QR factor, with the same products of columns.
Linear terms give Y = W beta + rho with W = J and Y = r + J x.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, repeat
from typing import Any, Protocol

import numpy as np

from ..arrays import Array, Bools, Ints
from ..estimation import SpanRows, System, by_joint, one_thread, stacked
from .blocks import MotionBlock, motion_blocks, predicted_torque
from .lag import LagCollector
from .problem import Problem
from .states import fast_for_lag
from .terms import Drives, Load, load_of
from .unknowns import Arm, Stated, Unknowns, make_unknowns
from .weights import sample_weights

# numbers of the positions of all recordings together whose measured motion is kept: 8 MB, a few
# times as much in all
MAX_KEPT = 1_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Equation:
    """The equation of motion of a recording, a sum of terms (C).

    Attributes:
        problem: recording, settings, and model of the robot.
        unknowns: x.
        arm, drives, load, stated: its terms.
    """

    problem: Problem
    unknowns: Unknowns
    arm: Arm
    drives: Drives
    load: tuple[Load, ...]
    stated: tuple[Stated, ...]

    @cached_property
    def _made(self) -> tuple[MotionBlock, ...]:
        return tuple(motion_blocks(self.problem))

    def motions(self) -> Iterable[MotionBlock]:
        """The measured motion in blocks: of a short recording made once, with its regressor."""
        if 0 < self.problem.signals.q.size * len(self.unknowns.arms) <= MAX_KEPT:
            return self._made
        return motion_blocks(self.problem.with_samples())

    @property
    def terms(self) -> tuple[Arm | Drives | Load | Stated, ...]:
        """All terms."""
        return self.arm, self.drives, *self.load, *self.stated

    def residual(self, x: Array, motion: MotionBlock) -> Array:
        """Return the residual (n, rows), N m or N, about x (p,): the known torque that no term
        explains.

            r(x) = F[w (known + drives(x) - arm(x) - load(x))]                           (C)
        """
        return np.asarray(motion.known - sum(term.torque(x, motion) for term in self.terms))

    def columns(self, x: Array, motion: MotionBlock) -> Array:
        """Return J = -dr/dx (n, p, rows) about x (p,), or Z along another motion."""
        return np.asarray(sum(term.columns(x, motion) for term in self.terms))


def equation_of(problem: Problem, unknowns: Unknowns, k: int) -> Equation:
    """Put together the equation of motion of recording k: its arm, its drives, and load friction
    and what is stated if there is any.
    """
    arm, places = unknowns.arms[k], {name: i for i, name in enumerate(unknowns.all)}
    robot = problem.signals.robot
    return Equation(
        problem=problem,
        unknowns=unknowns,
        arm=arm,
        drives=Drives(
            gains=np.array([places.get(f"K:{motor.name}", -1) for motor in robot.motors]),
            lag=int(unknowns.lags[next(g for g, of in enumerate(unknowns.groups) if k in of)]),
        ),
        load=load_of(problem, arm),
        stated=(Stated(held=held, first=len(unknowns.names)),) if (held := unknowns.held) else (),
    )


def equation_alone(problem: Problem) -> tuple[Equation, Array]:
    """Return the equation of motion of a recording by itself, and x (p,) of nothing but its lag."""
    unknowns = make_unknowns([problem])
    return equation_of(problem, unknowns, 0), unknowns.start([problem.settings.torque_lag_s])


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows:
    """The rows of recordings about x, and the measurements at their decimated instants.

    Attributes:
        x: (p,) values of the unknowns.
        system: of the free ones: W = J, Y = r + J x.
        L: (r, h + K) columns of what is held, and of the lags; without these, (r, h), where W and
            Y alone were asked for.
        C: (r, k) columns of terms that are not in the model; (r, 0) until they are asked for;
            `fast`: (r,) which rows of them show a lag.
        G: (r, g) columns of links at rest, with C.
        Z: (r, f) instruments of the free unknowns; (r, 0) where they are W itself.
        share: (T, n) weights of the decimated samples, 0 for those that do not count.
        tau: (T, n) decimated torques by x, not weighted.
        speed: (T, n) joint speeds.
        recorded: whether Z are along the measured motion.
        late: rows of the lag, of unknowns but gains: residual r, columns J and last of the lags;
            and their instruments. None along the measured motion.
    """

    x: Array
    system: System
    L: Array
    C: Array
    fast: Bools
    G: Array
    Z: Array
    share: Array
    tau: Array
    speed: Array
    recorded: bool
    late: tuple[System, Array] | None = None

    @property
    def parts(self) -> tuple[int, ...]:
        """Numbers of decimated samples of the recordings, in sequence."""
        return tuple(int(spans[-1]) for spans in self.system.spans)

    @cached_property
    def counts(self) -> Bools:
        """(T, n) whether a decimated sample counts."""
        return self.share > 0

    def of(self, places: Ints) -> System:
        """The system of some of the free unknowns; the others are held at x."""
        system, held = self.system, np.delete(np.arange(len(self.system.names)), places)
        if not len(held):
            return system
        return replace(system, Y=system.Y - system.W[:, held] @ self.x[held]).with_columns(places)

    def without(self, names: Collection[str]) -> "Rows":
        """The same without the columns of some parameters."""
        stay = np.array([name not in names for name in self.system.names])
        x = self.x[np.r_[stay, np.ones(len(self.x) - len(stay), dtype=bool)]]
        Z = self.Z[:, stay] if self.Z.size else self.Z
        return replace(self, x=x, Z=Z, system=self.system.with_columns(np.flatnonzero(stay)))

    def about(self, x: Array) -> "Rows":
        """The same about other values of what is held and of the lags, to first order, without rows
        of the lag.
        """
        f = len(self.system.names)
        Y = self.system.Y - self.L @ (x - self.x)[f:]
        return replace(self, x=x, late=None, system=replace(self.system, Y=Y))


class Candidate(Protocol):
    """What is asked for its columns along a motion of a recording, beside the terms."""

    @property
    def sliding(self) -> Array:
        """(c,) largest speeds along the directions of Coulomb friction."""

    def columns(self, motion: MotionBlock) -> Array:
        """(n, k, rows), weighted and decimated."""

    def at_rest(self, motion: MotionBlock) -> Array:
        """(n, g, rows) of links at rest, along the measured motion."""


@one_thread
def rows_of_recording(
    equation: Equation,
    x: Array,
    further: Candidate | None = None,
    along: Iterable[MotionBlock] | None = None,
    *,
    of_lag: bool = False,
) -> Rows:
    """Compute the rows [C Z J r] of a recording about x, in blocks: J is never whole in memory.

        Y = W beta + rho,     Y = r(x) + J x,     W = J = -dr/dx                    (5), (6), (C)

    Parameters
    ----------
    equation : the equation of motion of the recording.
    x : (p,) values of the unknowns.
    further : gives the columns C of terms that are not in the model; None for none.
    along : blocks of another motion, along which Z are the columns, such as that of the simulated
        robot (D). Without one, Z are along the measured motion, with the torque of the drives that
        x predicts, as the recorded one is noisy.
    of_lag : whether there are rows of the lag (G), along the other motion.

    Returns
    -------
    The rows, torques in N m or N, stacked by joint and span of time.
    """
    problem = equation.problem.with_samples()
    unknowns, share, beta = equation.unknowns, sample_weights(problem).of_rows, equation.arm.beta(x)
    names, lags, parts = unknowns.names, unknowns.lags, list[tuple[Array, Array]]()
    collected, of_late, lag = SpanRows(), np.r_[unknowns.arm, lags], None
    if of_lag:
        tau, predicted, speed = torque_of_recording(equation, x, exact=False)
        lag = LagCollector(problem, share, share * (tau - predicted), speed)
    f, K = len(names), len(lags)
    own = f if along is not None or unknowns.motors else 0
    # Where nothing is asked for but W and Y, no torque is predicted for the columns of lags.
    asked = own > 0 or further is not None
    places = np.r_[np.arange(own), lags] if asked else np.arange(0)
    others: Iterable[MotionBlock | None] = repeat(None) if along is None else along
    for motion, other in zip(equation.motions(), others, strict=False):
        J = equation.columns(x, motion)
        # The robot may have been prepared for other weights.
        z = motion if other is None else replace(other, problem=problem)
        z = z.with_torque_of(beta) if asked else z
        Z = equation.columns(x, z) if asked else J
        r, C, G, fast = equation.residual(x, motion)[:, None], J[:, :0], J[:, :0], None
        if lag is not None:
            J[:, lags] = Z[:, lags]
            lag.add(np.concatenate([Z[:, of_late], J[:, of_late], r], axis=1), z)
        if further is not None:
            C, fast = further.columns(z), fast_for_lag(z, further.sliding)
            G = further.at_rest(motion)
        # not the columns of the lags: the rate of a recorded torque is noise
        A = np.concatenate([G, C, Z[:, places], J[:, :-K], r], axis=1)
        collected.add(motion.first, A, share, fast)
        measured = equation.drives.measured(x, motion)
        parts.append((motion.filtered(measured.T).T, motion.kept(motion.dq)))
    tau, speed = (np.concatenate(each) for each in zip(*parts, strict=True))
    rows, fast_rows, followed = collected.rows(share)
    sizes = G.shape[1], C.shape[1], len(places), J.shape[1] - K
    G, C, Z, J, r = np.split(rows, np.cumsum(sizes), axis=1)
    W = J[:, :f]
    return Rows(
        x=x,
        system=System(W=W, Y=r[:, 0] + W @ x[:f], names=names, **followed),
        L=np.c_[J[:, f:], Z[:, own:]],
        C=C,
        fast=fast_rows,
        G=G,
        Z=Z[:, :own],
        share=share,
        tau=tau,
        speed=speed,
        recorded=along is None,
        late=None if lag is None else lag.rows(tuple(unknowns.all[i] for i in of_late)),
    )


def stacked_rows(each: Sequence[Rows]) -> Rows:
    """Stack the rows of recordings about the same x joint by joint, in the order given."""
    if len(each) == 1:
        return each[0]
    order = by_joint([rows.system for rows in each])
    of: dict[str, Any] = {
        name: np.concatenate([getattr(rows, name) for rows in each])
        for name in ("L", "C", "fast", "G", "Z", "share", "tau", "speed")
    }
    of |= {name: of[name][order] for name in ("L", "C", "fast", "G", "Z")}
    late, instruments = zip(*(rows.late or (None, None) for rows in each), strict=True)
    return replace(
        each[0],
        system=stacked([rows.system for rows in each]),
        **of,
        late=None if None in late else (stacked(late), np.concatenate(instruments)[by_joint(late)]),
    )


@one_thread
def torque_of_recording(
    equation: Equation, x: Array, *betas: Array, exact: bool = True
) -> tuple[Array, Array, Array]:
    """Compute the torques of a recording, decimated, without weights and without W.

    Parameters
    ----------
    equation : the equation of motion of the recording.
    x : (p,) unknowns, whose lag and gains the measured torque has.
    betas : base parameters (b,), by default those of x; each predicts one of as many equal spans of
        the rows.
    exact : whether links' torques are computed at every sample, not on a spline between some, which
        is within 1e-6 of the torque.

    Returns
    -------
    Measured and predicted torque, N m or N, and joint speed, rad/s or m/s, each (T, n).
    """
    problem, betas = equation.problem.with_samples(), betas or (equation.arm.beta(x),)
    parts, settings, of = list[tuple[Array, ...]](), problem.settings, (problem.model, problem.base)
    rows, fs = len(settings.instants), problem.signals.sample_rate_hz
    # as spans of time end
    edges = settings.stop - settings.decimation * (
        rows + -np.arange(len(betas) + 1) * rows // len(betas)
    )
    for motion in equation.motions():
        N = len(motion.q)
        stride = 1 if exact else motion.torque_stride
        cuts = [0, *np.clip(edges[1:-1] - round(motion.t_s[0] * fs), 0, N), N]
        predicted = np.concatenate(
            [
                predicted_torque(motion.part(slice(first, last)), *of, beta, stride)
                for beta, (first, last) in zip(betas, pairwise(cuts), strict=True)
                if first < last
            ]
        )
        measured = equation.drives.measured(x, motion)
        parts.append(
            (motion.filtered(measured.T).T, motion.filtered(predicted.T).T, motion.kept(motion.dq))
        )
    tau, predicted, speed = (np.concatenate(each) for each in zip(*parts, strict=True))
    return tau, predicted, speed
