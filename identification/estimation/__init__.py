"""Least squares, instrumental variables and their tests, on arrays; independent of robots.

It owns the system of rows, its estimates, their intervals, and the nearest physically consistent
parameters. It may use the records of `report`, but no other subpackage; it has no robot, no
recording and no file.
"""

from .confidence import (
    LEVEL,
    NORMAL_REACH,
    WHITE_COSINES,
    Intervals,
    by_rows_alone,
    changes_of,
    combined,
    cosines,
    covariance_of_all,
    deviations,
    deviations_of_sums,
    differs,
    essential_names,
    intervals_from,
    intervals_of,
    not_below_white,
)
from .consistency import (
    GAMMA_X,
    Consistent,
    PhysicalParameters,
    consistent_parameters,
    link_parameters,
    parameter_certainty,
    pseudo_inertia,
)
from .diagnostics import (
    MOVING,
    are_moving,
    autocorrelation,
    autoregression,
    chi_squared_quantile,
    f_tail,
    f_test,
    first_stage,
    relative_error_percent,
    relative_residual,
    t_quantile,
    torque_errors,
)
from .estimators import (
    MIN_COLUMN_NORM,
    Estimate,
    essential_parameters,
    instrumental_variables,
    one_thread,
    ordinary_least_squares,
    weighted_least_squares,
    weights_of,
)
from .system import (
    FINE_SPANS,
    SPANS,
    SpanRows,
    System,
    by_joint,
    orthonormal,
    r_factor,
    release_memory,
    spans_at,
    stacked,
    undetermined_parameters,
)
