"""Inputs of a test of a fit, and its results: its row with all its words.

A test is a function that finds which of its cases holds, and the figures. All words stand in its
row, below it, as templates of these figures: the terminal, the report and the JSON print the case
that holds, and the guide has a table of the rows. A row also has parts of texts. A part stands in
a text, or in a later part, where its name stands in braces; where the test says that it does not
hold, nothing stands there. `WORDS` in `verdict` has the rows of all tests.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import cast

import numpy as np

from acquisition.robot import Robot

from ..arrays import Array, Bools, Ints
from ..estimation import Estimate, Intervals, r_factor
from ..regression import Arm, Lag, Problem, Rows
from ..report import Assumed, Cause, Level, Method, TrustResult, is_gain
from .candidates import Candidates

BY_PRIOR = "held-out blocks by the prior"
# The order is worst first, because the first level of a fit is its verdict.
LEVELS: tuple[Level, ...] = ("do not use", "caution", "inconclusive", "skipped", "ok")
# A figure is a name, a value, the half-width of its 95 % interval, and the expected value.
Figure = tuple[str, float, float, float]


def figures_of(
    names: Iterable[str],
    values: Iterable[float],
    half_widths: Iterable[float],
    expected: Iterable[float],
) -> tuple[Figure, ...]:
    """Return rows of numbers for a plot from columns."""
    return tuple(zip(names, *(map(float, x) for x in (values, half_widths, expected)), strict=True))


def worst_of(lines: Iterable[TrustResult | None]) -> TrustResult | None:
    """Return the first caution, or the first result, with the largest figure.

    The result is None if `lines` has no results.
    """
    return max(
        filter(None, lines),
        key=lambda x: (x.level == "caution", abs(x.value or 0.0)),
        default=None,
    )


Part = Bools  # of the time: which spans, counted through all recordings


@dataclass(frozen=True, kw_only=True, eq=False)
class TrustInputs:
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
            `convergence`, `control law`, `noise bias`, `cross-validation`; and `BY_PRIOR`, the
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
    made: Mapping[str, TrustResult | None]
    first_stage_F: float | None = None

    @property
    def problem(self) -> Problem:
        """The first recording's problem: robot, model and base parameters are common to all."""
        return self.problems[0]

    @property
    def robot(self) -> Robot:
        """The robot as described."""
        return self.problem.signals.robot

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the recordings."""
        return tuple(problem.signals.recording for problem in self.problems)

    @cached_property
    def prior(self) -> dict[str, float]:
        """A priori base parameters of links, by name; empty if drive gains are not known."""
        return self.candidates.prior[0] if self.robot.gain_known else {}

    @cached_property
    def prior_source(self) -> str:
        """Source of the a priori parameters, `URDF` or `[parameters]`; empty for none."""
        return self.candidates.prior[1] if self.prior else ""

    @cached_property
    def prior_error_percent(self) -> float | None:
        """Held-out torque error of the a priori links, with everything else fitted."""
        return None if (line := self.made.get(BY_PRIOR)) is None else line.value

    @cached_property
    def ending(self) -> str:
        """How the method ended, as a case of the test of convergence."""
        return "" if (line := self.made.get("convergence")) is None else line.case

    @cached_property
    def gains(self) -> tuple[str, ...]:
        """Names of the estimated drive gains; a value of 1 confirms the drive gain of the robot."""
        return tuple(filter(is_gain, self.estimate.names))

    @property
    def by_recording(self) -> bool:
        """True if recordings are held out, not time blocks."""
        return len(self.names) > 1 and not self.gains

    @cached_property
    def lengths(self) -> Ints:
        """Numbers of instants of the time blocks, (S,)."""
        return np.concatenate([np.diff(own) for own in self.observed.system.spans])

    @cached_property
    def middles(self) -> Array:
        """Instants in the middle of the time blocks, (S,)."""
        return np.cumsum(self.lengths) - 0.5 * self.lengths

    @property
    def ends(self) -> Ints:
        """First instant of the recordings, and the end of each."""
        return np.cumsum([0, *(own[-1] for own in self.observed.system.spans)])

    def spans(self, count: int) -> list[Part]:
        """Divide the time of all recordings into `count` equal parts.

        Each recording is divided by itself if a part alone must determine drive gains.
        """
        ends = self.ends if self.gains else self.ends[[0, -1]]
        cuts = ends[:-1] - -np.arange(count + 1)[:, None] * np.diff(ends) // count
        return [
            np.any([self.between(*both) for both in zip(*pair, strict=True)], axis=0)
            for pair in pairwise(cuts)
        ]

    def between(self, start: int, stop: int) -> Part:
        """Return the time blocks from one instant to before another.

        The instants are rounded to the nearest borders.
        """
        return (start <= self.middles) & (self.middles < stop)

    def count(self, part: Part) -> float:
        """Return the number of rows in some time blocks.

        This is the sum of the squares of their weights.
        """
        return float(np.sum(self.observed.share[np.repeat(part, self.lengths)] ** 2))

    @property
    def Z(self) -> Array:
        """Instruments of all unknowns in the rows of W, (r, p); W itself for least squares."""
        return self.observed.Z if self.observed.Z.size else self.observed.system.W

    @cached_property
    def weight(self) -> Array:
        """Weights 1/s_j of the rows of the system, (r,)."""
        return np.asarray(self.estimate.weights[self.observed.system.joint_of_row])

    @cached_property
    def places(self) -> Ints:
        """Indices of the estimated parameters in the system, (b,)."""
        return np.array([self.observed.system.names.index(name) for name in self.estimate.names])

    @cached_property
    def W(self) -> Array:
        """Weighted columns of the estimated parameters, (r, b)."""
        return self.observed.system.W[:, self.places] * self.weight[:, None]

    @cached_property
    def Y(self) -> Array:
        """Weighted torques, (r,)."""
        return self.observed.system.Y * self.weight

    def factor(self, part: Part) -> Array:
        """Return the R factor of the weighted rows [Z W Y] of some time blocks."""
        system, rows = self.observed.system, part[self.observed.system.span]
        at = np.ix_(rows, self.places)
        return r_factor(self.weight[rows, None] * np.c_[self.Z[at], system.W[at], system.Y[rows]])

    def error(self, part: Part, beta: Array) -> float:
        """Return |Y - W beta| of some time blocks, in the unit of the torque."""
        system, rows = self.observed.system, part[self.observed.system.span]
        return float(np.linalg.norm(system.Y[rows] - system.W[np.ix_(rows, self.places)] @ beta))


@dataclass(frozen=True)
class Case:
    """One outcome of a test.

    It is a sentence with its figures, what to do, and the finding in a few words.
    """

    level: Level
    text: str
    advice: str = ""
    finding: str = ""


@dataclass(frozen=True, kw_only=True)
class Words:
    """The row of a test: its function and all its texts.

    Attributes:
        test: its name.
        place: the order among results of the same level.
        by: the function that returns the result, None where the test does not apply. Without it,
            the result is made with the solution or with its predictions.
        of_data: True if it tests the recording, not the estimate: the guide begins with these.
        detects, limit, advice: for the guide, what it detects, its limits, and what to do.
        cases: its outcomes, by name.
        parts: parts of the texts of its cases.
        unit: the unit of its figures by joint, motor or block.
    """

    test: str
    place: int
    by: Callable[[TrustInputs], TrustResult | None] | None = None
    of_data: bool = False
    advice: str
    detects: str
    limit: str
    cases: Mapping[str, Case]
    parts: Mapping[str, str] = field(default_factory=dict)
    unit: str = ""

    def line(self, evidence: TrustInputs) -> TrustResult | None:
        """Return the result of a fit."""
        return self.by(evidence) if self.by else evidence.made.get(self.test)

    def judge(
        self,
        cases: Mapping[str, object],
        *,
        value: float | None = None,
        expected: float | None = None,
        figures: tuple[Figure, ...] = (),
        assumed: tuple[Assumed, ...] = (),
        **said: object,
    ) -> TrustResult | None:
        """Return the result of the first case that holds; None if none does.

        `cases`: by name whether they hold. `figures`: the figures of their texts, and which parts
        hold; `causes` among them are those of the result.
        """
        name = next((name for name, holds in cases.items() if holds), None)
        if name is None:
            return None
        case, said = self.cases[name], {"value": value, **said}
        text, advice, finding = (
            written(text, self.parts, said) for text in (case.text, case.advice, case.finding)
        )
        return TrustResult(
            test=self.test,
            level=case.level,
            text=text,
            advice=advice,
            value=value,
            expected=expected,
            finding=finding,
            figures=figures,
            unit=self.unit,
            case=name,
            assumed=assumed,
            causes=cast(tuple[Cause, ...], said.get("causes", ())),
        )

    def part(self, part: str, **said: object) -> str:
        """Return a part of the texts."""
        return written(f"{{{part}}}", self.parts, said)


@dataclass(frozen=True)
class Assumption:
    """The row of an assumption: its value, why no test confirms it, and parts of these texts."""

    value: str
    why: str
    parts: Mapping[str, str] = field(default_factory=dict)


def written(text: str, parts: Mapping[str, str], said: Mapping[str, object]) -> str:
    """Fill in a template with the parts that hold."""
    for name, part in reversed([*parts.items()]):
        text = text.replace(f"{{{name}}}", part if said.get(name, True) else "")
    return text.format(**said)


def assume(what: str, **said: object) -> Assumed:
    """Return an assumption with its figures filled in."""
    row = ASSUMPTIONS[what]
    value, why = (written(text, row.parts, said) for text in (row.value, row.why))
    return Assumed(what, value, why)


ASSUMPTIONS: Mapping[str, Assumption] = {
    "payload": Assumption(
        "{payload}",
        "{scales}{taken_off}{both}{always}",
        {
            "scales": "drive gains and all parameters scale with its mass",
            "exact": ", as if it were exact, because its mass has no half-width",
            "taken_off": "it is subtracted from the arm{exact}",
            "both": "; ",
            "always": "no recording is without payload, so the parameters include what is not "
            "given of the lightest",
        },
    ),
    "drive gains": Assumption(
        "{gains}{recorded}",
        "a wrong gain scales all parameters, and fits equally well{common}",
        {
            "recorded": "torques recorded in {units}",
            "common": " if it is common to all joints",
        },
    ),
    "efforts": Assumption(
        "the whole torque of each motor",
        "a torque that a drive adds after the recorded effort, such as friction or gravity, cannot "
        "be seen",
    ),
    "per-recording parameters": Assumption(
        "their mean elsewhere",
        "other recordings are validated with the mean over these recordings",
    ),
    "gear ratios": Assumption("{ratios}", "joint positions and torques are computed with them"),
    "link lengths": Assumption("{lengths}", "link parameters absorb an error of a length"),
    "sample rate": Assumption("{fs:g} Hz", "speeds and accelerations scale with it"),
    "control law": Assumption(
        "{law}{default}", "{reason}", {"default": "a {bandwidth_hz:g} Hz PD"}
    ),
    "delay": Assumption(
        "{lag}",
        "{stated}{unseen}",
        {
            "stated": "given by torque_lag_s",
            "unseen": "without a recorded reference it cannot be estimated: {cost}",
        },
    ),
    "filters": Assumption(
        "{duration_s:.0f} s of motion",
        "intervals include noise only; filters distort a parameter by about 0.1 %, which is as "
        "much here",
    ),
    "encoder noise": Assumption(
        "the same spectrum below and above the low-pass",
        "position noise biases least squares, and only the noise above the low-pass is tested",
    ),
    "joint zeros": Assumption(
        "right at {joints}", "a wrong zero changes the links' parameters; not noticed: {each}"
    ),
    "rotor inertias": Assumption(
        "none at {joints} (rotor_inertia = false)",
        "the links' parameters absorb a rotor inertia; not noticed: {each}",
    ),
}
