"""Least squares, instrumental variables and their tests, on arrays; nothing here knows of robots."""

from .confidence import (
    InstrumentBlocks,
    Intervals,
    TimeBlocks,
    cosines,
    deviations,
    deviations_of_parts,
    intervals,
    intervals_of_blocks,
    slices,
)
from .consistency import (
    GAMMA,
    Consistent,
    PhysicalParameters,
    consistent_parameters,
    prior_shares,
)
from .diagnostics import (
    MOVING,
    InstrumentTests,
    TorqueError,
    are_moving,
    autocorrelation,
    hac_sigma,
    instrument_tests,
    lag_one,
    relative_error_percent,
    torque_errors,
)
from .estimators import (
    Estimate,
    Reduction,
    essential_parameters,
    instrumental_variables,
    one_thread,
    ordinary_least_squares,
    weighted_least_squares,
)
from .f_test import f_tail, independent_share
from .link_inertias import link_parameters, pseudo_inertia
from .system import Factors, System, combined, condensed, undetermined_parameters
from .whitening import whitened

__all__ = [
    "GAMMA",
    "MOVING",
    "Consistent",
    "Estimate",
    "Factors",
    "InstrumentBlocks",
    "InstrumentTests",
    "Intervals",
    "PhysicalParameters",
    "Reduction",
    "System",
    "TimeBlocks",
    "TorqueError",
    "are_moving",
    "autocorrelation",
    "combined",
    "condensed",
    "consistent_parameters",
    "cosines",
    "deviations",
    "deviations_of_parts",
    "essential_parameters",
    "f_tail",
    "hac_sigma",
    "independent_share",
    "instrument_tests",
    "instrumental_variables",
    "intervals",
    "intervals_of_blocks",
    "lag_one",
    "link_parameters",
    "one_thread",
    "ordinary_least_squares",
    "prior_shares",
    "pseudo_inertia",
    "relative_error_percent",
    "slices",
    "torque_errors",
    "undetermined_parameters",
    "weighted_least_squares",
    "whitened",
]
