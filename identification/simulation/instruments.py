"""Instruments of a recording: the columns along the motion of the robot simulated with an estimate,
made in a task, and how that robot follows the recording.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from .. import regression
from ..arrays import Array
from ..errors import NoFitError
from ..estimation import one_thread
from ..model import nearest_consistent
from ..regression import MotionBlock, Problem, Rows, Term
from ..report import DirectModelResidual
from .simulated_recording import SimulatedRecording

MAX_SERIES = 4_000_000  # numbers of a position; of longer ones the motion at rows is kept
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
        motion: the motion, None once dropped; of a long recording at the instants of the rows.
        error: (N, n) its position less the measured one.
        percent: |q_sim - q| in percent of |q - mean|, all joints that move, and `by_joint`; None
            and empty if nothing was simulated.
        rows: about the parameters asked, with instruments along the motion; None once dropped.
    """

    recording: str
    kind: InstrumentKind
    reason: str | None
    gains: Array
    prior_known: bool
    motion: MotionBlock | None
    error: Array
    percent: float | None
    by_joint: tuple[DirectModelResidual, ...]
    rows: Rows | None

    def without_rows(self) -> "Simulated":
        """Return the same without arrays of a recording's length."""
        return replace(self, motion=None, error=self.error[:0], rows=None)


@one_thread
def simulate(
    prepared: Callable[[float], SimulatedRecording],
    rate_per_bandwidth: float,
    problem: Problem,
    about: tuple[Array, Asked | None],
    further: Term | None = None,
    before: Array | None = None,
) -> Simulated:
    """Simulate a robot in a recording, and compute the rows of its `problem` about the base
    parameters x (b,) with instruments; `about` has x and what is asked, `further` and `before` are
    those of `rows_of_recording`.

    The robot is the physically consistent one nearest to what is asked, or without a covariance
    that of the very parameters. If nothing is asked, or the robot leaves its reference, instruments
    are along the motion that the reference predicts.

    The nearest parameters follow the estimate smoothly. The estimate itself moves a light wrist
    wildly long before its inertia matrix stops being positive, and the iteration then has no fixed
    point.
    """
    robot, beta, (x, asked) = prepared(rate_per_bandwidth), None, about
    kind: InstrumentKind = "reference"
    if asked is not None:
        beta, covariance, payload = asked
        if covariance is not None:
            with suppress(NoFitError):
                of = robot.problem.model, robot.problem.base
                beta = nearest_consistent(*of, beta - payload, covariance).beta + payload
    along, reason = robot.motion(beta, x)
    if asked is not None and reason is None:
        reason = robot.gains(asked[0])[1]
        kind = "simulated" if reason is None else "consistent"
        if reason is None and covariance is not None and beta is asked[0]:
            reason = "no physically consistent robot is near: that of the estimate itself"
    whole, q, torques = _compared(robot, along())
    percent, by_joint = _tracking(robot, (q, whole.q), torques)
    return Simulated(
        recording=robot.problem.signals.recording,
        kind=kind,
        reason=reason,
        gains=np.ones(len(robot.held)) if beta is None else robot.gains(beta)[0],
        prior_known=robot.prior_known,
        motion=whole,
        error=whole.q - q,
        percent=None if kind == "reference" else percent,
        by_joint=() if kind == "reference" else by_joint,
        rows=regression.rows_of_recording(problem, x, further, along(), before),
    )


def _compared(
    robot: SimulatedRecording, along: Iterator[MotionBlock]
) -> tuple[MotionBlock, Array, tuple[Array, Array]]:
    """A motion at the samples that are kept, the measured positions (N, n) there, and the torques
    (T, n) of the rows, measured and of the motion.
    """
    problem, kept, torques = robot.problem, list[list[Array]](), list[list[Array]]()
    settings, few = problem.settings, problem.signals.q.size > MAX_SERIES
    for motion in along:
        at, decimation = motion.at, motion.decimation
        q = robot.low_passed(problem.motion, robot.samples(at)).q
        series = motion.t_s, motion.q, motion.dq, motion.ddq, motion.tau, q
        own = [motion.own(x) for x in series]
        # A long recording keeps only the instants of the rows.
        kept.append([decimation.kept(x) for x in own] if few else own)
        used = at.samples(settings.stop - settings.start, settings.decimation)
        effort = problem.drives(settings.start + used.start, settings.start + used.stop)
        tau = settings.decimator.filtered(effort.T)
        of_model = decimation.filtered(motion.tau.T)
        torques.append([x[:, at.inside].T for x in (tau, of_model)])
    t_s, q, dq, ddq, tau, measured = (np.concatenate(each) for each in zip(*kept, strict=True))
    decimation = replace(decimation, factor=1) if few else decimation
    at, (recorded, of_model) = (
        replace(at, first=0, low=0),
        (np.concatenate(each) for each in zip(*torques, strict=True)),
    )
    whole = MotionBlock(t_s=t_s, q=q, dq=dq, ddq=ddq, tau=tau, at=at, decimation=decimation)
    return whole, measured, (recorded, of_model)


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
