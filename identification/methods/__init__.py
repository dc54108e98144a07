"""Identification by least squares and instrumental variables: the method, its results, their documents and files.

The path of a fit, stage by stage::

    Signals, Settings, Problem   a recording, the settings, the robot's model
    RecordingData, StackedSystem W and Y of one recording, and of all recordings, about given parameters
    Instruments, Pass            Z of the simulated robot, and the estimate of one pass
    FitData, Trust               inputs and results of the trust tests
    Fit                          the result; `report.FitFile` is its JSON file
"""

from .consistent import Known, Prior, consistent_set, read_prior, refuse_unknown_gain, urdf_prior, with_consistent
from .fit import Fit, FittedRecording, Pass
from .fit_files import fit_file, validation_file
from .fit_report import PARAMETERS, fit_document
from .gain_results import Gains
from .idim import identify, identify_iv, identify_ls, validate_all
from .iteration import Iteration, regular_start
from .parameters import (
    consistent_fit,
    fitted_parameters,
    least_squares_parameters,
    signals_as_fitted,
    stored_beta,
    stored_robot,
    stored_settings,
    true_parameters,
    with_stored_gains,
)
from .recording_report import Validated, recording_document, validation_document
from .settled import (
    leave_out_collinear_terms,
    load_passes,
    most_collinear,
    solve_with_load_friction,
    with_best_ramps,
)
from .system import StackedSystem, stack_of
from .timing import correct_known_lags
