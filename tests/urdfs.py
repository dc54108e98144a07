"""URDFs made up for tests: a chain with a hand, written by hand, with something of everything a URDF may have."""

from acquisition.robot import Robot, robot_from_files

BOX = '<inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.03" iyz="-0.002" izz="0.04"/>'


def link(name, mass=2.0, inertia=BOX, at="0.1 -0.02 0.03"):
    return (
        f'<link name="{name}"><inertial><origin xyz="{at}" rpy="0.1 0.2 -0.3"/><mass value="{mass}"/>{inertia}'
        "</inertial></link>\n"
    )


def joint(name, kind, parent, child, rest="", axis="0 0 1", origin="0.2 0 0.1"):
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{origin}" rpy="0.3 0 0.5"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="{axis}"/>{rest}</joint>\n'
    )


LIMIT = '<limit lower="-2" upper="1.5" velocity="3" effort="40"/>'

# base - turn - lift - slide - tool, fixed, with a gripper: the thumb mimics the finger. The sensor has no mass.
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
        "turn", "revolute", "base", "column", LIMIT + '<dynamics damping="0.6" friction="0.25"/>', axis="0 0.6 0.8"
    ),
    "lift": joint("lift", "revolute", "column", "arm", LIMIT, axis="0 1 0"),
    "slide": joint("slide", "prismatic", "arm", "beam", '<limit lower="0.1" upper="0.4" velocity="0.5" effort="90"/>'),
    "mount": joint("mount", "fixed", "beam", "tool"),
    "glued": joint("glued", "fixed", "arm", "sensor"),
    "finger": joint("finger", "prismatic", "tool", "left", '<limit lower="0" upper="0.04" velocity="1" effort="9"/>'),
    "thumb": joint(
        "thumb",
        "prismatic",
        "tool",
        "right",
        '<limit lower="0" upper="0.04" velocity="1" effort="9"/><mimic joint="finger" multiplier="-1"/>',
    ),
}


def urdf(**parts):
    """The URDF with some of its parts replaced by others; an empty one is left out."""
    return f'<?xml version="1.0"?>\n<robot name="made up">\n{"".join((PARTS | parts).values())}</robot>\n'


ARM = ("turn", "lift", "slide")  # without the fingers


def robot_of_arm(text: str, head: str) -> Robot:
    """The robot of these joints in a URDF; `head` begins its robot.toml."""
    toml = f'{head}name = "arm"\nurdf = "arm.urdf"\n[controller]\nbandwidth_hz = 5\n'
    for name, kind, unit in zip(ARM, ("revolute", "revolute", "prismatic"), ("N m", "N m", "N"), strict=True):
        toml += f'[[joint]]\nname = "{name}"\ntype = "{kind}"\n[[motor]]\nname = "m_{name}"\neffort_unit = "{unit}"\n'
    return robot_from_files({"robot.toml": toml.encode(), "robot.urdf": text.encode()}, "arm.toml")
