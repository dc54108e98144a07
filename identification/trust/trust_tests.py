"""The trust block: every test of a fit, each made by a function of the evidence."""

from collections.abc import Callable

from .evidence import Evidence
from .instruments import fixed_point_line
from .lines import Trust, TrustLine, worst_first
from .physical import physical_line

TESTS: tuple[Callable[[Evidence], TrustLine], ...] = (
    fixed_point_line,
    physical_line,
)


def trust_in(evidence: Evidence) -> Trust:
    """All tests of an estimate, worst first."""
    return worst_first([test(evidence) for test in TESTS])
