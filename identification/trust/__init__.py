"""When to believe a fit: tests of an estimate against everything that the recording tells, and one verdict."""

from .evidence import Evidence
from .lines import LEVELS, Figure, Level, Trust, TrustLine, Verdict
from .physical import covariance_of_all, inertias, nearest_consistent, not_positive, poses_of
from .trust_tests import trust_in

__all__ = [
    "LEVELS",
    "Evidence",
    "Figure",
    "Level",
    "Trust",
    "TrustLine",
    "Verdict",
    "covariance_of_all",
    "inertias",
    "nearest_consistent",
    "not_positive",
    "poses_of",
    "trust_in",
]
