"""From signals to W and Y: settings, filters, regressor, weights of samples, load friction."""

from .bandwidth import with_bandwidth
from .equations import (
    Rows,
    Term,
    predicted_torque,
    rows_by_measured_motion,
    rows_of_recording,
    torque_of_drives,
    torque_of_recording,
)
from .filtering import Decimation, forward_backward_3db_hz, lowpass_reach
from .law import Law, described_gains, law_of
from .load import LoadFriction, load_friction
from .motion import (
    BLOCK_SAMPLES,
    SPLINE_REACH,
    FilteredMotion,
    Motion,
    differentiate,
    later,
    motion_between,
    sampled_at,
    smooth,
)
from .payload import payload_of
from .problem import (
    MAX_CACHED_NUMBERS,
    MotionBlock,
    Problem,
    RowBlock,
    make_problem,
    motion_of_block,
    row_blocks,
)
from .settings import (
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
from .states import (
    fast_for_lag,
    friction_states,
    recorded_power,
    rigid_torque_at_rows,
    row_states,
)
from .unknowns import Arm, Unknowns, base_name, base_places, make_unknowns
from .weights import refuse_standing_joints, sample_weights, weighted, weights_at
