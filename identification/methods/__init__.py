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
from .timing import in_known_time
