"""Results: a fit with its tests, its JSON file and its documents; parameters of stored fits.

It owns `Evidence`, the solution of `methods` with its tests, and all that is said of it:
`report.FitFile`, the report, the torque errors on other recordings, the nearest physically
consistent parameters. It may use `methods` and the subpackages below; `study` and all above use
it.
"""

from .consistent import (
    Draws,
    Known,
    consistent_set,
    draw_consistent,
    stored_estimate,
    with_consistent,
)
from .evidence import HORIZONS_S, Evidence, FitOnRecording, errors_ahead, validated
from .fit_files import fit_file, validation_file
from .fit_report import PARAMETERS, fit_document
from .make_fit import identify, identify_iv, identify_ls
from .parameters import (
    consistent_fit,
    fitted_parameters,
    predict_recordings,
    prior_file,
    read_prior,
    refuse_unknown_gain,
    signals_as_fitted,
    stored_beta,
    stored_robot,
    stored_settings,
    stored_torque,
    terms_without_fit,
    true_parameters,
    urdf_prior,
    validate_all,
    with_stored_gains,
)
from .recording_report import (
    main_figures,
    recording_document,
    validation_document,
)
