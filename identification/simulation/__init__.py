"""Closed-loop simulation: the robot simulated in a recording, instruments, the plant of dry runs.

It owns the steps of the simulated robot, with its friction. It may use `control`, `regression` and
the subpackages below.
"""

from .closed_loop import ClosedLoop, RigidBodyPlant, described_robot, drive_loops, open_loop
from .instruments import InstrumentKind, Simulated, simulate
from .simulated_recording import SimulatedRecording, unstated_limits
