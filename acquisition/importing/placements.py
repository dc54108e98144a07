"""Where each link's frame is from the one before it, by the URDF or by the DH rows: for viewers that show robots.

The kinematics that estimates rest on are those of `identification.model`.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..errors import AcquisitionError
from ..files import text_of
from ..robot import Joint, Robot, effort_limits

UNLIMITED = 1e9  # a URDF must state effort and velocity: where the description has none
_BASE = "base_link"
_THICKNESS = 0.02  # of drawn links, m


@dataclass(frozen=True, kw_only=True, eq=False)
class _Link:
    """A link and the one before it: its placement (4, 4) at position zero, the axis (3,), the place of the joint's coordinate.

    The coordinate is `gain` times that of joint `joint`, plus `shift`; `joint` None for a link that does not move.
    """

    parent: str
    child: str
    placement: Array
    axis: Array
    slides: bool = False
    joint: int | None = None
    gain: float = 1.0
    shift: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class LinkFrames:
    """The links of a robot, each after the one that it sits on."""

    links: Sequence[_Link]

    @property
    def names(self) -> list[tuple[str, str]]:
        """Frames of each transform: parent and child."""
        return [(link.parent, link.child) for link in self.links]

    def transforms(self, q: Array) -> tuple[Array, Array]:
        """Origins (N, k, 3) in m and rotations (N, k, 3, 3) of the k links in their parents at joint positions q (N, n)."""
        origins, rotations = np.empty((len(q), len(self.links), 3)), np.empty((len(q), len(self.links), 3, 3))
        for k, link in enumerate(self.links):
            x = np.full(len(q), link.shift) if link.joint is None else link.gain * q[:, link.joint] + link.shift
            R, origin = link.placement[:3, :3], link.placement[:3, 3]
            slid = x[:, None] * link.axis if link.slides else np.zeros((len(q), 3))
            origins[:, k] = origin + slid @ R.T
            rotations[:, k] = R @ (np.eye(3) if link.slides else _about(link.axis, x))
        return origins, rotations


def link_frames(robot: Robot, place: str) -> LinkFrames:
    """The links of a robot; errors of its URDF name `place`."""
    if robot.urdf is None:
        names = [_BASE, *(f"link_{j + 1}" for j in range(robot.n))]  # as an exported URDF has them
        return LinkFrames(
            links=[
                _Link(
                    parent=names[j],
                    child=names[j + 1],
                    placement=_dh_placement(joint),
                    axis=np.array([0.0, 0.0, 1.0]),
                    slides=joint.type == "prismatic",
                    joint=j,
                )
                for j, joint in enumerate(robot.joints)
            ]
        )
    try:
        return LinkFrames(links=[_urdf_link(e, robot) for e in ET.fromstring(robot.urdf).findall("joint")])
    except (ET.ParseError, ValueError, AttributeError) as error:
        raise AcquisitionError(f"not a URDF: {error}", place=f"{place}: robot.urdf") from error


def urdf_of(robot: Robot) -> str:
    """The robot's URDF; one made of the DH rows where it has none, its links drawn as lines from joint to joint."""
    if robot.urdf is not None:
        return robot.urdf
    root, frames = ET.Element("robot", name=robot.name), link_frames(robot, "")
    ends, efforts = [link.placement[:3, 3] for link in frames.links], _efforts(robot)
    for name, end in zip([_BASE, *(child for _, child in frames.names)], [*ends, np.zeros(3)], strict=True):
        _draw(ET.SubElement(root, "link", name=name), end)
    for link, joint, effort in zip(frames.links, robot.joints, efforts, strict=True):
        limits = joint.si("position")
        kind = "prismatic" if joint.type == "prismatic" else "continuous" if limits is None else "revolute"
        element = ET.SubElement(root, "joint", name=joint.name, type=kind)
        ET.SubElement(element, "parent", link=link.parent)
        ET.SubElement(element, "child", link=link.child)
        turn = roll_pitch_yaw(link.placement[:3, :3])
        ET.SubElement(element, "origin", xyz=text_of(*link.placement[:3, 3]), rpy=text_of(*turn))
        ET.SubElement(element, "axis", xyz="0 0 1")
        low, high = limits or (-UNLIMITED, UNLIMITED)
        stated = {} if kind == "continuous" else {"lower": low, "upper": high}
        stated |= {"effort": effort, "velocity": joint.si("speed") or UNLIMITED}
        ET.SubElement(element, "limit", {name: text_of(value) for name, value in stated.items()})
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _efforts(robot: Robot) -> list[float]:
    """Largest effort of each joint, N m or N, by the description alone: its bus may name files that are not here."""
    found = effort_limits(replace(robot, bus=None), f"robot {robot.name}")
    known = dict(zip(found.names, found.limits, strict=True)) if robot.gain_known else {}
    return [known.get(f"joint {joint.name}", joint.si("effort") or UNLIMITED) for joint in robot.joints]


def quaternions(rotations: Array) -> Array:
    """Unit quaternions (..., 4), x y z w, of rotation matrices (..., 3, 3); w is not negative."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(flat).reshape(*rotations.shape[:-2], 4)


def _about(axis: Array, angle: Array) -> Array:
    """Rotations (N, 3, 3) by angles (N,) about a unit axis (3,): Rodrigues' formula."""
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + s * K + (1 - c) * (K @ K))


def _dh_placement(joint: Joint) -> Array:
    """Rot(x, alpha) Trans(x, d) Rot(z, theta) Trans(z, r): modified Denavit-Hartenberg."""
    assert joint.dh is not None  # the description has been checked
    about_x, about_z = np.eye(4), np.eye(4)
    about_x[:3, :3] = _about(np.array([1.0, 0, 0]), np.array([math.radians(joint.dh.alpha_deg)]))[0]
    about_z[:3, :3] = _about(np.array([0, 0, 1.0]), np.array([math.radians(joint.dh.theta_deg)]))[0]
    about_x[0, 3], about_z[2, 3] = joint.dh.d_m, joint.dh.r_m
    return np.asarray(about_x @ about_z)


def _urdf_link(element: ET.Element, robot: Robot) -> _Link:
    """A joint of a URDF; one that the description does not name stands at zero, one that mimics another follows it."""
    names = [joint.name for joint in robot.joints]
    name, kind, gain, shift = element.get("name", ""), element.get("type", ""), 1.0, 0.0
    mimic = element.find("mimic")
    if mimic is not None and name not in names:
        name, gain = mimic.get("joint", ""), float(mimic.get("multiplier", "1"))
        shift = float(mimic.get("offset", "0"))
    moves = kind in ("revolute", "continuous", "prismatic") and name in names
    placement = np.eye(4)
    origin = element.find("origin")
    if origin is not None:
        placement[:3, :3] = rotation(*_numbers(origin.get("rpy", "0 0 0")))
        placement[:3, 3] = _numbers(origin.get("xyz", "0 0 0"))
    found = element.find("axis")
    direction = np.array(_numbers("1 0 0" if found is None else found.get("xyz", "1 0 0")))
    parent, child = element.find("parent"), element.find("child")
    if parent is None or child is None:
        raise ValueError(f"joint {name!r} has no parent or child")
    return _Link(
        parent=parent.get("link", ""),
        child=child.get("link", ""),
        placement=placement,
        axis=direction / max(float(np.linalg.norm(direction)), 1e-300),
        slides=kind == "prismatic",
        joint=names.index(name) if moves else None,
        gain=gain,
        shift=shift if moves else 0.0,
    )


def _numbers(text: str) -> list[float]:
    numbers = [float(x) for x in text.split()]
    if len(numbers) != 3:
        raise ValueError(f"{text!r} is not three numbers")
    return numbers


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Rot(z, yaw) Rot(y, pitch) Rot(x, roll) (3, 3), as a URDF means these angles."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (roll, pitch, yaw))
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    return np.asarray(about_z @ about_y @ about_x)


def roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """The angles of a rotation (3, 3), as `rotation` takes them; of all rotations, those of 90° pitch too."""
    yaw = math.atan2(R[1, 0], R[0, 0])
    pitch = math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    s, c = math.sin(yaw), math.cos(yaw)
    return math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1]), pitch, yaw


def _draw(link: ET.Element, end: Array) -> None:
    """A cylinder from the link's origin to `end` (3,), where the next joint sits; a ball where that is the origin."""
    visual, length = ET.SubElement(link, "visual"), float(np.linalg.norm(end))
    if length > 1e-6:
        yaw, pitch = math.atan2(end[1], end[0]), math.atan2(math.hypot(end[0], end[1]), end[2])
        ET.SubElement(visual, "origin", xyz=text_of(*end / 2), rpy=text_of(0.0, pitch, yaw))
    shape = ET.SubElement(visual, "geometry")
    if length > 1e-6:
        ET.SubElement(shape, "cylinder", radius=f"{_THICKNESS:g}", length=f"{length:.9g}")
    else:
        ET.SubElement(shape, "sphere", radius=f"{2 * _THICKNESS:g}")
