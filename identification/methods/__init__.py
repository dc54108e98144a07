"""The method on one screen, the simulated replica of the experiment, and what a fit is worth."""

from .fit import NO_FIXED_POINT, DirectModelError, Fit, InstrumentEvidence, InstrumentKind, Method, Pass, Status
from .idim import Iteration, identify_iv, identify_ls, validate
from .plausibility import Doubt
from .replica import inertias, not_positive, regular_start

__all__ = [
    "NO_FIXED_POINT",
    "DirectModelError",
    "Doubt",
    "Fit",
    "InstrumentEvidence",
    "InstrumentKind",
    "Iteration",
    "Method",
    "Pass",
    "Status",
    "identify_iv",
    "identify_ls",
    "inertias",
    "not_positive",
    "regular_start",
    "validate",
]
