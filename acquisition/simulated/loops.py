"""Control loops of simulated drives: their gains and their state."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array

SUBSTEPS = 4  # of the control loops in a SYNC period


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopGains:
    """Gains of the drives at the joints: position 1/s, velocity effort/(rad/s), integral 1/s; each (n,).

    `feedforward` is the share of the reference's speed that goes to the velocity loop directly.
    """

    position: Array
    velocity: Array
    integral: Array
    feedforward: float = 1.0
    current_s: float = 3e-4  # time constant of the current loop


@dataclass(kw_only=True)
class LoopMemory:
    """State of the loops at the joints, each (n,): target now and before, its slope, integral, efforts, held by brakes."""

    target: Array
    before: Array
    slope: Array
    integral: Array
    actual: Array
    demand: Array
    held: NDArray[np.bool_]
