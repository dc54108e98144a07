"""Identification by least squares and instrumental variables: the method, its results,
their documents and files.

The path of a fit, stage by stage::

    Signals, Settings, Problem   a recording, the settings, the robot's model
    Model, Unknowns, Equation    the recordings of a fit, x of all of them, and the terms of each
    Rows                         [Z J r] about x, of equation (C)
    Simulated, Pass              Z of the simulated robot, and the estimate of one pass
    FitData, Trust               inputs and results of the trust tests
    Fit                          the result; `report.FitFile` is its JSON file
"""

from .consistent import (
    Known,
    consistent_set,
    read_prior,
    refuse_unknown_gain,
    urdf_prior,
    with_consistent,
)
from .fit import Fit, Pass
from .fit_files import fit_file, validation_file
from .fit_report import PARAMETERS, fit_document
from .idim import identify, identify_iv, identify_ls
from .iteration import Iteration, regular_start
from .model import Model, read_model
from .parameters import (
    consistent_fit,
    fitted_parameters,
    prior_file,
    signals_as_fitted,
    stored_beta,
    stored_robot,
    stored_settings,
    stored_torque,
    terms_without_fit,
    true_parameters,
    validate_all,
    with_stored_gains,
)
from .recording_report import (
    Validated,
    half_width_percents,
    main_figures,
    recording_document,
    validation_document,
)
from .start import least_squares, with_best_ramps
