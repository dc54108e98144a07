"""Numbers and frames as XML has them."""

import numpy as np

from ..arrays import Array

ROUNDING = 1e-18  # SI: no mass, length or inertia of a robot is so small


def text_of(*values: float) -> str:
    """Numbers with all their digits, separated by blanks; rounding of a zero is written as zero."""
    return " ".join(repr(float(x) if abs(x) > ROUNDING else 0.0) for x in values)


def about_com(link: Array) -> tuple[float, Array, Array]:
    """Mass, centre of mass (3,) and XX XY XZ YY YZ ZZ (6,) about it, of a link's ten parameters (10,) about the origin."""
    mass = float(link[9])
    com = link[6:9] / mass
    steiner = mass * (com @ com * np.eye(3) - np.outer(com, com))
    return mass, com, np.asarray(link[:6] - steiner[np.triu_indices(3)])


def quaternion(R: Array) -> Array:
    """w x y z of a rotation (3, 3), of norm one, w not negative."""
    # Of the four products 4 w² , 4 x², 4 y², 4 z² the largest is divided by.
    w, x, y, z = (1 + s @ np.diag(R) for s in np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]))
    columns = np.array(
        [
            [w, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], x, R[1, 0] + R[0, 1], R[0, 2] + R[2, 0]],
            [R[0, 2] - R[2, 0], R[1, 0] + R[0, 1], y, R[2, 1] + R[1, 2]],
            [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2], z],
        ]
    )
    q = columns[int(np.argmax([w, x, y, z]))]
    q = q / np.linalg.norm(q)
    return np.asarray(-q if q[0] < 0 else q)


def roll_pitch_yaw(R: Array) -> Array:
    """Angles (3,) of Rot(z, yaw) Rot(y, pitch) Rot(x, roll), as a URDF has them; of all rotations, those of 90° pitch too."""
    yaw = np.arctan2(R[1, 0], R[0, 0])
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    s, c = np.sin(yaw), np.cos(yaw)
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, pitch, yaw])


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Rot(z, yaw) Rot(y, pitch) Rot(x, roll) (3, 3)."""
    (sr, cr), (sp, cp), (sy, cy) = ((np.sin(a), np.cos(a)) for a in (roll, pitch, yaw))
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    return np.asarray(about_z @ about_y @ about_x)


def inertial_keys(link: Array) -> dict[str, dict[str, str]]:
    """The elements of a URDF's `<inertial>` and their attributes, of a link's ten parameters (10,)."""
    mass, com, inertia = about_com(link)
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    return {
        "origin": {"xyz": text_of(*com), "rpy": "0 0 0"},
        "mass": {"value": text_of(mass)},
        "inertia": {key: text_of(value) for key, value in zip(keys, inertia, strict=True)},
    }
