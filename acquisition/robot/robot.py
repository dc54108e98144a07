"""The robot of a description: joints, motors, the matrix between them, gains, limits.

SI units, angles in radians.
"""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path

import msgspec
import numpy as np

from ..arrays import Array
from ..errors import Location
from ..files import read_bytes, read_meshes
from .bus import FILL_IN, BusFile, dictionary_label
from .description import Joint, Motor, RobotFile
from .fit_tables import GAINS, Capsule, Controller, Identification, PayloadFile
from .toml import InvalidValueError, parse_toml

# This attachment describes the drives of a dry run, and replaces [controller].
SIMULATED_CONTROLLER = "simulated_controller.toml"
# What a person does before a robot with `unconfirmed` joints may move.
HOW_TO_CONFIRM = (
    "Move each of them by hand while `robot-acquire record --passive` or `check` shows its "
    "position, compare direction, amount and limits, then delete the key"
)
# Guards of [bus] and [[joint]] above these values would not stop anything in time.
MAX_BUS_GUARDS = {
    "heartbeat_s": 1.0,
    "late_sync_s": 1.0,
    "enable_motion_deg": 10.0,
    "enable_motion_m": 0.1,
}
MAX_JOINT_GUARDS = {
    "following_error_deg": 30.0,
    "following_error_m": 0.3,
    "speed_deg_s": 3000.0,
    "speed_m_s": 20.0,
}
# Other files by their first byte, and what to do with them.
_OTHER_FILES = {
    b"<": ("a URDF", "Make a robot.toml from it: `robot-identify init {0} -o robot.toml`"),
    b"{": (
        "a JSON file",
        "Make a robot.toml from a fit: `robot-identify export {0} --toml robot.toml`",
    ),
    b"\x89": ("a recording", "Pass the robot.toml"),
}
# The attachment of a mesh has this prefix before its name in the URDF: a label, never a path.
_MESH = "mesh:"


@dataclass(frozen=True, kw_only=True)
class Base:
    """The part that does not move.

    It has a shape, and the height of the ground in its frame, against gravity. Both are None if not
    given.
    """

    capsule: Capsule | None = None
    ground_m: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Robot:
    """A validated robot with `n` joints and as many motors.

    Attributes:
        R: motor matrix (n, n): motor speed = R · joint speed, joint torque = Rᵀ · motor torque.
        gravity: (3,) gravity in the base frame, m/s².
        parameters: a priori standard parameters by name, SI; may be empty.
        payload: frame and accuracy of payloads.
        base: the part that does not move.
        identified_gain: (n,) drive gains, motor torque per unit of recorded effort, that replace
            those of the motors.
        bus: `[bus]` of the file, None without it; `resolve` makes the drives.
        files: files of the description by name (`robot.toml`, the URDF and its meshes, object
            dictionaries).
        urdf: text of the URDF; None without one.
        unconfirmed: names of joints that were corrected from a recording, and that no person has
            checked yet.
    """

    name: str
    joints: tuple[Joint, ...]
    motors: tuple[Motor, ...]
    controller: Controller
    identification: Identification
    R: Array
    gravity: Array
    parameters: Mapping[str, float]
    payload: PayloadFile
    bus: BusFile | None
    files: Mapping[str, bytes]
    urdf: str | None
    base: Base = Base()
    identified_gain: Array | None = None
    unconfirmed: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return (
            f"Robot({self.name}: {self.n} "
            f"joints{'' if self.bus is None else f', {len(self.bus.drive)} drives'})"
        )

    def mesh(self, name: str) -> bytes | None:
        """Return the content of a mesh by its name in the URDF.

        The result is None if the robot does not include the mesh.
        """
        return self.files.get(f"{_MESH}{name}")

    @cached_property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @cached_property
    def zero(self) -> Array:
        """Joint positions (n,) at motor position 0, rad or m."""
        # The broadcast array is read-only, as the robot is.
        return np.broadcast_to([j.si("zero") or 0.0 for j in self.joints], self.n)

    @cached_property
    def bandwidth_hz(self) -> float:
        """Bandwidth of the position loop in Hz.

        `BadInputError` is raised if the description does not give it.
        """
        if self.controller.bandwidth_hz is None:
            Location(f"robot {self.name}").refuse(
                "controller.bandwidth_hz",
                None,
                advice="Give the bandwidth of the position loop in Hz",
            )
        return self.controller.bandwidth_hz

    @cached_property
    def gain_known(self) -> bool:
        """True if efforts are torques and forces; otherwise they are in A or V."""
        return self.identified_gain is not None or all(m.gain is not None for m in self.motors)

    @cached_property
    def gain(self) -> Array:
        """Drive gains (n,), motor torque per unit of recorded effort; ones if unknown."""
        return (
            np.broadcast_to(  # read-only
                [1.0 if m.gain is None else m.gain for m in self.motors], self.n
            )
            if self.identified_gain is None
            else self.identified_gain
        )

    @cached_property
    def saturation(self) -> Array:
        """Limits (n,) of the motors' efforts, as recorded; infinite without a limit."""
        # The broadcast array is read-only, as the robot is.
        return np.broadcast_to(
            [np.inf if m.saturation is None else m.saturation for m in self.motors], self.n
        )

    @cached_property
    def effort_units(self) -> tuple[str, ...]:
        """Unit of each joint's effort: N m or N if the drive gains are known, otherwise A or V."""
        return (
            tuple("N m" if j.type == "revolute" else "N" for j in self.joints)
            if self.gain_known
            else tuple(m.recorded_unit for m in self.motors)
        )

    def joint_position(self, q_motor: Array) -> Array:
        """Compute joint positions (N, n) in rad or m from motor positions (N, n).

        They are inv(R) q_motor + zero.
        """
        return np.linalg.solve(self.R, q_motor.T).T + self.zero

    def joint_velocity(self, dq_motor: Array) -> Array:
        """Compute joint speeds (N, n) in rad/s or m/s from motor speeds (N, n): inv(R) dq_motor."""
        return np.asarray(np.linalg.solve(self.R, dq_motor.T).T)

    def motor_velocity(self, dq: Array) -> Array:
        """Compute motor speeds (N, n) from joint speeds (N, n); the inverse of `joint_velocity`."""
        return np.asarray(dq @ self.R.T)

    def motor_position(self, q: Array) -> Array:
        """Compute motor positions (N, n) from joint positions (N, n).

        This is the inverse of `joint_position`.
        """
        return (q - self.zero) @ self.R.T

    def joint_effort(self, effort_motor: Array) -> Array:
        """Compute joint efforts (N, n) from recorded motor efforts v (N, n): Rᵀ G v.

        They are in A or V if the gain is unknown.
        """
        return (effort_motor * self.gain) @ self.R

    def motor_effort(self, effort: Array) -> Array:
        """Compute motor efforts (N, n) in the recorded unit from joint efforts (N, n).

        This is the inverse of `joint_effort`.
        """
        return np.linalg.solve(self.R.T, effort.T).T / self.gain


def load_robot(path: str | PathLike[str]) -> Robot:
    """Read a robot description, its URDF (with meshes if `urdf_meshes`) and its dictionaries.

    Parameters
    ----------
    path : path of robot.toml; the other files are in the same folder.

    Returns
    -------
    The checked robot, in SI units and radians.

    Raises
    ------
    BadInputError : a file cannot be read, or a key is wrong; with `place` (the file), `key`,
        `value`, and what is expected or advised.
    """
    path = Path(path)
    place = Location(str(path))
    files = {"robot.toml": read_bytes(path)}
    kind, way_out = _OTHER_FILES.get(
        files["robot.toml"].lstrip(b"\xef\xbb\xbf \t\r\n")[:1], ("", "")
    )
    place.require(not kind, text=f"this is {kind}, not a robot.toml", advice=way_out.format(path))
    document = parse_toml(files["robot.toml"], RobotFile, str(path))
    _refuse_idle_keys(document.controller, place.at("controller"))
    _refuse_wide_guards(document, place)
    if document.urdf is not None:
        files["robot.urdf"] = _companion(path, document.urdf, "urdf")
        if document.urdf_meshes:
            meshes = read_meshes(
                files["robot.urdf"], (path.parent / document.urdf).parent, str(path)
            )
            files |= {f"{_MESH}{name}": content for name, content in meshes.items()}
    for i, drive in enumerate(document.bus.drive if document.bus else ()):
        for k, extra in enumerate(drive.extra):
            if not isinstance(extra, str):
                place.refuse(
                    f"bus.drive[{i}].extra[{k}]",
                    extra,
                    text="a table has no effect, because frames contain raw integers",
                    advice=f"Write {extra['object']!r} alone",
                    shown="a table",
                )
        if drive.dictionary is not None:
            files[dictionary_label(drive.dictionary)] = _companion(
                path, drive.dictionary, f"bus.drive[{i}].dictionary"
            )
    return robot_from_files(files, str(path))


# A new description may not have keys or guards without effect. Recordings that have one can still
# be read, so this is not checked in the structures.
def _refuse_idle_keys(c: Controller, place: Location) -> None:
    idle: dict[str | None, tuple[str, ...]] = {
        None: ("sample_rate_hz", *GAINS, "velocity_estimate"),
        "cascade_p_pi": (),
        "pid": (),
    }
    for name in idle.get(c.structure, ("integral_gain",)):
        value = getattr(c, name)
        place.require(
            value is None,
            name,
            list(value) if isinstance(value, tuple) else value,
            text="it has no effect without controller.structure"
            if c.structure is None
            else f"it has no effect with structure = {c.structure!r}",
            advice="Give controller.structure, or remove it"
            if c.structure is None
            else "Remove it",
        )


def _refuse_wide_guards(document: RobotFile, place: Location) -> None:
    joints = ((f"joint[{i}]", joint, MAX_JOINT_GUARDS) for i, joint in enumerate(document.joint))
    for table, stated, guards in (("bus", document.bus, MAX_BUS_GUARDS), *joints):
        for name, most in guards.items():
            # A description without a bus has no such keys.
            value = getattr(stated, name, None)
            place.at(table).require(
                value is None or value <= most, name, value, f"at most {most:g}"
            )


def _companion(path: Path, name: str, key: str) -> bytes:
    try:
        return (path.parent / name).read_bytes()
    # A zero character in the name raises ValueError.
    except (OSError, ValueError) as error:
        Location(str(path)).refuse(
            key, name, text=f"the file cannot be read: {getattr(error, 'strerror', error)}"
        )


def robot_from_files(files: Mapping[str, bytes], place: str) -> Robot:
    """Build a robot from its files by name, as in a recording.

    Parameters
    ----------
    files : `robot.toml`, and if it refers to them `robot.urdf`, `mesh:<name>` and
        `dictionary:<name>`; of a dry run also `simulated_controller.toml`.
    place : name of the description in errors.

    Raises
    ------
    BadInputError : a file is missing, or a key is wrong.
    """
    at = Location(place)
    if "robot.toml" not in files:
        at.refuse(text="the recording has no robot.toml attached")
    f = parse_toml(files["robot.toml"], RobotFile, place)
    if (law := files.get(SIMULATED_CONTROLLER)) is not None:
        try:
            f = msgspec.structs.replace(
                f, controller=parse_toml(law, Controller, f"{place}: {SIMULATED_CONTROLLER}")
            )
        except InvalidValueError as refusal:
            at.refuse(*refusal.args[:2], **refusal.args[2])
    urdf = None
    if f.urdf is not None:
        at.require(
            "robot.urdf" in files,
            "urdf",
            f.urdf,
            text="the URDF is missing beside robot.toml",
        )
        urdf = files["robot.urdf"].decode("utf-8", errors="replace")
        # This finds typing errors; the model checks the tree of links.
        at.require(
            f.payload.frame is None or f.payload.frame in urdf,
            "payload.frame",
            f.payload.frame,
            text="the URDF has no such link",
            advice="Name a link of the URDF",
        )
    R = (
        np.diag([1.0 if m.ratio is None else m.ratio for m in f.motor])
        if f.motor_matrix is None
        else np.array(f.motor_matrix, dtype=float)
    )
    gravity = np.array(f.gravity_m_s2, dtype=float)
    for array in (R, gravity):
        array.flags.writeable = False
    names = [
        "robot.toml",
        "robot.urdf",
        SIMULATED_CONTROLLER,
        *(name for name in files if name.startswith(_MESH)),
        *(dictionary_label(d.dictionary) for d in (f.bus.drive if f.bus else ()) if d.dictionary),
    ]
    return Robot(
        name=f.name,
        joints=f.joint if urdf is None else _with_urdf_efforts(f.joint, urdf, at),
        motors=f.motor,
        controller=f.controller,
        identification=f.identification,
        R=R,
        gravity=gravity,
        parameters=f.parameters,
        payload=f.payload,
        bus=f.bus,
        files={name: files[name] for name in names if name in files},
        urdf=urdf,
        base=Base(capsule=f.base_capsule, ground_m=f.ground_m),
        unconfirmed=f.unconfirmed,
    )


_OF_MOTION = re.compile(r"\[\[?(bus|motor)\b")
_LIMIT = re.compile(r"[# ]*(position|speed|acceleration|following_error)_(deg|m)(_s2?)?\b")


def lines_to_fill_in(robot: Robot) -> list[int]:
    """Return the numbers of the lines of robot.toml with `FILL_IN` that motion needs."""
    return marks_of_motion(robot.files["robot.toml"].decode())


def marks_of_motion(text: str) -> list[int]:
    """Return the numbers of these lines in a robot.toml that need not load yet.

    They are marks in `[bus]` and `[[motor]]`, in the comments above these tables, and in limits of
    joints.
    """
    found, above, inside = [], list[int](), False
    for number, line in enumerate(text.splitlines(), 1):
        marked, begins = [number] if FILL_IN in line else [], line.startswith("[")
        inside = _OF_MOTION.match(line) is not None if begins else inside
        needed = inside or _LIMIT.match(line) is not None
        found += (above if begins and inside else []) + (marked if needed else [])
        above = above + marked if line.startswith("#") and not needed else []
    return found


def _with_urdf_efforts(joints: tuple[Joint, ...], urdf: str, place: Location) -> tuple[Joint, ...]:
    """Give joints without an effort limit that of the URDF, unless it is 0 or missing."""
    try:
        # Joints inside of transmissions have no limits, so only those at the top are read.
        limits = {
            joint.get("name"): limit.get("effort", "")
            for joint in ET.fromstring(urdf).findall("joint")
            for limit in joint.findall("limit")[:1]
        }
    # The code that needs the model reports a URDF that cannot be read.
    except (ET.ParseError, ValueError, LookupError):
        return joints
    out = []
    for joint in joints:
        text = limits.get(joint.name, "")
        try:
            effort = float(text or 0)
        except ValueError:
            effort = math.nan
        place.require(
            0 <= effort < math.inf,
            f"urdf: joint {joint.name}: effort",
            text,
            "0 or greater (0: no limit)",
        )
        if effort and joint.si("effort") is None:
            joint = msgspec.structs.replace(joint, **{joint.key("effort"): effort})
        out.append(joint)
    return tuple(out)
