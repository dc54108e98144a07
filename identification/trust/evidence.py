"""What the tests of a fit are given, and the lines that they give."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from acquisition.robot import Robot

from ..arrays import Array, Bools, Ints
from ..control import FoundLaw
from ..estimation import Estimate, Intervals, r_factor
from ..regression import Arm, Lag, Problem, Rows
from ..report import Assumed, Level, Method, Verdict
from .candidates import Candidates

# worst first
LEVELS: tuple[Level, ...] = ("do not use", "caution", "cannot tell", "not made", "ok")
# name, value, half-width of the 95 % interval, expected value
Figure = tuple[str, float, float, float]


@dataclass(frozen=True)
class HeldOut:
    """A recording predicted by the fit of the others, in the rows that count.

    Attributes:
        error_percent: its torque error, in percent of its torque; None where the others do not
            determine the parameters, or it has no torque.
        undetermined: names of the parameters that the others do not determine.
    """

    error_percent: float | None
    undetermined: tuple[str, ...]


@dataclass(frozen=True)
class TrustLine:
    """One test of a fit.

    Attributes:
        test: its name, such as `lag`.
        level: `not made` where the test could not be made, `cannot tell` where it is inconclusive.
        text: one sentence with the figure, and what to do.
        value: its figure, None where there is none.
        finding: the same in a few words, for the first line of a report.
        figures: by joint, motor or block its name, value, half-width of the 95 % interval, and
            expected value, for a plot, in `unit`.
        fails_held_out, far: whether held-out errors are so large, or the nearest physical robot is
            so far, that another sign of it makes the fit one that is not to be used.
        assumed: what the test cannot check.
    """

    test: str
    level: Level
    text: str
    value: float | None = None
    finding: str = ""
    figures: tuple[Figure, ...] = ()
    unit: str = ""
    fails_held_out: bool = False
    far: bool = False
    assumed: tuple[Assumed, ...] = ()


# whether it holds, the level, the text, and a finding where there is one
Case = tuple[object, Level, str, *tuple[str, ...]]


def first_case(test: str, *cases: Case, value: float | None = None, **of: Any) -> TrustLine | None:
    """The line of a test by the first of its cases that holds; None where none does. `of` are
    further attributes of the line.
    """
    lines = (
        TrustLine(test, level, text, value, finding="".join(finding), **of)
        for holds, level, text, *finding in cases
        if holds
    )
    return next(lines, None)


def figures_of(
    names: Iterable[str],
    values: Iterable[float],
    half_widths: Iterable[float],
    expected: Iterable[float],
) -> tuple[Figure, ...]:
    """Rows of numbers for a plot, of columns."""
    return tuple(zip(names, *(map(float, x) for x in (values, half_widths, expected)), strict=True))


def worst_of(lines: Iterable[TrustLine | None]) -> TrustLine | None:
    """The first of the cautions, or of all, with the largest figure; None for no line."""
    made = filter(None, lines)
    return max(made, key=lambda x: (x.level == "caution", abs(x.value or 0.0)), default=None)


@dataclass(frozen=True, kw_only=True)
class Trust:
    """All tests of a fit, worst first, and the assumptions that no test covers.

    A test that was not made does not count.
    """

    lines: tuple[TrustLine, ...]
    assumed: tuple[Assumed, ...] = ()

    def line(self, test: str) -> TrustLine:
        """The line of a test."""
        return next(line for line in self.lines if line.test == test)

    @cached_property
    def verdict(self) -> Verdict:
        """The worst level."""
        worst = self.lines[0].level
        return worst if worst == "do not use" or worst == "caution" else "trust"

    @property
    def finding(self) -> str:
        """The worst finding in a few words; empty where there is none."""
        worst = self.lines[0]
        return "" if self.verdict == "trust" else worst.finding or worst.test


Part = Bools  # of the time: which spans, counted through all recordings


@dataclass(frozen=True, kw_only=True, eq=False)
class FitData:
    """An estimate and its data.

    Attributes:
        problems: the recordings, in the order of the rows, without samples where several are long;
            `laws`: the control law that each shows; `arms`: their parameters.
        observed: the rows of W and Y of all recordings about the estimate.
        fixed_point: whether the method ended in a fixed point; always true of least squares.
        unconfirmed: status and reason, where no simulation confirms the fixed point.
        by_reference: why the instruments are along the motion that the reference predicts; None
            where the robot is simulated.
        estimate: of the base parameters, or of the essential ones only.
        predicted: (rows, n) predicted torque, not weighted.
        least_squares: weighted least squares of all base parameters on the same recordings.
        candidates: terms that are not in the model, of the first recording.
        position_noise: whether position noise biases least squares; None for
            instrumental variables.
        lags: one per group of recordings of equal timing.
        essential: names of the parameters that the recordings determine well.
        held_out: whether blocks of time, or recordings, are predicted by the fit of the others;
            `by_others`: recordings so predicted, empty for blocks.
        prior, prior_source: a-priori base parameters of links, by name, of the
            `URDF` or `[parameters]`.
        prior_error_percent: held-out torque error of these links with all else fitted to the other
            blocks, or recordings.
    """

    problems: tuple[Problem, ...]
    laws: tuple[FoundLaw | None, ...]
    arms: tuple[Arm, ...]
    observed: Rows
    method: Method
    fixed_point: bool
    estimate: Estimate
    predicted: Array
    intervals: Intervals
    least_squares: Estimate
    candidates: Candidates
    first_stage_F: float | None = None
    unconfirmed: str | None = None
    by_reference: str | None = None
    position_noise: TrustLine | None = None
    lags: tuple[Lag, ...] = ()
    essential: tuple[str, ...] = ()
    held_out: TrustLine | None = None
    by_others: tuple[HeldOut, ...] = ()
    prior: dict[str, float] = field(default_factory=dict)
    prior_source: str = ""
    prior_error_percent: float | None = None

    @property
    def problem(self) -> Problem:
        """The first recording's: robot, model and base parameters are common to all."""
        return self.problems[0]

    @property
    def robot(self) -> Robot:
        """The robot as it is described."""
        return self.problem.signals.robot

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

    @property
    def by_recording(self) -> bool:
        """Whether recordings are held out, not blocks of time."""
        return len(self.names) > 1 and not self.gains

    @cached_property
    def lengths(self) -> Ints:
        """(S,) numbers of instants of the spans of time."""
        return np.concatenate([np.diff(own) for own in self.observed.system.spans])

    @property
    def ends(self) -> Ints:
        """The first instant of the recordings, and the end of each."""
        return np.cumsum([0, *(own[-1] for own in self.observed.system.spans)])

    def spans(self, count: int) -> list[Part]:
        """Equal parts of the time of the recordings together; of each recording, if a part alone
        must determine drive gains.
        """
        ends = self.ends if self.gains else self.ends[[0, -1]]
        cuts = ends[:-1] - -np.arange(count + 1)[:, None] * np.diff(ends) // count
        return [
            np.any([self.between(*both) for both in zip(*pair, strict=True)], axis=0)
            for pair in pairwise(cuts)
        ]

    def between(self, start: int, stop: int) -> Part:
        """The spans of time from an instant to before another, rounded to the nearest borders."""
        middle = np.cumsum(self.lengths) - 0.5 * self.lengths
        return (start <= middle) & (middle < stop)

    def instants(self, part: Part) -> Bools:
        """(T,) the instants of some spans of time."""
        return np.repeat(part, self.lengths)

    def count(self, part: Part) -> float:
        """Number of rows of some spans of time: the sum of the squares of their weights."""
        return float(np.sum(self.observed.share[self.instants(part)] ** 2))

    @property
    def Z(self) -> Array:
        """(r, p) instruments of all unknowns in the rows of W, which they are in least squares."""
        return self.observed.Z if self.observed.Z.size else self.observed.system.W

    @cached_property
    def weight(self) -> Array:
        """(r,) 1/s_j of the rows of the system."""
        return np.asarray(self.estimate.weights[self.observed.system.joint_of_row])

    @cached_property
    def places(self) -> Ints:
        """(b,) places of the estimated parameters in the system."""
        return np.array([self.observed.system.names.index(name) for name in self.estimate.names])

    @cached_property
    def W(self) -> Array:
        """(r, b) weighted columns of the estimated parameters."""
        return self.observed.system.W[:, self.places] * self.weight[:, None]

    @cached_property
    def Y(self) -> Array:
        """(r,) weighted torques."""
        return self.observed.system.Y * self.weight

    def factor(self, part: Part) -> Array:
        """R factor of the weighted rows [Z W Y] of some spans of time."""
        system, rows = self.observed.system, part[self.observed.system.span]
        at = np.ix_(rows, self.places)
        return r_factor(self.weight[rows, None] * np.c_[self.Z[at], system.W[at], system.Y[rows]])

    def error(self, part: Part, beta: Array) -> float:
        """|Y - W beta| of some spans of time, in the unit of the torque."""
        system, rows = self.observed.system, part[self.observed.system.span]
        return float(np.linalg.norm(system.Y[rows] - system.W[np.ix_(rows, self.places)] @ beta))
