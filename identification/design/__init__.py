"""Design of recordings and models: exciting references, and friction terms by cross-validation.

It owns the criterion, the limits and the search of a reference, and the selection of friction
terms. It may use fits and their rows, the model, the estimators, and `export` to change a
description. It does not simulate.
"""

from .excitation import (
    Excitation,
    ExcitationSettings,
    excitation_document,
    excite,
    expected_after,
)
from .friction_report import friction_document, friction_file, write_friction
from .information import Information, earlier_information, prior_information, torque_noise
from .limits import Series, limits_of, motion_of
from .selection import Trial, select_friction, smallest_near_best, with_terms
