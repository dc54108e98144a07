"""Inputs of the trust tests, their result lines, and the verdict."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from ..arrays import Array
from ..data import PositionSteps
from ..estimation import Estimate, Intervals, Scores, Spans, scores_of_recordings, spans_of
from ..regression import NOTHING, Decimation, KnownLag, Motion, Problem, Regression, RowStates
from ..report import Assumed, Level, Method, Verdict

LEVELS: tuple[Level, ...] = ("do not use", "caution", "cannot tell", "not made", "ok")  # worst first


@dataclass(frozen=True, kw_only=True)
class Figure:
    """The result of a test at one joint, motor or block of time: value, half-width of the 95 % interval, expected value."""

    name: str
    value: float
    half_width: float = 0.0
    expected: float = 0.0


@dataclass(frozen=True)
class TrustLine:
    """One test of a fit.

    Attributes:
        test: its name, such as `lag`.
        level: `not made` where the test could not be made, `cannot tell` where it is inconclusive.
        text: one sentence with the figure, and what to do.
        value: its figure, None where there is none.
        finding: the same in a few words, for the first line of a report.
        figures: figures by joint, motor or block, for a plot, in `unit`.
        fails_held_out: whether held-out errors are so large that, with M not positive, the fit is not to be used.
    """

    test: str
    level: Level
    text: str
    value: float | None = None
    finding: str = ""
    figures: tuple[Figure, ...] = ()
    unit: str = ""
    fails_held_out: bool = False


@dataclass(frozen=True, kw_only=True)
class Trust:
    """All tests of a fit, worst first, and the assumptions that no test covers. A test that was not made does not count."""

    lines: tuple[TrustLine, ...]
    assumed: tuple[Assumed, ...] = ()

    def line(self, test: str) -> TrustLine:
        """The line of a test."""
        return next(line for line in self.lines if line.test == test)

    @property
    def severe(self) -> tuple[str, ...]:
        """Texts of the tests that forbid using the result."""
        return tuple(line.text for line in self.lines if line.level == "do not use")

    @property
    def verdict(self) -> Verdict:
        """The worst level."""
        levels = {line.level for line in self.lines}
        return "do not use" if "do not use" in levels else "caution" if "caution" in levels else "trust"

    @property
    def finding(self) -> str:
        """The worst finding in a few words; empty where there is none."""
        worst = self.lines[0]
        return (worst.finding or worst.test) if worst.level in ("do not use", "caution") else ""


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
        parameters: (b,) names of its base parameters in the system, in the order of the base parameters.
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
    parameters: tuple[str, ...] = ()
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
        observed: W and Y of all decimated rows about the estimate, with its used rows; QR factors for long recordings.
        fixed_point: whether the method ended in a fixed point; always true of least squares.
        unconfirmed: status and reason, where no simulation confirms the fixed point.
        estimate: of the base parameters, or of the essential ones only.
        predicted: (rows, n) predicted torque.
        used: (n rows,) samples used, joint by joint, 1 and 0.
        least_squares: weighted least squares of all base parameters on the same recordings.
        Z: (r, b) instruments of all base parameters in the rows of W, None after least squares.
        position_noise: whether position noise biases least squares; None for instrumental variables.
        beginning: where rows are reduced, the same data of the beginning of the first recording, with rows.
        lags: one per group of recordings of equal timing.
        essential: names of the parameters that the recordings determine well.
    """

    recordings: tuple[RecordingData, ...]
    observed: Regression
    method: Method
    fixed_point: bool
    estimate: Estimate
    predicted: Array
    used: Array
    intervals: Intervals
    least_squares: Estimate
    Z: Array | None = None
    first_stage_F: float | None = None
    unconfirmed: str | None = None
    position_noise: TrustLine | None = None
    beginning: "FitData | None" = None
    lags: tuple[Lag, ...] = ()
    essential: tuple[str, ...] = ()

    @property
    def problem(self) -> Problem:
        """The first recording's: robot, model and base parameters are common to all."""
        return self.recordings[0].problem

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

    def sums(self, part: slice) -> "PartSums":
        """Sums over the rows of a span of time of all recordings."""
        estimate, n = self.estimate, self.observed.tau.shape[1]
        part, rows = self.aligned(part)
        counts = part_of(self.used, n, part).reshape(n, -1).T
        rho, tau = (x[part] * counts for x in (self.observed.tau - self.predicted, self.observed.tau))
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
            rho_rho=float(np.sum(rho**2)),
            tau_tau=float(np.sum(tau**2)),
            rows=int(counts.sum()),
        )

    def scores(self, part: slice, beta: Array, bread: Array, basis: Array) -> list[Scores]:
        """Scores, by recording, of an estimate beta (b,) of a span of time with the orthonormal columns Q `basis`."""
        n, (part, rows) = self.observed.tau.shape[1], self.aligned(part)
        Q, W, Y = (part_of(x, n, rows) for x in (self.estimate.Q, self.rows.W, self.rows.Y))
        each = [own.between(part, start) for own, start in zip(self._spans, self._starts, strict=True)]
        spans = [own for own in each if own.count]
        return scores_of_recordings(Q @ basis, bread, (Y - W @ beta).reshape(n, -1), spans)

    def aligned(self, part: slice) -> tuple[slice, slice]:
        """A span of time rounded to the nearest borders of the recordings' spans, and the rows of a joint in it."""
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
    """Weighted rows of the system, zero where unused: W (r, b), Y, rho and `weight` (r,)."""

    W: Array
    Y: Array
    rho: Array
    weight: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class PartSums:
    """Sums over the used rows of a span of time.

    Attributes:
        QQ, QW: (b, b) Q'Q and Q'W, `QY`: (b,) Q'Y, of the orthonormal columns Q and the weighted rows of the estimate.
        WW: (b, b) W'W, `W_rho`: (b,) W'rho, and `rho_rho`, `tau_tau` in the unit of the torque; rho is the residual.
        rows: number of used rows.
    """

    QQ: Array
    QW: Array
    QY: Array
    WW: Array
    W_rho: Array
    rho_rho: float
    tau_tau: float
    rows: int

    def error(self, difference: Array) -> float:
        """|Y - W beta|² in the unit of the torque, where beta differs from the estimate by `difference` (b,)."""
        return max(0.0, float(self.rho_rho - 2 * difference @ self.W_rho + difference @ self.WW @ difference))


def part_of(x: Array, n: int, part: slice) -> Array:
    """Rows of a span of time, of all joints: x (r, ...) -> (n T_k, ...)."""
    return np.asarray(x.reshape(n, -1, *x.shape[1:])[:, part].reshape(-1, *x.shape[1:]))


def covariance_of_all(names: tuple[str, ...], estimate: Estimate, intervals: Intervals, full: Estimate) -> Array:
    """C = D R D (b, b) of all base parameters: the formula's correlations with the intervals' deviations.

    Parameters that are not in the estimate are zero with the deviations of `full`, least squares of all parameters.
    """
    covariance = np.diag(np.diag(full.covariance))
    indices = np.array([names.index(name) for name in estimate.names])
    covariance[np.ix_(indices, indices)] = intervals.covariance
    return covariance
