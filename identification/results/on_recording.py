"""A recording, the torque that a fit predicts on it, and how far it predicts the motion: its direct
model, open loop, from measured states.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Bools
from ..data import Signals
from ..estimation import Estimate, torque_errors
from ..model import direct_model
from ..regression import Problem, equation_alone, torque_of_recording
from ..report import TorqueResidual
from ..simulation import Simulated, open_loop
from ..trust import HeldOut

HORIZONS_S = (0.1, 0.5, 1.0)
MOST_STARTS = 20
MAX_STEP_S = 0.001


@dataclass(frozen=True, kw_only=True, eq=False)
class FitOnRecording:
    """A recording with the torque that a fit predicts, whether it was made from it or not.

    Attributes:
        problem: recording, settings and model; without samples if the recordings of a fit
            are too long to be held.
        names: (b,) of its base parameters in those of the fit; `carried`: (b,) the payload's share
            of them; `beta`: (b,) their values, with that.
        t_s: (rows,) instants of decimated rows, s, behind filters that depend on the motion only;
            those of the fit are in `Evidence.data`.
        tau, tau_predicted: (rows, n) torques there; `counts`: whether the joint moves, as in rows
            of a fit.
        held_out: its torque predicted by the fit of the other recordings; None if there are none.
        simulated: the robot simulated in it with the estimate; None without instruments.
        ahead: how far the motion is predicted, as of `errors_ahead`.
    """

    problem: Problem
    names: tuple[str, ...]
    carried: Array
    beta: Array
    t_s: Array
    tau: Array
    tau_predicted: Array
    counts: Bools
    held_out: HeldOut | None = None
    simulated: Simulated | None = None
    ahead: Array | None = None

    def values(self, estimate: Estimate) -> Array:
        """(b,) base parameters with the payload by an estimate, zero where it has none."""
        return estimate.values_of(self.names) + self.carried

    @property
    def errors(self) -> tuple[TorqueResidual, ...]:
        """Its torque errors, one entry per joint and, last, all joints together."""
        return errors_on([self])

    @property
    def signals(self) -> Signals:
        """The recording."""
        return self.problem.signals


def validated(problem: Problem, beta: Array) -> FitOnRecording:
    """The torque of base parameters (b,), with the payload, on a recording."""
    tau, (predicted,), counts, _, t_s, _ = torque_of_recording(
        *equation_alone(problem), [beta], judged=True
    )
    return FitOnRecording(
        problem=problem.for_errors,
        names=problem.base.names,
        carried=0 * beta,
        beta=beta,
        t_s=t_s,
        tau=tau,
        tau_predicted=predicted,
        counts=counts,
    )


def errors_on(recordings: Sequence[FitOnRecording]) -> tuple[TorqueResidual, ...]:
    """Torque errors of recordings together: one per joint and, last, that of all joints."""
    rows = [(one.tau, one.tau_predicted, one.counts) for one in recordings]
    tau, predicted, counts = map(np.concatenate, zip(*rows, strict=True))
    robot = recordings[0].signals.robot
    joints = zip((joint.name for joint in robot.joints), robot.effort_units, strict=True)
    return torque_errors(tau, predicted, counts, list(joints))


def first_ahead(recordings: Sequence[FitOnRecording]) -> Array | None:
    """How far the motion is predicted ahead, in the first of the recordings that shows it."""
    return next((one.ahead for one in recordings if one.ahead is not None), None)


def errors_ahead(problem: Problem, beta: Array) -> Array | None:
    """Predict the positions of a recording by base parameters (b,) and its recorded torque.

    Returns (2, h, n) the rms over the starts of the error after each of `HORIZONS_S`, and of the
    way moved until then, rad or m; None where the recording is too short, M is not positive, or the
    motion grows beyond bounds.
    """
    s, fs = problem.settings, problem.signals.sample_rate_hz
    ahead = [max(1, round(x * fs)) for x in HORIZONS_S]
    span, measured = ahead[-1] + 1, problem.measured_samples()
    starts = [
        k for k in range(s.start, s.stop - span, max(1, span)) if measured[k : k + span].all()
    ]
    model = direct_model(problem.model, problem.base.standard_parameters(beta))
    fastest, each = np.abs(problem.motion.between(s.start, s.stop, s.cutoff_hz).dq).max(axis=0), []
    for k in starts[:: -(-len(starts) // MOST_STARTS)] if starts else ():
        motion = problem.motion.between(k, k + span, s.cutoff_hz)
        tau = problem.drives(k, k + span, s.torque_lag_s)
        if problem.signals.known_torque is not None:
            tau = tau + problem.signals.known_torque[k : k + span]
        try:
            q = open_loop(model, (motion.q[0], motion.dq[0]), tau, (fs, MAX_STEP_S), fastest)
        except ArithmeticError:
            return None
        each.append((q[ahead] - motion.q[ahead], motion.q[ahead] - motion.q[0]))
    found = np.sqrt(np.mean(np.square(each), axis=0)) if each else np.array(np.inf)
    return found if np.isfinite(found).all() else None
