"""Models as a URDF (the user's own with new values, or a new one) and for MuJoCo.

An identified link is lumped: it is the link that a joint moves, with all links fixed to it or
carried by locked joints. In the user's URDF the moved link gets the lumped inertia minus the
inertials of the other links, if that is a rigid body; else it gets the lumped inertia, and the
others lose their inertials. Quotes and blanks may change. In a MuJoCo model, which has no shapes, a
motor that turns with several joints is a fixed tendon (its armature needs MuJoCo 3.3 or later).
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
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

UNLIMITED = 1e9  # effort and velocity, which a URDF needs, if the description gives none
_THICKNESS = 0.02  # of drawn links, m
# Sides of a box at the end of a link, m; unequal, so that every rotation is visible.
_TIP = "0.12 0.08 0.04"
_MUJOCO = [0, 3, 5, 1, 2, 4]  # MuJoCo's order xx yy zz xy xz yz, of XX XY XZ YY YZ ZZ


def link_names(robot: Robot) -> tuple[str, ...]:
    """Return names of the links that the joints move.

    They are those of the URDF, or `link_1`, ... of a new one.
    """
    if robot.urdf is None:
        return tuple(f"link_{j + 1}" for j in range(robot.n))
    joints = {
        joint.get("name"): joint.find("child")
        for joint in ET.fromstring(robot.urdf).findall("joint")
    }
    return tuple(
        "" if child is None else child.get("link", "")
        for child in (joints[joint.name] for joint in robot.joints)
    )


def _element(tag: str, attributes: dict[str, str], *children: ET.Element) -> ET.Element:
    made = ET.Element(tag, attributes)
    made.extend(children)
    return made


def mjcf_text(m: ExportedModel) -> str:
    """Return the MJCF of a model.

    It has no offsets, and only viscous and Coulomb friction.
    """
    robot, loop = m.model.robot, servo_loop(m)
    values = [
        {key: format_numbers(getattr(m, key)[k]) for key in ("armature", "damping", "frictionloss")}
        for k in range(len(m.names))
    ]
    tendons = [
        _element(
            "fixed",
            {"name": m.names[k]} | values[k],
            *(
                _element("joint", {"joint": joint.name, "coef": format_numbers(coefficient)})
                for joint, coefficient in zip(robot.joints, m.rows[k], strict=True)
                if coefficient
            ),
        )
        for k in range(robot.n, len(m.names))
    ]
    motors = (_element("motor", {"name": x.name, "joint": x.name}) for x in robot.joints)
    root = _element(
        "mujoco",
        {"model": robot.name},
        _element("compiler", {"angle": "radian"}),
        _element("option", {"gravity": format_numbers(*robot.gravity)}),
        _world(m, values),
        *([_element("tendon", {}, *tendons)] if tendons else []),
        _element("actuator", {}, *(motors if loop is None else _servos(m, loop))),
    )
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _world(m: ExportedModel, values: Sequence[dict[str, str]]) -> ET.Element:
    """Return the bodies, each with its joint, which has the `values` of its axis."""
    robot, carriers = m.model.robot, [ET.Element("worldbody")]
    for j, (joint, name) in enumerate(zip(robot.joints, link_names(robot), strict=True)):
        origin, rotation, axis = (of_joints[j] for of_joints in m.model.joint_frames)
        mass, com, inertia = about_com(m.links[j])
        moved = {
            "name": joint.name,
            "type": "slide" if joint.type == "prismatic" else "hinge",
            "axis": format_numbers(*axis),
        }
        if (limits := joint.si("position")) is not None:
            moved["range"] = format_numbers(*limits)
        body = _element(
            "body",
            {
                "name": name,
                "pos": format_numbers(*origin),
                "quat": format_numbers(*quaternion(rotation)),
            },
            _element(
                "inertial",
                {
                    "pos": format_numbers(*com),
                    "mass": format_numbers(mass),
                    "fullinertia": format_numbers(*inertia[_MUJOCO]),
                },
            ),
            _element("joint", moved | values[j]),
        )
        carriers[m.model.parents[j]].append(body)
        carriers.append(body)
    return carriers[0]


def servo_loop(m: ExportedModel) -> ControlLaw | None:
    """Return the control law of `[controller]` that actuators can have, or None.

    It acts on positions of motors, each of which is a joint or a tendon of the model.
    """
    robot = m.model.robot
    several = {
        motor.name
        for motor, row in zip(robot.motors, robot.R, strict=True)
        if np.count_nonzero(row) > 1
    }
    return (
        None
        if robot.controller.structure in (None, "computed_torque")
        or several - {*m.names[robot.n :]}
        else described_law(robot)
    )


def _servos(m: ExportedModel, loop: ControlLaw) -> Iterator[ET.Element]:
    """Yield actuators of the motors, with kp = Kp R² G in N m per rad of the joint or tendon.

    A second actuator per motor follows the speed.
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
        damping = "0" if loop.feedforward else kv
        yield _element("position", {"name": motor.name, "kp": kp, "kv": damping} | on)
        if loop.feedforward:
            yield _element("velocity", {"name": f"{motor.name}_speed", "kv": kv} | on)


def quaternion(R: Array) -> Array:
    """Return the unit quaternion w x y z of a rotation (3, 3); w is not negative."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R).as_quat(canonical=True))[[3, 0, 1, 2]]


def urdf_text(m: ExportedModel) -> tuple[str, tuple[str, ...]]:
    """Return the URDF of a model, and lines on changed links and unknown limits.

    A URDF has no armatures and couplings.
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
    notes = list(_note_unlimited(joints) if robot.urdf is None else ())
    frames = _find_lumped({joint.name for joint in robot.joints}, joints, links)
    for j, (joint, name) in enumerate(zip(robot.joints, link_names(robot), strict=True)):
        inertials = {
            other: (inertial, _read_inertia(inertial, T))
            for other, (carrier, T) in frames.items()
            if carrier == name and (inertial := _child(links[other], "inertial"))
        }
        rest = m.links[j] - sum((x for _, x in inertials.values()), start=np.zeros(10))
        if inertials and is_a_body(rest, MIN_EIGENVALUE):
            notes.append(f"link {name}: {', '.join(inertials)}, fixed to it, keep their inertials")
        elif inertials:
            notes.append(
                f"link {name}: without the inertials of {', '.join(inertials)} "
                f"({sum(x[9] for _, x in inertials.values()):.3g} kg), fixed to it, the rest is "
                "not a rigid body, so they are removed and the link has the lumped inertia"
            )
            rest = m.links[j]
            for other, (inertial, _) in inertials.items():
                links[other].removeChild(inertial)
        _set_inertial(links[name], rest)
        _set(
            joints[joint.name],
            "dynamics",
            {
                key: format_numbers(value)
                for key, value in {"damping": m.damping[j], "friction": m.frictionloss[j]}.items()
            },
        )
    # Comments may precede and follow the root element.
    lines = [node.toxml() for node in document.childNodes]
    return "\n".join(['<?xml version="1.0" encoding="utf-8"?>', *lines, ""]), tuple(notes)


def _set_inertial(link: Element, parameters: Array) -> None:
    """Write the parameters (10,) of a link as its inertial."""
    mass, com, about = about_com(parameters)
    inertial = _set(link, "inertial", {})
    inertial.childNodes.clear()
    _set(inertial, "origin", {"xyz": format_numbers(*com), "rpy": "0 0 0"})
    _set(inertial, "mass", {"value": format_numbers(mass)})
    _set(
        inertial, "inertia", {key: format_numbers(x) for key, x in zip(INERTIA, about, strict=True)}
    )


def _children(element: Element, name: str) -> list[Element]:
    return [
        child
        for child in element.childNodes
        if isinstance(child, Element) and child.tagName == name
    ]


def _child(element: Element, name: str) -> Element | None:
    return next(iter(_children(element, name)), None)


def _attribute(element: Element, name: str, attribute: str) -> str:
    """Return an attribute of the first child with this name; empty without one."""
    child = _child(element, name)
    return child.getAttribute(attribute) if child else ""


def _set(element: Element, name: str, attributes: dict[str, str]) -> Element:
    """Set attributes of the first child with this name, or of a new one; return it."""
    if (child := _child(element, name)) is None:
        assert element.ownerDocument is not None
        child = element.appendChild(element.ownerDocument.createElement(name))
    for key, value in attributes.items():
        child.setAttribute(key, value)
    return child


def _note_unlimited(joints: dict[str, Element]) -> Iterator[str]:
    """Yield lines on limits of a new URDF that are unknown."""
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
            yield (
                f"The {key} limit of {listed(names)} is unknown and written as {UNLIMITED:g}. "
                f"Set {keys} in robot.toml."
            )


def _find_lumped(
    moved: set[str], joints: dict[str, Element], links: dict[str, Element]
) -> dict[str, tuple[str, Array]]:
    """Find the link that carries each fixed link, and the fixed link's frame in it, (4, 4)."""
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
    """Return the `<origin>` of a joint or an inertial (4, 4)."""
    from scipy.spatial.transform import Rotation

    xyz, rpy = (
        [float(x) for x in (_attribute(element, "origin", key) or "0 0 0").split()]
        for key in ("xyz", "rpy")
    )
    upper = np.c_[Rotation.from_euler("xyz", rpy).as_matrix(), xyz]
    return np.vstack([upper, [0.0, 0.0, 0.0, 1.0]])


def _read_inertia(inertial: Element, T: Array) -> Array:
    """Return the parameters (10,) of an inertial; T (4, 4) is its link's frame in theirs."""
    about = [float(_attribute(inertial, "inertia", key) or 0.0) for key in INERTIA]
    mass, T = float(_attribute(inertial, "mass", "value") or 0.0), T @ _pose(inertial)
    return link_parameters(T @ pseudo_inertia(np.array([*about, 0.0, 0.0, 0.0, mass])) @ T.T)


def make_urdf(model: InverseModel) -> str:
    """Make a URDF for a robot that has none, or none with shapes.

    It has joints with limits, links drawn as cylinders, and no inertials.
    """
    robot = model.robot
    names = ["base_link", *(f"link_{j + 1}" for j in range(robot.n))]
    origins, rotations, axes = model.joint_frames
    found, root = effort_limits(robot), _element("robot", {"name": robot.name})
    for k, name in enumerate(names):
        ends = [x for x, parent in zip(origins, model.parents, strict=True) if parent == k]
        root.append(_element("link", {"name": name}, *map(_drawn, ends or [np.zeros(3)])))
    # Limits in A or V cannot be written, as a URDF has N m or N.
    efforts = dict(zip(found.names, found.limits, strict=True)) if robot.gain_known else {}
    for j, joint in enumerate(robot.joints):
        limits = joint.si("position")
        endless = limits is None and joint.type == "revolute"
        low, high = limits or (-UNLIMITED, UNLIMITED)
        stated = ({} if endless else {"lower": low, "upper": high}) | {
            "effort": efforts.get(f"joint {joint.name}", joint.si("effort") or UNLIMITED),
            "velocity": joint.si("speed") or UNLIMITED,
        }
        root.append(
            _element(
                "joint",
                {"name": joint.name, "type": "continuous" if endless else str(joint.type)},
                _element("parent", {"link": names[model.parents[j]]}),
                _element("child", {"link": names[j + 1]}),
                _element(
                    "origin",
                    {
                        "xyz": format_numbers(*origins[j]),
                        "rpy": format_numbers(*roll_pitch_yaw(rotations[j])),
                    },
                ),
                _element("axis", {"xyz": format_numbers(*axes[j])}),
                _element("limit", {key: format_numbers(x) for key, x in stated.items()}),
            )
        )
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """Return the angles of a rotation (3, 3) in a URDF, rad, also at a pitch of 90°."""
    yaw, pitch = math.atan2(R[1, 0], R[0, 0]), math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    s, c = math.sin(yaw), math.cos(yaw)
    return math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1]), pitch, yaw


def _drawn(end: Array) -> ET.Element:
    """Return a cylinder from the link's origin to the next joint at `end` (3,).

    If `end` is the origin, it is a box.
    """
    length = float(np.linalg.norm(end))
    if length <= 1e-6:
        return _element("visual", {}, _element("geometry", {}, _element("box", {"size": _TIP})))
    yaw, pitch = math.atan2(end[1], end[0]), math.atan2(math.hypot(end[0], end[1]), end[2])
    origin = {"xyz": format_numbers(*end / 2), "rpy": format_numbers(0.0, pitch, yaw)}
    shape = _element("cylinder", {"radius": f"{_THICKNESS:g}", "length": f"{length:.9g}"})
    return _element("visual", {}, _element("origin", origin), _element("geometry", {}, shape))
