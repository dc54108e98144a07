"""Inputs of the trust tests."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
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
    stacked_columns,
)
from ..regression import (
    Arm,
    KnownLag,
    MotionBlock,
    Problem,
    Rows,
    base_places,
    motion_of_block,
    row_blocks,
)
from ..report import Method
from .candidates import Candidates
from .lines import HeldOut, TrustLine

Span = tuple[slice, ...]  # of time: instants of the recordings in sequence


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
        observed: W and Y of all decimated rows about the estimate; QR factors for long recordings.
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

    def spans(self, count: int) -> list[Span]:
        """Equal spans of time of the recordings together; of each recording, if a span alone must
        determine drive gains.
        """
        parts = spans_of(self.observed.parts) if self.gains else [slice(0, len(self.observed.tau))]
        edges = [
            np.linspace(one.start, one.stop, count + 1).round().astype(int).tolist()
            for one in parts
        ]
        return [tuple(slice(own[k], own[k + 1]) for own in edges) for k in range(count)]

    @property
    def Z(self) -> Array | None:
        """(r, p) instruments of all unknowns in the rows of W; None after least squares."""
        return self.observed.Z if self.observed.Z.size else None

    @cached_property
    def weight(self) -> Array:
        """(r,) 1/s_j of the rows of the system, zero where they do not count."""
        return np.asarray(
            self.estimate.weights[self.observed.system.joint_of_row] * self.observed.system.used
        )

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

    def part(self, part: Span) -> tuple[Array, Array, Array, float]:
        """Q, W (r_k, b) and Y (r_k,) of a span of time, and its number of rows: the sum of the
        squares of their weights.
        """
        instants, rows = self.aligned(part)
        Q, W, Y = (
            part_of(x, self.observed.tau.shape[1], rows) for x in (self.estimate.Q, self.W, self.Y)
        )
        return Q, W, Y, float(np.sum(self.observed.share[instants] ** 2))

    def error(self, part: Span, beta: Array) -> float:
        """|Y - W beta| of a span of time, in the unit of the torque."""
        _, W, Y, _ = self.part(part)
        weight = part_of(self.weight, self.observed.tau.shape[1], self.aligned(part)[1])
        return float(np.linalg.norm((Y - W @ beta)[weight > 0] / weight[weight > 0]))

    def scores(self, part: Span, beta: Array, bread: Array, basis: Array) -> list[Scores]:
        """Scores, by recording, of an estimate beta (b,) of a span of time with the
        orthonormal columns Q `basis`.
        """
        Q, W, Y, _ = self.part(part)
        each = [
            own.between(self._rounded(one)[0], start) for one in part for own, start in self._spans
        ]
        rho = (Y - W @ beta).reshape(self.observed.tau.shape[1], -1)
        return scores_of_recordings(Q @ basis, bread, rho, [own for own in each if own.count])

    def aligned(self, part: Span) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The instants of a span of time, rounded to the nearest borders of the recordings' spans,
        and the rows of a joint.
        """
        each = zip(*map(self._rounded, part), strict=True)
        instants, rows = (
            np.concatenate([np.arange(one.start, one.stop) for one in slices]) for slices in each
        )
        return instants, rows

    def _rounded(self, part: slice) -> tuple[slice, slice]:
        edges = np.concatenate([start + own.edges for own, start in self._spans])
        rows = np.cumsum(
            np.concatenate([np.r_[0, np.full(own.count, own.rows)] for own, _ in self._spans])
        )
        first, last = (int(np.abs(edges - at).argmin()) for at in (part.start, part.stop))
        return slice(int(edges[first]), int(edges[last])), slice(int(rows[first]), int(rows[last]))

    @property
    def _spans(self) -> list[tuple[Spans, int]]:
        """By recording its spans and its first instant."""
        starts = [part.start for part in spans_of(self.observed.parts)]
        return list(zip(self.observed.system.spans, starts, strict=True))


def measured_motion(problem: Problem) -> MotionBlock:
    """The measured motion of a recording, in one block."""
    last = row_blocks(problem)[-1]
    return motion_of_block(problem, replace(last, first=0, low=0))


def further_columns(
    problems: Sequence[Problem], candidates: Sequence[Candidates], simulated: Sequence[MotionBlock]
) -> Array:
    """Columns (r, k + 1) of the candidates in the rows of the recordings: along the simulated
    motion, or the measured one.
    """
    found = list[Array]()
    for k, (problem, terms) in enumerate(zip(problems, candidates, strict=True)):
        motion = simulated[k] if simulated else measured_motion(problem)
        columns = terms.columns(problem, motion, motion.decimation)
        found.append(columns.transpose(0, 2, 1).reshape(-1, columns.shape[1]))
    return stacked_columns(found, problems[0].signals.robot.n)


def part_of(x: Array, n: int, part: slice | NDArray[np.intp]) -> Array:
    """Rows of a span of time, of all joints: x (r, ...) -> (n T_k, ...)."""
    return np.asarray(x.reshape(n, -1, *x.shape[1:])[:, part].reshape(-1, *x.shape[1:]))


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
