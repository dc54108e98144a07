"""The lines of the trust block and the verdict that they add up to."""

from dataclasses import dataclass
from typing import Literal

Level = Literal["do not use", "caution", "cannot tell", "not made", "ok"]
LEVELS: tuple[Level, ...] = ("do not use", "caution", "cannot tell", "not made", "ok")  # worst first
REDUCED = "not made: the rows of a long recording are reduced; fit a part of it, or with a larger --decimate"
ILL_CONDITIONED = (
    "not made: the parameters of a long recording are too ill-conditioned for it; fit a part of it, or with --essential"
)
Verdict = Literal["trust", "caution", "do not use"]


@dataclass(frozen=True, kw_only=True)
class Figure:
    """What a test found at one joint, motor or block of time: the value, half its 95 % interval, and the value expected."""

    name: str
    value: float
    half_width: float = 0.0
    expected: float = 0.0


@dataclass(frozen=True, kw_only=True)
class TrustLine:
    """One test of a fit.

    Attributes:
        test: its name, such as `lag`.
        level: `not made` where the test could not be made, `cannot tell` where it says nothing either way.
        value: its figure, None where there is none.
        text: one sentence with the figure, and what to do.
        caps: whether a test that was not made keeps the verdict from being `trust`.
        figures: its figures one by one, to be drawn, in `unit`.
    """

    test: str
    level: Level
    value: float | None
    text: str
    caps: bool = False
    figures: tuple[Figure, ...] = ()
    unit: str = ""


def not_made(test: str, text: str, caps: bool = False) -> TrustLine:
    """The line of a test that could not be made, `text` saying why; `caps` as of the line."""
    return TrustLine(test=test, level="not made", value=None, text=text, caps=caps)


@dataclass(frozen=True, kw_only=True)
class Trust:
    """All tests of a fit, worst first."""

    lines: tuple[TrustLine, ...]

    def line(self, test: str) -> TrustLine:
        """That of a test."""
        return next(line for line in self.lines if line.test == test)

    @property
    def severe(self) -> tuple[str, ...]:
        """Why the result is not to be used, test by test; empty where it may be."""
        return tuple(line.text for line in self.lines if line.level == "do not use")

    @property
    def verdict(self) -> Verdict:
        """The worst level; a test that was not made, but must be, counts as caution."""
        if any(line.level == "do not use" for line in self.lines):
            return "do not use"
        doubtful = any(line.level == "caution" or (line.level == "not made" and line.caps) for line in self.lines)
        return "caution" if doubtful else "trust"


def worst_first(lines: list[TrustLine]) -> Trust:
    """The trust block of these tests."""
    return Trust(lines=tuple(sorted(lines, key=lambda line: LEVELS.index(line.level))))
