"""The equations of motion of a serial URDF, its limits and control: its XML is read here, nothing
is the package's dynamics.
"""

import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from independent_robots import EYE, Chain, Friction, Plant, carried_on, skew
from independent_simulator import Controller, designed_pd

from acquisition.robot import Robot, robot_from_files

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class UrdfChain(Chain):
    """A chain of revolute joints: origin (n, 3) and rotation (n, 3, 3) in the link
    before, and axis (n, 3).
    """

    at: Array
    turned: Array
    along: Array

    def _frames(self, q: Array) -> tuple[Array, Array, Array]:
        s, c, K = np.sin(q)[..., None, None], np.cos(q)[..., None, None], skew(self.along)
        local = np.zeros((*q.shape, 4, 4))
        local[..., :3, :3] = self.turned @ (EYE + s * K + (1 - c) * (K @ K))
        local[..., :3, 3], local[..., 3, 3] = self.at, 1.0
        world = carried_on(local)
        return (
            (world[..., :3, :3] @ self.along[..., None])[..., 0],
            world[..., :3, 3],
            world[..., :3, :3],
        )


def numbers(element: ET.Element | None, key: str) -> Array:
    """The numbers of an attribute; zeros without it."""
    text = None if element is None else element.get(key)
    return np.array([float(x) for x in (text or "0 0 0").split()])


def rotation_of(rpy: Array) -> Array:
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(x), np.sin(x)) for x in rpy)
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    return np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ y @ x


def chain_of(text: str) -> UrdfChain:
    """The links that revolute joints carry, in the order of the joints."""
    root = ET.fromstring(text)
    links = {link.get("name"): link.find("inertial") for link in root.findall("link")}
    joints = root.findall("joint")
    bodies = [links[joint.find("child").get("link")] for joint in joints]
    mass = np.array([float(body.find("mass").get("value")) for body in bodies])
    c = np.array([numbers(body.find("origin"), "xyz") for body in bodies])
    about = np.array(
        [
            np.diag([float(body.find("inertia").get(k)) for k in ("ixx", "iyy", "izz")])
            for body in bodies
        ]
    )
    origins, none = [joint.find("origin") for joint in joints], np.zeros(len(joints))
    return UrdfChain(
        alpha=none, d=none, theta=none, r=none, prismatic=none.astype(bool),
        gravity=np.array([0, 0, -9.81]),
        inertia=about - mass[:, None, None] * skew(c) @ skew(c), moment=mass[:, None] * c,
        mass=mass,
        at=np.array([numbers(one, "xyz") for one in origins]),
        turned=np.array([rotation_of(numbers(one, "rpy")) for one in origins]),
        along=np.array([numbers(joint.find("axis"), "xyz") for joint in joints]),
    )  # fmt: skip


HEAD = 'name = "six"\nurdf = "arm.urdf"\n[controller]\nbandwidth_hz = 6\n'
JOINT = """[[joint]]
name = "{0}"
type = "revolute"
position_deg = [-100, 100]
speed_deg_s = 120
acceleration_deg_s2 = 500
[[motor]]
name = "m_{0}"
effort_unit = "N m"
"""
# Fv, Fc
FRICTION_OF_TORQUE = np.array(
    [(6.0, 8.0), (8.0, 10.0), (5.0, 6.0), (1.0, 1.2), (1.0, 1.2), (0.6, 0.8), (0.5, 0.7)]
)
ROTORS = np.array([0.9, 0.9, 0.5, 0.06, 0.06, 0.05, 0.04])
RATE_HZ = 500.0


def arm_of(text: str) -> tuple[Plant, Controller]:
    """The arm of a URDF with rotors and friction, and a PD that holds it."""
    joints = [joint.get("name") for joint in ET.fromstring(text).findall("joint")]
    described = tomllib.loads(HEAD + "".join(JOINT.format(name) for name in joints))
    viscous, coulomb = FRICTION_OF_TORQUE[: len(joints)].T
    n = len(joints)
    body = Plant(
        name="six", rigid=chain_of(text), rotor=np.diag(ROTORS[:n]), offset=np.zeros(n),
        R=np.eye(n),
        friction=Friction(
            directions=np.eye(n), coulomb=coulomb, viscous=np.diag(viscous), smooth=np.full(n, 0.01)
        ),
        description=described,
    )  # fmt: skip
    return body, designed_pd(body, 6.0, RATE_HZ)


def robot_of(text: str, names: list[str], joint: Callable[[str], str] = str) -> Robot:
    """The description that a fit is given, with the URDF `text` of the same joints; `joint`
    changes the text of each.
    """
    toml = HEAD + "".join(joint(JOINT.format(name)) for name in names)
    return robot_from_files(
        {"robot.toml": toml.encode(), "robot.urdf": text.encode()}, "robot.toml"
    )
