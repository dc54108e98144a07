"""The method on one screen, the simulated replica of the experiment, and what a fit is worth."""

from .fit import NO_FIXED_POINT, Fit, InstrumentEvidence, Pass
from .idim import Iteration, identify_iv, identify_ls, validate
from .plausibility import Doubt
from .replica import inertias, not_positive, regular_start

__all__ = [
    "NO_FIXED_POINT",
    "Doubt",
    "Fit",
    "InstrumentEvidence",
    "Iteration",
    "Pass",
    "identify_iv",
    "identify_ls",
    "inertias",
    "not_positive",
    "regular_start",
    "validate",
]
