"""Instruments of a recording: the columns along the motion of the robot simulated with an estimate,
made in a task, and how that robot follows the recording.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from acquisition.files import release_pages

from .. import regression
from ..arrays import Array
from ..errors import NoFitError
from ..estimation import SpanFactors, one_thread
from ..model import nearest_consistent
from ..regression import MotionBlock, Rows, Term
from ..report import DirectModelResidual
from .simulated_recording import SimulatedRecording

InstrumentKind = Literal["simulated", "consistent", "reference"]
# base parameters (b,) to simulate, their covariance (b, b), and the share (b,) of a payload in them
Asked = tuple[Array, Array | None, Array]


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulated:
    """What a robot simulated in a recording gives.

    Attributes:
        recording: its name.
        kind: `simulated`: with the physically consistent parameters nearest to those asked;
            `consistent`: the same, where the inertia matrix of those asked is not positive;
            `reference`: not simulated, the motion is that which the reference predicts.
        reason: why it is not the robot asked; None if it is.
        gains: (n,) factors on the controller's gains.
        prior_known: whether the inertias that these were set for are known.
        controller: `surrogate` for a PD of the stated bandwidth.
        motion: the motion, None once dropped; of a long recording at the instants of the rows.
        error: (N, n) its position less the measured one.
        percent: |q_sim - q| in percent of |q - mean|, all joints that move, and `by_joint`; None
            and empty if nothing was simulated.
        Z: (r, b + n) instruments of base parameters and drives, or of a long recording the rows
            [C Z W E Y] as QR factors by span.
    """

    recording: str
    kind: InstrumentKind
    reason: str | None
    gains: Array
    prior_known: bool
    controller: Literal["described", "found", "surrogate"]
    motion: MotionBlock | None
    error: Array
    percent: float | None
    by_joint: tuple[DirectModelResidual, ...]
    Z: Array | Rows

    def without_rows(self) -> "Simulated":
        """Return the same without arrays of a recording's length."""
        return replace(self, motion=None, error=self.error[:0], Z=self.error[:0])


@one_thread
def simulate(
    prepared: Callable[[float], SimulatedRecording],
    rate_per_bandwidth: float,
    x: Array,
    asked: Asked | None,
    further: Term | None = None,
    columns: Callable[[Array], Array] = np.asarray,
) -> Simulated:
    """Simulate a robot in a recording, and compute instruments about the base parameters x (b,);
    rows of a long recording have `further` columns C, others the `columns` of these.

    The robot is the physically consistent one nearest to what is asked, or without a covariance
    that of the very parameters. If nothing is asked, or the robot leaves its reference, instruments
    are along the motion that the reference predicts.

    The nearest parameters follow the estimate smoothly. The estimate itself moves a light wrist
    wildly long before its inertia matrix stops being positive, and the iteration then has no fixed
    point.
    """
    robot, beta = prepared(rate_per_bandwidth), None
    kind: InstrumentKind = "reference"
    if asked is not None:
        beta, covariance, payload = asked
        if covariance is not None:
            with suppress(NoFitError):
                of = robot.problem.model, robot.problem.base
                beta = nearest_consistent(*of, beta - payload, covariance).beta + payload
    along, gains, reason = robot.motion(beta, x)
    if asked is not None and reason is None:
        near = beta is not asked[0]
        reason = robot.gains(asked[0])[1] if near else None
        kind = "simulated" if reason is None else "consistent"
        if covariance is not None and not near:
            reason = "no physically consistent robot is near: that of the estimate itself"
    whole, q, torques, Z = _along(robot, along, x, further)
    percent, by_joint = _tracking(robot, (q, whole.q), torques)
    return Simulated(
        recording=robot.problem.signals.recording,
        kind=kind,
        reason=reason,
        gains=gains,
        prior_known=robot.prior_known,
        controller=robot.controller,
        motion=whole,
        error=whole.q - q,
        percent=None if kind == "reference" else percent,
        by_joint=() if kind == "reference" else by_joint,
        Z=Z if isinstance(Z, Rows) else columns(Z),
    )


def _along(
    robot: SimulatedRecording, along: Iterator[MotionBlock], x: Array, further: Term | None
) -> tuple[MotionBlock, Array, tuple[Array, Array], Array | Rows]:
    """A motion at the samples that are kept, the measured positions (N, n) there, the torques
    (T, n) of the rows, measured and of the motion, and Z of `Simulated` about x.
    """
    problem, settings, effort = robot.problem, robot.problem.settings, robot.problem.signals.effort
    kept, torques, columns = list[list[Array]](), list[list[Array]](), list[Array]()
    share = regression.sample_weights(problem).of_rows
    factors = SpanFactors(len(share), len(robot.held), robot.spans)
    for motion in along:
        at, decimation, tau = motion.at, motion.decimation, motion.tau
        q = robot.low_passed(problem.motion, robot.samples(at)).q
        own = [motion.own(y) for y in (motion.t_s, motion.q, motion.dq, motion.ddq, tau, q)]
        # A long recording keeps only the instants of the rows.
        kept.append([decimation.kept(y) for y in own] if robot.spans else own)
        used = at.samples(settings.stop - settings.start, settings.decimation)
        measured = settings.decimator.filtered(effort[settings.start :][used].T)
        torques.append([y[:, at.inside].T for y in (measured, decimation.filtered(tau.T))])
        release_pages(effort)
        if problem.needs_drives:
            tau = regression.predicted_torque(motion, problem.model, problem.base, x)
        columns.append(regression.columns_of_block(problem, replace(motion, tau=tau), x)[:, :-1])
        if robot.spans:
            Z = [columns.pop()]
            if further is not None:
                Z.insert(0, further.columns(problem, motion, decimation)[..., at.inside])
            Z.append(
                regression.columns_of_block(problem, regression.motion_of_block(problem, at), x)
            )
            factors.add(at.first, np.concatenate(Z, axis=1), share[at.first : at.last])
    t_s, q, dq, ddq, tau, measured = (np.concatenate(each) for each in zip(*kept, strict=True))
    decimation = replace(decimation, factor=1) if robot.spans else decimation
    recorded, of_model = (np.concatenate(each) for each in zip(*torques, strict=True))
    at = replace(at, first=0, low=0)
    whole = MotionBlock(t_s=t_s, q=q, dq=dq, ddq=ddq, tau=tau, at=at, decimation=decimation)
    if robot.spans:
        rows = regression.rows_of_factors(problem, factors, Z[-2].shape[1])
        return whole, measured, (recorded, of_model), rows
    held = np.concatenate(columns, axis=-1).transpose(0, 2, 1)
    return whole, measured, (recorded, of_model), held.reshape(-1, held.shape[-1])


def _tracking(
    robot: SimulatedRecording, positions: tuple[Array, Array], torques: tuple[Array, Array]
) -> tuple[float, tuple[DirectModelResidual, ...]]:
    """Norms of the errors in percent of those measured: of the positions about their mean, of all
    joints that move, and by joint of positions and torques.
    """
    (q, of_robot), (tau, of_model), moves = positions, torques, ~robot.held
    error, size, rho, whole = (
        np.linalg.norm(x, axis=0)
        for x in ((of_robot - q) * moves, (q - q.mean(axis=0)) * moves, of_model - tau, tau)
    )
    percents = [
        [100 * float(a / b) if b > 0 else None for a, b in zip(*pair, strict=True)]
        for pair in ((error, size), (rho, whole))
    ]
    by_joint = tuple(
        DirectModelResidual(name=joint.name, position_error_percent=a, torque_error_percent=b)
        for joint, a, b in zip(robot.problem.signals.robot.joints, *percents, strict=True)
    )
    return 100 * float(np.linalg.norm(error) / np.linalg.norm(size)), by_joint
