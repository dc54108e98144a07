"""What a dry run moves: the robot of `[parameters]` where the description has them, else a stand-in that weighs something."""

from importlib.metadata import EntryPoints

import numpy as np
import pytest
from conftest import REPLAY
from made_up_buses import bus_of, bus_text, robot_of

import acquisition.simulated.mechanism as mechanism_module
from acquisition.errors import BadInputError
from acquisition.robot import load_robot
from acquisition.simulated import driven_plant


def test_without_parameters_or_dynamics_a_stand_in_with_weight_moves(monkeypatch):
    robot = robot_of(bus_text(2))
    made = driven_plant(robot, bus_of(robot))
    assert made.warning.startswith("simulated as independent joints with a gravity-like load")
    assert "robot.toml has no [parameters]" in made.warning
    free = np.zeros(2, bool)
    for _ in range(50):
        made.plant.step(np.zeros(2), free, 0.001)
    # Level joints fall with (0.3 - 0.05) of the rated effort; half of that effort accelerates them by 4000 deg/s².
    fallen = 0.5 * (0.25 / 0.5) * np.radians(4000) * 0.05**2
    assert made.plant.state()[0] == pytest.approx([-fallen] * 2, rel=0.05)
    monkeypatch.setattr(mechanism_module, "entry_points", lambda **_: EntryPoints())
    scara = load_robot(REPLAY / "scara" / "robot.toml")
    alone = driven_plant(scara, bus_of(scara))
    assert "no installed package offers the robot's dynamics (entry points robot_idim.plants)" in alone.warning


def test_parameters_that_describe_no_robot_are_refused_in_one_line():
    robot = robot_of((REPLAY / "scara" / "robot.toml").read_text().replace("ZZ2 = 0.061", "ZZ2 = -1000.0"))
    with pytest.raises(BadInputError, match="cannot be simulated: the inertia matrix is not positive"):
        driven_plant(robot, bus_of(robot))
