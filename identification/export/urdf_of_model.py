"""A URDF made of a robot's model: its joints, their limits, and links drawn as lines from joint to joint."""

import math
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np

from acquisition.files import text_of
from acquisition.robot import Robot, effort_limits

from ..arrays import Array
from ..model import InverseModel

UNLIMITED = 1e9  # a URDF must state effort and velocity: where the description has none
_BASE = "base_link"
_THICKNESS = 0.02  # of drawn links, m
_TIP = "0.12 0.08 0.04"  # m, of a box that ends a link: its turns about any axis are seen


def made_link_names(robot: Robot) -> tuple[str, ...]:
    """Names of the links that the joints move, in a URDF that is made."""
    return tuple(f"link_{j + 1}" for j in range(robot.n))


def made_urdf(model: InverseModel) -> str:
    """The URDF of a robot of DH rows, or of one whose own URDF has no shapes, without inertials."""
    robot = model.robot
    root, names = ET.Element("robot", name=robot.name), [_BASE, *made_link_names(robot)]
    origins, rotations, axes = model.joint_frames
    for k, name in enumerate(names):
        link = ET.SubElement(root, "link", name=name)
        ends = [origin for origin, parent in zip(origins, model.parents, strict=True) if parent == k]
        for end in ends or [np.zeros(3)]:
            _draw(link, end)
    for j, (joint, effort) in enumerate(zip(robot.joints, _efforts(robot), strict=True)):
        limits = joint.si("position")
        kind = "prismatic" if joint.type == "prismatic" else "continuous" if limits is None else "revolute"
        element = ET.SubElement(root, "joint", name=joint.name, type=kind)
        ET.SubElement(element, "parent", link=names[model.parents[j]])
        ET.SubElement(element, "child", link=names[j + 1])
        turn = roll_pitch_yaw(rotations[j])
        ET.SubElement(element, "origin", xyz=text_of(*origins[j]), rpy=text_of(*turn))
        ET.SubElement(element, "axis", xyz=text_of(*axes[j]))
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


def roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """The angles of a rotation (3, 3), as a URDF means them; of all rotations, those of 90° pitch too."""
    yaw = math.atan2(R[1, 0], R[0, 0])
    pitch = math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    s, c = math.sin(yaw), math.cos(yaw)
    return math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1]), pitch, yaw


def _draw(link: ET.Element, end: Array) -> None:
    """A cylinder from the link's origin to `end` (3,), where the next joint sits; a box where that is the origin."""
    visual, length = ET.SubElement(link, "visual"), float(np.linalg.norm(end))
    if length > 1e-6:
        yaw, pitch = math.atan2(end[1], end[0]), math.atan2(math.hypot(end[0], end[1]), end[2])
        ET.SubElement(visual, "origin", xyz=text_of(*end / 2), rpy=text_of(0.0, pitch, yaw))
    shape = ET.SubElement(visual, "geometry")
    if length > 1e-6:
        ET.SubElement(shape, "cylinder", radius=f"{_THICKNESS:g}", length=f"{length:.9g}")
    else:
        ET.SubElement(shape, "box", size=_TIP)
