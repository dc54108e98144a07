"""The trust block: every test of a fit, each made by a function of the evidence."""

from collections.abc import Callable

from .columns import added_columns_test
from .evidence import Evidence
from .lag import lag_test
from .lines import Trust, TrustLine, worst_first
from .physical import consistent_test, physical_test
from .replay import replay_test
from .solution import (
    contrast_test,
    ends_test,
    fixed_point_test,
    halves_test,
    held_out_test,
    instruments_test,
    prewhitened_test,
)

TESTS: tuple[Callable[[Evidence], TrustLine], ...] = (
    fixed_point_test,
    physical_test,
    consistent_test,
    lag_test,
    replay_test,
    added_columns_test,
    held_out_test,
    halves_test,
    ends_test,
    contrast_test,
    instruments_test,
    prewhitened_test,
)


def trust_in(evidence: Evidence) -> Trust:
    """All tests of an estimate, worst first."""
    return worst_first([test(evidence) for test in TESTS])
