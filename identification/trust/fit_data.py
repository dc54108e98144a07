"""Inputs of the trust tests."""

from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np

from acquisition.robot import Robot

from ..arrays import Array, Bools, Ints
from ..estimation import Estimate, Intervals, r_factor
from ..regression import Arm, Lag, Problem, Rows
from ..report import Method
from .candidates import Candidates
from .lines import HeldOut, TrustLine

Part = Bools  # of the time: which spans, counted through all recordings


@dataclass(frozen=True, kw_only=True, eq=False)
class FitData:
    """An estimate and its data.

    Attributes:
        problems: the recordings, in the order of the rows, without samples where several are long;
            `arms`: their parameters.
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

    @cached_property
    def edges(self) -> Ints:
        """(S + 1,) the first instant of each span of time, and the end of the last."""
        of_recordings = [np.diff(own) for own in self.observed.system.spans]
        return np.cumsum(np.r_[0, np.concatenate(of_recordings)])

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
        low, high = (int(np.abs(self.edges - at).argmin()) for at in (start, stop))
        return np.isin(np.arange(len(self.edges) - 1), range(low, high))

    def instants(self, part: Part) -> Bools:
        """(T,) the instants of some spans of time."""
        return np.repeat(part, np.diff(self.edges))

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
        rows = part[self.observed.system.span]
        Z = self.Z[np.ix_(rows, self.places)] * self.weight[rows, None]
        return r_factor(np.c_[Z, self.W[rows], self.Y[rows]])

    def error(self, part: Part, beta: Array) -> float:
        """|Y - W beta| of some spans of time, in the unit of the torque."""
        rho = (self.Y - self.W @ beta) / self.weight
        return float(np.linalg.norm(rho[part[self.observed.system.span]]))
