"""The robot in closed loop: control laws, friction with stick phases, integration."""

from .closed_loop import ClosedLoop, simulate
from .control_law import (
    SURROGATE_DAMPING,
    Control,
    ControlLaw,
    Reference,
    has_controller,
    recorded_loop,
    surrogate_loop,
)
from .disturbances import Disturbances
from .friction import Friction
