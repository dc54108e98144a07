"""A URDF: the user's own with new inertials, damping and friction, all else as it was but blanks; or a new one of DH rows.

What the identification knows as one link is lumped: the link that a joint moves, and all that is fixed to it or that locked
joints carry. The difference to the other links' inertials goes to the moved link where that is a body; else the whole does,
and the others lose theirs.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from xml.dom import minidom
from xml.dom.minidom import Element

import numpy as np

from acquisition.errors import listed
from acquisition.files import text_of
from acquisition.robot import Robot

from ..arrays import Array
from ..estimation import link_parameters, pseudo_inertia
from ..model import is_a_body
from .mechanism import LEAST, Mechanism, about_com
from .urdf_of_model import UNLIMITED, made_link_names, made_urdf

INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def link_names(robot: Robot) -> tuple[str, ...]:
    """Names of the links that the joints move: those of the URDF, or `link_1` and so on of a robot of DH rows."""
    if robot.urdf is None:
        return made_link_names(robot)
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
    document = minidom.parseString((made_urdf(m.model) if robot.urdf is None else robot.urdf).encode())
    root = document.documentElement
    assert root is not None
    notes = _unlimited(root) if robot.urdf is None else []
    links = {link.getAttribute("name"): link for link in _children(root, "link")}
    joints = {joint.getAttribute("name"): joint for joint in _children(root, "joint")}
    lumped = _lumped(robot, joints, links)
    for j, (joint, name) in enumerate(zip(robot.joints, link_names(robot), strict=True)):
        inertials = {other: _children(links[other], "inertial") for other in lumped[name]}
        others = {other: _inertia_of(found[0], lumped[name][other]) for other, found in inertials.items() if found}
        own = m.links[j] - sum(others.values(), start=np.zeros(10))
        if others and not is_a_body(own, LEAST):
            mass = sum(inertia[9] for inertia in others.values())
            notes.append(
                f"link {name}: the inertials of {', '.join(others)} ({mass:.3g} kg), fixed to it, leave no body for it: "
                "they are removed, it has the whole"
            )
            own = m.links[j]
            for other in others:
                for inertial in inertials[other]:
                    links[other].removeChild(inertial)
        elif others:
            notes.append(f"link {name}: {', '.join(others)}, fixed to it, keep their inertials")
        inertial = _child_made(links[name], "inertial")
        inertial.childNodes.clear()
        for tag, values in inertial_keys(own).items():
            _set(_child_made(inertial, tag), values)
        dynamics = {"damping": text_of(m.damping[j]), "friction": text_of(m.frictionloss[j])}
        _set(_child_made(joints[joint.name], "dynamics"), dynamics)
    lines = [node.toxml() for node in document.childNodes]  # remarks may stand before and behind the root
    return "\n".join(['<?xml version="1.0" encoding="utf-8"?>', *lines, ""]), tuple(notes)


def _children(element: Element, name: str) -> list[Element]:
    return [child for child in element.childNodes if isinstance(child, Element) and child.tagName == name]


def _child(element: Element, name: str) -> Element | None:
    return next(iter(_children(element, name)), None)


def _child_made(element: Element, name: str) -> Element:
    """The first child of a name; a new one where there is none."""
    found = _child(element, name)
    if found is None:
        assert element.ownerDocument is not None
        found = element.appendChild(element.ownerDocument.createElement(name))
    return found


def _set(element: Element, values: Mapping[str, str]) -> None:
    for key, value in values.items():
        element.setAttribute(key, value)


def _unlimited(root: Element) -> list[str]:
    """Lines on the limits of a new URDF that the description does not have."""
    joints = [(joint.getAttribute("name"), _child(joint, "limit")) for joint in _children(root, "joint")]
    found = []
    for key, ways in (("effort", "effort_nm, effort_n or saturation"), ("velocity", "speed_deg_s or speed_m_s")):
        names = [name for name, limit in joints if limit and limit.getAttribute(key) == text_of(UNLIMITED)]
        if names:
            found.append(f"no {key} is known of {listed(names)}: {UNLIMITED:g} is written: state {ways}")
    return found


def _lumped(robot: Robot, joints: dict[str, Element], links: dict[str, Element]) -> dict[str, dict[str, Array]]:
    """By moved link, the links that move with it and their frames in its own, T (4, 4)."""
    moved = {joint.name for joint in robot.joints}
    above: dict[str, tuple[str, Array]] = {}  # of a link that does not move against its parent
    for name, joint in joints.items():
        parent, child = _child(joint, "parent"), _child(joint, "child")
        if name not in moved and parent is not None and child is not None:
            above[child.getAttribute("link")] = (parent.getAttribute("link"), _pose(joint))
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
    from scipy.spatial.transform import Rotation

    T, origin = np.eye(4), _child(element, "origin")
    if origin is not None:
        T[:3, 3] = [float(x) for x in (origin.getAttribute("xyz") or "0 0 0").split()]
        rpy = [float(x) for x in (origin.getAttribute("rpy") or "0 0 0").split()]
        T[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
    return T


def _inertia_of(inertial: Element, T: Array) -> Array:
    """Ten parameters (10,) of a link's inertial in a frame in which the link's own is T (4, 4)."""
    mass, inertia = _child(inertial, "mass"), _child(inertial, "inertia")
    about = [float(inertia.getAttribute(key) or 0.0) if inertia else 0.0 for key in INERTIA]
    value = float(mass.getAttribute("value") or 0.0) if mass else 0.0
    T = T @ _pose(inertial)
    return link_parameters(T @ pseudo_inertia(np.array([*about, 0.0, 0.0, 0.0, value])) @ T.T)


def inertial_keys(link: Array) -> dict[str, dict[str, str]]:
    """The elements of an `<inertial>` and their attributes, of a link's ten parameters (10,)."""
    mass, com, inertia = about_com(link)
    return {
        "origin": {"xyz": text_of(*com), "rpy": "0 0 0"},
        "mass": {"value": text_of(mass)},
        "inertia": {key: text_of(value) for key, value in zip(INERTIA, inertia, strict=True)},
    }
