"""Control: the control law that moves the robot, given, estimated from a recording, or a default.

It owns `ControlLaw`, its state in a simulation, the estimate of the control law of a recording, and
the delay that a given control law shows. It may use `regression` and the subpackages below.
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
