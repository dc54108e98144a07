"""Instruments of a recording: the columns along the motion of the robot simulated with an estimate,
made in a task, and how that robot follows the recording.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from ..arrays import Array
from ..control import ControllerKind
from ..errors import NoFitError
from ..estimation import one_thread
from ..model import nearest_consistent
from ..regression import Candidate, Equation, Motion, MotionBlock, Rows, rows_of_recording
from ..report import DirectModelResidual
from .simulated_recording import COARSE, FINE, SimulatedRecording, predicted_motion

MAX_SERIES = 4_000_000  # numbers of a position; of longer ones the motion at rows is kept
InstrumentKind = Literal["simulated", "consistent", "reference"]
# base parameters (b,) to simulate, their covariance (b, b), and the share (b,) of a payload in them
Asked = tuple[Array, Array | None, Array]


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulated:
    """What a robot simulated in a recording gives.

    Attributes:
        recording: its name; `controller`: the kind of its control law; `saturated`: as of
            `SimulatedRecording`.
        kind: `simulated`: with the physically consistent parameters nearest to those asked;
            `consistent`: the same, where the inertia matrix of those asked is not positive;
            `reference`: not simulated, the motion is that which the reference predicts.
        reason: why it is not the robot asked; None if it is.
        gains: (n,) factors on the gains of its control law.
        prior_known: whether the inertias that these were set for are known.
        motion: the motion, None once dropped or if nothing was simulated; of a long recording at
            the instants of the rows.
        error: (N, n) its position less the measured one.
        percent: |q_sim - q| in percent of |q - mean|, all joints that move, and `by_joint`; None
            and empty if nothing was simulated.
    """

    recording: str
    controller: ControllerKind
    saturated: dict[str, float]
    kind: InstrumentKind
    reason: str | None
    gains: Array
    prior_known: bool
    motion: Motion | None = None
    error: Array = field(default_factory=lambda: np.zeros((0, 0)))
    percent: float | None = None
    by_joint: tuple[DirectModelResidual, ...] = ()


@one_thread
def simulate(
    equation: Equation,
    prepared: Callable[[float], SimulatedRecording],
    about: tuple[Array, Asked | None],
    further: Candidate | None = None,
    of_lag: bool = False,
) -> tuple[Simulated, Rows]:
    """Simulate a robot in a recording, and compute the rows of its equation with instruments.

        Z = F[w IDM(q_s, dq_s, ddq_s)]                                                   (D)

    The robot is the physically consistent one nearest to what is asked, or without a covariance
    that of the very parameters. If nothing is asked, or the robot leaves its reference, instruments
    are along the motion that the reference predicts.

    The nearest parameters follow the estimate smoothly. The estimate itself moves a light wrist
    wildly long before its inertia matrix stops being positive, and the iteration then has no fixed
    point.

    Parameters
    ----------
    equation : the equation of motion of the recording.
    prepared : makes the recording in which robots are simulated, for a number of samples and steps
        per period of the bandwidth.
    about : x (p,), about which the rows are, and what is asked; None for nothing.
    further, of_lag : as of `rows_of_recording`.

    Returns
    -------
    The simulated motion with how it follows the recording, and the rows.
    """
    x, asked = about
    robot = prepared(COARSE if asked is None else FINE)
    kind: InstrumentKind = "reference"
    why, gains = None, np.ones(len(robot.held))
    if asked is not None:
        beta, covariance, payload = asked
        why = robot.gains(robot.model(beta))[1]
        kind = "simulated" if why is None else "consistent"
        if covariance is not None:
            with suppress(NoFitError):
                own = robot.problem.model, robot.problem.base, beta - payload
                beta = nearest_consistent(*own, covariance).beta + payload
            if why is None and beta is asked[0]:
                why = "no physically consistent robot is near: that of the estimate itself"
        path, gains, reason = robot.simulated(beta)
        if reason is not None:
            kind, why = "reference", reason
    motion = predicted_motion(robot.problem) if kind == "reference" else path
    rows = rows_of_recording(equation, x, further, robot.motion(motion), of_lag=of_lag)
    found = Simulated(
        recording=robot.problem.signals.recording,
        controller=robot.loop.kind,
        saturated=robot.saturated,
        kind=kind,
        reason=why,
        gains=gains,
        prior_known=robot.prior_known,
    )
    return (
        found if kind == "reference" else _followed(found, robot, robot.motion(motion), rows.tau),
        rows,
    )


def _followed(
    found: Simulated, robot: SimulatedRecording, along: Iterator[MotionBlock], measured: Array
) -> Simulated:
    """The same with its motion at the samples that are kept, the error of its positions, and norms
    of errors in percent of those measured: of the positions about their mean, of all joints that
    move, and by joint of positions and of torques, `measured` (T, n).
    """
    problem, moves, kept = robot.problem, ~robot.held, list[list[Array]]()
    few = problem.signals.q.size > MAX_SERIES  # only the instants of the rows
    for motion in along:
        q = robot.low_passed(problem.motion, motion.near).q
        torque = motion.tau + motion.known_torque
        every = motion.t_s, motion.q, motion.dq, motion.ddq, motion.tau, q
        own = motion.decimation.samples(motion.inside, len(q))  # those that no other block has
        parts = (motion.kept(x) if few else x[own] for x in every)
        kept.append([*parts, motion.filtered(torque.T).T])
    t_s, q, dq, ddq, tau, wanted, torque = map(np.concatenate, zip(*kept, strict=True))
    errors, sizes = (q - wanted) * moves, (wanted - wanted.mean(axis=0)) * moves
    percents = [
        [100 * float(a / b) if b > 0 else None for a, b in np.linalg.norm(pair, axis=1).T]
        for pair in ((errors, sizes), (torque - measured, measured))
    ]
    return replace(
        found,
        motion=Motion(t_s=t_s, q=q, dq=dq, ddq=ddq, tau=tau),
        error=q - wanted,
        percent=100 * float(np.linalg.norm(errors) / np.linalg.norm(sizes)),
        by_joint=tuple(
            DirectModelResidual(name=joint.name, position_error_percent=a, torque_error_percent=b)
            for joint, a, b in zip(problem.signals.robot.joints, *percents, strict=True)
        ),
    )
