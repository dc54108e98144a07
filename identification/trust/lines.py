"""Result lines of the trust tests, and the verdict."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ..report import Assumed, Level, Verdict

# worst first
LEVELS: tuple[Level, ...] = ("do not use", "caution", "cannot tell", "not made", "ok")
# name, value, half-width of the 95 % interval, expected value
Figure = tuple[str, float, float, float]


@dataclass(frozen=True)
class HeldOut:
    """A recording predicted by the fit of the others, in the rows that count.

    Attributes:
        error_percent: its torque error, in percent of its torque; None where the others do not
            determine the parameters.
        trained_percent: the same for the fit of all.
        undetermined: names of the parameters that the others do not determine.
    """

    error_percent: float | None
    trained_percent: float | None
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
        fails_held_out: whether held-out errors are so large that, with M not positive, the
            fit is not to be used.
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
    made = (line for line in lines if line is not None)
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
