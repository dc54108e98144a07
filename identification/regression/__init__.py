"""From signals to the rows [C Z J r]: settings, filters, motions, sample weights, terms, rows.

It owns `Problem`, a recording with its settings and its model, and the terms whose columns make the
rows. It may use `model` and the subpackages below.
"""

from .blocks import (
    Candidate,
    MotionBlock,
    motion_blocks,
    predicted_torque,
    refuse_standing_joints,
    sample_weights,
    weights_at,
)
from .filtering import Decimation, fast_size, forward_backward_3db_hz, lowpass, lowpass_reach
from .lag import LAG_ORDERS, combined_lag, lags_in
from .motion import (
    BLOCK_SAMPLES,
    CUT_PERIODS,
    NOTHING,
    SPLINE_REACH,
    FilteredMotion,
    Lag,
    Motion,
    differentiate,
    largest_of_type,
    motion_between,
    on_spline,
    sampled_at,
    smooth,
    spline_coefficients,
    standing_joints,
)
from .problem import Problem, make_problem, row_blocks, with_common_band
from .rows import (
    Equation,
    Rows,
    equation_alone,
    equation_of,
    rows_of_recording,
    stacked_rows,
    torque_of_recording,
)
from .settings import (
    RAMPS,
    ROWS,
    Overrides,
    Settings,
    decimation_rule,
    make_settings,
    rule_cutoff_hz,
    with_bandwidth,
)
from .terms import (
    friction_states,
    recorded_power,
    rigid_torque_at_rows,
    row_states,
    why_not_simulated,
)
from .unknowns import Arm, Unknowns, make_unknowns
