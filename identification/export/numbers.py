"""The inertia of a link as XML has it."""

import numpy as np

from acquisition.files import text_of

from ..arrays import Array


def about_com(link: Array) -> tuple[float, Array, Array]:
    """Mass, centre of mass (3,) and XX XY XZ YY YZ ZZ (6,) about it, of a link's ten parameters (10,) about the origin."""
    mass = float(link[9])
    com = link[6:9] / mass
    steiner = mass * (com @ com * np.eye(3) - np.outer(com, com))
    return mass, com, np.asarray(link[:6] - steiner[np.triu_indices(3)])


def inertial_keys(link: Array) -> dict[str, dict[str, str]]:
    """The elements of a URDF's `<inertial>` and their attributes, of a link's ten parameters (10,)."""
    mass, com, inertia = about_com(link)
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    return {
        "origin": {"xyz": text_of(*com), "rpy": "0 0 0"},
        "mass": {"value": text_of(mass)},
        "inertia": {key: text_of(value) for key, value in zip(keys, inertia, strict=True)},
    }
