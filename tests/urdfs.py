"""URDFs made up for tests, and those of the package example-robot-data."""

import importlib.metadata
from pathlib import Path

import pytest

from acquisition.robot import Robot, robot_from_files

BOX = '<inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.03" iyz="-0.002" izz="0.04"/>'


def link(name, mass=2.0, inertia=BOX, at="0.1 -0.02 0.03"):
    return (
        f'<link name="{name}"><inertial><origin xyz="{at}" rpy="0.1 0.2 -0.3"/><mass '
        f'value="{mass}"/>{inertia}'
        "</inertial></link>\n"
    )


def joint(name, kind, parent, child, rest="", axis="0 0 1", origin="0.2 0 0.1"):
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{origin}" rpy="0.3 0 0.5"/><parent '
        f'link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="{axis}"/>{rest}</joint>\n'
    )


LIMIT = '<limit lower="-2" upper="1.5" velocity="3" effort="40"/>'

# A chain with a hand, with something of everything a URDF may have.
# base - turn - lift - slide - tool, fixed, with a gripper: the thumb mimics the finger.
# The sensor has no mass.
PARTS = {
    "base": link("base"),
    "column": link("column"),
    "arm": link("arm", mass=1.5),
    "beam": link("beam", mass=0.7),
    "sensor": '<link name="sensor"/>\n',
    "tool": link("tool", mass=0.3),
    "left": link("left", mass=0.1),
    "right": link("right", mass=0.1),
    "turn": joint(
        "turn",
        "revolute",
        "base",
        "column",
        LIMIT + '<dynamics damping="0.6" friction="0.25"/>',
        axis="0 0.6 0.8",
    ),
    "lift": joint("lift", "revolute", "column", "arm", LIMIT, axis="0 1 0"),
    "slide": joint(
        "slide",
        "prismatic",
        "arm",
        "beam",
        '<limit lower="0.1" upper="0.4" velocity="0.5" effort="90"/>',
    ),
    "mount": joint("mount", "fixed", "beam", "tool"),
    "glued": joint("glued", "fixed", "arm", "sensor"),
    "finger": joint(
        "finger",
        "prismatic",
        "tool",
        "left",
        '<limit lower="0" upper="0.04" velocity="1" effort="9"/>',
    ),
    "thumb": joint(
        "thumb",
        "prismatic",
        "tool",
        "right",
        '<limit lower="0" upper="0.04" velocity="1" effort="9"/><mimic joint="finger" '
        'multiplier="-1"/>',
    ),
}


def urdf(**parts):
    """The URDF with some of its parts replaced by others; an empty one is left out."""
    return (
        '<?xml version="1.0"?>\n<robot name="made '
        f'up">\n{"".join((PARTS | parts).values())}</robot>\n'
    )


ARM = ("turn", "lift", "slide")  # without the fingers


def robot_of_arm(text: str, head: str) -> Robot:
    """The robot of these joints in a URDF; `head` begins its robot.toml."""
    toml = f'{head}name = "arm"\nurdf = "arm.urdf"\n[controller]\nbandwidth_hz = 5\n'
    for name, kind, unit in zip(
        ARM, ("revolute", "revolute", "prismatic"), ("N m", "N m", "N"), strict=True
    ):
        toml += (
            f'[[joint]]\nname = "{name}"\ntype = "{kind}"\n[[motor]]\nname = '
            f'"m_{name}"\neffort_unit = "{unit}"\n'
        )
    return robot_from_files({"robot.toml": toml.encode(), "robot.urdf": text.encode()}, "arm.toml")


# Six joints as a UR5's, with its masses: name, axis, origin and rpy of the joint; mass, centre,
# principal inertias of the link.
SIX = (
    ("pan", "0 0 1", "0 0 0.0892", "0 0 0", 3.7, "0 0 0", (0.0103, 0.0103, 0.00666)),
    ("lift", "0 1 0", "0 0.1358 0", "0 1.5708 0", 8.393, "0 0 0.28", (0.2269, 0.2269, 0.0151)),
    ("elbow", "0 1 0", "0 -0.1197 0.425", "0 0 0", 2.275, "0 0 0.196", (0.0312, 0.0312, 0.0041)),
    (
        "wrist_1",
        "0 1 0",
        "0 0 0.3922",
        "0 1.5708 0",
        1.219,
        "0 0.093 0",
        (0.00256, 0.00256, 0.00219),
    ),
    ("wrist_2", "0 0 1", "0 0.093 0", "0 0 0", 1.219, "0 0 0.0947", (0.00256, 0.00256, 0.00219)),
    (
        "wrist_3",
        "0 1 0",
        "0 0 0.0947",
        "0 0 0",
        0.1879,
        "0 0.0656 0",
        (0.0000847, 0.0000847, 0.000132),
    ),
)


# Seven joints as a Panda's, with the axes of a Panda and bodies of about its size.
SEVEN = (
    ("j1", "0 0 1", "0 0 0.333", "0 0 0", 3.1, "0 -0.03 -0.12", (0.034, 0.032, 0.011)),
    ("j2", "0 0 1", "0 0 0", "-1.5708 0 0", 3.0, "0 -0.07 0.03", (0.031, 0.010, 0.030)),
    ("j3", "0 0 1", "0 -0.316 0", "1.5708 0 0", 2.6, "0.03 0.02 -0.08", (0.021, 0.020, 0.009)),
    ("j4", "0 0 1", "0.0825 0 0", "1.5708 0 0", 2.5, "-0.04 0.07 0.02", (0.019, 0.009, 0.021)),
    ("j5", "0 0 1", "-0.0825 0.384 0", "-1.5708 0 0", 2.9, "0 0.03 -0.14", (0.035, 0.029, 0.009)),
    ("j6", "0 0 1", "0 0 0", "1.5708 0 0", 1.5, "0.05 0.01 0.01", (0.003, 0.005, 0.005)),
    ("j7", "0 0 1", "0.088 0 0", "1.5708 0 0", 1.1, "0.01 0.01 0.08", (0.004, 0.004, 0.002)),
)


def six_joints(factors=(1.0, 1.0, 1.0, 1.0, 1.0, 1.0)):
    """The URDF of the six joints, mass and inertia of each link times its factor."""
    return serial(SIX, factors)


def serial(links, factors=(1.0,) * 7):
    """The URDF of links, each with its joint."""
    parts = ['<?xml version="1.0"?>\n<robot name="six">\n<link name="base"/>\n']
    for k, (name, axis, origin, rpy, mass, at, (xx, yy, zz)) in enumerate(links):
        x, parent = factors[k], links[k - 1][0] + "_link" if k else "base"
        parts.append(
            f'<link name="{name}_link"><inertial><origin xyz="{at}"/><mass value="{x * mass}"/>'
            f'<inertia ixx="{x * xx}" ixy="0" ixz="0" iyy="{x * yy}" iyz="0" '
            f'izz="{x * zz}"/></inertial></link>\n'
            f'<joint name="{name}" type="revolute"><origin xyz="{origin}" rpy="{rpy}"/><parent '
            f'link="{parent}"/>'
            f'<child link="{name}_link"/><axis xyz="{axis}"/>'
            '<limit lower="-3" upper="3" velocity="3" effort="150"/></joint>\n'
        )
    return "".join(parts) + "</robot>\n"


TWO_TURNING = """<robot name="two">
  <link name="base"/><link name="l1"/><link name="l2"/><link name="finger"/>
  <joint name="j1" type="continuous"><parent link="base"/><child link="l1"/><axis xyz="0 0 1"/>
    <origin xyz="0.3 0 0"/></joint>
  <joint name="j2" type="revolute"><parent link="l1"/><child link="l2"/><axis xyz="0 0 1"/>
    <origin xyz="0.3 0 0" rpy="1.5707963267948966 0 0"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="grip" type="prismatic"><parent link="l2"/><child link="finger"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>
</robot>"""
TURN_AND_SLIDE = """<robot name="arm"><link name="base"/><link name="upper"/><link name="slide"/>
<joint name="elbow" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1" effort="{effort}"/></joint>
<joint name="rail" type="prismatic"><parent link="upper"/><child link="slide"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" velocity="1" effort="40"/></joint>
<transmission name="t"><joint name="elbow"/></transmission></robot>"""
TURN_AND_SLIDE_TOML = """
name = "arm"
urdf = "arm.urdf"
[[joint]]
name = "elbow"
type = "revolute"
{elbow}
[[joint]]
name = "rail"
type = "prismatic"
{rail}
[[motor]]
name = "m1"
ratio = 50
drive_gain = 2.0
drive_gain_unit = "N m/A"
saturation = 0.3
[[motor]]
name = "m2"
effort_unit = "N"
[controller]
bandwidth_hz = 5
"""


def packaged_urdf(name: str) -> Path:
    """A file of the package example-robot-data."""
    try:
        files = importlib.metadata.files("example-robot-data") or []
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(
            "example-robot-data is not installed: pip install -e '.[test]' installs it",
            allow_module_level=True,
        )
    (path,) = (Path(str(file.locate())) for file in files if file.name == name)
    return path
