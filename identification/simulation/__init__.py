"""The robot in closed loop: control laws, friction, a recorded experiment simulated again, instruments, dry runs' plant."""

from .bench import Bench, DirectModelError, Place, Replica
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
from .instruments import Counting, InstrumentKind, simulate_instruments
from .lab import Lab, PassInstruments, told, worst
from .motion import simulated_motion
from .plant import RigidBodyPlant, described_robot, drive_loops
