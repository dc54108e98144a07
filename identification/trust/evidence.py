"""What the tests of a fit look at: everything computed on the way to the estimate, so that nothing is simulated again."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from ..arrays import Array
from ..estimation import Estimate, Intervals, System
from ..passes import RowStates
from ..regression import Decimation, Motion, Problem, Regression
from .lines import TrustLine


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """What one recording brings to the evidence.

    Attributes:
        problem: recording, settings, model. The samples of long recordings may be left out.
        parameters: (b,) names of its base parameters among those of the system, in the order of the base parameters.
        slip_noise: (c,) noise of the speeds of the c directions of Coulomb friction.
        poses: (P, n) positions at which the inertia matrix M is looked at.
        replay: the described control law against the recorded effort.
        states: some rows and the motion at them, at which friction is looked at; None where it has the usual terms alone.
        simulated: motion of the robot simulated in the recorded experiment, at a multiple of the rows' rate, with
            `decimation` to the rows; None where there is none.
        reference: `recorded`, or `surrogate` where the measured position stands in; None where nothing was simulated.
    """

    problem: Problem
    parameters: tuple[str, ...]
    slip_noise: Array
    poses: Array
    replay: TrustLine
    states: RowStates | None = None
    simulated: Motion | None = None
    decimation: Decimation | None = None
    reference: Literal["recorded", "surrogate"] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Evidence:
    """An estimate and what it rests on.

    Attributes:
        parts: the recordings, in the order of the rows.
        observed: W and Y of all decimated rows; reduced to QR factors for long recordings.
        method: by which the estimate was found.
        fixed_point: whether the method ended in one; always of least squares.
        unconfirmed: the status and its reason, where the method did not end in a fixed point that a simulation confirms.
        estimate: of the base parameters, fewer where only the essential ones were kept.
        used: (r,) rows of the system that it rests on, 1 and 0.
        intervals: of the estimate's parameters.
        least_squares: weighted least squares of all base parameters on the same recordings.
        Z: (r, b) instruments of all base parameters in the rows of W, None after least squares.
        first_stage_F: of the instruments, None without.
        factors: where rows are reduced and recordings several, the reduced system and instruments of each.
    """

    parts: tuple[Part, ...]
    observed: Regression
    method: Literal["ols", "wls", "iv"]
    fixed_point: bool
    estimate: Estimate
    used: Array
    intervals: Intervals
    least_squares: Estimate
    Z: Array | None = None
    first_stage_F: float | None = None
    unconfirmed: str | None = None
    factors: tuple[tuple[System, Array], ...] = ()

    @property
    def problem(self) -> Problem:
        """That of the first recording: robot, model and base parameters are those of all."""
        return self.parts[0].problem

    @cached_property
    def rows(self) -> "WeightedRows":
        """W and Y of the parameters estimated, weighted as the estimate was; not for reduced rows."""
        system = self.observed.system.with_rows(self.used)
        system = system.with_columns(np.array([system.names.index(name) for name in self.estimate.names]))
        weight = self.estimate.weights[system.joint_of_row] * self.used
        W, Y = system.W * weight[:, None], system.Y * weight
        return WeightedRows(W=W, Y=Y, rho=Y - W @ self.estimate.beta, weight=weight)


@dataclass(frozen=True, kw_only=True, eq=False)
class WeightedRows:
    """Rows of the system, zero where they do not count: W (r, b), Y and rho (r,), and the `weight` (r,) they were given."""

    W: Array
    Y: Array
    rho: Array
    weight: Array


def covariance_of_all(names: tuple[str, ...], estimate: Estimate, intervals: Intervals, full: Estimate) -> Array:
    """C = D R D (b, b) of all base parameters: the formula's correlations with the intervals' deviations.

    Parameters that the estimate has not count as zero with the deviations of `full`, the least squares of all of them.
    """
    covariance = np.diag(np.diag(full.covariance))
    among = np.array([names.index(name) for name in estimate.names])
    covariance[np.ix_(among, among)] = intervals.covariance
    return covariance
