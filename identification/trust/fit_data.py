"""Inputs of the trust tests."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import (
    Estimate,
    Intervals,
    Scores,
    Spans,
    scores_of_recordings,
    spans_of,
)
from ..regression import Arm, KnownLag, Problem, Rows, base_places
from ..report import Method
from .candidates import Candidates
from .lines import HeldOut, TrustLine

Part = NDArray[np.bool_]  # of the time: which spans, counted through all recordings


@dataclass(frozen=True, kw_only=True, eq=False)
class Lag:
    """The lag of the torque of recordings of equal timing, s, positive: late.

    Attributes:
        value_s, sd_s: the lag and its deviation, which the intervals include; half a 95 % interval
            is `reach` deviations.
        source: where the value comes from; `prior`: the lag as known without a fit.
        found: value, deviation and its degrees of freedom by the instruments alone; None where
            they do not determine it.
        delay_s: time from command to torque and half its interval, where the described
            controller was replayed.
        moved: (b,) shift of each parameter by one deviation of the lag.
        recordings: their names.
    """

    value_s: float
    sd_s: float
    reach: float
    source: str
    prior: KnownLag
    found: tuple[float, float, int] | None
    delay_s: tuple[float, float] | None = None
    moved: Array = field(default_factory=lambda: np.zeros(0))
    recordings: tuple[str, ...] = ()

    @property
    def half_width_s(self) -> float:
        """Half its 95 % interval."""
        return self.reach * self.sd_s


@dataclass(frozen=True, kw_only=True, eq=False)
class FitData:
    """An estimate and its data.

    Attributes:
        problems: the recordings, in the order of the rows, without samples where several are long;
            `arms`: their parameters.
        replays: by recording, the described control law against the recorded effort.
        observed: the rows of W and Y of all recordings about the estimate.
        fixed_point: whether the method ended in a fixed point; always true of least squares.
        unconfirmed: status and reason, where no simulation confirms the fixed point.
        by_reference: why the instruments are along the motion that the reference predicts; None
            where the robot is simulated.
        estimate: of the base parameters, or of the essential ones only.
        predicted: (rows, n) predicted torque, not weighted.
        least_squares: weighted least squares of all base parameters on the same recordings.
        candidates: terms that are not in the model, by recording.
        position_noise: whether position noise biases least squares; None for
            instrumental variables.
        lags: one per group of recordings of equal timing.
        essential: names of the parameters that the recordings determine well.
        held_out: blocks of time, or recordings, predicted by the fit of the others; empty
            where that is not made.
        prior, prior_source: a-priori base parameters of links, by name, of the
            `URDF` or `[parameters]`.
        prior_error_percent: held-out torque error of these links with all else fitted to the other
            blocks, or recordings.
    """

    problems: tuple[Problem, ...]
    arms: tuple[Arm, ...]
    replays: tuple[TrustLine, ...]
    observed: Rows
    method: Method
    fixed_point: bool
    estimate: Estimate
    predicted: Array
    intervals: Intervals
    least_squares: Estimate
    candidates: tuple[Candidates, ...] = ()
    first_stage_F: float | None = None
    unconfirmed: str | None = None
    by_reference: str | None = None
    position_noise: TrustLine | None = None
    lags: tuple[Lag, ...] = ()
    essential: tuple[str, ...] = ()
    held_out: tuple[HeldOut, ...] = ()
    prior: dict[str, float] = field(default_factory=dict)
    prior_source: str = ""
    prior_error_percent: float | None = None

    @property
    def problem(self) -> Problem:
        """The first recording's: robot, model and base parameters are common to all."""
        return self.problems[0]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the recordings."""
        return tuple(problem.signals.recording for problem in self.problems)

    @cached_property
    def gains(self) -> tuple[str, ...]:
        """Names of the estimated gains; one is 1 where the drive gain of the problem's robot
        is the identified one.
        """
        return tuple(name for name in self.estimate.names if name.startswith("K:"))

    @cached_property
    def base(self) -> NDArray[np.intp]:
        """Places of the base parameters in the estimate, which may have payloads and gains too."""
        return base_places(self.estimate.names)

    def spans(self, count: int) -> list[Part]:
        """Equal parts of the time of the recordings together; of each recording, if a part alone
        must determine drive gains.
        """
        parts = spans_of(self.observed.parts) if self.gains else [slice(0, len(self.observed.tau))]
        return [
            np.any([self.between(*_part(one, k, count)) for one in parts], axis=0)
            for k in range(count)
        ]

    def between(self, start: int, stop: int) -> Part:
        """The spans of time from an instant to before another, rounded to the nearest borders."""
        edges = np.concatenate([first + own.edges[:-1] for own, first in self._recordings])
        ends = np.concatenate([first + own.edges[1:] for own, first in self._recordings])
        low, high = (int(np.abs(np.r_[edges, ends[-1]] - at).argmin()) for at in (start, stop))
        return (np.arange(len(edges)) >= low) & (np.arange(len(edges)) < high)

    def instants(self, part: Part) -> NDArray[np.bool_]:
        """(T,) the instants of some spans of time."""
        return np.repeat(part, np.concatenate([np.diff(own.edges) for own, _ in self._recordings]))

    @property
    def Z(self) -> Array | None:
        """(r, p) instruments of all unknowns in the rows of W; None after least squares."""
        return self.observed.Z if self.observed.Z.size else None

    @cached_property
    def weight(self) -> Array:
        """(r,) 1/s_j of the rows of the system."""
        return np.asarray(self.estimate.weights[self.observed.system.joint_of_row])

    @cached_property
    def W(self) -> Array:
        """(r, b) weighted columns of the estimated parameters."""
        names = self.observed.system.names
        return (
            self.observed.system.W[:, [names.index(name) for name in self.estimate.names]]
            * self.weight[:, None]
        )

    @cached_property
    def Y(self) -> Array:
        """(r,) weighted torques; `rho`: residuals."""
        return self.observed.system.Y * self.weight

    @cached_property
    def rho(self) -> Array:
        """(r,) weighted residuals."""
        return self.Y - self.W @ self.estimate.beta

    def part(self, part: Part) -> tuple[Array, Array, Array, float]:
        """Q, W (r_k, b) and Y (r_k,) of some spans of time, and their number of rows: the sum of
        the squares of their weights.
        """
        rows = part[self.observed.system.span]
        share = self.observed.share[self.instants(part)]
        return self.estimate.Q[rows], self.W[rows], self.Y[rows], float(np.sum(share**2))

    def error(self, part: Part, beta: Array) -> float:
        """|Y - W beta| of some spans of time, in the unit of the torque."""
        _, W, Y, _ = self.part(part)
        weight = self.weight[part[self.observed.system.span]]
        return float(np.linalg.norm((Y - W @ beta) / weight))

    def scores(self, part: Part, beta: Array, bread: Array, basis: Array) -> list[Scores]:
        """Scores, by recording, of an estimate beta (b,) of some spans of time with the
        orthonormal columns Q `basis`.
        """
        rho, Q = self.Y - self.W @ beta, self.estimate.Q @ basis
        return scores_of_recordings(self.observed.system, Q, bread, rho, part)

    @cached_property
    def _recordings(self) -> list[tuple[Spans, int]]:
        """By recording its spans and its first instant."""
        starts = [part.start for part in spans_of(self.observed.parts)]
        return list(zip(self.observed.system.spans, starts, strict=True))


def _part(of: slice, k: int, count: int) -> tuple[int, int]:
    """Part k of `count` equal ones of some instants, its first and past its last, as spans end."""
    T = of.stop - of.start
    return of.start - (-k * T // count), of.start - (-(k + 1) * T // count)


def covariance_of_all(
    names: tuple[str, ...], estimate: Estimate, intervals: Intervals, full: Estimate
) -> Array:
    """C = D R D (b, b) of all base parameters; those that are not in the estimate are zero with
    the deviations of `full`.
    """
    variances = dict(zip(full.names, np.diag(full.covariance), strict=True))
    covariance = np.diag([variances.get(name, 0.0) for name in names])
    indices = np.array([names.index(name) for name in estimate.names])
    covariance[np.ix_(indices, indices)] = intervals.covariance
    return covariance
