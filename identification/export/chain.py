"""Read the joints of a URDF that are identified: the longest serial chain, or named joints.

Other joints are locked at zero. A URDF must be one tree of links and joints.
"""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.errors import COMMAND_LINE, Location, listed
from acquisition.files import read_bytes

from ..errors import BadInputError

MOVABLE = ("revolute", "continuous", "prismatic")
_TYPES = (*MOVABLE, "fixed", "floating", "planar")
INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_JOINT_NAME = re.compile(r"[A-Za-z0-9_.\- ]{1,64}")  # as in robot.toml
_MAX_ROUNDING = 1e-6  # of the largest principal moment, as CAD programs write few digits
_NUMBERS = {
    "speed": ("limit", "velocity"),
    "effort": ("limit", "effort"),
    "damping": ("dynamics", "damping"),
    "friction": ("dynamics", "friction"),
}
_OF_JOINTS = "position", "speed", "acceleration", "following_error", "ratio", "drive_gain"
# Units of efforts that go with a value.
_EFFORTS = {
    "ratio": ("A", "N m", "%", "V", "N"),
    "drive_gain": ("A", "%", "V"),
    "torque_sensor": ("N m",),
}
_OF_A_HAND = re.compile("finger|thumb|gripper|knuckle|jaw", re.IGNORECASE)


class UrdfTree:
    """A URDF that is one tree.

    Attributes:
        place: the file.
        name: name of the robot.
        links, joints: elements by name.
        above: joint that carries each link.
    """

    def __init__(self, text: bytes, place: Location) -> None:
        try:
            robot = ET.fromstring(text)
        except (ET.ParseError, ValueError, LookupError) as error:
            raise BadInputError(
                f"is not XML: {error}", place=place.name, expected="a URDF"
            ) from error
        place.require(
            robot.tag == "robot",
            "root element",
            robot.tag,
            "<robot>",
            shown=f"<{robot.tag}>",
        )
        place.require(
            not any("xacro" in str(element.tag) for element in robot.iter()),
            text="has xacro elements",
            advice="Convert it first: `xacro FILE > robot.urdf`",
        )
        self.place, self.name = place, robot.get("name") or ""
        self.links, self.joints = (_by_name(robot, tag, place) for tag in ("link", "joint"))
        self.above: dict[str, str] = {}
        for name, joint in self.joints.items():
            self._check_joint(name, joint)
            self.above[_end(joint, "child")] = name
        roots = [link for link in self.links if link not in self.above]
        place.require(
            len(roots) == 1,
            text=f"has {len(roots)} root links: {listed(roots)}"
            if roots
            else "has no root link, since its joints form a loop",
            advice="Give it one base link, which is not the child of any joint",
        )
        if loop := [
            link for link in self.links if len(self.path(self.above.get(link))) > len(self.joints)
        ]:
            place.refuse(
                text=f"links {listed(loop)} are in a loop of joints",
                advice="Break the loop, so that the links form a tree",
            )

    def _check_joint(self, name: str, joint: ET.Element) -> None:
        at, kind = Location(f"{self.place}: joint {name!r}"), joint.get("type")
        at.require(kind in _TYPES, "type", kind, f"one of {', '.join(_TYPES)}")
        child = _end(joint, "child")
        for tag, link in (("parent", _end(joint, "parent")), ("child", child)):
            at.require(
                link in self.links, tag, link or None, f"one of the links {listed([*self.links])}"
            )
        at.require(
            child not in self.above,
            "child",
            child,
            text=f"is the child of joint {self.above.get(child)!r} too",
            advice="Give each link one parent joint",
        )

    def path(self, joint: str | None) -> list[str]:
        """Return the joints from the root to `joint`, including it.

        If joints form a loop, these are more than the URDF has.
        """
        path: list[str] = []
        while joint is not None and len(path) <= len(self.joints):
            path.append(joint)
            joint = self.above.get(_end(self.joints[joint], "parent"))
        return path[::-1]

    @property
    def movable(self) -> list[str]:
        """Revolute, continuous and prismatic joints that do not mimic another joint."""
        return [
            name
            for name, j in self.joints.items()
            if j.get("type") in MOVABLE and j.find("mimic") is None
        ]


def _by_name(robot: ET.Element, tag: str, place: Location) -> dict[str, ET.Element]:
    elements: dict[str, ET.Element] = {}
    for i, element in enumerate(robot.findall(tag), 1):
        name = element.get("name", "")
        Location(f"{place}: {tag} {i}").require(
            name and name not in elements,
            "name",
            name or None,
            text="is used twice" if name else "",
            advice=f"Give each {tag} a name of its own",
        )
        elements[name] = element
    place.require(elements, text=f"has no {tag}", advice="Add its links and joints")
    return elements


def _end(joint: ET.Element, tag: str) -> str:
    """Return the `parent` or `child` link of a joint; empty if missing."""
    return attribute_of(joint, tag, "link") or ""


def attribute_of(element: ET.Element, tag: str, name: str) -> str | None:
    """Return an attribute of the first child `tag`; None without one."""
    child = element.find(tag)
    return None if child is None else child.get(name)


def finite_number(text: str | None, place: Location, key: str) -> float:
    """Read a finite number of a URDF; refuse anything else."""
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    place.require(math.isfinite(value), key, text, "a finite number")
    return value


@dataclass(frozen=True, kw_only=True)
class UrdfJoint:
    """A joint of the chain, SI: rad or m, N m or N; missing values are None.

    The last five values are not part of a URDF.

    Attributes:
        name: name of the joint.
        type: `revolute` or `prismatic`.
        position: lower and upper limit.
        speed, effort: limits.
        damping, friction: viscous and Coulomb friction; 0 if missing.
        acceleration, following_error: limits.
        ratio: motor rad (or m) per joint rad (or m).
        drive_gain: motor torque or force per unit of the recorded effort.
        effort_unit: unit of the recorded effort; empty for N m or N at the joint.
    """

    name: str
    type: str
    position: tuple[float, float] | None = None
    speed: float | None = None
    effort: float | None = None
    damping: float = 0.0
    friction: float = 0.0
    acceleration: float | None = None
    following_error: float | None = None
    ratio: float | None = None
    drive_gain: float | None = None
    effort_unit: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """The robot to identify, from a URDF and further values.

    Attributes:
        place: file of the URDF.
        name: name of the robot, valid in robot.toml.
        text: the URDF.
        joints: joints to identify, numbered from the base outwards.
        locked: other movable joints, fixed at zero, each with its type and the joint it mimics.
        rigid: for each joint of the chain, the links that move with it as one rigid body.
        notes: remarks on unusual inertials.
        has_inertials: True if the inertials are a priori values: each joint moves a mass, and none
            is negative.
        bandwidth_hz: bandwidth of the position loops, which is not part of a URDF.
        torque_sensors: True if the recorded efforts are from joint torque sensors.
    """

    place: str
    name: str
    text: bytes
    joints: tuple[UrdfJoint, ...]
    locked: tuple[str, ...] = ()
    rigid: tuple[tuple[str, ...], ...] = ()
    notes: tuple[str, ...] = ()
    has_inertials: bool = True
    bandwidth_hz: float | None = None
    torque_sensors: bool = False

    def units_of(self, units: Sequence[str]) -> list[str]:
        """Return units of efforts, one or one per joint, by joint; N m is N for sliding joints."""
        each = [*units] * (len(self.joints) if len(units) == 1 else 1)
        return [
            "N" if unit == "N m" and joint.type == "prismatic" and len(units) == 1 else unit
            for joint, unit in zip(self.joints, each, strict=False)
        ]

    def with_efforts(self, units: Sequence[str], given: Mapping[str, Any]) -> "Chain":
        """Return the chain with the units of the recorded efforts, and with values.

        Parameters
        ----------
        units : units by joint.
        given : values as in `with_values`, and `torque_sensor` if these measure the efforts.

        Raises
        ------
        BadInputError : a value does not go with the units, or as `with_values`.
        """
        for name, fit in _EFFORTS.items():
            sensed = name == "ratio" and "torque_sensor" in given
            COMMAND_LINE.require(
                name not in given or ({*units} & {*fit} and not sensed),
                name,
                given.get(name),
                text="cannot be combined with torque sensors"
                if sensed
                else f"requires efforts in {' or '.join(fit)}",
            )
        pairs = zip(self.joints, units, strict=True)
        return replace(
            self,
            joints=tuple(replace(joint, effort_unit=unit) for joint, unit in pairs),
            torque_sensors="torque_sensor" in given,
        ).with_values({name: x for name, x in given.items() if name != "torque_sensor"})

    def with_values(self, given: Mapping[str, Sequence[float]]) -> "Chain":
        """Return the chain with values that the URDF lacks.

        Parameters
        ----------
        given : values by name, one for all joints or one for each: `position` (± about zero),
            `speed`, `acceleration`, `following_error` in rad or m (per s, s²), `ratio`,
            `drive_gain` as in `UrdfJoint`, and `bandwidth_hz`, of which the lowest is used. The
            URDF's own position and speed limits still apply.

        Raises
        ------
        BadInputError : a wrong number of values, or a range outside the URDF's.
        """
        joints, n = list(self.joints), len(self.joints)
        alike = len({joint.type for joint in joints}) == 1
        for name, values in given.items():
            COMMAND_LINE.require(
                len(values) in (1, n),
                name,
                values,
                f"1 value, or {n} for {', '.join(joint.name for joint in joints)}",
                shown=f"{len(values)} values",
            )
            COMMAND_LINE.require(
                len(values) == n or alike or name not in _OF_JOINTS,
                name,
                values[0],
                text="one value cannot be in rad for some joints and in m for others",
                advice=f"Give {n} values",
            )
            for j, joint in enumerate(joints if name in _OF_JOINTS else ()):
                value: Any = values[j % len(values)]
                if name == "position":
                    value = _intersect_range(joint, value, self.place)
                elif name == "speed":
                    value = min(joint.speed or value, value)
                joints[j] = replace(joint, **{name: value})
        return replace(
            self,
            joints=tuple(joints),
            bandwidth_hz=min(given.get("bandwidth_hz", ()), default=None),
        )


def _intersect_range(joint: UrdfJoint, side: float, place: str) -> tuple[float, float]:
    low, high = joint.position or (-side, side)
    narrowed, unit = (max(low, -side), min(high, side)), "m" if joint.type == "prismatic" else "rad"
    COMMAND_LINE.require(
        narrowed[0] < narrowed[1],
        "position",
        side,
        text=f"does not overlap the limits of joint {joint.name!r} in {place}: {low:g} to {high:g} "
        f"{unit}",
    )
    return narrowed


def read_chain(path: Path, names: Sequence[str] = ()) -> Chain:
    """Read a URDF with its limits, damping and friction.

    Parameters
    ----------
    path : the URDF.
    names : joints to identify, from the base outwards; by default the longest serial chain without
        fingers.

    Raises
    ------
    BadInputError : the file is not a URDF or not one tree; it has floating or planar joints, two
        chains of equal length, invalid numbers, or reversed limits.
    """
    text = read_bytes(path)
    tree = UrdfTree(text, Location(str(path)))
    for i, name in enumerate(names):
        COMMAND_LINE.require(
            name in tree.movable and name not in names[:i],
            "joints",
            name,
            f"{listed(tree.movable)}, each at most once",
        )
    chain = list(names) or _find_longest(tree)
    for name in dict.fromkeys(joint for last in chain for joint in tree.path(last)):
        kind = tree.joints[name].get("type")
        Location(f"{path}: joint {name!r}, between the base and joint {chain[-1]!r}").require(
            kind not in ("floating", "planar"),
            "type",
            kind,
            "fixed, revolute, continuous or prismatic joints on a fixed base",
        )
    rigid: dict[str, list[str]] = {name: [] for name in chain}
    for link in tree.links:
        # A link moves with the last joint of the chain on its way to the base.
        if carried := [joint for joint in tree.path(tree.above.get(link)) if joint in rigid]:
            rigid[carried[-1]].append(link)
    lacks, notes = _check_inertials(tree, rigid)
    return Chain(
        place=str(path),
        name="".join(c if c.isascii() and (c.isalnum() or c in "_.- ") else "_" for c in tree.name)[
            :64
        ]
        or "robot",
        text=text,
        joints=tuple(_read_joint(tree, name) for name in chain),
        locked=tuple(
            _describe_locked(tree, name)
            for name, joint in tree.joints.items()
            if name not in chain and joint.get("type") != "fixed"
        ),
        rigid=tuple(tuple(links) for links in rigid.values()),
        notes=(*lacks, *notes),
        has_inertials=not lacks,
    )


def _find_longest(tree: UrdfTree) -> list[str]:
    free = {name for name in tree.movable if not _OF_A_HAND.search(name)} or {*tree.movable}
    tree.place.require(
        free, text="has no movable joint", expected=f"joints of type {', '.join(MOVABLE)}"
    )
    chains = {
        name: [joint for joint in tree.path(name) if joint in free]
        for name in tree.movable
        if name in free
    }
    most = max(map(len, chains.values()))
    last = [name for name, chain in chains.items() if len(chain) == most]
    tree.place.require(
        len(last) == 1,
        text=f"has {len(last)} chains of {most} joints each, which end at {listed(last)}",
        advice="Name the joints of one chain",
        arguments=("joints",),
    )
    return chains[last[0]]


def _describe_locked(tree: UrdfTree, name: str) -> str:
    joint = tree.joints[name]
    mimicked = f", mimics {attribute_of(joint, 'mimic', 'joint')}"
    return f"{name}: {joint.get('type')}{'' if joint.find('mimic') is None else mimicked}"


def _read_joint(tree: UrdfTree, name: str) -> UrdfJoint:
    tree.place.require(
        _JOINT_NAME.fullmatch(name),
        "name of a joint",
        name,
        "1 to 64 letters, digits, spaces, and _ . -, as in robot.toml",
    )
    joint, at = tree.joints[name], Location(f"{tree.place}: joint {name!r}")

    def number(tag: str, attribute: str) -> float:
        text = attribute_of(joint, tag, attribute)
        return 0.0 if text is None else finite_number(text, at, f"{tag} {attribute}")

    kind, low, high = joint.get("type"), number("limit", "lower"), number("limit", "upper")
    at.require(kind == "continuous" or low <= high, "limit lower", low, f"at most upper = {high:g}")
    numbers = {key: number(*where) for key, where in _NUMBERS.items()}
    for key, value in numbers.items():
        at.require(value >= 0, " ".join(_NUMBERS[key]), value, "0 or greater")
    return UrdfJoint(
        name=name,
        type="prismatic" if kind == "prismatic" else "revolute",
        # Equal limits mean no limits: 0 is the default of both.
        position=None if kind == "continuous" or low == high else (low, high),
        speed=numbers["speed"] or None,
        effort=numbers["effort"] or None,
        damping=numbers["damping"],
        friction=numbers["friction"],
    )


def _check_inertials(
    tree: UrdfTree, rigid: Mapping[str, Sequence[str]]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return notes that prevent a priori values, and other notes on the inertials.

    Joints that move no mass and negative inertials prevent a priori values. Other notes name
    moments that violate the triangle inequality; these can be simulated.
    """
    negative, notes, masses = list[str](), list[str](), dict.fromkeys(rigid, 0.0)
    for joint, link in ((joint, link) for joint, links in rigid.items() for link in links):
        inertial, at = tree.links[link].find("inertial"), Location(f"{tree.place}: link {link!r}")
        if inertial is None:
            continue
        m = finite_number(attribute_of(inertial, "mass", "value"), at, "mass")
        masses[joint] += abs(m)
        matrix = np.zeros((3, 3))
        matrix[np.triu_indices(3)] = [
            finite_number(attribute_of(inertial, "inertia", k), at, f"inertia {k}") for k in INERTIA
        ]
        moments = np.linalg.eigvalsh(matrix, UPLO="U")
        slack, shown = _MAX_ROUNDING * np.abs(moments).max(), ", ".join(f"{x:.4g}" for x in moments)
        if m < 0 or moments[0] < -slack:
            negative.append(f"link {link} has mass {m:g} kg, principal moments {shown} kg m²")
        elif moments[2] > moments[0] + moments[1] + slack:
            notes.append(
                f"link {link} has impossible principal moments {shown} kg m²: one exceeds the sum "
                "of the others"
            )
    without = [joint for joint, mass in masses.items() if not mass]
    lacks = [*([f"no mass moves with {listed(without)}"] if without else []), *negative]
    text = f"no [parameters], which simulations need and fits do not: {listed(lacks)}"
    return (text,) * bool(lacks), tuple(notes)
