"""The method on one screen, the simulated replica of the experiment, and what a fit is worth."""

from .consistent import Known, Prior, consistent_set, refuse_unknown_gain, urdf_prior, with_consistent
from .fit import (
    NO_FIXED_POINT,
    ConsistentSet,
    Fit,
    FittedRecording,
    InstrumentEvidence,
    LeastSquares,
    Method,
    OwnTest,
    Pass,
    Rows,
    Status,
)
from .idim import identify, identify_iv, identify_ls, validate, validate_all
from .iteration import Iteration, regular_start
from .recordings import observe_all

__all__ = [
    "NO_FIXED_POINT",
    "ConsistentSet",
    "Fit",
    "FittedRecording",
    "InstrumentEvidence",
    "Iteration",
    "Known",
    "LeastSquares",
    "Method",
    "OwnTest",
    "Pass",
    "Prior",
    "Rows",
    "Status",
    "consistent_set",
    "identify",
    "identify_iv",
    "identify_ls",
    "observe_all",
    "refuse_unknown_gain",
    "regular_start",
    "urdf_prior",
    "validate",
    "validate_all",
    "with_consistent",
]
