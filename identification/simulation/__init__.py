"""The robot in closed loop: control laws, friction, a recorded experiment simulated again, instruments, dry runs' plant."""

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
from .experiment import make_experiment
from .instruments import InstrumentKind, Instruments, simulate_instruments, told, worst
from .lab import Lab, Simulation
from .motion import DirectModelError, Replica, simulate_replica
from .plant import RigidBodyPlant, described_robot, drive_loops
