"""From a URDF to a reference, and back to a model to simulate with: the six commands of the README.

The robot that is moved is known, so what comes out is compared with it.
"""

import json
import re
import shlex
import shutil
import subprocess

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from conftest import ACQUIRE, IDENTIFY, ROOT
from urdfs import packaged_urdf

from acquisition.robot import load_robot
from identification.model import InverseModel


@pytest.fixture(scope="module")
def loop(tmp_path_factory):
    """The folder after the six commands."""
    there = tmp_path_factory.mktemp("ur5")
    shutil.copy(packaged_urdf("ur5_robot.urdf"), there)
    text = (ROOT / "identification" / "README.md").read_text()
    section = text.split("\n## Your arm in MuJoCo in six commands\n")[1].split("\n## ")[0]
    commands = re.findall(r"^ {4}(.*)$", section, flags=re.MULTILINE)
    assert len(commands) == 6
    programs = {program.name: program for program in (ACQUIRE, IDENTIFY)}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(there)
        for command in commands:
            program, *arguments = shlex.split(command, comments=True)
            if program in programs:
                assert programs[program].main(arguments) == 0, command
            else:
                subprocess.run([program, *arguments], check=True)
    return there


def test_the_exported_model_opens_in_mujoco(loop):
    assert mujoco.MjModel.from_xml_path(str(loop / "new.xml")).nv == 6


def torque(robot, states):
    """Torque of the description's `[parameters]`."""
    dynamics = InverseModel(robot)
    return dynamics.regressor(*states) @ np.array([robot.parameters.get(name, 0.0) for name in dynamics.names])


def states_of(robot, number=200):
    rng = np.random.default_rng(5)
    limits = np.array([(*joint.si("position"), joint.si("speed"), joint.si("acceleration")) for joint in robot.joints])
    q = rng.uniform(limits[:, 0], limits[:, 1], (number, robot.n))
    return q, rng.uniform(-1, 1, q.shape) * limits[:, 2], rng.uniform(-1, 1, q.shape) * limits[:, 3]


def relative(error, of):
    return np.linalg.norm(error, axis=0) / np.linalg.norm(of, axis=0)


def test_the_exported_description_moves_as_the_robot_that_was_recorded(loop):
    robot, exported = load_robot(loop / "robot.toml"), load_robot(loop / "new.toml")
    assert [joint.name for joint in exported.joints] == [joint.name for joint in robot.joints]
    states = states_of(robot)
    true = torque(robot, states)
    assert relative(torque(exported, states) - true, true).max() < 0.03


def test_the_exported_urdf_has_the_rigid_body_of_the_robot(loop):
    """Read by pinocchio alone; the sum of what was fitted is the robot's, though no link need be."""
    robot = load_robot(loop / "robot.toml")
    rigid = {name: value for name, value in robot.parameters.items() if not name.startswith(("Ia", "Fv", "Fc"))}
    dynamics, names = InverseModel(robot), [joint.name for joint in robot.joints]
    model = pin.buildModelFromUrdf(str(loop / "new.urdf"))
    data, order = model.createData(), [model.joints[model.getJointId(name)].idx_v for name in names]
    q, dq, ddq = states_of(robot)
    tau, zero = np.empty(q.shape), np.zeros(model.nv)
    for k in range(len(q)):
        at = [zero.copy() for _ in range(3)]
        for x, given in zip(at, (q[k], dq[k], ddq[k]), strict=True):
            x[order] = given
        tau[k] = pin.rnea(model, data, *at)[order]
    true = dynamics.regressor(q, dq, ddq) @ np.array([rigid.get(name, 0.0) for name in dynamics.names])
    assert relative(tau - true, true).max() < 0.05


def test_the_exported_description_is_simulated_and_studied(loop, monkeypatch, capsys):
    monkeypatch.chdir(loop)
    rate_hz = load_robot(loop / "new.toml").controller.sample_rate_hz or 500  # of the law that the fit found
    short = ["--duration-s", "2", "--rate-hz", f"{rate_hz:g}"]
    assert IDENTIFY.main(["simulate", "new.toml", *short, "-o", "again.mcap"]) == 0
    assert IDENTIFY.main(["study", "new.toml", *short, "--runs", "1", "--json", "study.json"]) == 0
    assert capsys.readouterr().err == ""
    (run,) = json.loads((loop / "study.json").read_text())["runs"]
    assert run["ls"]["error"] < 0.5
