"""When to believe a fit: tests of an estimate against everything that the recording tells, and one verdict."""

from .evidence import Evidence
from .lines import LEVELS, Figure, Level, Trust, TrustLine
from .physical import Doubt, inertias, not_positive, physical_doubts, poses_of
from .trust_tests import trust_in

__all__ = [
    "LEVELS",
    "Doubt",
    "Evidence",
    "Figure",
    "Level",
    "Trust",
    "TrustLine",
    "inertias",
    "not_positive",
    "physical_doubts",
    "poses_of",
    "trust_in",
]
