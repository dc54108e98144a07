"""From a URDF to a reference, and back to a model to simulate with: the six
commands of the README.
"""

import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import mujoco
import numpy as np
from conftest import ACQUIRE, IDENTIFY, ROOT, described_chi
from urdfs import packaged_urdf

from acquisition.robot import load_robot
from identification.model import InverseModel


def test_six_commands_export_true_models(tmp_path, monkeypatch, capsys):
    """The robot that is moved is known, so what comes out is compared with it.

    A study simulates it.
    """
    shutil.copy(packaged_urdf("ur5_robot.urdf"), tmp_path)
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "identification" / "docs" / "howto" / "export.md").read_text()
    section = text.split("\n## Steps\n")[1].split("\n## ")[0]
    commands = re.findall(r"^ {4}(.*)$", section, flags=re.MULTILINE)
    assert len(commands) == 6
    programs = {program.name: program for program in (ACQUIRE, IDENTIFY)}
    for command in commands:
        program, *arguments = shlex.split(command, comments=True)
        if program in programs:
            assert programs[program].main(arguments) == 0, command
        else:
            subprocess.run([program, *arguments], check=True)
    assert json.loads(Path("fit.json").read_text())["verdict"] == "trust"
    assert mujoco.MjModel.from_xml_path("new.xml").nv == 6
    robot, exported = (load_robot(Path(name)) for name in ("robot.toml", "new.toml"))
    assert [joint.name for joint in exported.joints] == [joint.name for joint in robot.joints]
    limits = np.array(
        [
            (*joint.si("position"), joint.si("speed"), joint.si("acceleration"))
            for joint in robot.joints
        ]
    ).T
    q, dq, ddq = (
        np.random.default_rng(5)
        .uniform((limits[0], *-limits[2:]), limits[1:], (200, 3, 6))
        .swapaxes(0, 1)
    )
    true, found = (
        InverseModel(one).regressor(q, dq, ddq) @ described_chi(InverseModel(one))
        for one in (robot, exported)
    )
    assert (np.linalg.norm(found - true, axis=0) / np.linalg.norm(true, axis=0)).max() < 0.03
    capsys.readouterr()
    options = f"--duration-s 2 --rate-hz {exported.controller.sample_rate_hz or 500:g} --runs 1"
    assert IDENTIFY.main(["study", "new.toml", *options.split(), "--json", "study.json"]) == 0
    assert capsys.readouterr().err == ""
    (run,) = json.loads(Path("study.json").read_text())["runs"]
    assert run["ls"]["error"] < 0.5
