"""A new URDF for a robot of DH rows: bodies, joints, limits, damping and friction; shapes and meshes there are none."""

import xml.etree.ElementTree as ET

from .mechanism import Mechanism
from .numbers import inertial_keys, roll_pitch_yaw, text_of
from .urdf_patch import link_names

UNLIMITED = 1e9  # a URDF must state effort and velocity


def urdf_text(m: Mechanism) -> str:
    """The URDF of a mechanism, link frames as its DH rows have them; armatures and couplings have no place in it."""
    robot = m.model.robot
    root = ET.Element("robot", name=robot.name)
    names = ("base_link", *link_names(robot))
    origins, rotations, axes = m.model.joint_frames
    ET.SubElement(root, "link", name=names[0])
    for j, joint in enumerate(robot.joints):
        inertial = ET.SubElement(ET.SubElement(root, "link", name=names[j + 1]), "inertial")
        for tag, keys in inertial_keys(m.links[j]).items():
            ET.SubElement(inertial, tag, keys)
        limits = joint.si("position")
        kind = "prismatic" if joint.type == "prismatic" else "continuous" if limits is None else "revolute"
        moved = ET.SubElement(root, "joint", name=joint.name, type=kind)
        ET.SubElement(moved, "parent", link=names[m.model.parents[j]])
        ET.SubElement(moved, "child", link=names[j + 1])
        ET.SubElement(moved, "origin", xyz=text_of(*origins[j]), rpy=text_of(*roll_pitch_yaw(rotations[j])))
        ET.SubElement(moved, "axis", xyz=text_of(*axes[j]))
        ends = (-UNLIMITED, UNLIMITED) if limits is None else limits
        stated = {"effort": text_of(UNLIMITED), "velocity": text_of(joint.si("speed") or UNLIMITED)}
        if kind != "continuous":
            stated = {"lower": text_of(ends[0]), "upper": text_of(ends[1])} | stated
        ET.SubElement(moved, "limit", stated)
        ET.SubElement(moved, "dynamics", damping=text_of(m.damping[j]), friction=text_of(m.frictionloss[j]))
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
