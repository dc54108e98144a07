"""The method on one screen, several recordings, what a fit is worth, and its documents and files.

The path of a fit, stage by stage::

    Signals, Settings, Problem   a recording, what is done with it, with its robot's model
    RecordingData, StackedSystem W and Y of one recording, and of all together, about any parameters
    Instruments, Pass            Z along the simulated robot, the estimate that it gives, how far that moved
    Evidence, Trust              all that the tests look at, and what they say
    Fit                          the result; `report.FitFile` is its JSON file
"""

from .consistent import Known, Prior, consistent_set, refuse_unknown_gain, urdf_prior, with_consistent
from .fit import Fit, FittedRecording, Pass
from .fit_files import fit_file, validation_file
from .fit_report import fit_document, trust_document
from .idim import identify, identify_iv, identify_ls, validate, validate_all
from .iteration import Iteration, regular_start
from .parameters import (
    consistent_fit,
    fitted_parameters,
    least_squares_parameters,
    other_meaning,
    stored_beta,
    stored_robot,
    stored_settings,
    true_parameters,
)
from .recording_report import Validated, recording_document, validation_document
from .settled import leave_out_collinear_terms, load_passes, most_collinear, solve_with_load_friction
from .system import StackedSystem, stack_of
from .timing import correct_known_lags
