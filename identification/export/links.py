"""The inertials of a URDF's links, checked: masses and principal moments that no body can have are refused."""

from collections.abc import Sequence

import numpy as np

from ..errors import IdentificationError
from .tree import Tree, number

_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
ROUNDING = 1e-6  # of the largest principal moment: CAD programs write few digits


def check_inertials(tree: Tree, links: Sequence[str]) -> tuple[str, ...]:
    """Lines about `links` whose principal moments break the triangle inequality: no body has them, but they can be simulated.

    Raises `IdentificationError` for a number that is none, a mass or a principal moment below zero.
    """
    notes = []
    for link in links:
        inertial = tree.links[link].find("inertial")
        if inertial is None:
            continue
        at = f"{tree.place}: link {link!r}"
        mass, inertia = inertial.find("mass"), inertial.find("inertia")
        m = number(None if mass is None else mass.get("value"), at, "mass")
        if m < 0:
            raise IdentificationError(place=at, key="mass", value=m, expected="a number from 0, kg")
        xx, xy, xz, yy, yz, zz = (
            number(None if inertia is None else inertia.get(name), at, f"inertia {name}") for name in _INERTIA
        )
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        slack, shown = ROUNDING * np.abs(moments).max(), ", ".join(f"{x:.4g}" for x in moments)
        if moments[0] < -slack:
            expected = "none below zero, kg m²"
            key = "principal moments"
            raise IdentificationError(place=at, key=key, value=moments.tolist(), shown=shown, expected=expected)
        if moments[2] > moments[0] + moments[1] + slack:
            notes.append(f"link {link}: principal moments {shown} kg m²: no body has one above the sum of the others")
    return tuple(notes)
