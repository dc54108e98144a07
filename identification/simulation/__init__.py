"""The robot in closed loop: control laws, friction, a recorded experiment simulated again, instruments, dry runs' plant."""

from .closed_loop import ClosedLoop
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
from .instruments import Instruments, Lab, Simulation, told, worst
from .motion import DirectModelError, Replica
from .plant import RigidBodyPlant, described_robot, drive_loops
