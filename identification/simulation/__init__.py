"""The robot in closed loop: control laws, friction, a recorded experiment simulated again, instruments, dry runs' plant."""

from .closed_loop import ClosedLoop, RigidBodyPlant, described_robot, drive_loops
from .control_law import Control, ControlLaw, Disturbances, Reference, recorded_loop, surrogate_loop
from .instruments import ClosedLoops, Instruments, Simulation, join_reasons, max_or_none
from .motion import Replica
