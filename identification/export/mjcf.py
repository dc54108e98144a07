"""A MuJoCo model: bodies, armature, damping, friction loss; a motor that turns with several joints is a fixed tendon.

The tendon's coefficients are the motor's row of the motor matrix; the motor's armature, damping and friction loss are the
tendon's (armature of tendons: MuJoCo 3.3 and later). Shapes and meshes are not written.
"""

import xml.etree.ElementTree as ET

import numpy as np

from acquisition.files import text_of

from ..arrays import Array
from .mechanism import Mechanism, about_com
from .urdf import link_names

INERTIA = (0, 3, 5, 1, 2, 4)  # MuJoCo's order xx yy zz xy xz yz, of XX XY XZ YY YZ ZZ


def mjcf_text(m: Mechanism) -> str:
    """The MJCF of a mechanism, whose couplings are tendons; an offset or another friction term has no place in it."""
    robot = m.model.robot
    root = ET.Element("mujoco", model=robot.name)
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", gravity=text_of(*robot.gravity))
    carriers = {0: ET.SubElement(root, "worldbody")}
    names = link_names(robot)
    origins, rotations, axes = m.model.joint_frames
    turns = quaternions(rotations)[:, [3, 0, 1, 2]]  # MuJoCo's order is w x y z
    for j, joint in enumerate(robot.joints):
        place = {"name": names[j], "pos": text_of(*origins[j]), "quat": text_of(*turns[j])}
        body = ET.SubElement(carriers[m.model.parents[j]], "body", place)
        carriers[j + 1] = body
        mass, com, inertia = about_com(m.links[j])
        ET.SubElement(
            body, "inertial", pos=text_of(*com), mass=text_of(mass), fullinertia=text_of(*inertia[list(INERTIA)])
        )
        moved: dict[str, str] = {
            "name": joint.name,
            "type": "slide" if joint.type == "prismatic" else "hinge",
            "axis": text_of(*axes[j]),
        }
        limits = joint.si("position")
        if limits is not None:
            moved["range"] = text_of(*limits)
        for key in ("armature", "damping", "frictionloss"):
            moved[key] = text_of(getattr(m, key)[j])
        ET.SubElement(body, "joint", moved)
    if m.couplings:
        tendons = ET.SubElement(root, "tendon")
        for c in m.couplings:
            values = {"name": c.name} | {
                key: text_of(getattr(c, key)) for key in ("armature", "damping", "frictionloss")
            }
            fixed = ET.SubElement(tendons, "fixed", values)
            for joint, coefficient in zip(robot.joints, c.row, strict=True):
                if coefficient:
                    ET.SubElement(fixed, "joint", joint=joint.name, coef=text_of(coefficient))
    actuators = ET.SubElement(root, "actuator")
    for joint in robot.joints:
        ET.SubElement(actuators, "motor", name=joint.name, joint=joint.name)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def quaternions(rotations: Array) -> Array:
    """Unit quaternions (n, 4), x y z w, of rotation matrices (n, 3, 3); w is not negative."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotations).as_quat(canonical=True))
