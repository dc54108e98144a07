"""From signals to W and Y: settings, filters, regressor, selection of rows, load friction."""

from .bandwidth import with_bandwidth
from .filtering import Decimation, forward_backward_3db_hz
from .load import LoadFriction, load_columns, load_friction
from .motion import (
    BLOCK_SAMPLES,
    SPLINE_REACH,
    FilteredMotion,
    Motion,
    differentiate,
    later,
    motion_between,
    sampled_at,
)
from .payload import payload_of
from .problem import Problem, RowBlock, make_problem, row_blocks
from .rows import (
    RowStates,
    friction_states,
    lowest_nearby,
    measured_fast_rows,
    moving_rows_of,
    recorded_power,
    refuse_slow_joints,
    rigid_torque_at_rows,
    row_states,
)
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
from .several import OwnParameters, RecordingParameters, base_name, base_places, own_parameters
from .system import (
    ALL_REDUCED,
    HELD,
    Regression,
    decimated_regressor,
    known_torque_rows,
    predicted_drive_torques,
    predicted_torque,
    reduced_regression,
    regained,
    regression_of_recording,
    retimed,
    rows_of_block,
    torque_of_recording,
    torque_rate,
)
