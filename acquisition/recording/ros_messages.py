"""ROS 2 messages of the common interfaces as CDR, by the package rosbags."""

from ..arrays import Array

JOINT_STATE, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/String"


class RosMessages:
    """CDR of ROS 2 messages, by the package rosbags."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore  # slow to import: needed for writing only

        self.store = get_typestore(Stores.ROS2_JAZZY)
        types = self.store.types
        self._state, self._time = types[JOINT_STATE], types["builtin_interfaces/msg/Time"]
        self._header, self._text = types["std_msgs/msg/Header"], types[TEXT]

    def definition(self, kind: str) -> str:
        """The text that defines a type of message."""
        text: str = self.store.generate_msgdef(kind, ros_version=2)[0]
        return text

    def joint_state(self, stamp_ns: int, names: list[str], position: Array, velocity: Array, effort: Array) -> bytes:
        """A JointState; arrays (n,) each, or empty."""
        header = self._header(self._time(*divmod(stamp_ns, 1_000_000_000)), "")
        state = self._state(header, names, position, velocity, effort)
        return bytes(self.store.serialize_cdr(state, JOINT_STATE))

    def text(self, text: str) -> bytes:
        """A String."""
        return bytes(self.store.serialize_cdr(self._text(text), TEXT))
