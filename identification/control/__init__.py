"""Control: the control law that moves the robot, described, found in a recording, or the default
PD.

It owns `ControlLaw`, the state that a simulation needs of it, the search for the control law of a
recording, and what a given control law says of the delay. It may use `regression` and the rooms
below.
"""

from .control_law import (
    ARRAYS,
    FLOATS,
    Control,
    ControlLaw,
    ControllerKind,
    Numbers,
    Reference,
    default_law,
    described_law,
)
from .found_law import MAX_LAW_PERCENT, FoundLaw, lag_without_fit, law_of, law_of_recording
from .motor_paths import SATURATED
