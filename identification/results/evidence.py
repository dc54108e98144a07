"""The material from which a fit is made.

This is the torque that it predicts on each recording and, of all recordings together, the estimate,
its settings and its tests. A fit that was read from a file has the former alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Literal, TypeVar, get_args

import msgspec
import numpy as np

from acquisition.robot import ripple_notes

from ..arrays import Array, Bools
from ..control import ControllerKind, FoundLaw
from ..data import Signals
from ..estimation import Estimate, Intervals, torque_errors
from ..methods import Pass, Solution, direct_errors, largest
from ..model import BaseParameters, direct_model_of_base
from ..regression import Problem, Settings, equation_alone, torque_of_recording
from ..report import (
    ConsistentFile,
    DirectModelResidual,
    DriveGain,
    FTest,
    Method,
    PayloadOfFit,
    StandardParameter,
    Status,
    TorqueResidual,
    is_base,
)
from ..simulation import Simulated, open_loop
from ..trust import HeldOut, Trust, TrustInputs

Found = TypeVar("Found", Estimate, Intervals)

HORIZONS_S = (0.1, 0.5, 1.0)
MOST_STARTS = 20
MAX_STEP_S = 0.001


@dataclass(frozen=True, kw_only=True, eq=False)
class FitOnRecording:
    """A recording with the torque that a fit predicts, whether it was fitted to it or not.

    Attributes:
        problem: recording, settings and model; without samples if the recordings of a fit are too
            long to be held.
        names: (b,) names of its base parameters in the fit.
        carried: (b,) the payload's share of them.
        beta: (b,) their values, with the payload.
        t_s: (rows,) instants of decimated rows, s, after filters that depend on the motion only;
            those of the fit are in `Evidence.data`.
        tau, tau_predicted: (rows, n) measured and predicted torques there, N m or N.
        counts: (rows, n) True where the joint moves, as in rows of a fit.
        held_out: its torque predicted by the fit of the other recordings; None if there are none.
        simulated: the robot simulated with the estimate; None without instruments.
        ahead: how far the motion is predicted, as in `errors_ahead`.
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
        """Return the base parameters (b,) with the payload from an estimate.

        They are zero where the estimate has none.
        """
        return estimate.values_of(self.names) + self.carried

    @property
    def errors(self) -> tuple[TorqueResidual, ...]:
        """Torque errors, one entry per joint and, last, all joints together."""
        return errors_on([self])

    @property
    def signals(self) -> Signals:
        """Signals of the recording."""
        return self.problem.signals


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Evidence:
    """Base parameters of a robot from one recording or several, with their tests.

    Attributes:
        solution: the solution of the method, with its iterations and their status.
        data: rows, estimate, instruments, and all other inputs of its tests.
        recordings: the recordings in the order given.
        errors: torque errors of the rows that count, one entry per joint and, last, all joints
            together.
        own: the test of per-recording parameters; None if all are shared.
        gains: drive gains, if identified.
        payloads: the nearest rigid bodies with positive mass density, in the frame of the last
            joint;
            None without one near the given values, or a ball.
        consistent_set, standard_parameters: the nearest physically consistent parameters, if
            requested.
    """

    solution: Solution
    data: TrustInputs
    recordings: tuple[FitOnRecording, ...]
    errors: tuple[TorqueResidual, ...]
    warnings: tuple[str, ...]
    trust: Trust
    own: FTest | None = None
    gains: tuple[DriveGain, ...] = ()
    payloads: tuple[PayloadOfFit, ...] = ()
    consistent_set: ConsistentFile | None = None
    standard_parameters: tuple[StandardParameter, ...] = ()

    @property
    def method(self) -> Method:
        """Method of the solution."""
        return self.data.method

    @property
    def status(self) -> Status:
        """Status of the solution; `reason` says why it is not `converged`."""
        return self.solution.status

    @property
    def passes(self) -> tuple[Pass, ...]:
        """Iterations of the instrumental variable method, in order; none after least squares."""
        return self.solution.passes

    @cached_property
    def estimate(self) -> Estimate:
        """Estimate of the base parameters, without those of gains and payloads.

        It has fewer than `base` if only the essential ones were requested.
        """
        return self._of_base(self.data.estimate, self.data.estimate.names)

    @cached_property
    def intervals(self) -> Intervals:
        """Intervals of the estimate."""
        return self._of_base(self.data.intervals, self.data.estimate.names)

    @cached_property
    def least_squares(self) -> Pass:
        """Weighted least squares of the same recordings and settings: its base parameters.

        A fit by least squares returns itself.
        """
        found, names = self.solution.least_squares, self.solution.least_squares.estimate.names
        return replace(
            found,
            estimate=self._of_base(found.estimate, names),
            intervals=self._of_base(found.intervals, names),
        )

    def _of_base(self, found: Found, names: Sequence[str]) -> Found:
        """Return the part of the base parameters with these names."""
        places = np.flatnonzero([bool(is_base(name)) for name in names])
        return found.part(places) if self.gains or self.payloads else found

    @cached_property
    def essential(self) -> FTest:
        """Essential base parameters by least squares, and the test of leaving out the others."""
        found = self.solution.essential
        return msgspec.structs.replace(found, names=tuple(filter(is_base, found.names)))

    @cached_property
    def direct(self) -> tuple[DirectModelResidual, ...]:
        """Errors of the direct model by joint.

        The tuple is empty without a robot simulated with the final estimate.
        """
        return direct_errors([one.simulated for one in self.recordings if one.simulated])

    @property
    def controller(self) -> ControllerKind | None:
        """Kind of the simulated controller.

        Of several recordings it is the last of these kinds that occurs. It is None after least
        squares.
        """
        return max(
            (one.simulated.controller for one in self.recordings if one.simulated),
            key=get_args(ControllerKind).index,
            default=None,
        )

    @property
    def saturated_percent(self) -> float | None:
        """Share of recorded samples at a drive's limit, percent; None if no limit is given."""
        return largest(
            [max(one.saturated.values(), default=None) for one in self.solution.simulated]
        )

    @property
    def t_s(self) -> Array:
        """Instants of the rows of all recordings, in their order, s, (rows,)."""
        return np.concatenate([one.t_s for one in self.recordings])

    @property
    def tau(self) -> Array:
        """Measured torques of the rows, (rows, n)."""
        return np.concatenate([one.tau for one in self.recordings])

    @property
    def tau_predicted(self) -> Array:
        """Predicted torques of the rows, (rows, n)."""
        return np.concatenate([one.tau_predicted for one in self.recordings])

    @property
    def counts(self) -> Bools:
        """Mask of the rows in which the joint moves, as in rows of a fit, (rows, n)."""
        return np.concatenate([one.counts for one in self.recordings])

    @property
    def problem(self) -> Problem:
        """Problem of the first recording; all have the same robot, model and base parameters."""
        return self.recordings[0].problem

    @property
    def law(self) -> FoundLaw | None:
        """Control law that the first recording shows."""
        return self.solution.model.laws[self.solution.model.order[0]]

    @property
    def settings(self) -> Settings:
        """Settings of the first recording; all have the same cut-off and rate of rows."""
        return self.problem.settings

    @property
    def base(self) -> BaseParameters:
        """All base parameters of the robot."""
        return self.problem.base

    @property
    def essential_names(self) -> tuple[str, ...]:
        """Essential parameters whose 95 % interval is narrower than their value."""
        return self.data.essential

    @cached_property
    def full(self) -> Estimate:
        """Least squares of all base parameters."""
        return self._of_base(self.data.least_squares, self.data.least_squares.names)

    @property
    def beta(self) -> Array:
        """Values of all base parameters of the first recording, zero if left out, (b,)."""
        return self.estimate.values_of(self.recordings[0].names)

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks that do not affect the verdict.

        Examples are torque demand values sampled at a fixed phase of the control period, or an
        error of inertias that is not a delay.
        """
        texts = (
            ripple_notes(s.robot.bus, s.robot.controller.bandwidth_hz)
            for s in (one.signals for one in self.recordings)
            if s.of_drives and s.motion_hz is None
        )
        return tuple(dict.fromkeys(chain.from_iterable(texts)))

    @property
    def reference(self) -> Literal["recorded", "surrogate"]:
        """Kind of the reference; `surrogate` is the measured position.

        With the measured position, instruments are not strictly exogenous.
        """
        return "recorded" if self.solution.model.exogenous else "surrogate"

    @property
    def contrast(self) -> tuple[float, str]:
        """Largest difference between least squares and the estimate, and its parameter.

        The difference is in half-widths.
        """
        estimate, full = self.data.estimate, self.data.least_squares
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.abs(full.values_of(estimate.names) - estimate.beta) / self.data.intervals.half
        off = np.nan_to_num(np.where(np.isin(estimate.names, full.names), off, 0.0))
        return float(off.max()), estimate.names[int(off.argmax())]

    @property
    def held_out_error_percent(self) -> float | None:
        """Torque error of time blocks predicted by the others, percent."""
        return self.trust.line("cross-validation").value


def validated(problem: Problem, beta: Array) -> FitOnRecording:
    """Return the torque of base parameters (b,), with the payload, on a recording."""
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
    """Return the torque errors of all recordings together: one per joint and, last, all joints."""
    tau, predicted, counts = (
        np.concatenate([getattr(one, name) for one in recordings])
        for name in ("tau", "tau_predicted", "counts")
    )
    robot = recordings[0].signals.robot
    joints = zip((joint.name for joint in robot.joints), robot.effort_units, strict=True)
    return torque_errors(tau, predicted, counts, list(joints))


def first_ahead(recordings: Sequence[FitOnRecording]) -> Array | None:
    """Return how far the motion is predicted ahead in the first recording that shows it."""
    return next((one.ahead for one in recordings if one.ahead is not None), None)


def errors_ahead(problem: Problem, beta: Array) -> Array | None:
    """Predict the positions of a recording from base parameters (b,) and its recorded torque.

    Returns
    -------
    (2, h, n) : the rms over the starts of the error after each of `HORIZONS_S`, and of the way
        moved until then, rad or m; None if the recording is too short, M is not positive, or the
        motion grows without bounds.
    """
    s, fs = problem.settings, problem.signals.sample_rate_hz
    ahead = [max(1, round(x * fs)) for x in HORIZONS_S]
    span, measured = ahead[-1] + 1, problem.measured_samples()
    starts = [
        k for k in range(s.start, s.stop - span, max(1, span)) if measured[k : k + span].all()
    ]
    model = direct_model_of_base(problem.model, problem.base, beta)
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
