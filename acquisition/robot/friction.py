"""Friction terms that a description may list, each as a function of speed.

To add a term, add its name to `FrictionTerm` and its row to `FRICTION`: descriptions, models,
intervals, charts and exports take it from there. Viscous friction and offsets act through matrices,
without a row.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..arrays import Array

FrictionTerm = Literal["viscous", "coulomb", "offset", "asymmetric", "root", "load", "stribeck"]


@dataclass(frozen=True, kw_only=True)
class Friction:
    """A friction term as a function of the speed u along a direction of joints or of a motor.

    Attributes:
        name: of its parameter; `motor_name` for a motor that turns with several joints, "" if
            such a motor has none.
        unit: of the parameter, from {effort} and {length}.
        size: per unit of the parameter, of |u|, the described speed and the
            size of the links' torque; None: 1 at any speed, as of Coulomb friction.
        slope: its derivative by |u|, of |u| and the described speed.
        has_sign: the term is sign(u) size, which jumps or is steep at 0; false for |u| alone, which
            a simulated robot knows as viscous friction by direction.
        is_steep: the slope is infinite at 0.
    """

    name: str
    motor_name: str = ""
    unit: str = "{effort}"
    size: Callable[[Array, float | Array, float | Array], Array] | None = None
    slope: Callable[[Array, float | Array], Array] = lambda u, u_s: 0.0 * u
    has_sign: bool = True
    is_steep: bool = False


FRICTION: dict[str, Friction] = {
    "coulomb": Friction(name="Fc", motor_name="Fcm"),
    "asymmetric": Friction(
        name="Fa",
        unit="{effort} s/{length}",
        size=lambda u, u_s, load: u,
        slope=lambda u, u_s: np.ones_like(u),
        has_sign=False,
    ),
    "root": Friction(
        name="Fr",
        motor_name="Frm",
        unit="{effort} (s/{length})^½",
        size=lambda u, u_s, load: np.sqrt(u),
        slope=lambda u, u_s: 0.5 / np.sqrt(u),
        is_steep=True,
    ),
    "stribeck": Friction(
        name="Fs",
        motor_name="Fsm",
        size=lambda u, u_s, load: np.exp(-((u / u_s) ** 2)),
        slope=lambda u, u_s: -2 * u / u_s**2 * np.exp(-((u / u_s) ** 2)),
    ),
    "load": Friction(name="mu", unit="", size=lambda u, u_s, load: load + 0.0 * u),
}
