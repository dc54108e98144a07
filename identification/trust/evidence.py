"""What the tests of a fit are given, and the lines that they give."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from acquisition.robot import Robot

from ..arrays import Array, Bools, Ints
from ..estimation import Estimate, Intervals, r_factor
from ..regression import Arm, Lag, Problem, Rows
from ..report import Assumed, Level, Method, TrustLine, Verdict, is_gain
from .candidates import Candidates

BY_PRIOR = "held-out blocks by the prior"
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
            `arms`: their parameters.
        observed: the rows of W and Y of all recordings about the estimate.
        estimate: of the base parameters, or of the essential ones only.
        predicted: (rows, n) predicted torque, not weighted.
        least_squares: weighted least squares of all base parameters on the same recordings.
        candidates: terms that are not in the model, of the first recording.
        lags: one per group of recordings of equal timing.
        essential: names of the parameters that the recordings determine well.
        made: lines of tests that were made with the solution and with its predictions, by test:
            `fixed point`, `control law`, `position noise`, `held-out blocks`; and `BY_PRIOR`, the
            same of the prior's links with all else fitted to the other blocks, or recordings.
        first_stage_F: how strong the instruments are; None for least squares.
    """

    problems: tuple[Problem, ...]
    arms: tuple[Arm, ...]
    observed: Rows
    method: Method
    estimate: Estimate
    predicted: Array
    intervals: Intervals
    least_squares: Estimate
    candidates: Candidates
    lags: tuple[Lag, ...]
    essential: tuple[str, ...]
    made: Mapping[str, TrustLine | None]
    first_stage_F: float | None = None

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
    def prior(self) -> dict[str, float]:
        """A-priori base parameters of links, by name; empty where drive gains are not known."""
        return self.candidates.prior[0] if self.robot.gain_known else {}

    @cached_property
    def prior_source(self) -> str:
        """Where they are from, `URDF` or `[parameters]`; empty for none."""
        return self.candidates.prior[1] if self.prior else ""

    @cached_property
    def prior_error_percent(self) -> float | None:
        """The torque error of these links, held out, with all else fitted."""
        return None if (line := self.made.get(BY_PRIOR)) is None else line.value

    @cached_property
    def ending(self) -> str:
        """How the method ended, as a case of the test `fixed point`."""
        return "" if (line := self.made.get("fixed point")) is None else line.case

    @cached_property
    def gains(self) -> tuple[str, ...]:
        """Names of the estimated gains; one is 1 where the drive gain of the problem's robot
        is the identified one.
        """
        return tuple(filter(is_gain, self.estimate.names))

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
