"""Imports the joint states of a ROS 2 bag into a recording."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from ..arrays import Array, Ints
from ..errors import BadInputError, Place, listed
from ..files import GrowingBytes, by_rows, taken
from ..recording import JOINT_STATE, Header, in_gaps
from ..robot import Payload, Robot
from .held import grid_of_new_rows
from .publishers import ONE_PUBLISHER, refuse_several_publishers
from .quantities import EFFORT_UNITS, effort_at_joint, effort_side, position_side, si_units
from .time_base import (
    GridValues,
    ImportSummary,
    interpolate,
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
KINDS = ("position", "velocity", "effort")
# of the messages, besides one: a controller that starts again may name joints in another order,
# two publishers change it all the time
MAX_CHANGES = 1e-3
# What to do about a reader's error.
_WAYS_OUT = (
    ("metadata|YAML|Some database files", "a whole folder: `ros2 bag reindex FOLDER` repairs it"),
    (
        "end magic|Truncated|seems to be empty|footer|Invalid argument",
        "a whole file: `mcap recover CUT.mcap -o WHOLE.mcap` keeps what was written",
    ),
    ("Profile is not", "a ROS 2 bag, which `mcap merge` makes with --profile ros2"),
    ("database", "a whole file: `sqlite3 CUT.db3 .recover | sqlite3 WHOLE.db3` keeps what is left"),
    ("", "a ROS 2 bag: a folder, .mcap or .db3"),
)


def is_bag(path: Path) -> bool:
    """Whether a path is that of a ROS 2 bag: a folder, .db3, or .mcap with the profile of ROS 2."""
    if path.suffix.lower() == ".mcap" and path.is_file():
        with path.open("rb") as file:  # magic, op code and length of the header, its profile
            return b"ros2" in file.read(32)
    return path.is_dir() or path.suffix.lower() == ".db3"


@dataclass(frozen=True, kw_only=True)
class BagOptions:
    """Topic of the joint states; unit of the effort, one or one for each joint; rate of the grid.

    N m and N are at the joints; A, V and their fractions are of the motors, in the order of the
    joints. Without a rate that of the stamps is taken, rounded within their scatter; without a
    topic the only one of joint states, and as the reference the only one of a controller.
    """

    effort_unit: Sequence[str]
    topic: str = ""
    reference_topic: str = ""
    resample_hz: float | None = None


def import_bag(
    bag: Path, robot: Robot, out: Path, options: BagOptions, payload: Payload | None = None
) -> ImportSummary:
    """Write the recording `out` from joint states of a ROS 2 bag; joints go by their names.

    Times are the headers' stamps, or those of reception if headers have none; values are
    interpolated to a uniform grid. The recording states that efforts were measured at these times,
    because a JointState has no commands. The reference is of a trajectory controller's states.
    `bag`: a folder, .mcap or .db3; `payload`: what the robot carried. States at the start are left
    out as long as a position or an effort is nan: drivers publish it until they have read one.

    Raises `BadInputError` before anything is written: the bag or its topic cannot be read, efforts
    are missing, zero, not finite or not in units of robot.toml, stamps have gaps or do not grow.
    """
    joints = [joint.name for joint in robot.joints]
    position_side(robot, "joint", "position", Place(str(bag)))
    read, controllers, topic = _read(bag, options, joints)
    place = read.place
    stamps_ns, received, parts, warnings = read.states(topic)
    controller = options.reference_topic or _only_controller(controllers, joints, Place(str(bag)))
    q = parts["position"]
    parts["effort"], provenance, effort_object = _effort(
        robot, parts.get("effort"), options.effort_unit, place
    )
    refuse_several_publishers(q, parts["effort"], joints, place)
    if "velocity" in parts and not np.isfinite(parts["velocity"]).all():
        del parts["velocity"]
        warnings.append("velocities that are not finite numbers are left out")
    first_ns = int(stamps_ns[0])
    time_s = np.asarray((stamps_ns - first_ns) * np.float64(1e-9))
    held = grid_of_new_rows(time_s, parts, place, options.resample_hz)
    clock = "times of reception" if received else "header stamps"
    way_out = (
        "record a topic that the robot's own clock stamps, or import a table whose map states "
        "sample_rate_hz"
    )
    grid = held or with_warnings(
        resample(time_s, parts, rate_hz=options.resample_hz, place=place), time_s, q, clock, way_out
    )
    grid, reference = replace(grid, first_ns=first_ns), dict[str, str]()
    try:
        if controller:
            grid, reference["reference"] = _with_reference(
                grid, controllers[controller], received, controller
            )
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
    chosen = "" if options.topic else f"{topic}, the only one of {JOINT_STATE}"
    return replace(write_samples(header, grid, warnings, str(place), out), topic=chosen)


def _only_controller(
    controllers: Mapping[str, "_Parts"], joints: Sequence[str], place: Place
) -> str | None:
    """Topic of the controller of all joints; of one that lacks some if there is no
    other, None without any.
    """
    found = [topic for topic, states in controllers.items() if {*joints} <= {*states.names}]
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
    at = np.flatnonzero(inside)
    time_s, kept = time_s[at], {name: taken(x, at) for name, x in grid.parts.items()}
    kept["reference"] = interpolate(own_s, rows["reference"], time_s)
    text = f"{topic}, {report.rows} rows at {1 / report.period_s:.4g} Hz, interpolated"
    text += f"; {(~inside).sum()} samples before and after it left out" * (not inside.all())
    absent = np.asarray(grid.absent)[at] | in_gaps(own_s, time_s)
    return replace(grid, parts=kept, start_s=float(time_s[0]), absent=absent), text


def _effort(
    robot: Robot, effort: Array | None, effort_unit: Sequence[str], place: Place
) -> tuple[Array, str, str]:
    """Joint efforts (N, n), their origin, and what they are. A bag does not contain their unit."""
    if effort is None:
        place.refuse(
            expected="measured torques or currents in them", text="messages have no effort"
        )
    if not effort.any():
        expected = "measured efforts; this driver does not publish them"
        place.refuse("effort", expected=expected, text="is zero in all rows")
    given = tuple(effort_unit) * (robot.n if len(effort_unit) == 1 else 1)
    units, factors = si_units(given, robot.n, EFFORT_UNITS, "--effort-unit", place)
    at_joint = all(unit in ("N m", "N") for unit in units)
    if at_joint and len(effort_unit) == 1:  # an effort in N m is a force in N where a joint slides
        units = tuple("N m" if joint.type == "revolute" else "N" for joint in robot.joints)
    side = effort_side(robot, units, "joint" if at_joint else "motor", "--effort-unit", place)
    what = f"{', '.join(effort_unit)} at the {side}"
    joint_effort = by_rows(lambda x: effort_at_joint(robot, x * factors, side)[0], effort)
    rule = effort_at_joint(robot, effort[:1] * factors, side)[1]
    return joint_effort, f"effort of {place}: {what}, as stated; {rule}", what


def _refuse_infinite(kind: str, x: Array, first: int, joints: Sequence[str], place: Place) -> None:
    """Refuse numbers that are not finite in x (N, n) from the row `first` on."""
    finite = np.isfinite(x)
    for name, some in zip(joints, finite.T, strict=True):
        if not some.any():
            place.refuse(
                f"{kind} of joint {name}",
                expected="measured positions and efforts",
                text="is no number in any row",
            )
    if not finite[first:].all():
        row, joint = np.argwhere(~finite[first:])[0] + [first, 0]
        key = f"{kind} of joint {joints[joint]}"
        Place(f"{place}: state {row + 1}").refuse(key, float(x[row, joint]), "a finite number")


def _storage(path: Path) -> Path:
    """The only file of a folder without metadata.yaml (of a record that was killed), or `path`."""
    whole = not path.is_dir() or (path / "metadata.yaml").exists()
    files = [] if whole else sorted(x for x in path.iterdir() if x.suffix.lower() in SUFFIXES)
    if len(files) > 1:
        Place(str(path)).refuse(
            text=f"cannot be read: no metadata.yaml; it has {listed([x.name for x in files])}",
            expected=f"`ros2 bag reindex {path}` first, or the name of one of them",
        )
    return files[0] if files else path


def _read(
    path: Path, options: BagOptions, joints: Sequence[str]
) -> tuple["_Parts", dict[str, "_Parts"], str]:
    """Joint states of the `joints` in the bag's order, controllers' by topic; the topic read."""
    wanted, parts = options.reference_topic, _Parts(joints, Place(str(path)))
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store = get_typestore(Stores.ROS2_JAZZY)
        store.register(get_types_from_msg(BEGIN, CONTROLLER_STATE))
        begin = store.get_msgdef(CONTROLLER_STATE)
        with AnyReader([_storage(path)], default_typestore=store) as reader:
            types = {c.topic: c.msgtype for c in reader.connections}
            topic = _topic_of(JOINT_STATE, options.topic, types, parts.place)
            if wanted:
                _topic_of(CONTROLLER_STATE, wanted, types, parts.place)
            parts.place = Place(f"{path}: {topic}")
            connections = [c for c in reader.connections if c.topic == topic]
            parts.publishers = sum(
                max(1, len(getattr(c.ext, "offered_qos_profiles", ()))) for c in connections
            )
            others = [c for c in reader.connections if c.msgtype == CONTROLLER_STATE]
            controllers = {c.topic: _Parts(joints, Place(f"{path}: {c.topic}")) for c in others}
            for connection, received_ns, raw in reader.messages(
                connections=[*connections, *others]
            ):
                if connection.topic == topic:
                    parts.add(received_ns, reader.deserialize(raw, connection.msgtype))
                elif (states := controllers[connection.topic]).refused is None:
                    decode = begin.deserialize_cdr_le if raw[1] else begin.deserialize_cdr_be
                    try:
                        states.add(received_ns, decode(raw[4:], 0, begin.cls, store)[0])
                    except BadInputError as error:
                        states.refused = error
    except BadInputError:
        raise
    except Exception as error:  # readers and SQLite raise errors of any kind for a damaged file
        after = f" after {parts.count} messages" if parts.count else ""
        told = (getattr(error, "strerror", None) or str(error) or type(error).__name__)[:200]
        Place(str(path)).refuse(
            expected=next(way for pattern, way in _WAYS_OUT if re.search(pattern, told)),
            text=f"cannot be read{after}: {told}",
        )
    return parts, controllers, topic


def _topic_of(kind: str, topic: str, types: dict[str, str], place: Place) -> str:
    """The topic, by default the only one of its kind."""
    found = [name for name, own in types.items() if own == kind]
    if topic in found or (not topic and len(found) == 1):
        return topic or found[0]
    problem = f"has type {types[topic]}" if topic in types else "does not exist"
    place.refuse(
        expected=f"--topic of {kind}; it has {listed(found or [*types])}",
        text=f"topic {topic} {problem}" if topic else f"has {len(found)} topics of joint states",
    )


class _Parts:
    """Collects joint states. Messages of one publisher have one frame, and names of all joints."""

    def __init__(self, joints: Sequence[str], place: Place) -> None:
        self._joints, self.place = list(joints), place
        self._places: dict[tuple[str, tuple[str, ...]], list[int] | None] = {}
        self._source: tuple[str, tuple[str, ...]] | None = None
        columns = [(kind, "<f8", (len(joints),)) for kind in KINDS]
        self._layout = np.dtype([("received", "<i8"), ("stamp", "<i8"), *columns])
        # Rows of `_layout`: messages as Python objects are six times as large.
        self._rows, self._without = GrowingBytes(), np.full(len(joints), np.nan).tobytes()
        self._given = dict.fromkeys(KINDS, 0)
        self.count, self._others, self._changes, self.publishers = 0, 0, 0, 1
        self.refused: BadInputError | None = None

    @property
    def names(self) -> list[str]:
        """All names in the messages."""
        return sorted({name for _, names in self._places for name in names})

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
        self._changes += self._source not in (None, source)
        self._source, stamp = source, message.header.stamp
        row = np.array([received_ns, stamp.sec * 10**9 + stamp.nanosec], "<i8").tobytes()
        for kind in KINDS:
            content = np.asarray(getattr(message, kind, ()), "<f8")
            if len(content) not in (0, len(source[1])) or (kind == "position" and not len(content)):
                self._refuse_message(
                    f"{len(content)} values of {kind}", f"{len(source[1])}, one for each name"
                )
            row += content[places].tobytes() if len(content) else self._without
            self._given[kind] += len(content) > 0
        self._rows.write(row)

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
        if self._source is not None and source[0] != self._source[0]:
            apart = f"frame {source[0]!r} after {self._source[0]!r}"
            self._refuse_message(f"messages of several publishers: {apart}", ONE_PUBLISHER)
        return [names.index(joint) for joint in self._joints]

    def _refuse_message(self, problem: str, expected: str) -> NoReturn:
        Place(f"{self.place}: message {self.count}").refuse(expected=expected, text=problem)

    def states(self, topic: str) -> tuple[Ints, bool, dict[str, Array], list[str]]:
        """Stamps (N,) in ns of the headers, or of reception if headers have none (then True);
        arrays (N, n); warnings.
        """
        if self.refused is not None:
            raise self.refused
        rows = np.frombuffer(self._rows.whole(), self._layout)
        if not len(rows):
            problem = f"has {listed(self.names)}" if self.names else "has no messages"
            self.place.refuse(
                expected=f"the joints {listed(self._joints)} of robot.toml", text=problem
            )
        stamps, count = rows["stamp"].astype(np.int64), len(rows)
        received = not stamps.any()
        # a clock that begins at 0 gives the first stamp 0
        if not received and not stamps[1:].all():
            place = Place(f"{self.place}: state {2 + int(np.argmin(stamps[1:] != 0))}")
            place.refuse(
                expected="stamps in all headers or in none", text="a header without a stamp"
            )
        for kind, given in self._given.items():
            if given not in (0, count):
                problem = f"{kind} in {given} of {count} messages"
                self.place.refuse(expected=f"{kind} in all or in none", text=problem)
        arrays = {kind: rows[kind] for kind, given in self._given.items() if given}
        needed = {kind: x for kind, x in arrays.items() if kind != "velocity"}
        # where none is known, the first one is refused
        first = int(np.argmin(np.any([np.isnan(x).any(axis=1) for x in needed.values()], axis=0)))
        for kind, x in needed.items():
            _refuse_infinite(kind, x, first, self._joints, self.place)
        if self._changes > 1 + MAX_CHANGES * count:
            self.place.refuse(
                expected=ONE_PUBLISHER,
                text=f"the names or their order change {self._changes} times in {count} messages",
            )
        doubts = {
            "headers have no stamps: times are those of reception, which jitter more": received,
            f"{topic} has {self.publishers} publishers (connections or QoS profiles): record it "
            "with one": self.publishers > 1,
            f"{self._others} messages without any of the joints are left out": self._others,
            f"the names or their order change {self._changes} times: joints go by their "
            "names": self._changes,
            f"{first} states at the start are left out: a position or an effort is nan "
            "there": first,
        }
        return (
            (rows["received"].astype(np.int64) if received else stamps)[first:],
            received,
            {kind: x[first:] for kind, x in arrays.items()},
            [text for text, holds in doubts.items() if holds],
        )
