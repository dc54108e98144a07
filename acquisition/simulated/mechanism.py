"""The mechanism that simulated drives move: the described robot, or independent joints in its place.

This package does not know the dynamics of `[parameters]`. Another package offers them as an entry point of the group
`robot_idim.plants`: a function of the robot that returns the plant and control loops that suit its inertias. It raises
`AcquisitionError` where the description cannot be simulated.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points

import numpy as np

from ..arrays import Array
from ..errors import Place
from ..robot import Bus, Robot
from .loops import LoopGains, cascaded_loops
from .plants import Plant, typical_inertia, typical_plant

GROUP = "robot_idim.plants"
PlantOf = Callable[[Robot], tuple[Plant, LoopGains]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Mechanism:
    """The plant that simulated drives move, and their loops; `warning` is set where it is not the described robot."""

    plant: Plant
    loops: LoopGains
    warning: str | None = None


def mechanism_of(robot: Robot, bus: Bus) -> Mechanism:
    """The mechanism of a description: the robot of its `[parameters]`, or independent joints without them.

    Independent joints, with a warning, also where no installed package offers the robot's dynamics.
    """
    if not robot.parameters:
        return _stand_in(robot, bus, "robot.toml has no [parameters]")
    offered = list(entry_points(group=GROUP))
    if not offered:
        return _stand_in(robot, bus, f"no installed package offers the robot's dynamics (entry points {GROUP})")
    try:
        plant_of: PlantOf = offered[0].load()
    except (ImportError, AttributeError) as error:
        Place(f"entry point {GROUP} {offered[0].value}").refuse(text=f"cannot be loaded: {error}")
    plant, loops = plant_of(robot)
    return Mechanism(plant=plant, loops=loops)


def _stand_in(robot: Robot, bus: Bus, why: str) -> Mechanism:
    rated = rated_motor_effort(bus)
    warning = f"a stand-in of independent joints with a gravity-like load moves, not the described robot: {why}"
    loops = cascaded_loops(robot, typical_inertia(robot, rated))
    return Mechanism(plant=typical_plant(robot, rated), loops=loops, warning=warning)


def rated_motor_effort(bus: Bus) -> Array:
    """Rated efforts (n,) of the motors, in the recorded units: 1000 raw units of each drive's effort object."""
    return np.array([1000.0 * abs(drive.effort.scale) for drive in bus.drives])
