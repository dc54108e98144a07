"""What the tests of a fit look at, computed on the way to the estimate; the lines that they give, and their verdict."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from ..arrays import Array
from ..data import PositionSteps
from ..estimation import BlockSums, Estimate, Intervals, Scores, System, scores_of_recordings, spans_of
from ..regression import NOTHING, Decimation, KnownLag, Motion, Problem, Regression, RowStates
from ..report import Assumed, Level, Method, Verdict

LEVELS: tuple[Level, ...] = ("do not use", "caution", "cannot tell", "not made", "ok")  # worst first
ILL_CONDITIONED = (
    "not made: the parameters of this long recording are too ill-conditioned; fit a part of it, or use --essential"
)
MAX_SUMS_ERROR = 1e-6  # of the products of orthonormal columns, by which sums of squares may be off


@dataclass(frozen=True, kw_only=True)
class Figure:
    """What a test found at one joint, motor or block of time: the value, half its 95 % interval, and the value expected."""

    name: str
    value: float
    half_width: float = 0.0
    expected: float = 0.0


@dataclass(frozen=True)
class TrustLine:
    """One test of a fit.

    Attributes:
        test: its name, such as `lag`.
        level: `not made` where the test could not be made, `cannot tell` where it says nothing either way.
        text: one sentence with the figure, and what to do.
        value: its figure, None where there is none.
        finding: the same in a few words, for the first line of a report.
        figures: its figures one by one, to be drawn, in `unit`.
        fails_held_out: whether held-out errors are so far above the trained ones that other doubts weigh more.
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
    """All tests of a fit, worst first, and what none of them tests. A test that was not made says nothing either way."""

    lines: tuple[TrustLine, ...]
    assumed: tuple[Assumed, ...] = ()

    def line(self, test: str) -> TrustLine:
        """That of a test."""
        return next(line for line in self.lines if line.test == test)

    @property
    def severe(self) -> tuple[str, ...]:
        """Why the result is not to be used, test by test; empty where it may be."""
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
    """A recording as a fit and its tests see it.

    Attributes:
        problem: without samples where rows are reduced and recordings are several.
        regression: its W and Y.
        poses: (P, n) positions at which the inertia matrix M is looked at.
        replay: the described control law against the recorded effort; `replay_lag` what that tells of the torque's lag.
        steps: of its positions, which tell of missing rows.
        t_s: (rows,) instants of its decimated rows, s.
        states: some rows and the motion at them, at which friction is looked at; None where it has the usual terms alone.
        parameters: (b,) names of its base parameters among those of the system, in the order of the base parameters.
        simulated: motion of the robot simulated in it, at a multiple of the rows' rate, with `decimation` to the rows.
        reference: of that: `surrogate` where the measured position stands in for it.
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
        """What is known of its torque's lag without an estimate."""
        known, replayed = self.problem.settings.known_lag, self.replay_lag
        if known.stated or replayed is None:
            return known
        return replayed if known.source == NOTHING else known.with_other(replayed)


@dataclass(frozen=True, kw_only=True, eq=False)
class Lag:
    """The lag of the torque of recordings alike, s, positive where it is late.

    Attributes:
        value_s, sd_s: what is corrected, and its deviation, which the intervals count; half a 95 % interval is `reach` of them.
        source: what it follows from; `prior`: what is known of it without a fit.
        found: value and deviation by the instruments alone, and the reach; None where they say nothing.
        delay_s: time from command to torque and half its interval, where the described controller could be replayed.
        moved: (b,) by how much one deviation of the lag moves each parameter.
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
    """An estimate and what it rests on.

    Attributes:
        recordings: in the order of the rows.
        observed: W and Y of all decimated rows; reduced to QR factors for long recordings.
        fixed_point: whether the method ended in one; always of least squares.
        unconfirmed: the status and its reason, where the method did not end in a fixed point that a simulation confirms.
        estimate: of the base parameters, fewer where only the essential ones were kept.
        predicted: (rows, n) torque that it predicts.
        used: (n rows,) samples that it rests on, joint by joint, 1 and 0: the rows of the system where these are not reduced.
        least_squares: weighted least squares of all base parameters on the same recordings.
        Z: (r, b) instruments of all base parameters in the rows of W, None after least squares.
        factors: where rows are reduced and recordings several, the reduced system and instruments of each.
        blocks: where rows are reduced, sums over the blocks of time of each recording.
        position_noise: whether noise of the position biases least squares; None of instrumental variables.
        beginning: where rows are reduced, the evidence of the beginning of the first recording, which has rows.
        lags: those of each group of recordings alike.
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
    factors: tuple[tuple[System, Array], ...] = ()
    blocks: tuple[BlockSums, ...] = ()
    position_noise: TrustLine | None = None
    beginning: "FitData | None" = None
    lags: tuple[Lag, ...] = ()
    essential: tuple[str, ...] = ()

    @property
    def problem(self) -> Problem:
        """That of the first recording: robot, model and base parameters are those of all."""
        return self.recordings[0].problem

    @property
    def with_rows(self) -> "FitData":
        """The evidence whose rows are held: that of a long recording's beginning."""
        return self.beginning or self

    @cached_property
    def rows(self) -> "WeightedRows":
        """W and Y of the parameters estimated, weighted as the estimate was; not for reduced rows."""
        system = self.observed.system.with_rows(self.used)
        system = system.with_columns(np.array([system.names.index(name) for name in self.estimate.names]))
        weight = self.estimate.weights[system.joint_of_row] * self.used
        W, Y = system.W * weight[:, None], system.Y * weight
        return WeightedRows(W=W, Y=Y, rho=Y - W @ self.estimate.beta, weight=weight)

    def sums(self, part: slice) -> "PartSums":
        """Sums over the rows of some instants of all recordings; of reduced rows over those blocks that are nearest."""
        part, estimate, n = self.aligned(part), self.estimate, self.observed.tau.shape[1]
        counts = part_of(self.used, n, part).reshape(n, -1).T
        rho, tau = (x[part] * counts for x in (self.observed.tau - self.predicted, self.observed.tau))
        sizes = float(np.sum(rho**2)), float(np.sum(tau**2))
        if self.blocks:
            each = [own.total for own in self._blocks(part)]
            QQ, QW, QY, WW, WY = (sum(arrays) for arrays in zip(*each, strict=True))
            W_rho = WY - WW @ estimate.beta
        else:
            rows = self.rows
            Q, W, Y, weight = (part_of(x, n, part) for x in (estimate.Q, rows.W, rows.Y, rows.weight))
            plain = W / np.where(weight > 0, weight, 1.0)[:, None]
            QQ, QW, QY, WW, W_rho = Q.T @ Q, Q.T @ W, Q.T @ Y, plain.T @ plain, plain.T @ rho.T.reshape(-1)
        return PartSums(
            QQ=QQ, QW=QW, QY=QY, WW=WW, W_rho=W_rho, rho_rho=sizes[0], tau_tau=sizes[1], rows=int(counts.sum())
        )

    def scores(self, part: slice, beta: Array, bread: Array, basis: Array) -> list[Scores]:
        """Scores, by recording, of an estimate beta (b,) of some instants that has the orthonormal columns Q `basis`."""
        part, n = self.aligned(part), self.observed.tau.shape[1]
        if self.blocks:
            return [own.scores(beta, bread, basis) for own in self._blocks(part) if len(own.QY)]
        rows = self.rows
        Q, W, Y = (part_of(x, n, part) for x in (self.estimate.Q, rows.W, rows.Y))
        instants = [last - first for first, last in self._within(part) if last > first]
        return scores_of_recordings(Q @ basis, bread, (Y - W @ beta).reshape(n, -1), instants)

    def aligned(self, part: slice) -> slice:
        """The instants of the blocks of time nearest to a part of the time; the part itself where rows are held."""
        if not self.blocks:
            return part
        starts = [whole.start for whole in spans_of(self.observed.parts)]
        edges = np.concatenate([start + own.edges for start, own in zip(starts, self.blocks, strict=True)])
        first, last = (int(edges[np.abs(edges - at).argmin()]) for at in (part.start, part.stop))
        return slice(first, last)

    @property
    def sums_accurate(self) -> bool:
        """Whether sums over blocks, of squares, still have the digits that tests need: Q'Q = 1 and Q'W bread = 1."""
        if not self.blocks:
            return True
        QQ, QW, *_ = (sum(arrays) for arrays in zip(*(own.total for own in self.blocks), strict=True))
        one = np.eye(len(self.estimate.beta))
        return bool(max(np.abs(QQ - one).max(), np.abs(QW @ self.estimate.bread - one).max()) < MAX_SUMS_ERROR)

    def _within(self, part: slice) -> list[tuple[int, int]]:
        """What a part of the time has of each recording: first and last instant, counted from the recording's start."""
        ends = [
            np.clip((part.start, part.stop), own.start, own.stop) - own.start for own in spans_of(self.observed.parts)
        ]
        return [(int(first), int(last)) for first, last in ends]

    def _blocks(self, part: slice) -> list[BlockSums]:
        return [own.between(*ends) for own, ends in zip(self.blocks, self._within(part), strict=True)]


@dataclass(frozen=True, kw_only=True, eq=False)
class WeightedRows:
    """Rows of the system, zero where they do not count: W (r, b), Y and rho (r,), and the `weight` (r,) they were given."""

    W: Array
    Y: Array
    rho: Array
    weight: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class PartSums:
    """Sums over the rows that count of a part of the time.

    Attributes:
        QQ, QW: (b, b) Q'Q and Q'W, `QY`: (b,) Q'Y, of the orthonormal columns Q and the weighted rows of the estimate.
        WW: (b, b) W'W, `W_rho`: (b,) W'rho, and `rho_rho`, `tau_tau` in the unit of the torque, rho left by the estimate.
        rows: how many count.
    """

    QQ: Array
    QW: Array
    QY: Array
    WW: Array
    W_rho: Array
    rho_rho: float
    tau_tau: float
    rows: int

    def error(self, off: Array) -> float:
        """|Y - W beta|² in the unit of the torque, of parameters that are `off` (b,) the estimate's."""
        return max(0.0, float(self.rho_rho - 2 * off @ self.W_rho + off @ self.WW @ off))


def part_of(x: Array, n: int, part: slice) -> Array:
    """Rows of a part of the time, of all joints: x (r, ...) -> (n T_k, ...)."""
    return np.asarray(x.reshape(n, -1, *x.shape[1:])[:, part].reshape(-1, *x.shape[1:]))


def covariance_of_all(names: tuple[str, ...], estimate: Estimate, intervals: Intervals, full: Estimate) -> Array:
    """C = D R D (b, b) of all base parameters: the formula's correlations with the intervals' deviations.

    Parameters that the estimate has not count as zero with the deviations of `full`, the least squares of all of them.
    """
    covariance = np.diag(np.diag(full.covariance))
    indices = np.array([names.index(name) for name in estimate.names])
    covariance[np.ix_(indices, indices)] = intervals.covariance
    return covariance
