"""Closed-loop simulation: control laws, friction, replicas of recorded experiments, instruments,
the plant of dry runs.
"""

from .closed_loop import ClosedLoop, RigidBodyPlant, described_robot, drive_loops
from .control_law import Control, ControlLaw, Encoder, Reference, recorded_loop, surrogate_loop
from .experiment import saturated_percents, unstated_limits
from .instruments import ClosedLoops, Instruments, Simulation, join_reasons, max_or_none
from .motion import Replica
