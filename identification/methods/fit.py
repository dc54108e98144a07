"""What an identification gives: an estimate, the settings it was made with, and the evidence for and against it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import Estimate, InstrumentTests, Intervals, Reduction
from ..model import BaseParameters
from ..regression import Motion, Problem, RowStates, Settings
from ..report import FTest, Method, Status, TorqueError
from ..simulation import DirectModelError, Instruments, Replica
from ..trust import HeldOut, Lag, Trust


@dataclass(frozen=True, kw_only=True, eq=False)
class Pass:
    """One pass of the instrumental variable method, without what is as large as W but of the last one.

    Attributes:
        z: its instruments. Their `kind`: along the robot `simulated` with the physically consistent parameters nearest to the
            estimate before; named `consistent` where the inertia matrix of that estimate itself is not positive; along the
            `reference` where the simulated robot leaves it. `reason` says why it is one of the last two.
        asked, covariance: (b, b) of all base parameters, with honest deviations: that the instruments were asked for with,
            None of a regular start, and that of the estimate.
        coarse: whether the robot was simulated coarsely.
        change_sigma, change_percent, changed: largest change of a parameter in its deviations, and in percent of itself
            among those larger than two deviations; the parameter of the former.
        residual_percent: change of the residual norm by the pass, over the same rows.
        residual_settled, parameters_settled: whether the residual, and every parameter, changed less than the tolerance.
        number: counted from 1.
        failure: why the pass after it gave no estimate; None where it did, or there was none.
        replicas: the robot simulated with the estimate in each recording; of the pass that is returned alone.
    """

    z: Instruments
    estimate: Estimate
    asked: Array | None
    covariance: Array
    change_sigma: float
    change_percent: float
    changed: str
    residual_percent: float
    residual_settled: bool
    parameters_settled: bool
    coarse: bool = False
    number: int = 1
    failure: str | None = None
    replicas: tuple[Replica, ...] = ()

    def without_rows(self) -> "Pass":
        """The same without what is as large as W: only the last pass needs that."""
        return replace(self, z=self.z.without_rows(), estimate=self.estimate.without_rows(), replicas=())

    @property
    def settled(self) -> bool:
        """Whether both tests hold."""
        return self.residual_settled and self.parameters_settled

    @property
    def is_last(self) -> bool:
        """Whether it is a fixed point of instruments that are not coarse."""
        return self.settled and not self.coarse


@dataclass(frozen=True, kw_only=True, eq=False)
class InstrumentEvidence:
    """What the instrumental variable method adds to a fit.

    Attributes:
        start: as of `Iteration`.
        reference: `recorded`, or `surrogate` where the measured position stands in, which leaves the instruments not
            strictly exogenous. `controller`: `described`, or `surrogate` for a PD of the stated bandwidth.
        passes: one by one; `returned` is the number of the one whose estimate this is, counted from 1.
        reason: why the status is what it is, None for `converged`.
        contrast, contrast_at: least squares off the estimate, in half-widths of the parameter that is furthest off.
        saturated_percent: share of recorded samples at a drive's limit, None where no limit is stated.
        direct: the direct model's errors by joint, empty where the final estimate could not be simulated.
        simulated, q: the simulated motion with the final estimate and the measured position at its instants.
    """

    start: str
    reference: Literal["recorded", "surrogate"]
    controller: Literal["described", "surrogate"]
    passes: tuple[Pass, ...]
    returned: int
    reason: str | None
    tests: InstrumentTests
    contrast: float
    contrast_at: str
    rows_used_percent: float
    saturated_percent: float | None
    direct: tuple[DirectModelError, ...]
    simulated: Motion | None
    q: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class LeastSquares:
    """Least squares of a recording, as every fit has it.

    Attributes:
        estimate: `full`, or that of the essential parameters where only these were asked for.
        full, essential: that of all base parameters, and the reduction to the essential ones.
        tau_predicted: (rows, n) decimated torque that `estimate` predicts.
    """

    estimate: Estimate
    intervals: Intervals
    full: Estimate
    essential: Reduction
    tau_predicted: Array

    def without_rows(self) -> "LeastSquares":
        """The same without the estimates' Q, each as large as W."""
        essential = replace(self.essential, estimate=self.essential.estimate.without_rows())
        return replace(self, estimate=self.estimate.without_rows(), full=self.full.without_rows(), essential=essential)


def essential_names(essential: Reduction, estimate: Estimate, found: Intervals) -> tuple[str, ...]:
    """The essential parameters of an estimate whose 95 % interval is narrower than their value."""
    kept, narrow = set(essential.estimate.names), found.half < np.abs(estimate.beta)
    return tuple(name for name, n in zip(estimate.names, narrow, strict=True) if n and name in kept)


@dataclass(frozen=True, kw_only=True, eq=False)
class ConsistentSet:
    """The physically consistent standard parameters nearest to an estimate.

    Attributes:
        chi: (p,) standard parameters: each link's pseudo-inertia and every rotor inertia is positive, friction feeds no energy.
        half: (p,) half-widths of their 95 % intervals, by Laplace.
        from_prior: (p,) which of them come from the prior: their variance is above half of the one that it alone gives.
        base_names, beta, base_half, base_from_prior: (b,) the same of the base parameters K chi; their move is in it.
        prior: what was expected of the links, in words.
        chi_squared: distance of the estimate, (beta - estimate)' C⁻¹ (beta - estimate), C = D R D.
        deviations: (b,) moves of the base parameters in deviations of the estimate.
        reach: deviations in half a 95 % interval of the estimate.
        certificate: Newton decrement at the optimum.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    chi: Array
    half: Array
    from_prior: NDArray[np.bool_]
    base_names: tuple[str, ...]
    beta: Array
    base_half: Array
    base_from_prior: NDArray[np.bool_]
    prior: str
    chi_squared: float
    deviations: Array
    reach: float
    certificate: float

    @property
    def moves(self) -> Array:
        """(b,) by how many half-widths of the estimate's 95 % intervals the base parameters moved: beyond 1 they left these."""
        return self.deviations / self.reach

    @property
    def moved_most(self) -> str:
        """The base parameter that moved most."""
        return self.base_names[int(np.abs(self.deviations).argmax())]

    @property
    def largest_move(self) -> float:
        """By how many half-widths of its 95 % interval that parameter moved."""
        return float(np.abs(self.moves).max())


@dataclass(frozen=True, kw_only=True, eq=False)
class FittedRecording:
    """One of the recordings of a fit.

    Attributes:
        problem: recording, settings and model; without samples where several recordings are too long to be held.
        parameters: (b,) names of its base parameters among those of the fit.
        rows: its decimated samples among those of the fit.
        errors: that the fit leaves on it, one entry per joint and, last, all joints together.
        held_out: its torque predicted by the fit of the other recordings; None where there are none.
        replica: the robot simulated in it with the estimate; None after least squares.
        states: some rows and the motion at them, at which friction is looked at; None where it has the usual terms alone.
    """

    problem: Problem
    parameters: tuple[str, ...]
    rows: slice
    errors: tuple[TorqueError, ...]
    held_out: HeldOut | None
    replica: Replica | None
    states: RowStates | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """Base parameters of a robot from one recording or several, and the evidence for them.

    Attributes:
        recordings: in the order given.
        estimate: of the base parameters, fewer than `base` has when only the essential ones were kept.
        least_squares: least squares of the same recording and settings; that of the fit itself, or weighted least squares
            beside instrumental variables.
        t_s: (rows,) instants of the decimated rows in their recordings, s; recordings in the order of their digests.
        tau, tau_predicted, speed: (rows, n) torques and joint speeds there.
        errors: one entry per joint and, last, all joints together.
        iv: None after least squares.
        consistent: the nearest physically consistent parameters, where asked for, and `consistent_errors`: their torque errors,
            as `errors`.
        lags: of the recordings' torques, corrected and counted in the intervals.
        own: the test of the parameters that recordings have for themselves; None where they share all.
    """

    recordings: tuple[FittedRecording, ...]
    method: Method
    status: Status
    estimate: Estimate
    intervals: Intervals
    least_squares: LeastSquares
    t_s: Array
    tau: Array
    tau_predicted: Array
    speed: Array
    errors: tuple[TorqueError, ...]
    warnings: tuple[str, ...]
    trust: Trust
    iv: InstrumentEvidence | None = None
    consistent: ConsistentSet | None = None
    consistent_errors: tuple[TorqueError, ...] = ()
    own: FTest | None = None
    method_reason: str = "asked for"
    lags: tuple[Lag, ...] = ()
    _repr_html_: ClassVar[Callable[["Fit"], str]]  # bound in `identification.notebook`: the report is a room above

    def on(self, one: FittedRecording) -> "Fit":
        """The fit as one of its recordings shows it: rows, errors and simulated motion of that one."""
        iv = self.iv
        if iv is not None and one.replica is not None:
            iv = replace(iv, simulated=one.replica.motion, q=one.replica.q, direct=one.replica.direct)
        rows = {name: getattr(self, name)[one.rows] for name in ("t_s", "tau", "tau_predicted", "speed")}
        here = slice(0, one.rows.stop - one.rows.start)
        return replace(self, recordings=(replace(one, rows=here),), errors=one.errors, iv=iv, **rows)

    @property
    def problem(self) -> Problem:
        """That of the first recording: robot, model and base parameters are those of all."""
        return self.recordings[0].problem

    @property
    def settings(self) -> Settings:
        """What the fit did with the first recording; cut-off and rate of rows are common to all."""
        return self.problem.settings

    @property
    def base(self) -> BaseParameters:
        """All base parameters of the robot."""
        return self.problem.base

    @property
    def essential(self) -> Reduction:
        """The essential parameters, by least squares."""
        return self.least_squares.essential

    @property
    def essential_names(self) -> tuple[str, ...]:
        """Those of the essential parameters whose 95 % interval is narrower than their value."""
        return essential_names(self.essential, self.estimate, self.intervals)

    @property
    def widest_essential_percent(self) -> float | None:
        """The widest interval among the essential parameters, half of it in percent of the value; None where there are none."""
        with np.errstate(divide="ignore", invalid="ignore"):
            percent = 100 * self.intervals.half / np.abs(self.estimate.beta)
        essential = set(self.essential_names)
        return max(
            (float(p) for name, p in zip(self.estimate.names, percent, strict=True) if name in essential), default=None
        )

    @property
    def beta(self) -> Array:
        """(b,) values of all base parameters, of the first recording; zero where one was left out."""
        return self.estimate.values_of(self.recordings[0].parameters)

    @property
    def distrust(self) -> tuple[str, ...]:
        """Why the result is not to be trusted: the tests whose level is `do not use`. Empty where it may be."""
        return self.trust.severe

    def __repr__(self) -> str:
        essential, error = len(self.essential_names), self.errors[-1].moving_relative_error_percent
        moving = "nothing moves" if error is None else f"moving error {error:.3g} %"
        names = ", ".join(one.problem.signals.recording for one in self.recordings)
        made = f"{self.problem.signals.robot.name}, {names}, {self.method}, {self.status}"
        return f"Fit({made}: {len(self.beta)} parameters, {essential} essential, {moving})"
