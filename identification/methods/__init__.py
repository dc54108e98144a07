"""The method on one screen, the simulated replica of the experiment, and what a fit is worth."""

from .fit import (
    NO_FIXED_POINT,
    DirectModelError,
    Fit,
    InstrumentEvidence,
    InstrumentKind,
    LeastSquares,
    Method,
    Pass,
    Rows,
    Status,
)
from .idim import identify_iv, identify_ls, validate
from .iteration import Iteration, regular_start

__all__ = [
    "NO_FIXED_POINT",
    "DirectModelError",
    "Fit",
    "InstrumentEvidence",
    "InstrumentKind",
    "Iteration",
    "LeastSquares",
    "Method",
    "Pass",
    "Rows",
    "Status",
    "identify_iv",
    "identify_ls",
    "regular_start",
    "validate",
]
