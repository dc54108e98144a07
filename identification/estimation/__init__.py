"""Least squares, instrumental variables and their tests, on arrays; nothing here knows of robots."""

from .confidence import (
    BlockSums,
    Intervals,
    Scores,
    TimeBlocks,
    deviations_of_sums,
    estimate_deviations,
    intervals,
    intervals_from,
    intervals_of_blocks,
    scores_of_recordings,
    slices,
    sums_of_blocks,
)
from .consistency import (
    GAMMA,
    Consistent,
    PhysicalParameters,
    certainty,
    consistent_parameters,
)
from .diagnostics import (
    MOVING,
    InstrumentTests,
    TorqueError,
    are_moving,
    autocorrelation,
    instrument_tests,
    lag_one,
    relative_error_percent,
    torque_errors,
    whitened,
)
from .distributions import chi_squared_quantile, f_tail, independent_share, t_quantile
from .estimators import (
    Estimate,
    Reduction,
    essential_parameters,
    instrumental_variables,
    one_thread,
    ordinary_least_squares,
    weighted_least_squares,
)
from .link_inertias import link_parameters, pseudo_inertia
from .system import Factors, System, combined, condensed, r_factor, undetermined_parameters
