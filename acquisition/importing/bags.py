"""Imports the joint states of a ROS 2 bag into a recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from ..arrays import Array, Ints
from ..errors import BadInputError, Place, listed
from ..recording import JOINT_STATE, Header
from ..robot import Payload, Robot
from .publishers import refuse_several_publishers
from .quantities import EFFORT_UNITS, effort_at_joint, effort_side, position_side, si_units
from .time_base import (
    GridValues,
    ImportSummary,
    resample,
    rows_to_interpolate,
    with_warnings,
    write_samples,
)

SUFFIXES = (".mcap", ".db3")
CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
# What the bytes of all its versions begin with: position is that of `reference`, which older
# ones call `desired`.
BEGIN = "std_msgs/Header header\nstring[] name\nfloat64[] position"
Messages = list[tuple[int, Any]]  # with the times of reception, ns


def is_bag(path: Path) -> bool:
    """Whether a path looks like a ROS 2 bag, a folder or a file."""
    return path.is_dir() or path.suffix.lower() in SUFFIXES


@dataclass(frozen=True, kw_only=True)
class BagOptions:
    """Topic of the joint states; unit of the effort, one for all joints or one for
    each; rate of the grid.

    N m and N are at the joints; A, V and their fractions are of the motors, in the order of the
    joints. Without a rate that of the stamps is taken, rounded within their scatter; without a
    topic of the reference the only one of a controller.
    """

    topic: str
    effort_unit: Sequence[str]
    reference_topic: str = ""
    resample_hz: float | None = None


def import_bag(
    bag: Path, robot: Robot, out: Path, options: BagOptions, payload: Payload | None = None
) -> ImportSummary:
    """Write the recording `out` from joint states of a ROS 2 bag; joints are assigned by
    their names in robot.toml.

    Times are the headers' stamps, or those of reception if headers have none; values are
    interpolated to a uniform grid. The recording states that efforts were measured at these times,
    because a JointState has no commands. The reference is of a trajectory controller's states.
    `bag`: a folder, .mcap or .db3; `payload`: what the robot carried.

    Raises `BadInputError`: the bag or its topic cannot be read, efforts are missing, zero,
    not finite or in other units than those of robot.toml, stamps do not grow or have gaps.
    Nothing is written then.
    """
    joints, topic = [joint.name for joint in robot.joints], options.topic
    place = Place(f"{bag}: {topic}")
    position_side(robot, "joint", "position", place)
    read, controllers = _read(bag, options, joints)
    stamps_ns, received, parts, warnings = read.states(topic)
    controller = options.reference_topic or _only_controller(controllers, joints, Place(str(bag)))
    position = parts["position"]
    parts["effort"], provenance, effort_object = _effort(
        robot, parts.get("effort"), options.effort_unit, place
    )
    refuse_several_publishers(position, parts["effort"], joints, place)
    if "velocity" in parts and not np.isfinite(parts["velocity"]).all():
        del parts["velocity"]
        warnings.append("velocities that are not finite numbers are left out")
    first_ns = int(stamps_ns[0])
    time_s = np.asarray((stamps_ns - first_ns) * np.float64(1e-9))
    grid = resample(time_s, parts, rate_hz=options.resample_hz, place=place)
    clock = "times of reception" if received else "header stamps"
    way_out = (
        "record a topic that the robot's own clock stamps, or import a table whose map states "
        "sample_rate_hz"
    )
    grid, reference = (
        replace(with_warnings(grid, time_s, position, clock, way_out), first_ns=first_ns),
        {},
    )
    try:
        if controller:
            states = _Parts(joints, Place(f"{bag}: {controller}"))
            for received_ns, message in controllers[controller]:
                states.add(received_ns, message)
            grid, reference["reference"] = _with_reference(grid, states, received, controller)
    except BadInputError as error:
        if options.reference_topic:
            raise
        warnings.append(f"no reference: {error.args[0]}")
    header = Header(
        robot=robot,
        source=f"ROS 2 bag {bag.name}, topic {topic}",
        sample_rate_hz=grid.rate_hz,
        effort_provenance=provenance,
        effort_timing="measured",
        payload=payload,
        notes={**grid.notes, "effort_object": effort_object, **reference},
    )
    return write_samples(header, grid, warnings, str(place), out)


def _only_controller(
    controllers: Mapping[str, Messages], joints: Sequence[str], place: Place
) -> str | None:
    """Topic of the controller of all joints; of one that lacks some if there is no
    other, None without any.
    """
    found = [
        topic for topic, rows in controllers.items() if rows and {*joints} <= {*rows[0][1].name}
    ]
    if len(found) > 1:
        place.refuse(
            expected="one of them in --topic, after a comma",
            text=f"has the references {listed(found)}",
        )
    return next(iter(found or controllers), None)


def _with_reference(
    grid: GridValues, states: "_Parts", received: bool, topic: str
) -> tuple[GridValues, str]:
    """The part of the grid within the times of a controller's states, with its
    reference; what was done.
    """
    from scipy.interpolate import CubicSpline

    stamps_ns, own_received, own, _ = states.states(topic)
    if own_received != received:
        states.place.refuse(
            "time", expected="stamps in the headers of both topics", text="only one has them"
        )
    own_s = np.asarray((stamps_ns - grid.first_ns) * np.float64(1e-9))
    own_s, rows, report = rows_to_interpolate(own_s, {"reference": own["position"]}, states.place)
    time_s = grid.start_s + np.arange(len(grid.parts["position"])) / grid.rate_hz
    inside = (time_s > own_s[0] - 1e-9) & (time_s < own_s[-1] + 1e-9)
    if not inside.any():
        found = f"from {own_s[0]:.6g} s to {own_s[-1]:.6g} s after the first joint state"
        states.place.refuse("time", expected="some within the joint states", text=found)
    time_s, kept = time_s[inside], {name: x[inside] for name, x in grid.parts.items()}
    kept["reference"] = np.asarray(CubicSpline(own_s, rows["reference"])(time_s))
    text = f"{topic}, {report.rows} rows at {1 / report.period_s:.4g} Hz, interpolated"
    text += f"; {(~inside).sum()} samples before and after it left out" * (not inside.all())
    return replace(grid, parts=kept, start_s=float(time_s[0])), text


def _effort(
    robot: Robot, effort: Array | None, effort_unit: Sequence[str], place: Place
) -> tuple[Array, str, str]:
    """Joint efforts (N, n), their origin, and what they are. A bag does not contain their unit."""
    if effort is None:
        place.refuse(
            expected="measured torques or currents in them", text="messages have no effort"
        )
    _refuse_no_effort(robot, effort, place)
    given = tuple(effort_unit) * (robot.n if len(effort_unit) == 1 else 1)
    units, factors = si_units(given, robot.n, EFFORT_UNITS, "--effort-unit", place)
    at_joint = all(unit in ("N m", "N") for unit in units)
    if at_joint and len(effort_unit) == 1:  # an effort in N m is a force in N where a joint slides
        units = tuple("N m" if joint.type == "revolute" else "N" for joint in robot.joints)
    side = effort_side(robot, units, "joint" if at_joint else None, "effort", place)
    what = f"{', '.join(effort_unit)} at the {side}"
    joint_effort, rule = effort_at_joint(robot, effort * factors, side)
    return joint_effort, f"effort of {place}: {what}, as stated; {rule}", what


def _refuse_no_effort(robot: Robot, effort: Array, place: Place) -> None:
    names = [joint.name for joint in robot.joints]
    for name, x in zip(names, effort.T, strict=True):
        if not np.isfinite(x).any():
            place.refuse(
                f"effort of joint {name}",
                expected="measured efforts",
                text="is no number in any row",
            )
    _refuse_infinite("effort", effort, names, place)
    if not effort.any():
        expected = "measured efforts; this driver does not publish them"
        place.refuse("effort", expected=expected, text="is zero in all rows")


def _refuse_infinite(kind: str, x: Array, joints: Sequence[str], place: Place) -> None:
    if not np.isfinite(x).all():
        row, joint = np.argwhere(~np.isfinite(x))[0]
        key = f"{kind} of joint {joints[joint]}"
        Place(f"{place}: state {row + 1}").refuse(key, float(x[row, joint]), "a finite number")


def _read(
    path: Path, options: BagOptions, joints: Sequence[str]
) -> tuple["_Parts", dict[str, Messages]]:
    """Joint states of the `joints`, by name, in the order of the bag; states of
    trajectory controllers by topic.
    """
    topic, wanted = options.topic, options.reference_topic
    parts = _Parts(joints, Place(f"{path}: {topic}"))
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store = get_typestore(Stores.ROS2_JAZZY)
        store.register(get_types_from_msg(BEGIN, CONTROLLER_STATE))
        begin = store.get_msgdef(CONTROLLER_STATE)
        with AnyReader([path], default_typestore=store) as reader:
            types = {c.topic: c.msgtype for c in reader.connections}
            _refuse_topic(topic, JOINT_STATE, types, Place(str(path)))
            if wanted:
                _refuse_topic(wanted, CONTROLLER_STATE, types, Place(str(path)))
            connections = [c for c in reader.connections if c.topic == topic]
            parts.publishers = sum(
                max(1, len(getattr(c.ext, "offered_qos_profiles", ()))) for c in connections
            )
            others = [c for c in reader.connections if c.msgtype == CONTROLLER_STATE]
            controllers: dict[str, Messages] = {c.topic: [] for c in others}
            for connection, received_ns, raw in reader.messages(
                connections=[*connections, *others]
            ):
                if connection.topic == topic:
                    parts.add(received_ns, reader.deserialize(raw, connection.msgtype))
                else:
                    decode = begin.deserialize_cdr_le if raw[1] else begin.deserialize_cdr_be
                    controllers[connection.topic].append(
                        (received_ns, decode(raw[4:], 0, begin.cls, store)[0])
                    )
    except BadInputError:
        raise
    except OSError as error:
        Place(str(path)).refuse(text=f"cannot be read: {error.strerror or error}")
    except Exception as error:  # readers and SQLite raise errors of any kind for a damaged file
        after = f" after {parts.count} messages" if parts.count else ""
        problem = f"cannot be read{after}: {(str(error) or type(error).__name__)[:200]}"
        Place(str(path)).refuse(expected="a ROS 2 bag: a folder, .mcap or .db3", text=problem)
    return parts, controllers


def _refuse_topic(topic: str, wanted: str, types: dict[str, str], place: Place) -> None:
    if types.get(topic) == wanted:
        return
    states = [name for name, kind in types.items() if kind == wanted]
    problem = f"has type {types[topic]}" if topic in types else "does not exist"
    expected = (
        f"one of {wanted}: {listed(states)}"
        if states
        else f"a topic of {wanted}; it has {listed([*types])}"
    )
    place.refuse(expected=expected, text=f"topic {topic} {problem}")


class _Parts:
    """Collects joint states. Messages of one publisher have one frame and one list of names."""

    def __init__(self, joints: Sequence[str], place: Place) -> None:
        self._joints, self.place = list(joints), place
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
            content = getattr(message, kind, np.empty(0))
            if len(content) not in (0, len(source[1])) or (kind == "position" and not len(content)):
                self._refuse_message(
                    f"{len(content)} values of {kind}", f"{len(source[1])}, one for each name"
                )
            if len(content):
                values.append(content[places])

    def _checked(self, source: tuple[str, tuple[str, ...]]) -> list[int] | None:
        """Indices of the joints in messages of a source; None if it has none of them."""
        names = source[1]
        missing = [joint for joint in self._joints if joint not in names]
        if len(missing) == len(self._joints) and self._joints:
            return None
        if missing:
            problem = f"joints {listed(missing)} missing in {listed(names)}"
            self._refuse_message(
                problem, "all joints of robot.toml in each message, by their names there"
            )
        if self._source is not None:
            apart = (
                f"frame {source[0]!r} after {self._source[0]!r}"
                if source[1] == self._source[1]
                else "other names"
            )
            expected = "one publisher; record the topic of the arm's own driver"
            self._refuse_message(f"messages of several publishers: {apart}", expected)
        self._source = source
        return [names.index(joint) for joint in self._joints]

    def _refuse_message(self, problem: str, expected: str) -> NoReturn:
        Place(f"{self.place}: message {self.count}").refuse(expected=expected, text=problem)

    def states(self, topic: str) -> tuple[Ints, bool, dict[str, Array], list[str]]:
        """Stamps (N,) in ns of the headers, or of reception if headers have none (then True);
        arrays (N, n); warnings.
        """
        if not self._stamps:
            names = sorted({name for _, names in self._places for name in names})
            problem = f"has {listed(names)}" if names else "has no messages"
            self.place.refuse(
                expected=f"the joints {listed(self._joints)} of robot.toml", text=problem
            )
        stamps, count = np.array(self._stamps, dtype=np.int64), len(self._stamps)
        received = not stamps.any()
        # a clock that begins at 0 gives the first stamp 0
        if not received and not stamps[1:].all():
            place = Place(f"{self.place}: state {2 + int(np.argmin(stamps[1:] != 0))}")
            place.refuse(
                expected="stamps in all headers or in none", text="a header without a stamp"
            )
        for kind, values in self._values.items():
            if len(values) not in (0, count):
                problem = f"{kind} in {len(values)} of {count} messages"
                self.place.refuse(expected=f"{kind} in all or in none", text=problem)
        arrays = {
            kind: np.array(values, dtype=np.float64)
            for kind, values in self._values.items()
            if values
        }
        _refuse_infinite("position", arrays["position"], self._joints, self.place)
        warnings = (
            ["headers have no stamps: times are those of reception, which jitter more"]
            if received
            else []
        )
        if self.publishers > 1:
            publishers = f"{self.publishers} publishers (connections or QoS profiles)"
            warnings.append(f"{topic} has {publishers}: record it with one")
        if self._others:
            warnings.append(f"{self._others} messages without any of the joints are left out")
        return (
            np.array(self._received, dtype=np.int64) if received else stamps,
            received,
            arrays,
            warnings,
        )
