"""From signals to the over-determined system: settings, filters, regressor, the rows that count."""

from .filtering import Decimation, forward_backward_3db_hz
from .load import LinkSeries, LoadFriction, load_friction
from .low_speed import fast_rows, lowest_nearby, measured_fast_rows, measured_slip, refuse_slow_joints
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
    largest_of_type,
    make_settings,
    rule_cutoff_hz,
    standing_joints,
)
from .system import (
    ALL_REDUCED,
    HELD,
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
