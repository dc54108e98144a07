"""The lines of the trust block and the verdict that they add up to."""

from dataclasses import dataclass

from ..report import Assumed, Level, Verdict

LEVELS: tuple[Level, ...] = ("do not use", "caution", "cannot tell", "not made", "ok")  # worst first
ILL_CONDITIONED = (
    "not made: the parameters of a long recording are too ill-conditioned for it; fit a part of it, or with --essential"
)


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
        far_off: whether held-out errors are so far above the trained ones that other doubts weigh more.
    """

    test: str
    level: Level
    text: str
    value: float | None = None
    finding: str = ""
    figures: tuple[Figure, ...] = ()
    unit: str = ""
    far_off: bool = False


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


def worst_first(lines: list[TrustLine], assumed: tuple[Assumed, ...]) -> Trust:
    """The trust block of these tests."""
    return Trust(lines=tuple(sorted(lines, key=lambda line: LEVELS.index(line.level))), assumed=assumed)
