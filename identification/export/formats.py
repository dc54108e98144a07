"""Write a model as a URDF (the user's own with new values, or a new one made of DH rows)
and as a MuJoCo model.

An identified link is lumped: the link that a joint moves, with all links fixed to it or carried by
locked joints. In the user's URDF the lumped inertia minus the other links' inertials is written to
the moved link if it is a physical body; else the moved link gets the lumped inertia, and the others
lose their inertials. Quotes and blanks may change. In a MuJoCo model, which has no shapes, a motor
that turns with several joints is a fixed tendon (its armature: MuJoCo 3.3 and later).
"""

import math
import xml.etree.ElementTree as ET
from xml.dom import minidom
from xml.dom.minidom import Element

import numpy as np

from acquisition.errors import listed
from acquisition.files import format_numbers
from acquisition.robot import Robot, effort_limits

from ..arrays import Array
from ..control import ControlLaw, described_law
from ..estimation import link_parameters, pseudo_inertia
from ..model import InverseModel, is_a_body
from .chain import INERTIA
from .exported_model import MIN_EIGENVALUE, ExportedModel, about_com

UNLIMITED = 1e9  # effort and velocity, which a URDF must have, if the description has none
_BASE = "base_link"
_THICKNESS = 0.02  # of drawn links, m
# m, of a box at the end of a link: unequal, so that any rotation is visible
_TIP = "0.12 0.08 0.04"
_MUJOCO = [0, 3, 5, 1, 2, 4]  # MuJoCo's order xx yy zz xy xz yz, of XX XY XZ YY YZ ZZ


def link_names(robot: Robot, *, made: bool = False) -> tuple[str, ...]:
    """Names of the links that the joints move: those of the URDF, or
    `link_1`, ... in a `made` one.
    """
    if robot.urdf is None or made:
        return tuple(f"link_{j + 1}" for j in range(robot.n))
    joints = {
        joint.get("name"): joint.find("child")
        for joint in ET.fromstring(robot.urdf).findall("joint")
    }
    children = (joints[joint.name] for joint in robot.joints)
    return tuple("" if child is None else child.get("link", "") for child in children)


def mjcf_text(m: ExportedModel) -> str:
    """The MJCF of a model, without offsets, and without friction that is
    neither viscous nor dry.
    """
    robot, axes_values = m.model.robot, ("armature", "damping", "frictionloss")
    values = [
        {key: format_numbers(getattr(m, key)[k]) for key in axes_values}
        for k in range(len(m.names))
    ]
    root = ET.Element("mujoco", model=robot.name)
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", gravity=format_numbers(*robot.gravity))
    carriers = [ET.SubElement(root, "worldbody")]
    origins, rotations, axes = m.model.joint_frames
    for j, (joint, name) in enumerate(zip(robot.joints, link_names(robot), strict=True)):
        body = ET.SubElement(
            carriers[m.model.parents[j]],
            "body",
            name=name,
            pos=format_numbers(*origins[j]),
            quat=format_numbers(*quaternion(rotations[j])),
        )
        carriers.append(body)
        mass, com, inertia = about_com(m.links[j])
        ET.SubElement(
            body,
            "inertial",
            pos=format_numbers(*com),
            mass=format_numbers(mass),
            fullinertia=format_numbers(*inertia[_MUJOCO]),
        )
        moved = {
            "name": joint.name,
            "type": "slide" if joint.type == "prismatic" else "hinge",
            "axis": format_numbers(*axes[j]),
        }
        if (limits := joint.si("position")) is not None:
            moved["range"] = format_numbers(*limits)
        ET.SubElement(body, "joint", moved | values[j])
    if len(m.names) > robot.n:
        tendons = ET.SubElement(root, "tendon")
        for k in range(robot.n, len(m.names)):
            fixed = ET.SubElement(tendons, "fixed", {"name": m.names[k]} | values[k])
            for joint, coefficient in zip(robot.joints, m.rows[k], strict=True):
                if coefficient:
                    ET.SubElement(
                        fixed, "joint", joint=joint.name, coef=format_numbers(coefficient)
                    )
    actuators, loop = ET.SubElement(root, "actuator"), servo_loop(m)
    if loop is not None:
        _servos(actuators, m, loop)
    else:
        for joint in robot.joints:
            ET.SubElement(actuators, "motor", name=joint.name, joint=joint.name)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def servo_loop(m: ExportedModel) -> ControlLaw | None:
    """The loop of `[controller]` that actuators can have: of motors' positions, each a joint's or a
    tendon's of the model.
    """
    robot = m.model.robot
    several = {
        motor.name
        for motor, row in zip(robot.motors, robot.R, strict=True)
        if np.count_nonzero(row) > 1
    }
    if robot.controller.structure in (None, "computed_torque") or several - {*m.names[robot.n :]}:
        return None
    return described_law(robot)


def _servos(actuators: ET.Element, m: ExportedModel, loop: ControlLaw) -> None:
    """Actuators of the motors' angles, kp = Kp R² G in N m per rad of the joint, or of the tendon;
    a second one for speeds.
    """
    robot, several = m.model.robot, m.names[m.model.robot.n :]
    for j, motor in enumerate(robot.motors):
        first = int(np.flatnonzero(robot.R[j])[0])
        k = robot.n + several.index(motor.name) if motor.name in several else first
        ratio = robot.R[j, first] / m.rows[k][first]
        kp, kv = (
            format_numbers(float(ratio**2 * loop.G[j] * gains[j])) for gains in (loop.Kp, loop.Kd)
        )
        on = {"tendon" if k >= robot.n else "joint": m.names[k]}
        if math.isfinite(most := float(abs(ratio * loop.G[j]) * loop.saturation[j])):
            on["forcerange"] = format_numbers(-most, most)
        own = {"name": motor.name, "kp": kp, "kv": "0" if loop.feedforward else kv}
        ET.SubElement(actuators, "position", own | on)
        if loop.feedforward:
            ET.SubElement(actuators, "velocity", {"name": f"{motor.name}_speed", "kv": kv} | on)


def quaternion(R: Array) -> Array:
    """Unit quaternion w x y z of a rotation (3, 3); w is not negative."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R).as_quat(canonical=True))[[3, 0, 1, 2]]


def urdf_text(m: ExportedModel) -> tuple[str, tuple[str, ...]]:
    """The URDF of a model without armatures and couplings; lines on other links that changed,
    and on unknown limits.
    """
    robot = m.model.robot
    document = minidom.parseString(
        (make_urdf(m.model) if robot.urdf is None else robot.urdf).encode()
    )
    root = document.documentElement
    assert root is not None
    links, joints = (
        {e.getAttribute("name"): e for e in _children(root, tag)} for tag in ("link", "joint")
    )
    notes = _note_unlimited(joints) if robot.urdf is None else []
    frames = _find_lumped({joint.name for joint in robot.joints}, joints, links)
    for j, (joint, name) in enumerate(zip(robot.joints, link_names(robot), strict=True)):
        inertials = {}
        for other, (carrier, T) in frames.items():
            if carrier == name and (found := _child(links[other], "inertial")):
                inertials[other] = found, _read_inertia(found, T)
        rest, others = (
            m.links[j] - sum((x for _, x in inertials.values()), start=np.zeros(10)),
            ", ".join(inertials),
        )
        if others and not is_a_body(rest, MIN_EIGENVALUE):
            mass = sum(x[9] for _, x in inertials.values())
            notes.append(
                f"link {name}: minus the inertials of {others} ({mass:.3g} kg), fixed to it, "
                "it is no physical body: they are removed, it has the lumped inertia"
            )
            rest = m.links[j]
            for other, (inertial, _) in inertials.items():
                links[other].removeChild(inertial)
        elif others:
            notes.append(f"link {name}: {others}, fixed to it, keep their inertials")
        mass, com, about = about_com(rest)
        inertial = _set(links[name], "inertial", {})
        inertial.childNodes.clear()
        _set(inertial, "origin", {"xyz": format_numbers(*com), "rpy": "0 0 0"})
        _set(inertial, "mass", {"value": format_numbers(mass)})
        _set(
            inertial,
            "inertia",
            {key: format_numbers(x) for key, x in zip(INERTIA, about, strict=True)},
        )
        _set(
            joints[joint.name],
            "dynamics",
            {
                "damping": format_numbers(m.damping[j]),
                "friction": format_numbers(m.frictionloss[j]),
            },
        )
    # comments may precede and follow the root
    lines = [node.toxml() for node in document.childNodes]
    return "\n".join(['<?xml version="1.0" encoding="utf-8"?>', *lines, ""]), tuple(notes)


def _children(element: Element, name: str) -> list[Element]:
    return [
        child
        for child in element.childNodes
        if isinstance(child, Element) and child.tagName == name
    ]


def _child(element: Element, name: str) -> Element | None:
    return next(iter(_children(element, name)), None)


def _attribute(element: Element, name: str, attribute: str) -> str:
    """Of the first child with this name; empty without one."""
    child = _child(element, name)
    return child.getAttribute(attribute) if child else ""


def _set(element: Element, name: str, attributes: dict[str, str]) -> Element:
    """Set attributes of the first child with this name, or of a new one; return it."""
    child = _child(element, name)
    if child is None:
        assert element.ownerDocument is not None
        child = element.appendChild(element.ownerDocument.createElement(name))
    for key, value in attributes.items():
        child.setAttribute(key, value)
    return child


def _note_unlimited(joints: dict[str, Element]) -> list[str]:
    """Lines on limits of a new URDF that are unknown."""
    notes = []
    for key, keys in (
        ("effort", "effort_nm, effort_n or saturation"),
        ("velocity", "speed_deg_s or speed_m_s"),
    ):
        names = [
            name
            for name, joint in joints.items()
            if _attribute(joint, "limit", key) == format_numbers(UNLIMITED)
        ]
        if names:
            notes.append(
                f"unknown {key} of {listed(names)}: written as {UNLIMITED:g}; state {keys}"
            )
    return notes


def _find_lumped(
    moved: set[str], joints: dict[str, Element], links: dict[str, Element]
) -> dict[str, tuple[str, Array]]:
    """For each link fixed to another one: the link that carries it, and its frame in that
    link's frame, T (4, 4).
    """
    above = {
        _attribute(joint, "child", "link"): (_attribute(joint, "parent", "link"), _pose(joint))
        for name, joint in joints.items()
        if name not in moved
    }
    frames = {}
    for name in links:
        T, at = np.eye(4), name
        while at in above:
            at, step = above[at]
            T = step @ T
        if at != name:
            frames[name] = at, T
    return frames


def _pose(element: Element) -> Array:
    """The `<origin>` of a joint or an inertial (4, 4)."""
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    xyz, rpy = (
        [float(x) for x in (_attribute(element, "origin", key) or "0 0 0").split()]
        for key in ("xyz", "rpy")
    )
    T[:3, 3] = xyz
    T[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
    return T


def _read_inertia(inertial: Element, T: Array) -> Array:
    """Ten parameters (10,) of an inertial in a frame where its link's frame is T (4, 4)."""
    about = [float(_attribute(inertial, "inertia", key) or 0.0) for key in INERTIA]
    mass, T = float(_attribute(inertial, "mass", "value") or 0.0), T @ _pose(inertial)
    return link_parameters(T @ pseudo_inertia(np.array([*about, 0.0, 0.0, 0.0, mass])) @ T.T)


def make_urdf(model: InverseModel) -> str:
    """A URDF for a robot that has none, or none with shapes: joints with limits, links drawn as
    cylinders, no inertials.
    """
    robot = model.robot
    root, names = ET.Element("robot", name=robot.name), [_BASE, *link_names(robot, made=True)]
    origins, rotations, axes = model.joint_frames
    for k, name in enumerate(names):
        link = ET.SubElement(root, "link", name=name)
        ends = [
            origin for origin, parent in zip(origins, model.parents, strict=True) if parent == k
        ]
        for end in ends or [np.zeros(3)]:
            _draw(link, end)
    found = effort_limits(robot)
    # N m or N
    efforts = dict(zip(found.names, found.limits, strict=True)) if robot.gain_known else {}
    for j, joint in enumerate(robot.joints):
        limits, effort = (
            joint.si("position"),
            efforts.get(f"joint {joint.name}", joint.si("effort") or UNLIMITED),
        )
        kind = (
            "prismatic"
            if joint.type == "prismatic"
            else "continuous"
            if limits is None
            else "revolute"
        )
        element = ET.SubElement(root, "joint", name=joint.name, type=kind)
        ET.SubElement(element, "parent", link=names[model.parents[j]])
        ET.SubElement(element, "child", link=names[j + 1])
        ET.SubElement(
            element,
            "origin",
            xyz=format_numbers(*origins[j]),
            rpy=format_numbers(*roll_pitch_yaw(rotations[j])),
        )
        ET.SubElement(element, "axis", xyz=format_numbers(*axes[j]))
        low, high = limits or (-UNLIMITED, UNLIMITED)
        stated = {} if kind == "continuous" else {"lower": low, "upper": high}
        stated |= {"effort": effort, "velocity": joint.si("speed") or UNLIMITED}
        ET.SubElement(
            element, "limit", {name: format_numbers(value) for name, value in stated.items()}
        )
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """The angles of a rotation (3, 3) in a URDF, also at a pitch of 90°."""
    yaw, pitch = math.atan2(R[1, 0], R[0, 0]), math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    s, c = math.sin(yaw), math.cos(yaw)
    return math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1]), pitch, yaw


def _draw(link: ET.Element, end: Array) -> None:
    """A cylinder from the link's origin to the next joint, `end` (3,); a box
    if `end` is the origin.
    """
    visual, length = ET.SubElement(link, "visual"), float(np.linalg.norm(end))
    if length > 1e-6:
        yaw, pitch = math.atan2(end[1], end[0]), math.atan2(math.hypot(end[0], end[1]), end[2])
        ET.SubElement(
            visual, "origin", xyz=format_numbers(*end / 2), rpy=format_numbers(0.0, pitch, yaw)
        )
    shape = ET.SubElement(visual, "geometry")
    if length > 1e-6:
        ET.SubElement(shape, "cylinder", radius=f"{_THICKNESS:g}", length=f"{length:.9g}")
    else:
        ET.SubElement(shape, "box", size=_TIP)
