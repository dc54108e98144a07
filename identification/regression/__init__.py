"""From signals to the over-determined system: settings, filters, regressor, the rows that count."""

from .filtering import Decimation, forward_backward_3db_hz
from .low_speed import fast_rows, lowest_nearby, measured_slip, slip_cutoff_hz
from .motion import FilteredMotion, Motion, differentiate, motion_between, sampled_at
from .problem import Problem, make_problem
from .settings import (
    CUTOFF_PER_BANDWIDTH,
    Overrides,
    Settings,
    Span,
    decimation_rule,
    make_settings,
    rule_cutoff_hz,
)
from .system import (
    Regression,
    decimated_regressor,
    known_torque_rows,
    predicted_torque,
    regression_of_recording,
    torque_of_recording,
    torque_rate,
)

__all__ = [
    "CUTOFF_PER_BANDWIDTH",
    "Decimation",
    "FilteredMotion",
    "Motion",
    "Overrides",
    "Problem",
    "Regression",
    "Settings",
    "Span",
    "decimated_regressor",
    "decimation_rule",
    "differentiate",
    "fast_rows",
    "forward_backward_3db_hz",
    "known_torque_rows",
    "lowest_nearby",
    "make_problem",
    "make_settings",
    "measured_slip",
    "motion_between",
    "predicted_torque",
    "regression_of_recording",
    "rule_cutoff_hz",
    "sampled_at",
    "slip_cutoff_hz",
    "torque_of_recording",
    "torque_rate",
]
