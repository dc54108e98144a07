"""ROS 2 messages of the common interfaces as CDR, by the package rosbags."""

from collections.abc import Sequence
from typing import Any

from ..arrays import Array

JOINT_STATE, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
TRANSFORMS, _TRANSFORM = "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/TransformStamped"


class RosMessages:
    """CDR of ROS 2 messages, by the package rosbags."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore  # slow to import: needed for writing only

        self.store = get_typestore(Stores.ROS2_JAZZY)
        types = self.store.types
        self._state, self._time = types[JOINT_STATE], types["builtin_interfaces/msg/Time"]
        self._header, self._text = types["std_msgs/msg/Header"], types[TEXT]
        self._transforms, self._transform = types[TRANSFORMS], types[_TRANSFORM]
        self._pose = types["geometry_msgs/msg/Transform"]
        self._vector, self._quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]

    def definition(self, kind: str) -> str:
        """The text that defines a type of message."""
        text: str = self.store.generate_msgdef(kind, ros_version=2)[0]
        return text

    def joint_state(self, stamp_ns: int, names: list[str], position: Array, velocity: Array, effort: Array) -> bytes:
        """A JointState; arrays (n,) each, or empty."""
        state = self._state(self._stamped(stamp_ns, ""), names, position, velocity, effort)
        return bytes(self.store.serialize_cdr(state, JOINT_STATE))

    def transforms(self, stamp_ns: int, frames: Sequence[tuple[str, str]], shift: Array, turn: Array) -> bytes:
        """A TFMessage of the `frames` (parent, child): translations (k, 3) in m, quaternions (k, 4), x y z w."""
        poses = [
            self._transform(
                self._stamped(stamp_ns, parent),
                child,
                self._pose(self._vector(*map(float, x)), self._quaternion(*map(float, r))),
            )
            for (parent, child), x, r in zip(frames, shift, turn, strict=True)
        ]
        return bytes(self.store.serialize_cdr(self._transforms(poses), TRANSFORMS))

    def text(self, text: str) -> bytes:
        """A String."""
        return bytes(self.store.serialize_cdr(self._text(text), TEXT))

    def _stamped(self, stamp_ns: int, frame: str) -> Any:
        return self._header(self._time(*divmod(stamp_ns, 1_000_000_000)), frame)
