"""A recording, and the torque that a fit predicts on it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Bools
from ..data import Signals
from ..estimation import Estimate, torque_errors
from ..regression import Problem, equation_alone, torque_of_recording
from ..report import TorqueResidual
from ..simulation import Simulated
from ..trust import HeldOut


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
    torques = torque_of_recording(*equation_alone(problem), [beta], judged=True)
    tau, (predicted,), counts, _, t_s, _ = torques
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
    names = [joint.name for joint in robot.joints]
    joints = list(zip(names, robot.effort_units, strict=True))
    return torque_errors(tau, predicted, counts, joints)
