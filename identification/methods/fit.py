"""Results of an identification: the estimate, its settings, and its tests."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from acquisition.robot import ripple_notes

from ..arrays import Array, Bools
from ..estimation import Estimate, Intervals
from ..model import BaseParameters
from ..regression import Arm, Lag, Problem, Rows, Settings, base_places
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
)
from ..simulation import InstrumentKind, Simulated
from ..trust import FitData, HeldOut, Trust


def join_reasons(reasons: Sequence[tuple[str, str | None]]) -> str | None:
    """Return the reasons of recordings in one line, led by their names if there are several."""
    if len(reasons) == 1:
        return reasons[0][1]
    return "; ".join(f"{name}: {why}" for name, why in reasons if why is not None) or None


@dataclass(frozen=True, kw_only=True, eq=False)
class Pass:
    """One pass of the instrumental variable method, or least squares, from which passes start; only
    the last one keeps arrays as large as W.

    Attributes:
        x: (p,) values before it, with the lags found.
        rows: about x, with the instruments; `z`: by recording, the robot simulated for them.
        estimate: of the free unknowns, and its `intervals`.
        lags: found, with what is known.
        asked: values (p,) simulated, and their covariance (f, f), None for a regular start; None
            along the reference.
        about: whether the rows are about these lags, and the values simulated.
        change_sigma, change_percent, changed: largest change of a parameter in its deviations; in
            percent of those larger than two deviations; the parameter of the former.
        residual_percent: change of the residual norm by the pass, over the same rows.
        residual_settled, parameters_settled: whether the residual, and every parameter, changed
            less than the tolerance.
        number: counted from 1; least squares is 0.
        by_reference: why no simulated robot confirms others, so that its instruments, of kind
            `reference`, stand alone: one solution; None where they do not.
        failure: why the next pass gave no estimate; None if it did, or there was none.
        confirmed_by: by recording, the robot simulated with the estimate, or with the values that
            it settled at; only of the pass that is returned.
        tau_predicted: (rows, n) decimated torque of the estimate; of least squares alone.
    """

    x: Array
    rows: Rows | None
    estimate: Estimate
    intervals: Intervals
    parameters_settled: bool
    lags: tuple[Lag, ...]
    z: tuple[Simulated, ...] = ()
    asked: tuple[Array, Array | None] | None = None
    about: bool = False
    change_sigma: float = 0.0
    change_percent: float = 0.0
    changed: str = ""
    residual_percent: float = 0.0
    residual_settled: bool = False
    number: int = 0
    by_reference: str | None = None
    failure: str | None = None
    confirmed_by: tuple[Simulated, ...] = ()
    tau_predicted: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def without_rows(self) -> "Pass":
        """The same without arrays as large as W."""
        if self.rows is None:
            return self
        z = tuple(replace(one, motion=None, error=one.error[:0]) for one in self.z)
        estimate = self.estimate.without_rows()
        return replace(self, z=z, rows=None, estimate=estimate, confirmed_by=())

    @property
    def kind(self) -> InstrumentKind:
        """The kind of its instruments, as of `Simulated`: of several recordings the worst, which
        is the last.
        """
        return max((one.kind for one in self.z), key=get_args(InstrumentKind).index)

    @property
    def reason(self) -> str | None:
        """Why its instruments are not those of the robot asked; None if they are."""
        return self.by_reference or join_reasons([(one.recording, one.reason) for one in self.z])

    @property
    def gains(self) -> Array:
        """Factors on the controllers' gains, n for each recording."""
        return np.concatenate([one.gains for one in self.z])

    @property
    def tracking_percent(self) -> float | None:
        """The largest error of the simulated position; None if a robot was not simulated."""
        percents = [x for one in self.z if (x := one.percent) is not None]
        return max(percents) if len(percents) == len(self.z) else None

    @property
    def settled(self) -> bool:
        """Whether both tests hold."""
        return self.residual_settled and self.parameters_settled

    @property
    def is_last(self) -> bool:
        """Whether it and its lags settled, at the robot that was simulated."""
        return self.settled and self.about


def essential_names(essential: FTest, estimate: Estimate, found: Intervals) -> tuple[str, ...]:
    """The essential parameters of an estimate whose 95 % interval is narrower than their value."""
    at = base_places(estimate.names)
    at = at[found.half[at] < np.abs(estimate.beta[at])]
    return tuple(name for i in at if (name := estimate.names[i]) in essential.names)


@dataclass(frozen=True, kw_only=True, eq=False)
class FittedRecording:
    """One of the recordings of a fit.

    Attributes:
        problem: recording, settings and model; without samples if the recordings
            are too long to be held.
        arm: its base parameters in those of the fit.
        rows: its rows in those of `tau`.
        errors: its torque errors, one entry per joint and, last, all joints together.
        held_out: its torque predicted by the fit of the other recordings; None if there are none.
        simulated: the robot simulated in it with the estimate; None after least squares.
    """

    problem: Problem
    arm: Arm
    rows: slice
    errors: tuple[TorqueResidual, ...]
    held_out: HeldOut | None
    simulated: Simulated | None


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Fit:
    """Base parameters of a robot from one recording or several, with their tests.

    Attributes:
        recordings: in the order given.
        estimate: of the base parameters, fewer than `base` has if only the
            essential ones were requested.
        least_squares: that of the fit itself, or weighted least squares of the same recording and
            settings if the method is `iv`; `essential`: the essential parameters by it, and the
            test of leaving out the others.
        t_s: (rows,) instants of decimated rows in their recordings, s; recordings in the
            order of their digests. They are behind filters that depend on the motion only, those of
            the fit are in `data`.
        tau, tau_predicted: (rows, n) torques there; `counts`: whether the joint moves, as in rows
            of a fit.
        errors: of the rows that count, one entry per joint and, last, all joints together.
        passes: of the instrumental variable method, in order, from a `start` as of `Iteration`;
            none after least squares. `returned` is the number, counted from 1, of the one whose
            estimate this is.
        reason: of the status; None for `converged` with instruments of a simulated robot.
        controller: `described`, `found` in the recording, or `surrogate`: a PD of the bandwidth. Of
            several recordings the last of these that one of them has.
        strength: of the instruments, as of `estimation.first_stage`.
        saturated_percent: share of recorded samples at a drive's limit; None if no limit is stated.
        direct: errors of the direct model by joint; empty if the final estimate
            could not be simulated.
        consistent_set, standard_parameters: the nearest physically consistent parameters, if
            requested.
        data: the evidence: rows, estimate, instruments, and whatever else its tests looked at.
        gains: of the drives, if identified; `payloads`: the nearest bodies of positive density, in
            the frame of the last joint; without one near what is stated, or a ball.
        own: the test of parameters of single recordings; None if all are shared.
    """

    recordings: tuple[FittedRecording, ...]
    method: Method
    status: Status
    estimate: Estimate
    intervals: Intervals
    least_squares: Pass
    essential: FTest
    t_s: Array
    tau: Array
    tau_predicted: Array
    counts: Bools
    errors: tuple[TorqueResidual, ...]
    warnings: tuple[str, ...]
    trust: Trust
    data: FitData
    start: str = ""
    passes: tuple[Pass, ...] = ()
    returned: int = 0
    reason: str | None = None
    controller: Literal["described", "found", "surrogate"] | None = None
    strength: float = 1.0
    saturated_percent: float | None = None
    direct: tuple[DirectModelResidual, ...] = ()
    consistent_set: ConsistentFile | None = None
    standard_parameters: tuple[StandardParameter, ...] = ()
    own: FTest | None = None
    method_reason: str = "as requested"
    gains: tuple[DriveGain, ...] = ()
    payloads: tuple[PayloadOfFit, ...] = ()

    def on(self, one: FittedRecording) -> "Fit":
        """The fit restricted to one of its recordings: rows, errors and simulated robot."""
        names = ("t_s", "tau", "tau_predicted", "counts")
        rows = {name: getattr(self, name)[one.rows] for name in names}
        here = slice(0, one.rows.stop - one.rows.start)
        return replace(
            self,
            recordings=(replace(one, rows=here),),
            errors=one.errors,
            direct=one.simulated.by_joint if one.simulated else (),
            **rows,
        )

    @property
    def problem(self) -> Problem:
        """That of the first recording; all have the same robot, model and base parameters."""
        return self.recordings[0].problem

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
        """The essential parameters whose 95 % interval is narrower than their value."""
        return essential_names(self.essential, self.estimate, self.intervals)

    @property
    def full(self) -> Estimate:
        """Least squares of all base parameters, without those of payloads."""
        full = self.data.least_squares
        return full.part(base_places(full.names)) if self.payloads else full

    @property
    def beta(self) -> Array:
        """(b,) values of all base parameters, of the first recording; zero if left out."""
        return self.estimate.values_of(self.recordings[0].arm.names)

    @property
    def notes(self) -> tuple[str, ...]:
        """What is no fault: torque demands sampled at one phase of the control, an error of
        inertias that is no lag.
        """
        each = [one.problem.signals for one in self.recordings]
        robots = [s.robot for s in each if s.of_drives and s.motion_hz is None]
        return tuple(
            dict.fromkeys(
                text for r in robots for text in ripple_notes(r.bus, r.controller.bandwidth_hz)
            )
        )

    @property
    def reference(self) -> Literal["recorded", "surrogate"]:
        """`surrogate`: the measured position, with which instruments are not strictly exogenous."""
        given = all(one.problem.signals.q_ref is not None for one in self.recordings)
        return "recorded" if given else "surrogate"

    @property
    def rows_used_percent(self) -> float:
        """Share of the rows that count."""
        return float(100 * self.data.observed.counts.mean())

    @property
    def contrast(self) -> tuple[float, str]:
        """Largest difference of least squares from the estimate, in half-widths; its parameter."""
        estimate, full = self.data.estimate, self.data.least_squares
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.abs(full.values_of(estimate.names) - estimate.beta) / self.data.intervals.half
        off = np.nan_to_num(np.where(np.isin(estimate.names, full.names), off, 0.0))
        return float(off.max()), estimate.names[int(off.argmax())]

    @property
    def held_out_error_percent(self) -> float | None:
        """Torque error of blocks of time predicted by the others."""
        return self.trust.line("held-out blocks").value

    @property
    def distrust(self) -> tuple[str, ...]:
        """The tests whose level is `do not use`; empty if the result may be used."""
        return tuple(line.text for line in self.trust.lines if line.level == "do not use")
