"""Which mechanism simulated drives move, and with which loops: the described robot, or independent joints in its place.

The dynamics of a description's `[parameters]` are not known here. Who knows them offers them as an entry point of the group
`robot_idim.plants`: a function of the robot that gives the plant and the loops of drives that suit its inertias. It raises
`AcquisitionError` where the description cannot be simulated.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points

import numpy as np

from ..arrays import Array
from ..errors import AcquisitionError
from ..robot import Bus, Robot
from .loops import LoopGains
from .plants import Plant, typical_inertia, typical_plant

GROUP = "robot_idim.plants"
PlantOf = Callable[[Robot], tuple[Plant, LoopGains]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Mechanism:
    """What simulated drives move, and their loops; `warning` is set where it is not the described robot."""

    plant: Plant
    loops: LoopGains
    warning: str | None = None


def mechanism_of(robot: Robot, bus: Bus) -> Mechanism:
    """The robot of `[parameters]` where they are given and an installed package can simulate them, else independent joints.

    Raises `AcquisitionError` where `[parameters]` describe no robot that can be simulated.
    """
    if not robot.parameters:
        return _stand_in(robot, bus, "robot.toml has no [parameters]")
    offered = list(entry_points(group=GROUP))
    if not offered:
        return _stand_in(robot, bus, f"no installed package offers the robot's dynamics (entry points {GROUP})")
    try:
        plant_of: PlantOf = offered[0].load()
    except (ImportError, AttributeError) as error:
        raise AcquisitionError(f"entry point {GROUP} {offered[0].value}: cannot be loaded: {error}") from error
    plant, loops = plant_of(robot)
    return Mechanism(plant=plant, loops=loops)


def _stand_in(robot: Robot, bus: Bus, why: str) -> Mechanism:
    rated = rated_motor_effort(bus)
    warning = f"a stand-in of independent joints with a gravity-like load moves, not the described robot: {why}"
    return Mechanism(plant=typical_plant(robot, rated), loops=typical_loops(robot, rated), warning=warning)


def rated_motor_effort(bus: Bus) -> Array:
    """Rated efforts (n,) of the motors, in the recorded units: 1000 raw units of each drive's effort object."""
    return np.array([1000.0 * abs(drive.effort.scale) for drive in bus.drives])


def typical_loops(robot: Robot, rated: Array) -> LoopGains:
    """Cascaded gains for `typical_plant`: position loop at the stated bandwidth, velocity loop four times as fast."""
    w = 2 * np.pi * robot.controller.bandwidth_hz * np.ones(robot.n)
    return LoopGains(position=w, velocity=4 * w * typical_inertia(robot, rated), integral=w)
