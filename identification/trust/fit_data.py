"""Inputs of the trust tests."""

from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..data import PositionSteps
from ..estimation import Estimate, Intervals, Scores, Spans, scores_of_recordings, spans_of
from ..regression import (
    NOTHING,
    Decimation,
    KnownLag,
    Motion,
    Problem,
    RecordingParameters,
    Regression,
    RowStates,
    base_places,
)
from ..report import Method
from .lines import HeldOut, TrustLine

Span = slice | NDArray[np.intp]  # of time: instants of the recordings in sequence

NO_PARAMETERS = RecordingParameters(names=())  # until recordings are stacked


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordingData:
    """A recording of a fit, as its tests use it.

    Attributes:
        problem: without samples where rows are reduced and recordings are several.
        regression: its W and Y.
        poses: (P, n) positions at which the inertia matrix M is tested.
        replay: the described control law against the recorded effort; `replay_lag`: the lag of the torque by it.
        steps: of its positions, to find missing rows.
        t_s: (rows,) instants of its decimated rows, s.
        states: rows at which friction power is tested; None if there is viscous and Coulomb friction only.
        parameters: its base parameters in those of the system.
        simulated: simulated motion, at a multiple of the rows' rate, with `decimation` to the rows.
        reference: of the simulation; `surrogate`: the measured position replaces it.
    """

    problem: Problem
    regression: Regression
    poses: Array
    replay: TrustLine
    replay_lag: KnownLag | None
    steps: PositionSteps
    t_s: Array
    states: RowStates | None
    parameters: RecordingParameters = NO_PARAMETERS
    simulated: Motion | None = None
    decimation: Decimation | None = None
    reference: Literal["recorded", "surrogate"] | None = None

    @cached_property
    def known_lag(self) -> KnownLag:
        """The lag of its torque as known without an estimate."""
        known, replayed = self.problem.settings.known_lag, self.replay_lag
        if known.stated or replayed is None:
            return known
        return replayed if known.source == NOTHING else known.with_other(replayed)


@dataclass(frozen=True, kw_only=True, eq=False)
class Lag:
    """The lag of the torque of recordings of equal timing, s, positive: late.

    Attributes:
        value_s, sd_s: the lag and its deviation, which the intervals include; half a 95 % interval is `reach` deviations.
        source: where the value comes from; `prior`: the lag as known without a fit.
        found: value, deviation and reach by the instruments alone; None where they do not determine it.
        delay_s: time from command to torque and half its interval, where the described controller was replayed.
        moved: (b,) shift of each parameter by one deviation of the lag.
        recordings: their names.
    """

    value_s: float
    sd_s: float
    reach: float
    source: str
    prior: KnownLag
    found: tuple[float, float, float] | None
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
        recordings: in the order of the rows.
        observed: W and Y of all decimated rows about the estimate; QR factors for long recordings.
        fixed_point: whether the method ended in a fixed point; always true of least squares.
        unconfirmed: status and reason, where no simulation confirms the fixed point.
        estimate: of the base parameters, or of the essential ones only.
        predicted: (rows, n) predicted torque, not weighted.
        least_squares: weighted least squares of all base parameters on the same recordings.
        Z: (r, b) instruments of all base parameters in the rows of W, None after least squares.
        position_noise: whether position noise biases least squares; None for instrumental variables.
        beginning: where rows are reduced, the same data of the beginning of the first recording, with rows.
        lags: one per group of recordings of equal timing.
        essential: names of the parameters that the recordings determine well.
        held_out: blocks of time, or recordings, predicted by the fit of the others; empty where that is not made.
    """

    recordings: tuple[RecordingData, ...]
    observed: Regression
    method: Method
    fixed_point: bool
    estimate: Estimate
    predicted: Array
    intervals: Intervals
    least_squares: Estimate
    Z: Array | None = None
    first_stage_F: float | None = None
    unconfirmed: str | None = None
    position_noise: TrustLine | None = None
    beginning: "FitData | None" = None
    lags: tuple[Lag, ...] = ()
    essential: tuple[str, ...] = ()
    held_out: tuple[HeldOut, ...] = ()

    @property
    def problem(self) -> Problem:
        """The first recording's: robot, model and base parameters are common to all."""
        return self.recordings[0].problem

    @cached_property
    def gains(self) -> tuple[str, ...]:
        """Names of the estimated gains; one is 1 where the drive gain of the problem's robot is the identified one."""
        return tuple(name for name in self.estimate.names if name.startswith("K:"))

    @cached_property
    def base(self) -> NDArray[np.intp]:
        """Places of the base parameters in the estimate, which may have payloads and gains too."""
        return base_places(self.estimate.names)

    def spans(self, count: int) -> list["Span"]:
        """Equal spans of time of the recordings together; of each recording, if a span alone must tell drive gains."""
        parts = spans_of(self.observed.parts) if self.gains else [slice(0, len(self.observed.tau))]
        edges = [np.linspace(one.start, one.stop, count + 1).round().astype(int) for one in parts]
        if len(parts) == 1:
            return [slice(int(first), int(last)) for first, last in pairwise(edges[0])]
        return [np.concatenate([np.arange(own[k], own[k + 1]) for own in edges]) for k in range(count)]

    @property
    def with_rows(self) -> "FitData":
        """The data with rows: of a long recording its beginning."""
        return self.beginning or self

    @cached_property
    def rows(self) -> "WeightedRows":
        """W and Y of the estimated parameters, weighted as in the estimate."""
        system = self.observed.system
        system = system.with_columns(np.array([system.names.index(name) for name in self.estimate.names]))
        weight = self.estimate.weights[system.joint_of_row] * system.used
        W, Y = system.W * weight[:, None], system.Y * weight
        return WeightedRows(W=W, Y=Y, rho=Y - W @ self.estimate.beta, weight=weight)

    def sums(self, part: Span) -> "PartSums":
        """Sums over the rows of a span of time of all recordings."""
        estimate, n = self.estimate, self.observed.tau.shape[1]
        part, rows = self.aligned(part)
        weighted = (estimate.Q, self.rows.W, self.rows.Y, self.rows.rho, self.rows.weight)
        Q, W, Y, left, weight = (part_of(x, n, rows) for x in weighted)
        per_weight = np.divide(1.0, weight, out=np.zeros_like(weight), where=weight > 0)
        plain = W * per_weight[:, None]
        return PartSums(
            QQ=Q.T @ Q,
            QW=Q.T @ W,
            QY=Q.T @ Y,
            WW=plain.T @ plain,
            W_rho=plain.T @ (left * per_weight),
            rho_rho=float(np.sum((left * per_weight) ** 2)),
            rows=float(np.sum(self.observed.share[part] ** 2)),
        )

    def scores(self, part: Span, beta: Array, bread: Array, basis: Array) -> list[Scores]:
        """Scores, by recording, of an estimate beta (b,) of a span of time with the orthonormal columns Q `basis`."""
        n, (part, rows) = self.observed.tau.shape[1], self.aligned(part)
        Q, W, Y = (part_of(x, n, rows) for x in (self.estimate.Q, self.rows.W, self.rows.Y))
        if isinstance(part, slice):
            each = [own.between(part, start) for own, start in zip(self._spans, self._starts, strict=True)]
        else:
            counts = np.bincount(np.searchsorted(self._starts, part, side="right") - 1)
            each = [Spans(instants=int(count), count=int(count)) for count in counts]
        spans = [own for own in each if own.count]
        return scores_of_recordings(Q @ basis, bread, (Y - W @ beta).reshape(n, -1), spans)

    def aligned(self, part: Span) -> tuple[Span, Span]:
        """A span of time rounded to the nearest borders of the recordings' spans, and the rows of a joint in it."""
        if not isinstance(part, slice):
            return part, part
        each = list(zip(self._spans, self._starts, strict=True))
        edges = np.concatenate([start + own.edges for own, start in each])
        rows = np.cumsum(np.concatenate([np.r_[0, np.full(own.count, own.rows)] for own, _ in each]))
        first, last = (int(np.abs(edges - at).argmin()) for at in (part.start, part.stop))
        return slice(int(edges[first]), int(edges[last])), slice(int(rows[first]), int(rows[last]))

    @property
    def _spans(self) -> tuple[Spans, ...]:
        return self.observed.system.spans

    @property
    def _starts(self) -> list[int]:
        """The first instant of each recording."""
        return [part.start for part in spans_of(self.observed.parts)]


@dataclass(frozen=True, kw_only=True, eq=False)
class WeightedRows:
    """Rows of the system times 1/s_j, zero where they do not count: W (r, b), Y, rho and `weight` (r,)."""

    W: Array
    Y: Array
    rho: Array
    weight: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class PartSums:
    """Sums over the used rows of a span of time.

    Attributes:
        QQ, QW: (b, b) Q'Q and Q'W, `QY`: (b,) Q'Y, of the orthonormal columns Q and the weighted rows of the estimate.
        WW: (b, b) W'W, `W_rho`: (b,) W'rho, and `rho_rho` in the unit of the torque; rho is the residual.
        rows: number of rows, the sum of the squares of their weights.
    """

    QQ: Array
    QW: Array
    QY: Array
    WW: Array
    W_rho: Array
    rho_rho: float
    rows: float

    def error(self, difference: Array) -> float:
        """|Y - W beta|² in the unit of the torque, where beta differs from the estimate by `difference` (b,)."""
        return max(0.0, float(self.rho_rho - 2 * difference @ self.W_rho + difference @ self.WW @ difference))


def part_of(x: Array, n: int, part: Span) -> Array:
    """Rows of a span of time, of all joints: x (r, ...) -> (n T_k, ...)."""
    return np.asarray(x.reshape(n, -1, *x.shape[1:])[:, part].reshape(-1, *x.shape[1:]))


def covariance_of_all(names: tuple[str, ...], estimate: Estimate, intervals: Intervals, full: Estimate) -> Array:
    """C = D R D (b, b) of all base parameters: the formula's correlations with the intervals' deviations.

    Parameters that are not in the estimate are zero with the deviations of `full`, least squares of all parameters.
    """
    variances = dict(zip(full.names, np.diag(full.covariance), strict=True))
    covariance = np.diag([variances.get(name, 0.0) for name in names])
    indices = np.array([names.index(name) for name in estimate.names])
    covariance[np.ix_(indices, indices)] = intervals.covariance
    return covariance
