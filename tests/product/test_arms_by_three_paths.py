"""The three ways to a model: drives, a table of another tool, arrays in Python; arms of
different build.

Each starts at a URDF and takes the files as `init` and `import` write them; nothing but FILL IN is
filled in. What comes out is compared with the arm itself at a motion that nobody recorded.
"""

import re
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from conftest import ACQUIRE, IDENTIFY
from pinocchio_arm import Arm, arm_of, mujoco_torque
from urdfs import packaged_urdf
from virtual_buses import serving

import identification
from acquisition.robot import load_robot, resolve
from acquisition.simulated import SimulatedDrives, driven_plant

TORSO = ("torso_lift_joint", *(f"arm_{k}_joint" for k in range(1, 8)))
# Six turning joints; seven, and two sliding fingers of which one mimics the other; a slide that
# carries seven joints, among wheels, a head and a hand of 19.
ARMS = {"ur5_robot": (), "panda": (), "tiago": TORSO}
# Short sessions: joints, how far each may go, rad or m, and the period of the reference, s.
SESSIONS = {
    "panda": (tuple(f"panda_joint{k}" for k in range(1, 5)), "1.2", 4),
    "tiago": (TORSO[:5], "0.15,2,2,2,2", 4),
}
RATE_HZ, MOST_PERCENT, MOST_OF_DRIVES = 250.0, 0.3, 1.0


@pytest.fixture(params=ARMS)
def arm(request, tmp_path, monkeypatch) -> str:
    """The name of an arm, whose URDF stands in the working folder."""
    shutil.copy(packaged_urdf(f"{request.param}.urdf"), tmp_path / "arm.urdf")
    monkeypatch.chdir(tmp_path)
    return request.param


def acquire(*arguments: str) -> None:
    assert ACQUIRE.main(list(arguments)) == 0, arguments


def identify(*arguments: str) -> None:
    assert IDENTIFY.main(list(arguments)) == 0, arguments


def described(joints: Sequence[str], *options: str) -> list[str]:
    """robot.toml as `init` writes it; the names of its joints."""
    chosen = ["--joints", ",".join(joints)] if joints else []
    identify("init", "arm.urdf", *chosen, *options, "-o", "robot.toml", "--overwrite")
    return [joint.name for joint in load_robot(Path("robot.toml")).joints]


def fill_in(path: str, **values: str) -> None:
    """Fill in the marked keys, those of a table as `table_key`, and take all marks away."""
    table, lines = "", Path(path).read_text().splitlines()
    for k, line in enumerate(lines):
        table = line.strip("[]") if line.startswith("[") else table
        if k and "FILL IN" in line:
            key = line.removeprefix("# ").partition(" = ")[0]
            value = values.get(f"{table}_{key}", values.get(key))
            lines[k] = f"{key} = {value}" if value else ""
    Path(path).write_text("\n".join([*lines, ""]))


def true_to(arm: Arm, fit: identification.Fit, most_percent: float = MOST_PERCENT) -> bool:
    """Whether the torques of a fit and of the exported model are those of the arm."""
    torques = fit.predict, mujoco_torque("robot.xml")
    return max(arm.errors_percent(torque).max() for torque in torques) < most_percent


def drives(path: str) -> SimulatedDrives:
    """The simulated drives of a description."""
    robot = load_robot(Path(path))
    bus = resolve(robot, path)
    return SimulatedDrives(robot, bus, driven_plant(robot, bus))


@pytest.mark.parametrize("arm", SESSIONS, indirect=True)
def test_from_drives(arm, capsys):
    """The simulated drives are the package's own; the truth is the URDF's, read by pinocchio, with
    the friction and the rotors that the file shows. The six turning joints go this way by the
    commands of the guide (`test_six_commands_export_true_models`).
    """
    chosen, reach, period_s = SESSIONS[arm]
    joints = described(chosen, "--range", reach)
    text = re.sub(r"(?m)^#: ", "", Path("robot.toml").read_text())
    Path("robot.toml").write_text(text)
    fill_in(
        "robot.toml", acceleration_deg_s2="460", acceleration_m_s2="1", bandwidth_hz="10",
        following_error_deg="12", following_error_m="0.02",
    )  # fmt: skip
    with serving(drives("robot.toml")):
        ACQUIRE.main(["check", "robot.toml"])
    # late on a busy machine
    assert not re.search(r"^NO(?!  SYNC )", capsys.readouterr().out, re.MULTILINE)
    # One arm is validated by another session.
    for log, size in (("log", period_s), ("other", 2))[: 1 + (arm == "panda")]:
        size = ["--period", f"{size}", "--harmonics", f"{size}", "--periods", "1"]
        identify("excite", "robot.toml", *size, "-o", f"{log}.csv")
        dry = ("--dry-run", "--no-fit", "--track", f"{log}.csv", "-o", f"{log}.mcap")
        acquire("record", "robot.toml", *dry)
    identify("fit", "log.mcap", "--require", "trust", "--json", "fit.json", "--rrd", "fit.rrd")
    identify("validate", "fit.json", f"{log}.mcap", "--max-error-percent", "3")
    identify("export", "fit.json", "--mjcf", "robot.xml")
    given = load_robot(Path("robot.toml")).parameters
    truth = arm_of(Path("arm.urdf").read_text(), joints)
    for term in ("Fv", "Fc", "Ia"):
        getattr(truth, term)[:] = [given.get(f"{term}{j + 1}", 0.0) for j in range(len(joints))]
    assert true_to(truth, identification.load("fit.json"), MOST_OF_DRIVES)


def test_from_table(arm):
    """Without a reference nothing tells the delay of the torque, and it is assumed."""
    truth = arm_of(Path("arm.urdf").read_text(), described(ARMS[arm], "--effort", "N m"))
    q, torque = truth.measured(1, 20.0, RATE_HZ)
    names = ["time", *(f"{kind}_{j}" for kind in ("q", "tau") for j in range(len(truth.joints)))]
    np.savetxt(
        "log.csv", np.column_stack([np.arange(len(q)) / RATE_HZ, q, torque]), delimiter=",",
        header=",".join(names), comments="", fmt="%.9g",
    )  # fmt: skip
    acquire("import", "log.csv", "--robot", "robot.toml")
    units = [["m", "N"] if slides else ["rad", "N m"] for slides in truth.slides]
    position, effort = (str(list(one)).replace("'", '"') for one in zip(*units, strict=True))
    assert position in Path("log.map.toml").read_text() or not truth.slides.any()
    fill_in("log.map.toml", position_unit=position, effort_unit=effort, side='"joint"')
    acquire("import", "log.csv", "--robot", "robot.toml")
    identify("fit", "log.mcap", "--json", "fit.json")
    identify("export", "fit.json", "--mjcf", "robot.xml")
    fit = identification.load("fit.json")
    assert fit.verdict == "trust"
    assert {one.test: one.level for one in fit.file.trust}["delay"] == "inconclusive"
    assert "delay" in [one.what for one in fit.file.assumed]
    assert true_to(truth, fit)


def test_from_arrays(arm):
    """A PD of which the description says nothing holds the arm to a reference; nothing of
    robot.toml is filled in.
    """
    truth = arm_of(Path("arm.urdf").read_text(), described(ARMS[arm]))
    q, torque, q_ref = truth.driven(1, 6.0, 500.0)
    fit = identification.fit(q, torque, 500.0, "robot.toml", q_ref)
    assert (fit.verdict, fit.status, fit.file.method) == ("trust", "converged", "iv")
    fit.write_report("report.html")
    fit.export(mjcf="robot.xml")
    assert "<html" in Path("report.html").read_text()
    assert true_to(truth, fit)
