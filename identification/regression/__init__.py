"""From signals to W and Y: settings, filters, regressor, weights of samples, load friction."""

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
    fast_rows,
    friction_states,
    recorded_power,
    rigid_torque_at_rows,
    row_states,
)
from .settings import (
    CUTOFF_PER_BANDWIDTH,
    NOTHING,
    RAMPS,
    ROWS,
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
    columns_of_drives,
    decimated_regressor,
    predicted_drives,
    predicted_torque,
    recorded_drives,
    regression_again,
    regression_of_recording,
    rows_of_block,
    torque_of_recording,
    torque_rate,
    with_torque,
)
from .weights import refuse_standing_joints, sample_weights, weighted, weights_at
