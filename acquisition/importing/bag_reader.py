"""Joint states out of ROS 2 bags."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from ..arrays import Array, Ints
from ..errors import AcquisitionError, Place, listed
from ..recording import JOINT_STATE


def read_joint_states(path: Path, topic: str, joints: Sequence[str]) -> tuple[Ints, bool, dict[str, Array], list[str]]:
    """Joint states of the `joints`, by name, in the order of the bag.

    Parameters
    ----------
    path : folder of a bag, or its file: .mcap (zstd, lz4 or no compression) or .db3.
    topic : of sensor_msgs/msg/JointState.

    Returns
    -------
    Stamps (N,) in ns of the headers, of reception where headers have none (True then); `position` (N, n), `velocity` and
    `effort` where messages have them; warnings.

    Raises
    ------
    AcquisitionError
        The bag cannot be read, the topic does not exist or is of another type, joints are missing, messages come from several
        publishers, or a position is not finite.
    """
    parts = _Parts(joints, Place(f"{path}: {topic}"))
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            connections = [c for c in reader.connections if c.topic == topic]
            _refuse_topic(topic, {c.topic: c.msgtype for c in reader.connections}, Place(str(path)))
            parts.publishers = sum(max(1, len(getattr(c.ext, "offered_qos_profiles", ()))) for c in connections)
            for connection, received_ns, raw in reader.messages(connections=connections):
                parts.add(received_ns, reader.deserialize(raw, connection.msgtype))
    except AcquisitionError:
        raise
    except OSError as error:
        Place(str(path)).refuse(text=f"cannot be read: {error.strerror or error}")
    except Exception as error:  # readers and SQLite meet damage with whatever their parts raise
        after = f" after {parts.count} messages" if parts.count else ""
        problem = f"cannot be read{after}: {(str(error) or type(error).__name__)[:200]}"
        Place(str(path)).refuse(expected="a ROS 2 bag: a folder, .mcap or .db3", text=problem)
    return parts.states(topic)


def _refuse_topic(topic: str, found: dict[str, str], place: Place) -> None:
    if found.get(topic) == JOINT_STATE:
        return
    states = [name for name, kind in found.items() if kind == JOINT_STATE]
    if topic in found:
        place.refuse(topic, expected=f"{JOINT_STATE}: {listed(states)}", text=f"of type {found[topic]}")
    expected = f"one of {JOINT_STATE}: {listed(states)}"
    if not states:
        expected = f"a topic of {JOINT_STATE}; it has {listed([*found])}"
    place.refuse(expected=expected, text=f"topic {topic} is not there")


class _Parts:
    """Joint states so far. Messages of one publisher have one frame and one list of names."""

    def __init__(self, joints: Sequence[str], place: Place) -> None:
        self._joints, self._place = list(joints), place
        self._places: dict[tuple[str, tuple[str, ...]], list[int] | None] = {}
        self._source: tuple[str, tuple[str, ...]] | None = None
        self._received: list[int] = []
        self._stamps: list[int] = []
        self._values: dict[str, list[Array]] = {"position": [], "velocity": [], "effort": []}
        self.count, self._others, self.publishers = 0, 0, 1

    def add(self, received_ns: int, message: Any) -> None:
        """Add a message."""
        self.count += 1
        source = (message.header.frame_id, tuple(message.name))
        if source not in self._places:
            self._places[source] = self._checked(source)
        places = self._places[source]
        if places is None:
            self._others += 1
            return
        self._received.append(received_ns)
        self._stamps.append(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
        for kind, values in self._values.items():
            found = getattr(message, kind)
            if len(found) not in (0, len(source[1])) or (kind == "position" and not len(found)):
                self._refuse_message(f"{len(found)} values of {kind}", f"{len(source[1])}, one for each name")
            if len(found):
                values.append(found[places])

    def _checked(self, source: tuple[str, tuple[str, ...]]) -> list[int] | None:
        """Places of the joints in messages of a source; None for one that has none of them."""
        names = source[1]
        missing = [joint for joint in self._joints if joint not in names]
        if len(missing) == len(self._joints) and self._joints:
            return None
        if missing:
            problem = f"joints {listed(missing)} missing among {listed(names)}"
            self._refuse_message(problem, "all joints of robot.toml in each message, by the names that it gives them")
        if self._source is not None:
            apart = f"frame {source[0]!r} after {self._source[0]!r}" if source[1] == self._source[1] else "other names"
            expected = "one publisher; record the topic of the arm's own driver"
            self._refuse_message(f"messages of several publishers: {apart}", expected)
        self._source = source
        return [names.index(joint) for joint in self._joints]

    def _refuse_message(self, problem: str, expected: str) -> NoReturn:
        Place(f"{self._place}: message {self.count}").refuse(expected=expected, text=problem)

    def states(self, topic: str) -> tuple[Ints, bool, dict[str, Array], list[str]]:
        """All that was added."""
        if not self._stamps:
            names = sorted({name for _, names in self._places for name in names})
            found = f"has {listed(names)}" if names else "has no messages"
            self._place.refuse(expected=f"the joints {listed(self._joints)} of robot.toml", text=found)
        stamps, count = np.array(self._stamps, dtype=np.int64), len(self._stamps)
        received = not stamps.any()
        if not received and not stamps[1:].all():  # a clock that begins at 0 stamps the first with it
            row = 1 + int(np.argmin(stamps[1:] != 0))
            where = Place(f"{self._place}: state {row + 1}")
            where.refuse(expected="stamps in all headers or in none", text="a header without a stamp")
        for kind, values in self._values.items():
            if len(values) not in (0, count):
                problem = f"{kind} in {len(values)} of {count} messages"
                self._place.refuse(expected=f"{kind} in all or in none", text=problem)
        arrays = {kind: np.array(values, dtype=np.float64) for kind, values in self._values.items() if values}
        position = arrays["position"]
        if not np.isfinite(position).all():
            row, joint = np.argwhere(~np.isfinite(position))[0]
            key = f"position of joint {self._joints[joint]}"
            where = Place(f"{self._place}: state {row + 1}")
            where.refuse(key, float(position[row, joint]), "a finite number")
        doubts = ["headers have no stamps: times are those of reception, which jitter more"] if received else []
        if self.publishers > 1:
            doubts.append(f"{topic} has {self.publishers} publishers (connections or QoS profiles): record it with one")
        if self._others:
            doubts.append(f"{self._others} messages without any of the joints are left out")
        return np.array(self._received, dtype=np.int64) if received else stamps, received, arrays, doubts
