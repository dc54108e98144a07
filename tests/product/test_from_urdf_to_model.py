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
import pytest
from conftest import ACQUIRE, IDENTIFY, ROOT, described_chi
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


def test_the_exported_description_moves_as_the_robot_that_was_recorded(loop):
    robot, exported = (load_robot(loop / name) for name in ("robot.toml", "new.toml"))
    assert [joint.name for joint in exported.joints] == [joint.name for joint in robot.joints]
    limits = np.array(
        [(*joint.si("position"), joint.si("speed"), joint.si("acceleration")) for joint in robot.joints]
    ).T
    q, dq, ddq = (
        np.random.default_rng(5).uniform((limits[0], *-limits[2:]), limits[1:], (200, 3, robot.n)).swapaxes(0, 1)
    )
    true, found = (
        InverseModel(one).regressor(q, dq, ddq) @ described_chi(InverseModel(one)) for one in (robot, exported)
    )
    assert (np.linalg.norm(found - true, axis=0) / np.linalg.norm(true, axis=0)).max() < 0.03


def test_the_exported_description_is_simulated_and_studied(loop, monkeypatch, capsys):
    monkeypatch.chdir(loop)
    rate_hz = load_robot(loop / "new.toml").controller.sample_rate_hz or 500  # of the law that the fit found
    short = ["--duration-s", "2", "--rate-hz", f"{rate_hz:g}"]
    assert IDENTIFY.main(["simulate", "new.toml", *short, "-o", "again.mcap"]) == 0
    assert IDENTIFY.main(["study", "new.toml", *short, "--runs", "1", "--json", "study.json"]) == 0
    assert capsys.readouterr().err == ""
    (run,) = json.loads((loop / "study.json").read_text())["runs"]
    assert run["ls"]["error"] < 0.5
