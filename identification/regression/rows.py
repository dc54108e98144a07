"""The rows of a recording, linearised at values of the unknowns, equations (5), (6) and (C).

    r(x) = F[w (known + drives(x) - arm(x) - load(x))]     residual, along the measured motion
    J = -dr/dx                                             columns of all terms, along this motion
    Z                                                      the same columns along another motion

The rows are weighted, decimated, and stacked by joint and time block. If a block has more rows than
columns it keeps their R factor, which has the same products of columns. Linear terms give Y = W
beta + rho with W = J and Y = r + J x.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain, groupby, islice, pairwise, repeat, starmap
from typing import Any

import numpy as np

from ..arrays import Array, Bools, Ints
from ..data import HERE, Work
from ..estimation import SpanRows, System, by_joint, one_thread, stacked
from ..report import is_gain, motor_of
from .blocks import Candidate, MotionBlock, motion_blocks, predicted_torque, sample_weights
from .lag import LagFilters, fast_for_lag
from .problem import Problem
from .terms import Drives, Load, load_of
from .unknowns import Arm, Stated, Unknowns, make_unknowns

MOST_AT_ONCE = 16  # blocks sent to the workers at a time: a block has some 10 MB
# Numbers of the positions of all recordings whose measured motion is kept: a few times 8 MB in all.
MAX_KEPT = 1_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Equation:
    """The equation of motion of a recording, a sum of terms, equation (C).

    Attributes:
        problem: recording, settings, and model of the robot.
        unknowns: names and places of x.
        arm: term W beta of links, rotors, friction and payload.
        drives: term of the drives.
        load: term of load-dependent friction; empty if the robot has none.
        stated: term of values given with a half-width; empty if there are none.
        work: workers of the tasks.
    """

    problem: Problem
    unknowns: Unknowns
    arm: Arm
    drives: Drives
    load: tuple[Load, ...]
    stated: tuple[Stated, ...]
    work: Work = HERE

    @cached_property
    def kept(self) -> tuple[MotionBlock, ...]:
        """Measured motion of a short recording in blocks, made once; empty for a long recording."""
        few = self.problem.signals.q.size * len(self.unknowns.arms) <= MAX_KEPT
        return tuple(motion_blocks(self.problem)) if few else ()

    def read(self) -> "Equation":
        """Return the equation with the samples of its recording, which are read if necessary."""
        read = self.problem.with_samples()
        return self if read is self.problem else replace(self, problem=read)

    @property
    def apart(self) -> "Equation":
        """Equation without samples, to be sent to another process; itself if there is no other."""
        away = self.work.workers != 1
        return replace(self, problem=self.problem.without_samples) if away else self

    def by_block(
        self, task: Callable[..., Any], x: Array, along: Iterable[MotionBlock | None] | None = None
    ) -> Iterator[Any]:
        """Yield the results of a task for each block of the measured motion.

        Parameters
        ----------
        task : function of a block of the measured motion, and of another motion.
        x : (p,) unknowns, whose drive gains and delay the torque of the drives has.
        along : blocks of the other motion; the task gets None without one.
        """
        each = zip(
            (
                self.drives.with_gains_and_lag(x, motion)
                for motion in self.kept or motion_blocks(self.problem)
            ),
            repeat(None) if along is None else along,
            strict=False,
        )
        if self.work.workers == 1:
            return starmap(task, each)
        several = iter(lambda: list(islice(each, MOST_AT_ONCE)), [])
        return chain.from_iterable(
            (self.work if len(some) > 1 else HERE).run(task, some) for some in several
        )

    @property
    def terms(self) -> tuple[Arm | Drives | Load | Stated, ...]:
        """All terms."""
        return self.arm, self.drives, *self.load, *self.stated

    def residual(self, x: Array, motion: MotionBlock) -> Array:
        """Return r(x) (n, rows), equation (C): the external torque that no term explains."""
        explained = sum(term.torque(x, motion) for term in self.terms)
        return np.asarray(motion.weighted(motion.known_torque.T) - explained)

    def columns(self, x: Array, motion: MotionBlock) -> Array:
        """Return J = -dr/dx (n, p, rows) at x (p,); or Z, along another motion."""
        return np.asarray(sum(term.columns(x, motion) for term in self.terms))


def equation_of(problem: Problem, unknowns: Unknowns, k: int, work: Work = HERE) -> Equation:
    """Make the equation of motion of recording k."""
    arm, motors = unknowns.arms[k], problem.signals.robot.motors
    places = {motor_of(name): i for i, name in enumerate(unknowns.all) if is_gain(name)}
    return Equation(
        problem=problem,
        unknowns=unknowns,
        arm=arm,
        drives=Drives(
            gains=np.array([places.get(motor.name, -1) for motor in motors]),
            lag=int(unknowns.lags[next(g for g, of in enumerate(unknowns.groups) if k in of)]),
        ),
        load=load_of(problem, arm),
        stated=(Stated(held=held, first=len(unknowns.names)),) if (held := unknowns.held) else (),
        work=work,
    )


def equation_alone(problem: Problem) -> tuple[Equation, Array]:
    """Return the equation of motion of a single recording, and x (p,) with only its delay."""
    unknowns = make_unknowns([problem])
    return equation_of(problem, unknowns, 0), unknowns.start([problem.settings.torque_lag_s])


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows:
    """The rows of recordings about x, and the measurements at their decimated instants.

    Attributes:
        x: (p,) values of the unknowns.
        system: system of the free unknowns: W = J, Y = r + J x.
        L: (r, h + K) columns of held values and of delays; (r, h) without delays if only W and Y
            were requested.
        C: (r, k) columns of terms that are not in the model; (r, 0) unless requested.
        fast: (r,) mask of the rows of C that show a delay.
        G: (r, g) columns of links at rest, with C.
        Z: (r, f) instruments of the free unknowns; (r, 0) if these are W itself.
        share: (T, n) weights of the decimated samples, 0 for those that do not count.
        tau: (T, n) decimated torques by x, not weighted, N m or N.
        speed: (T, n) speeds of the joints, rad/s or m/s.
        most: (k, n) largest decimated torques of the drives in each block.
        recorded: True if Z is along the measured motion.
        late: rows of the delay: residual r and columns J (of all unknowns but gains, delays last),
            instruments, order of the whitening filter. None along the measured motion.
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
    most: Array
    recorded: bool
    late: tuple[System, Array, int] | None = None

    @property
    def parts(self) -> tuple[int, ...]:
        """Numbers of decimated samples of the recordings, in sequence."""
        return tuple(int(spans[-1]) for spans in self.system.spans)

    @cached_property
    def counts(self) -> Bools:
        """Mask (T, n) of the decimated samples that count."""
        return self.share > 0

    def of(self, places: Ints) -> System:
        """Return the system of some of the free unknowns; the others are held at x."""
        system, held = self.system, np.delete(np.arange(len(self.system.names)), places)
        if not len(held):
            return system
        return replace(system, Y=system.Y - system.W[:, held] @ self.x[held]).with_columns(places)

    def without(self, names: Collection[str]) -> "Rows":
        """Return a copy without the columns of some parameters."""
        stay = np.array([name not in names for name in self.system.names])
        return replace(
            self,
            x=self.x[np.r_[stay, np.ones(len(self.x) - len(stay), dtype=bool)]],
            Z=self.Z[:, stay] if self.Z.size else self.Z,
            system=self.system.with_columns(np.flatnonzero(stay)),
        )

    def linearised_at(self, x: Array) -> "Rows":
        """Return a copy with other held values and delays, to first order.

        It has no rows of the delay.
        """
        Y = self.system.Y - self.L @ (x - self.x)[len(self.system.names) :]
        return replace(self, x=x, late=None, system=replace(self.system, Y=Y))


@one_thread
def _rows_of_block(
    equation: Equation,
    x: Array,
    asked: tuple[Ints, Candidate | None, LagFilters | None],
    motion: MotionBlock,
    z: MotionBlock | None,
) -> tuple[SpanRows, SpanRows, Array, Array, Array, Array, Ints]:
    """Return the rows [G C Z J r] of a block, along its measured motion and along `z`.

    Also return the rows of the delay; (rows, n) torque, speed, and weights of the rows of the
    delay; `most` of `Rows`; and where the columns are split.

    Parameters
    ----------
    equation : the equation of motion.
    x : (p,) values of the unknowns.
    asked : places (k,) of Z in x, provider of further columns, filters of the delay.
    motion : block of the measured motion.
    z : block of the other motion; None for the measured one.
    """
    (places, further, lag), lags, share = asked, equation.unknowns.lags, motion.share
    known = motion.problem.signals.known_torque
    instants, drives = len(motion.problem.settings.instants), motion.filtered(motion.tau.T)
    J, r = equation.columns(x, motion), equation.residual(x, motion)[:, None]
    z = motion if z is None else z
    z = z.with_torque_of(equation.arm.beta(x)) if len(places) else z
    Z = equation.columns(x, z) if len(places) else J
    C, G, fast, late, of_lag = J[:, :0], J[:, :0], None, SpanRows(), share
    if lag is not None:
        J[:, lags] = Z[:, lags]
        white, of_lag = lag.whitened(np.concatenate([Z[:, lag.of], J[:, lag.of], r], axis=1), z)
        late = SpanRows.of_block(instants, motion.first, white, of_lag)
    if further is not None:
        C, fast = further.columns(z), fast_for_lag(z, further.sliding)
        G = further.at_rest(motion)
    # J has no columns of the delays here, because the rate of a recorded torque is noise.
    each = G, C, Z[:, places], J[:, : -len(lags)]
    return (
        SpanRows.of_block(instants, motion.first, np.concatenate([*each, r], axis=1), share, fast),
        late,
        (drives if known is None else drives + motion.filtered(motion.known_torque.T)).T,
        motion.kept(motion.dq),
        of_lag.T,
        np.abs(drives).max(axis=1)[None],
        np.cumsum([part.shape[1] for part in each])[None],
    )


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
    equation : equation of motion of the recording.
    x : (p,) values of the unknowns.
    further : provider of the columns C of terms that are not in the model; None for none.
    along : blocks of another motion, along which Z is evaluated, such as that of the simulated
        robot (D). Without one, Z is along the measured motion, with the torque of the drives that x
        predicts, as the recorded one is noisy.
    of_lag : True for rows of the delay (G), along the other motion.

    Returns
    -------
    The rows, torques in N m or N, stacked by joint and time block.
    """
    unknowns = (equation := equation.read()).unknowns
    share = sample_weights(equation.problem).of_rows
    lag = _lag_filters(equation, x, share) if of_lag else None
    f, own = len(unknowns.names), bool(unknowns.motors) or along is not None
    # If only W and Y are requested, no torque is predicted for the columns of the delays.
    places = np.r_[: f * own, unknowns.lags] if own or further is not None else np.arange(0)
    task = partial(_rows_of_block, equation.apart, x, (places, further, lag))
    # Evaluate W before blocks are copied with another torque, so that all iterations share it.
    for motion in equation.kept:
        _ = motion.W
    collected, late, (tau, speed, share_of_lag, most, edges) = _collected(
        # The robot may have been prepared for other weights, which must not be used here.
        equation.by_block(task, x, along and (replace(z, problem=equation.problem) for z in along))
    )
    rows, fast, followed = collected.rows(share)
    G, C, Z, J, r = np.split(rows, edges[0], axis=1)
    return Rows(
        x=x,
        system=System(W=J[:, :f], Y=r[:, 0] + J[:, :f] @ x[:f], names=unknowns.names, **followed),
        L=np.c_[J[:, f:], Z[:, f * own :]],
        C=C,
        fast=fast,
        G=G,
        Z=Z[:, : f * own],
        share=share,
        tau=tau,
        speed=speed,
        most=most,
        recorded=along is None,
        late=lag.system(late, share_of_lag, unknowns.all) if lag else None,
    )


def _lag_filters(equation: Equation, x: Array, share: Array) -> LagFilters:
    """Return the filters of the rows of the delay, by the residuals at x."""
    tau, (predicted,), _, speed, *_ = torque_of_recording(equation, x)
    of = np.r_[equation.unknowns.arm, equation.unknowns.lags]
    return LagFilters(equation.problem, of, share, share * (tau - predicted), speed)


def _collected(blocks: Iterable[Any]) -> tuple[SpanRows, SpanRows, list[Array]]:
    """Collect the results of `_rows_of_block` of all blocks."""
    rows, late, parts = SpanRows(), SpanRows(), list[Sequence[Array]]()
    for of_block, of_lag, *arrays in blocks:
        rows.add(of_block)
        late.add(of_lag)
        parts.append(arrays)
    return rows, late, [np.concatenate(each) for each in zip(*parts, strict=True)]


def stacked_rows(each: Sequence[Rows]) -> Rows:
    """Stack the rows of recordings about the same x, joint by joint, in the given order."""
    if len(each) == 1:
        return each[0]
    order = by_joint([rows.system for rows in each])
    of: dict[str, Any] = {
        name: np.concatenate([getattr(rows, name) for rows in each])
        for name in ("L", "C", "fast", "G", "Z", "share", "tau", "speed", "most")
    }
    of |= {name: of[name][order] for name in ("L", "C", "fast", "G", "Z")}
    late, Z, orders = zip(*(rows.late or (None, None, None) for rows in each), strict=True)
    return replace(
        each[0],
        system=stacked([rows.system for rows in each]),
        **of,
        late=None
        if None in late
        else (stacked(late), np.concatenate(Z)[by_joint(late)], min(orders)),
    )


@one_thread
def torque_of_recording(
    equation: Equation, x: Array, *sets: Sequence[Array], judged: bool = False
) -> tuple[Array, Array, Bools, Array, Array, Ints]:
    """Compute the measured and predicted torques of a recording, decimated, not weighted.

    Torques of links are on a spline between samples of a low-passed motion; at the decimation of
    the rule this is exact to 1e-6.

    Parameters
    ----------
    equation : equation of motion of the recording.
    x : (p,) unknowns, whose delay and gains the measured torque has.
    sets : sets of base parameters (b,), by default only those of x. The members of a set predict
        equal parts of the rows in turn.
    judged : True for the filters of torque errors, False for those of the fit.

    Returns
    -------
    Measured torque (T, n); torque predicted by each set (K, T, n), N m or N; a mask (T, n) of the
    rows that count; joint speed (T, n), rad/s or m/s; instants (T,), s; and the row of the fit at
    or after each instant.
    """
    sets, s = sets or ([equation.arm.beta(x)],), (of := equation.problem).settings
    rows = len(s.instants)
    # Parts of the recording end where time blocks of the fit end.
    groups = [
        (
            s.stop - s.decimation * (rows + -np.arange(1, spans) * rows // spans),
            np.stack([*some], axis=1),
        )
        for spans, some in groupby(sets, len)
    ]
    equation = (replace(equation, problem=of.for_errors) if judged else equation).read()
    tau, predicted, speed = zip(
        *equation.by_block(partial(_torque_of_block, groups), x), strict=True
    )
    problem = equation.problem
    return (
        np.concatenate(tau),
        np.concatenate(predicted, axis=1),
        (sample_weights(problem).of_rows > 0) & problem.measured_rows()[:, None],
        np.concatenate(speed),
        problem.signals.t_s[problem.settings.instants],
        np.searchsorted(s.instants, problem.settings.instants),
    )


@one_thread
def _torque_of_block(
    groups: Sequence[tuple[Ints, Array]], motion: MotionBlock, _: None
) -> tuple[Array, Array, Array]:
    """Return measured torque, torque predicted by betas (parts, K, b), and speed of a block."""
    problem, stride, N = motion.problem, motion.torque_stride, len(motion.q)
    first, predicted = round(motion.t_s[0] * problem.signals.sample_rate_hz), list[Array]()
    for edges, betas in groups:
        cuts = pairwise([0, *np.clip(edges - first, 0, N), N])
        each = [
            predicted_torque(motion.part(slice(*at)), problem.model, problem.base, beta, stride)
            for beta, at in zip(betas, cuts, strict=True)
            if at[0] < at[1]
        ]
        predicted += [*np.concatenate(each, axis=1)]
    series = np.stack([motion.tau + motion.known_torque, *predicted]).swapaxes(1, 2)
    measured, *found = motion.filtered(series).swapaxes(1, 2)
    return measured, np.stack(found), motion.kept(motion.dq)
