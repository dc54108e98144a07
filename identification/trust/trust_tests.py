"""The trust block: every test of a fit, each made by a function of the evidence."""

from collections.abc import Callable

from .evidence import Evidence
from .lines import Trust, TrustLine, worst_first

TESTS: tuple[Callable[[Evidence], TrustLine], ...] = ()


def trust_in(evidence: Evidence) -> Trust:
    """All tests of an estimate, worst first."""
    return worst_first([test(evidence) for test in TESTS])
