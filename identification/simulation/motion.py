"""The robot's motion in the recorded experiment, block by block: simulated in closed loop, or along the reference."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from acquisition.files import let_go

from ..arrays import Array
from ..errors import IdentificationError
from ..model import direct_model, inertias, nearest_consistent, not_positive
from ..regression import Decimation, Motion, RowBlock
from .closed_loop import ClosedLoop
from .control_law import surrogate_loop
from .experiment import Experiment


class NotSimulatedError(Exception):
    """The robot with these parameters cannot be simulated, or leaves its reference; its text says why."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionBlock:
    """The motion of the samples of the instruments that a block of rows needs."""

    rows: RowBlock
    motion: Motion


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedMotion:
    """The robot simulated with parameters, in the whole of a recording.

    Attributes:
        motion: at the instruments' instants, of a long recording at those of the rows; None where it could not be simulated.
        q: measured positions at the same instants, and `decimation` from there to the rows.
        reason: why it could not be simulated; where there is a motion all the same, it is that of the nearest physically
            consistent parameters.
        gains: (n,) factors on the controller.
        tracking_percent: |q_sim - q| in percent of |q - mean|, all joints that move; `position_percent` by joint, None for one
            that is held. `torque_percent`: decimated torque in percent of the measured one.
    """

    motion: Motion | None
    q: Array
    decimation: Decimation
    reason: str | None
    gains: Array
    tracking_percent: float | None = None
    position_percent: tuple[float | None, ...] = ()
    torque_percent: tuple[float | None, ...] = ()


def gains_for(e: Experiment, beta: Array) -> tuple[Array, str | None]:
    """Factors (n,) on the controller's gains for the inertias of beta (b,), and why that cannot be simulated, if so."""
    model = direct_model(e.problem.model, e.problem.base.standard_parameters(beta))
    J, reason = inertias(model, e.poses), not_positive(model, e.poses)
    # Where nothing tells what its saturation was set for, computed torque keeps it.
    known = e.J_known or e.loop is None or not e.loop.computed_torque
    return J / e.J_prior if e.gain_update and known else np.ones(len(J)), reason


def simulated_blocks(e: Experiment, beta: Array) -> Iterator[MotionBlock]:
    """The closed loop simulated with `beta` (b,), if M(q, beta) is positive on the trajectory and the loop follows.

    Raises `NotSimulatedError`, maybe after some blocks.
    """
    gains, reason = gains_for(e, beta)
    if reason is not None:
        raise NotSimulatedError(reason)
    model, layout = direct_model(e.problem.model, e.problem.base.standard_parameters(beta)), e.layout
    loop = e.loop.scaled(gains) if e.loop else surrogate_loop(e.bandwidth_hz, gains * e.J_prior, 1 / layout.period_s)
    robot = ClosedLoop(model, loop, e.start, fastest=e.fastest, substeps=layout.substeps)
    n, done, first = len(gains), 0, 0
    rows = np.empty((0, 4 * n))  # simulated, from row `first` on
    for block in e.blocks:
        at = e.samples(block)
        begin, end = layout.around(at)
        rows, first = rows[begin * layout.substeps - first :], begin * layout.substeps
        if end > done:
            part = robot.follow(e.reference(done, end), e.bound)
            if part.reason is not None:
                raise NotSimulatedError(part.reason)
            rows, done = np.concatenate([rows, np.hstack([part.q, part.dq, part.ddq, part.tau])]), end
        x = np.ascontiguousarray(np.split(layout.sampled(rows, first, at, layout.substeps), 4, axis=1))
        yield MotionBlock(rows=block, motion=Motion(t_s=layout.t_s(at), q=x[0], dq=x[1], ddq=x[2], tau=x[3]))


def reference_blocks(e: Experiment) -> Iterator[MotionBlock]:
    """The reference itself as the motion, without torque."""
    for block in e.blocks:
        at = e.samples(block)
        begin, end = e.layout.around(at)
        reference = e.reference(begin, end)
        q, dq, ddq = (e.layout.sampled(x, begin, at, 1) for x in (reference.q, reference.dq, reference.ddq))
        yield MotionBlock(rows=block, motion=Motion(t_s=e.layout.t_s(at), q=q, dq=dq, ddq=ddq, tau=np.zeros_like(q)))


class Followed:
    """What is kept of a motion that goes by block by block: how far it is off the measured one, and the motion itself."""

    def __init__(self, e: Experiment, *, keep: bool = True) -> None:
        """`keep`: the motion, of a long recording at the instants of the rows alone."""
        self._e, self._keep = e, keep
        self._off, self._rho, self._tau = np.zeros((3, e.problem.signals.robot.n))
        self._kept: list[tuple[Array, ...]] = []

    def add(self, block: MotionBlock) -> None:
        """Take a block in."""
        e, motion = self._e, block.motion
        needed, own = e.samples(block.rows), block.rows.own_samples(e.layout.N, e.decimation.factor)
        inside, q = slice(own.start - needed.start, own.stop - needed.start), e.measured(own)
        self._off += ((motion.q[inside] - q) ** 2).sum(axis=0)
        settings, effort = e.problem.settings, e.problem.signals.effort
        used = block.rows.samples(settings.stop - settings.start, settings.decimation)
        measured = settings.decimator.filtered(effort[settings.start :][used].T)[:, block.rows.inside]
        let_go(effort)
        tau = e.decimation.filtered(motion.tau.T)[:, block.rows.inside]
        self._rho, self._tau = self._rho + ((measured - tau) ** 2).sum(axis=1), self._tau + (measured**2).sum(axis=1)
        if self._keep:
            parts = (motion.t_s[inside], q, *(x[inside] for x in (motion.q, motion.dq, motion.ddq, motion.tau)))
            self._kept.append(tuple(e.decimation.kept(x) for x in parts) if e.long else parts)

    def motion(self, gains: Array) -> SimulatedMotion:
        """The whole of it."""
        e = self._e
        kept, q, moves = None, np.zeros((0, len(gains))), ~e.held
        scatter = e.scatter * moves
        if self._kept:
            t_s, q, *rest = (np.concatenate(x) for x in zip(*self._kept, strict=True))
            kept = Motion(**dict(zip(("t_s", "q", "dq", "ddq", "tau"), (t_s, *rest), strict=True)))
        position, torque = (
            tuple(100.0 * float(np.sqrt(x / whole)) if whole > 0 else None for x, whole in zip(off, of, strict=True))
            for off, of in ((self._off, scatter), (self._rho, self._tau))
        )
        return SimulatedMotion(
            motion=kept,
            q=q,
            decimation=replace(e.decimation, factor=1) if e.long else e.decimation,
            reason=None,
            gains=gains,
            tracking_percent=100.0 * float(np.sqrt(self._off[moves].sum() / scatter.sum())),
            position_percent=position,
            torque_percent=torque,
        )


def simulated_motion(e: Experiment, beta: Array) -> SimulatedMotion:
    """The closed loop simulated with `beta` (b,), if it can be."""
    followed, gains = Followed(e), gains_for(e, beta)[0]
    try:
        for block in simulated_blocks(e, beta):
            followed.add(block)
    except NotSimulatedError as why:
        nothing = np.zeros((0, len(gains)))
        return SimulatedMotion(motion=None, q=nothing, decimation=e.decimation, reason=str(why), gains=gains)
    return followed.motion(gains)


def simulated_robot(e: Experiment, beta: Array, covariance: Array) -> SimulatedMotion:
    """The closed loop simulated with `beta` (b,), or else with the nearest consistent parameters; `reason` is that of beta."""
    free = simulated_motion(e, beta)
    if free.reason is None:
        return free
    near = simulated_motion(e, nearest(e, beta, covariance))
    return free if near.motion is None else replace(near, reason=free.reason)


def nearest(e: Experiment, beta: Array, covariance: Array) -> Array:
    """Consistent base parameters (b,) nearest to beta; beta itself where none are to be found."""
    try:
        return nearest_consistent(e.problem.model, e.problem.base, beta, covariance).beta
    except IdentificationError:
        return beta
