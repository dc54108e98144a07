"""Import of the joint states of a ROS 2 bag into a recording."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import COMMAND_LINE, BadInputError, Location, listed
from ..files import by_rows, taken
from ..recording import JOINT_STATE, Header, in_gaps
from ..robot import Payload, Robot
from .held import grid_of_new_rows
from .joint_states import JointStates, refuse_several_publishers
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
# The bytes of all its versions begin with this; position is that of `reference`, which older
# versions call `desired`.
BEGIN = "std_msgs/Header header\nstring[] name\nfloat64[] position"
# The advice for an error of a reader, by words in its message.
_WAYS_OUT = (
    ("metadata|YAML|Some database files", "Repair the folder: `ros2 bag reindex FOLDER`"),
    (
        "end magic|Truncated|seems to be empty|footer|Invalid argument",
        "Recover what was written: `mcap recover CUT.mcap -o WHOLE.mcap`",
    ),
    ("Profile is not", "Make it a ROS 2 bag: `mcap merge --profile ros2`"),
    ("database", "Recover what is left: `sqlite3 CUT.db3 .recover | sqlite3 WHOLE.db3`"),
    ("", "Import a ROS 2 bag: a folder, .mcap or .db3"),
)


def is_bag(path: Path) -> bool:
    """Test for a ROS 2 bag: a folder, .db3, or .mcap with the profile of ROS 2."""
    if path.suffix.lower() == ".mcap" and path.is_file():
        # The file begins with a magic, op code and length of the header, and its profile.
        with path.open("rb") as file:
            return b"ros2" in file.read(32)
    return path.is_dir() or path.suffix.lower() == ".db3"


@dataclass(frozen=True, kw_only=True)
class BagOptions:
    """Options of the import of a bag.

    Attributes:
        effort_unit: unit of the effort, one or one per joint. N m and N are at the joints; A, V and
            their fractions are at the motors, in the order of the joints.
        topic: topic of the joint states; by default the only one.
        reference_topic: topic of a controller with the reference; by default the only one.
        resample_hz: rate of the grid in Hz; by default that of the timestamps, rounded within their
            scatter.
    """

    effort_unit: Sequence[str]
    topic: str = ""
    reference_topic: str = ""
    resample_hz: float | None = None


def import_bag(
    bag: Path, robot: Robot, out: Path, options: BagOptions, payload: Payload | None = None
) -> ImportSummary:
    """Write the recording `out` from joint states of a ROS 2 bag.

    Joints are identified by their names. Times are the timestamps of the headers, or reception
    times if headers have none. Values are interpolated to a uniform grid. In the recording,
    efforts count as measured at these times, because a JointState has no commands. The reference
    comes from the states of a trajectory controller. States at the start are left out as long as a
    position or an effort is nan: drivers publish nan until they have read a value.

    Parameters
    ----------
    bag : a folder, .mcap or .db3.
    robot : the robot, whose joints have the names of the messages.
    out : the recording to write.
    options : topics, units and rate.
    payload : what the robot carried.

    Raises
    ------
    BadInputError : the bag or its topic cannot be read; efforts are missing, zero, not finite or
        not in units of robot.toml; or timestamps have gaps or do not grow. Nothing is written then.
    """
    joints = [joint.name for joint in robot.joints]
    position_side(robot, "joint", "position", Location(str(bag)))
    read, controllers, topic = _read(bag, options, joints)
    place = read.place
    stamps_ns, received, parts, warnings = read.states(topic)
    controller = options.reference_topic or _only_controller(
        controllers, joints, Location(str(bag))
    )
    parts["effort"], provenance, effort_object = _effort(
        robot, parts.get("effort"), options.effort_unit, place
    )
    refuse_several_publishers(parts["position"], parts["effort"], joints, place)
    if "velocity" in parts and not np.isfinite(parts["velocity"]).all():
        del parts["velocity"]
        warnings.append("some velocities are not finite, so no velocities are imported")
    first_ns = int(stamps_ns[0])
    time_s = np.asarray((stamps_ns - first_ns) * np.float64(1e-9))
    grid = grid_of_new_rows(time_s, parts, place, options.resample_hz) or with_warnings(
        resample(time_s, parts, rate_hz=options.resample_hz, place=place),
        time_s,
        parts["position"],
        "reception times" if received else "header timestamps",
        "record a topic with timestamps of the robot's own clock, or import a table whose map "
        "gives sample_rate_hz",
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
        warnings.append(f"no reference is imported: {error}")
    return replace(
        write_samples(
            Header(
                robot=robot,
                source=f"ROS 2 bag {bag.name}, topic {topic}",
                sample_rate_hz=grid.rate_hz,
                effort_provenance=provenance,
                effort_timing="measured",
                payload=payload,
                notes={**grid.notes, "effort_object": effort_object, **reference},
            ),
            grid,
            warnings,
            str(place),
            out,
        ),
        topic="" if options.topic else f"{topic}, the only one of {JOINT_STATE}",
    )


def _only_controller(
    controllers: Mapping[str, JointStates], joints: Sequence[str], place: Location
) -> str | None:
    """Return the topic of the only controller of all joints.

    Without one, return that of a controller that lacks some joints, or None.
    """
    found = [topic for topic, states in controllers.items() if {*joints} <= {*states.names}]
    place.require(
        len(found) <= 1,
        text=f"several controllers publish a reference: {listed(found)}",
        advice="Name one of them, after the topic and a comma",
        arguments=("topic",),
    )
    return next(iter(found or controllers), None)


def _with_reference(
    grid: GridValues, states: JointStates, received: bool, topic: str
) -> tuple[GridValues, str]:
    """Add the reference of a controller to a grid; also return what was done.

    The grid is cut to the times of the controller's states.
    """
    stamps_ns, own_received, own, _ = states.states(topic)
    states.place.require(
        own_received == received,
        "time",
        text="only one of the two topics has timestamps in its headers",
        advice="Record both topics with timestamps in the headers",
    )
    own_s, rows, report = rows_to_interpolate(
        np.asarray((stamps_ns - grid.first_ns) * np.float64(1e-9)),
        {"reference": own["position"]},
        states.place,
    )
    time_s = grid.start_s + np.arange(len(grid.parts["position"])) / grid.rate_hz
    inside = (time_s > own_s[0] - 1e-9) & (time_s < own_s[-1] + 1e-9)
    states.place.require(
        inside.any(),
        "time",
        text=f"the reference lasts from {own_s[0]:.6g} s to {own_s[-1]:.6g} s after the first "
        "joint state, outside the joint states",
        advice="Record both topics at the same time",
    )
    at = np.flatnonzero(inside)
    time_s = time_s[at]
    left_out = f"; {(~inside).sum()} samples before and after it left out" * (not inside.all())
    return (
        replace(
            grid,
            parts={
                **{name: taken(x, at) for name, x in grid.parts.items()},
                "reference": interpolate(own_s, rows["reference"], time_s),
            },
            start_s=float(time_s[0]),
            absent=np.asarray(grid.absent)[at] | in_gaps(own_s, time_s),
        ),
        f"{topic}, {report.rows} rows at {1 / report.period_s:.4g} Hz, interpolated{left_out}",
    )


def _effort(
    robot: Robot, effort: Array | None, effort_unit: Sequence[str], place: Location
) -> tuple[Array, str, str]:
    """Convert the efforts of a bag, which does not contain their unit, to the joints.

    Returns joint efforts (N, n), their origin, and unit and side.
    """
    advice = "Record a topic with measured torques or currents"
    effort = place.given(effort, text="the messages contain no efforts", advice=advice)
    place.require(
        effort.any(),
        "effort",
        text="all values are 0, because this driver does not publish efforts",
        advice=advice,
    )
    units, factors = si_units(
        tuple(effort_unit) * (robot.n if len(effort_unit) == 1 else 1),
        robot.n,
        EFFORT_UNITS,
        "effort_unit",
        COMMAND_LINE,
    )
    at_joint = all(unit in ("N m", "N") for unit in units)
    # One unit for all joints means a force in N where a joint slides.
    if at_joint and len(effort_unit) == 1:
        units = tuple("N m" if joint.type == "revolute" else "N" for joint in robot.joints)
    side = effort_side(robot, units, "joint" if at_joint else "motor", "effort_unit", COMMAND_LINE)
    what = f"{', '.join(effort_unit)} at the {side}"
    return (
        by_rows(lambda x: effort_at_joint(robot, x * factors, side)[0], effort),
        f"effort of {place}: {what}, as given; "
        + effort_at_joint(robot, effort[:1] * factors, side)[1],
        what,
    )


def _storage(path: Path) -> Path:
    """Return the only file of a folder without metadata.yaml (of a killed recorder), or `path`."""
    files = (
        sorted(x for x in path.iterdir() if x.suffix.lower() in SUFFIXES)
        if path.is_dir() and not (path / "metadata.yaml").exists()
        else []
    )
    Location(str(path)).require(
        len(files) <= 1,
        text=f"the folder has no metadata.yaml, but several files: "
        f"{listed([x.name for x in files])}",
        advice=f"Run `ros2 bag reindex {path}` first, or import one of the files",
    )
    return files[0] if files else path


def _read(
    path: Path, options: BagOptions, joints: Sequence[str]
) -> tuple[JointStates, dict[str, JointStates], str]:
    """Read the joint states of a bag; also return those of controllers, and the chosen topic.

    The states of controllers are given by topic.
    """
    wanted, parts = options.reference_topic, JointStates(joints, Location(str(path)))
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
            parts.place = Location(f"{path}: {topic}")
            connections = [c for c in reader.connections if c.topic == topic]
            parts.publishers = sum(
                max(1, len(getattr(c.ext, "offered_qos_profiles", ()))) for c in connections
            )
            others = [c for c in reader.connections if c.msgtype == CONTROLLER_STATE]
            controllers = {
                c.topic: JointStates(joints, Location(f"{path}: {c.topic}")) for c in others
            }
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
    # For a damaged file, readers and SQLite raise errors of any kind.
    except Exception as error:
        told = (getattr(error, "strerror", None) or str(error) or type(error).__name__)[:200]
        Location(str(path)).refuse(
            text=f"the bag cannot be read"
            f"{f' after {parts.count} messages' if parts.count else ''}: {told}",
            advice=next(way for pattern, way in _WAYS_OUT if re.search(pattern, told)),
        )
    return parts, controllers, topic


def _topic_of(kind: str, topic: str, types: dict[str, str], place: Location) -> str:
    """Choose the topic, by default the only one of its kind."""
    found = [name for name, own in types.items() if own == kind]
    if topic in found or (not topic and len(found) == 1):
        return topic or found[0]
    place.refuse(
        text=(
            f"the bag has {len(found)} topics of joint states"
            if not topic
            else f"topic {topic} has the type {types[topic]}"
            if topic in types
            else f"topic {topic} does not exist"
        )
        + f" ({listed(found or [*types])})",
        advice=f"Choose a topic of type {kind}",
        arguments=("topic",),
    )
