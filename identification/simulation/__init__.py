"""Closed-loop simulation: control laws, friction, the robot simulated in a recording, instruments,
the plant of dry runs.
"""

from .closed_loop import ClosedLoop, RigidBodyPlant, described_robot, drive_loops, open_loop
from .control_law import Control, ControlLaw, Reference, recorded_loop, surrogate_loop
from .instruments import InstrumentKind, Simulated, simulate
from .recording_checks import unstated_limits
from .simulated_recording import ControllerKind, SimulatedRecording
