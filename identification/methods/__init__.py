"""The method on one screen, several recordings, what a fit is worth, and its documents and files."""

from .comparison import (
    Parameter,
    ParameterSet,
    comparison_document,
    comparison_file,
    comparison_section,
    differences,
    fitted_parameters,
    least_squares_parameters,
    true_parameters,
)
from .consistent import Known, Prior, consistent_set, refuse_unknown_gain, urdf_prior, with_consistent
from .fit import Fit, FittedRecording, Method, Pass, Rows
from .fit_files import fit_file, fit_schema, validation_file
from .fit_report import fit_document, trust_document
from .idim import identify, identify_iv, identify_ls, validate, validate_all
from .iteration import Iteration, regular_start
from .recording_report import Validated, recording_document, validation_document
from .recordings import observe_all
from .stored_fit import StoredFit, doubts, frame_lines, read_fit
from .timing import in_known_time
