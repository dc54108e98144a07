"""From signals to the over-determined system: settings, filters, regressor, the rows that count."""

from .filtering import Decimation, forward_backward_3db_hz
from .load import LinkSeries, LoadFriction, load_friction
from .low_speed import fast_rows, lowest_nearby, measured_slip, refuse_slow_joints
from .motion import FilteredMotion, Motion, differentiate, motion_between, sampled_at
from .own import OwnParameters, base_name, own_parameters
from .problem import Problem, RowBlock, make_problem, motion_blocks, row_blocks
from .settings import (
    CUTOFF_PER_BANDWIDTH,
    NOTHING,
    KnownLag,
    Overrides,
    Settings,
    Span,
    decimation_rule,
    make_settings,
    rule_cutoff_hz,
)
from .system import (
    ALL_REDUCED,
    Regression,
    decimated_regressor,
    is_long,
    known_torque_rows,
    predicted_torque,
    regression_of_recording,
    retimed,
    rows_of_block,
    stacked,
    torque_of_recording,
    torque_rate,
)

__all__ = [
    "ALL_REDUCED",
    "CUTOFF_PER_BANDWIDTH",
    "NOTHING",
    "Decimation",
    "FilteredMotion",
    "KnownLag",
    "LinkSeries",
    "LoadFriction",
    "Motion",
    "Overrides",
    "OwnParameters",
    "Problem",
    "Regression",
    "RowBlock",
    "Settings",
    "Span",
    "base_name",
    "decimated_regressor",
    "decimation_rule",
    "differentiate",
    "fast_rows",
    "forward_backward_3db_hz",
    "is_long",
    "known_torque_rows",
    "load_friction",
    "lowest_nearby",
    "make_problem",
    "make_settings",
    "measured_slip",
    "motion_between",
    "motion_blocks",
    "own_parameters",
    "predicted_torque",
    "refuse_slow_joints",
    "regression_of_recording",
    "retimed",
    "row_blocks",
    "rows_of_block",
    "rule_cutoff_hz",
    "sampled_at",
    "stacked",
    "torque_of_recording",
    "torque_rate",
]
