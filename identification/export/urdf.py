"""A URDF: the user's own with new inertials, damping and friction, every other byte as it was; or a new one of DH rows.

What the identification knows as one link is lumped: the link that a joint moves, and all that is fixed to it or that locked
joints carry. The difference to the other links' inertials goes to the moved link where that is a body; else the whole does,
and the others lose theirs.
"""

import xml.etree.ElementTree as ET

import numpy as np

from acquisition.errors import listed
from acquisition.files import Edits, Element, parse_xml, text_of
from acquisition.robot import Robot

from ..arrays import Array
from ..estimation import link_parameters, pseudo_inertia
from ..model import is_a_body
from .dh_urdf import UNLIMITED, dh_link_names, dh_urdf
from .mechanism import LEAST, Mechanism
from .numbers import inertial_keys


def link_names(robot: Robot) -> tuple[str, ...]:
    """Names of the links that the joints move: those of the URDF, or `link_1` and so on of a robot of DH rows."""
    if robot.urdf is None:
        return dh_link_names(robot)
    child = {}
    for joint in ET.fromstring(robot.urdf).findall("joint"):
        moved = joint.find("child")
        if moved is not None:
            child[joint.get("name")] = moved.get("link", "")
    return tuple(child[joint.name] for joint in robot.joints)


def urdf_text(m: Mechanism) -> tuple[str, tuple[str, ...]]:
    """The URDF of a mechanism, and lines on what of other links was changed, and on limits that nobody stated.

    Armatures and couplings have no place in it.
    """
    robot = m.model.robot
    source = (dh_urdf(m.model) if robot.urdf is None else robot.urdf).encode()
    root, edits = parse_xml(source, f"robot {robot.name}: URDF"), Edits(source=source)
    notes = _unlimited(root) if robot.urdf is None else []
    links = {link.attributes.get("name", ""): link for link in root.all("link")}
    joints = {joint.attributes.get("name", ""): joint for joint in root.all("joint")}
    lumped = _lumped(robot, joints, links)
    for j, (joint, name) in enumerate(zip(robot.joints, link_names(robot), strict=True)):
        others = {other: T for other, T in lumped[name].items() if links[other].child("inertial") is not None}
        own = m.links[j] - sum((_inertia_of(links[other], T) for other, T in others.items()), start=np.zeros(10))
        if others and not is_a_body(own, LEAST):
            mass = sum(_inertia_of(links[other], T)[9] for other, T in others.items())
            notes.append(
                f"link {name}: the inertials of {', '.join(others)} ({mass:.3g} kg), fixed to it, leave no body for it: "
                "they are removed, it has the whole"
            )
            own = m.links[j]
            for other in others:
                for inertial in links[other].all("inertial"):
                    edits.remove(inertial)
        elif others:
            notes.append(f"link {name}: {', '.join(others)}, fixed to it, keep their inertials")
        _set_inertial(edits, links[name], own)
        _set_friction(edits, joints[joint.name], m.damping[j], m.frictionloss[j])
    return edits.text(), tuple(notes)


def _unlimited(root: Element) -> list[str]:
    """Lines on the limits of a new URDF that the description does not have."""
    joints = [(joint.attributes["name"], joint.child("limit")) for joint in root.all("joint")]
    found = []
    for key, ways in (("effort", "effort_nm, effort_n or saturation"), ("velocity", "speed_deg_s or speed_m_s")):
        names = [name for name, limit in joints if limit and limit.attributes[key] == text_of(UNLIMITED)]
        if names:
            found.append(f"no {key} is known of {listed(names)}: {UNLIMITED:g} is written: state {ways}")
    return found


def _lumped(robot: Robot, joints: dict[str, Element], links: dict[str, Element]) -> dict[str, dict[str, Array]]:
    """By moved link, the links that move with it and their frames in its own, T (4, 4)."""
    moved = {joint.name for joint in robot.joints}
    above: dict[str, tuple[str, Array]] = {}  # of a link that does not move against its parent
    for name, joint in joints.items():
        parent, child = joint.child("parent"), joint.child("child")
        if name not in moved and parent is not None and child is not None:
            above[child.attributes.get("link", "")] = (parent.attributes.get("link", ""), _pose(joint))
    lumps: dict[str, dict[str, Array]] = {name: {} for name in link_names(robot)}
    for name in links:
        T, at = np.eye(4), name
        while at in above:
            at, step = above[at]
            T = step @ T
        if at != name and at in lumps:
            lumps[at][name] = T
    return lumps


def _pose(element: Element) -> Array:
    """The `<origin>` of a joint or an inertial (4, 4)."""
    T, origin = np.eye(4), element.child("origin")
    if origin is not None:
        T[:3, 3] = _numbers(origin.attributes.get("xyz", "0 0 0"))
        T[:3, :3] = rotation(*_numbers(origin.attributes.get("rpy", "0 0 0")))
    return T


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Rot(z, yaw) Rot(y, pitch) Rot(x, roll) (3, 3), as a URDF means these angles."""
    (sr, cr), (sp, cp), (sy, cy) = ((np.sin(a), np.cos(a)) for a in (roll, pitch, yaw))
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    return np.asarray(about_z @ about_y @ about_x)


def _inertia_of(link: Element, T: Array) -> Array:
    """Ten parameters (10,) of a link's inertial in a frame in which the link's own is T (4, 4)."""
    inertial = link.child("inertial")
    assert inertial is not None
    mass, inertia = inertial.child("mass"), inertial.child("inertia")
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    about = [float(inertia.attributes.get(key, 0.0)) if inertia else 0.0 for key in keys]
    value = float(mass.attributes.get("value", 0.0)) if mass else 0.0
    T = T @ _pose(inertial)
    return link_parameters(T @ pseudo_inertia(np.array([*about, 0.0, 0.0, 0.0, value])) @ T.T)


def _numbers(text: str) -> list[float]:
    return [float(x) for x in text.split()]


def _set_inertial(edits: Edits, link: Element, parameters: Array) -> None:
    elements = [_tag(name, keys) for name, keys in inertial_keys(parameters).items()]
    inertial = link.child("inertial")
    indent = edits.indent(link) + "  " if inertial is None else edits.indent(inertial)
    inside = "".join(f"\n{indent}  {element}" for element in elements)
    text = f"<inertial>{inside}\n{indent}</inertial>"
    if inertial is None:
        edits.insert(link, text)
    else:
        edits.replace(inertial, text)


def _set_friction(edits: Edits, joint: Element, damping: float, frictionloss: float) -> None:
    dynamics = joint.child("dynamics")
    stated = dynamics.attributes if dynamics else {}
    text = _tag("dynamics", stated | {"damping": text_of(damping), "friction": text_of(frictionloss)})
    if dynamics is None:
        edits.insert(joint, text)
    else:
        edits.replace(dynamics, text)


def _tag(name: str, attributes: dict[str, str]) -> str:
    return ET.tostring(ET.Element(name, attributes), encoding="unicode", short_empty_elements=True).replace(" />", "/>")
