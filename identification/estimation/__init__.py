"""Least squares, instrumental variables and their tests, on arrays; independent of robots."""

from .confidence import (
    LEVEL,
    Intervals,
    Scores,
    by_rows_alone,
    combined,
    deviations_of_sums,
    differs,
    estimate_deviations,
    intervals_from,
    intervals_of,
    scores_of_recordings,
)
from .consistency import (
    Consistent,
    PhysicalParameters,
    consistent_parameters,
    link_parameters,
    parameter_certainty,
    pseudo_inertia,
)
from .diagnostics import (
    MOVING,
    InstrumentTests,
    are_moving,
    autocorrelation,
    autoregression,
    chi_squared_quantile,
    f_tail,
    f_tests,
    instrument_tests,
    relative_error_percent,
    t_quantile,
    torque_errors,
)
from .estimators import (
    MIN_COLUMN_NORM,
    Estimate,
    Reduction,
    essential_parameters,
    instrumental_variables,
    one_thread,
    ordinary_least_squares,
    weighted_least_squares,
)
from .system import (
    SPANS,
    Spans,
    System,
    by_joint,
    r_factor,
    spans_of,
    stacked,
    undetermined_parameters,
)
