"""ROS 2: messages as CDR, joint states out of bags, bags written, the frames of a robot's links."""

from .bag_reader import JointStates, read_joint_states
from .bag_writer import BagWriter
from .messages import JOINT_STATE, RosMessages
from .placements import UNLIMITED, LinkFrames, link_frames, quaternions, roll_pitch_yaw, rotation, urdf_of
