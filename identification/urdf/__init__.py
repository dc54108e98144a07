"""A URDF as a robot's description: its chain of joints, what options add to it, the robot.toml that says the same."""

from .chain import QUANTITIES, Chain, UrdfJoint, is_urdf, read_chain
from .description import FILL_IN, describe, described_robot
from .stated import OPTIONS, Stated
