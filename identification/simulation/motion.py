"""The robot's motion in the recorded experiment, block by block: simulated in closed loop, or
predicted by the reference.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from acquisition.files import release_pages

from ..arrays import Array
from ..errors import NoFitError
from ..model import DirectModel, inertias, nearest_consistent, why_not_positive
from ..regression import Decimation, Motion, RowBlock
from ..report import DirectModelResidual
from .closed_loop import ClosedLoop
from .control_law import surrogate_loop
from .experiment import Experiment
from .predicted import predicted_motion

# motions at the instrument samples of each block of rows
MotionBlocks = Iterator[tuple[RowBlock, Motion]]


class NotSimulatedError(Exception):
    """The robot cannot be simulated with these parameters, or leaves its
    reference; the text says why.
    """


@dataclass(frozen=True, kw_only=True, eq=False)
class Replica:
    """The robot simulated in a whole recorded experiment.

    Attributes:
        motion: at the instruments' instants, of a long recording at those of the rows: simulated,
            or if that could not be, predicted by the reference; None once dropped.
        q: measured positions at the same instants; `decimation` leads from there to the rows.
        tracking_percent: |q_sim - q| in percent of |q - mean|, all joints that move; `direct` by
            joint; None and empty if it could not be simulated.
        reference_kind, J_known, controller, bandwidth_hz: as in `Experiment`.
    """

    motion: Motion | None
    q: Array
    decimation: Decimation
    tracking_percent: float | None
    direct: tuple[DirectModelResidual, ...]
    reference_kind: Literal["recorded", "surrogate"]
    controller: Literal["described", "found", "surrogate"]
    J_known: bool
    bandwidth_hz: float


def with_gains_for(e: Experiment, beta: Array) -> tuple[DirectModel, Array, str | None]:
    """The model with beta (b,), factors (n,) on the gains for its inertias, and why it cannot
    be simulated, or None.
    """
    model = e.model(beta)
    M = model.inertia(e.poses)
    J = inertias(M)
    # Computed torque keeps its saturation if the inertias it was set for are unknown.
    known = e.J_known or e.loop is None or not e.loop.computed_torque
    return model, J / e.J_prior if e.gain_update and known else np.ones(len(J)), why_not_positive(M)


def simulated_blocks(
    e: Experiment, model: DirectModel, gains: Array, reason: str | None
) -> MotionBlocks:
    """Simulate the closed loop with the result of `with_gains_for`.

    Raises `NotSimulatedError`, also between blocks.
    """
    if reason is not None:
        raise NotSimulatedError(reason)
    loop = (
        e.loop.scaled(gains)
        if e.loop
        else surrogate_loop(e.bandwidth_hz, gains * e.J_prior, 1 / e.period_s)
    )
    robot = ClosedLoop(model, loop, e.start, fastest=e.fastest, substeps=e.substeps)
    done, first = 0, 0
    rows = np.empty((4, 0, len(gains)))  # simulated, from row `first` on
    for block in e.blocks:
        at = e.samples(block)
        begin, end = e.around(at)
        rows, first = rows[:, begin * e.substeps - first :], begin * e.substeps
        if end > done:
            part, reason = robot.follow(e.reference(done, end), e.bound)
            if reason is not None:
                raise NotSimulatedError(reason)
            rows, done = np.concatenate([rows, part], axis=1), end
        q, dq, ddq, tau = (e.sampled(x, first, at, e.substeps) for x in rows)
        yield block, Motion(t_s=e.t_s(at), q=q, dq=dq, ddq=ddq, tau=tau)


def reference_blocks(e: Experiment, x: Array) -> MotionBlocks:
    """The motion that the reference predicts, low-passed as the measured one, with the torque of
    base parameters x (b,).
    """
    predicted, model = predicted_motion(e.problem), e.model(x)
    for block in e.blocks:
        motion = e.motion(e.samples(block), predicted).part(slice(None, None, e.stride))
        yield block, replace(motion, tau=model.torque(motion.q, motion.dq, motion.ddq))


class TrackingDeviation:
    """Accumulates the deviation of a motion from the measured one, block by block."""

    def __init__(self, e: Experiment) -> None:
        self._e = e
        self._position, self._rho, self._tau = np.zeros((3, len(e.held)))

    def add(self, block: RowBlock, motion: Motion) -> tuple[slice, Array]:
        """Add a block; returns the samples that no other block has, and the
        measured positions there.
        """
        e = self._e
        needed, own = e.samples(block), block.own_samples(e.N, e.decimation.factor)
        inside, q = slice(own.start - needed.start, own.stop - needed.start), e.measured(own)
        self._position += ((motion.q[inside] - q) ** 2).sum(axis=0)
        settings, effort = e.problem.settings, e.problem.signals.effort
        used = block.samples(settings.stop - settings.start, settings.decimation)
        measured = settings.decimator.filtered(effort[settings.start :][used].T)[:, block.inside]
        release_pages(effort)
        tau = e.decimation.filtered(motion.tau.T)[:, block.inside]
        self._rho, self._tau = (
            self._rho + ((measured - tau) ** 2).sum(axis=1),
            self._tau + (measured**2).sum(axis=1),
        )
        return inside, q

    @property
    def percent(self) -> float:
        """Position error of all joints that move."""
        moving = ~self._e.held
        return 100.0 * float(np.sqrt(self._position[moving].sum() / self._e.scatter[moving].sum()))

    @property
    def by_joint(self) -> tuple[DirectModelResidual, ...]:
        """Position and torque errors."""
        e = self._e
        position, torque = (
            [
                100.0 * float(np.sqrt(x / whole)) if whole > 0 else None
                for x, whole in zip(errors, wholes, strict=True)
            ]
            for errors, wholes in ((self._position, e.scatter * ~e.held), (self._rho, self._tau))
        )
        return tuple(
            DirectModelResidual(name=joint.name, position_error_percent=x, torque_error_percent=tau)
            for joint, x, tau in zip(e.problem.signals.robot.joints, position, torque, strict=True)
        )


def nearest(e: Experiment, beta: Array, covariance: Array, payload: Array | float) -> Array:
    """Consistent base parameters (b,) nearest to beta, of which `payload` (b,) stays; beta
    itself if none are found.
    """
    try:
        return (
            nearest_consistent(e.problem.model, e.problem.base, beta - payload, covariance).beta
            + payload
        )
    except NoFitError:
        return beta
