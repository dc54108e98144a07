"""Mistakes of a user of `robot-identify`: one line each, nothing lost, nothing misunderstood."""

import dataclasses
import json
import os
import subprocess
import sys
from functools import cache

import msgspec
import numpy as np
import pytest
from command_runs import refused, run
from conftest import REPLAY, ROOT, robot_named
from made_up_recordings import header

from acquisition.errors import BadInputError, RobotIdimError
from acquisition.recording import RecordingWriter, read_recording
from acquisition.robot import robot_from_files
from identification.data import load_signals
from identification.methods import Iteration, identify_iv, identify_ls
from identification.model import InverseModel, direct_model
from identification.regression import Overrides
from identification.study import Noise, closed_loop, random_reference

SESSION = REPLAY / "scara" / "session.mcap"


@pytest.fixture
def robot_file(tmp_path):
    place = tmp_path / "r.toml"
    place.write_text((REPLAY / "scara" / "robot.toml").read_text())
    return place


def test_no_output_takes_the_place_of_an_input(capsys, tmp_path, robot_file):
    fit = tmp_path / "fit.json"
    assert run(capsys, "fit", SESSION, "--json", fit)[0] == 0
    for command in (
        ["base", robot_file, "--json", robot_file],
        ["simulate", robot_file, "-o", robot_file],
        ["study", robot_file, "--runs", "1", "--json", robot_file],
        ["fit", SESSION, "--robot", robot_file, "--json", robot_file],
        ["fit", SESSION, "--robot", robot_file, "--rrd", robot_file],
        ["fit", SESSION, "--method", "iv", "--start", fit, "--json", fit],
        ["validate", fit, SESSION, "--json", fit],
    ):
        before = {path: path.read_bytes() for path in (robot_file, fit)}
        assert "is an input too" in refused(capsys, *command)
        assert before == {path: path.read_bytes() for path in before}


def test_a_study_looks_at_its_outputs_before_it_runs(capsys, robot_file):
    told = refused(capsys, "study", robot_file, "--runs", "100000", "--json", "/nonexist/x.json")
    assert "no folder /nonexist" in told


def test_volts_never_become_newton_metres(tmp_path):
    text = (REPLAY / "scara" / "robot.toml").read_text()
    recording = read_recording(SESSION)
    kept = [li for li in text.splitlines() if not li.startswith(("drive_gain", "effort_unit"))]
    in_volts = "\n".join(f'{li}\neffort_unit = "V"' if li == "[[motor]]" else li for li in kept)
    volts = robot_from_files({"robot.toml": in_volts.encode()}, "v.toml")
    path = tmp_path / "volts.mcap"
    with RecordingWriter(path, header(volts)) as writer:
        writer.samples(recording.samples)
    assert load_signals(path).robot.effort_units[0] == "V"
    with pytest.raises(BadInputError, match=r"unit of motor .* in robot SCARA = .*: expected V, as recorded"):
        load_signals(path, robot_named("scara"))


def test_motors_in_another_order_than_joints_are_refused():
    text = (REPLAY / "scara" / "robot.toml").read_text()
    lines = [line for line in text.splitlines() if not line.startswith("ratio")]
    swapped = "\n".join(["motor_matrix = [[0.0, 1.0], [1.0, 0.0]]", *lines])
    with pytest.raises(BadInputError, match=r"motor_matrix\[0\] = .*: expected motor 1 to turn joint 1"):
        robot_from_files({"robot.toml": swapped.encode()}, "r.toml")


@pytest.mark.parametrize(
    ("key", "value", "cutoff_hz", "expected"),
    [
        (None, None, "1e-9", "cut-off = 1e-09 Hz: 5 periods are longer"),
        (None, None, "1e-300", "cut-off = 1e-300 Hz: 5 periods are longer"),
        ("bandwidth_hz", "1e-9", "25", "controller.bandwidth_hz = 1e-09: expected a period shorter than"),
        ("sample_rate_hz", "1e9", None, "expected at most 2e+07 steps"),
    ],
)
def test_cutoffs_and_controllers_that_cannot_be(capsys, robot_file, key, value, cutoff_hz, expected):
    lines = [f"{key} = {value}" if key and li.startswith(key) else li for li in robot_file.read_text().splitlines()]
    robot_file.write_text("\n".join(lines))
    options = ["--robot", robot_file, "--method", "iv"] if key else []
    options += ["--cutoff-hz", cutoff_hz] if cutoff_hz else []
    assert expected in refused(capsys, "fit", SESSION, *options)


def test_simulations_that_are_too_short_and_folders_that_cannot_be(capsys, tmp_path, robot_file):
    out = tmp_path / "x.mcap"
    short = refused(capsys, "simulate", robot_file, "-o", out, "--duration-s", "0.0001")
    assert "0.1 samples; expected 100 to" in short
    assert "/dev/null: cannot be created" in refused(capsys, "demo", "--out", "/dev/null")
    with pytest.raises(SystemExit):
        run(capsys, "simulate", robot_file, "-o", out, "--seed", "-1")
    assert "--seed" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
def test_a_full_standard_output_is_one_line(robot_file):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "identification", "base", str(robot_file)],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False, cwd=ROOT,
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr == "robot-identify: standard output: cannot be written: No space left on device\n"


def test_a_start_of_huge_values_is_told_and_written(capsys, tmp_path):
    fit, out = tmp_path / "fit.json", tmp_path / "iv.json"
    assert run(capsys, "fit", SESSION, "--json", fit)[0] == 0
    stored = json.loads(fit.read_text())
    for p in stored["parameters"]:
        p["value"] = 1e200
    fit.write_text(json.dumps(stored))
    status, _, err = run(capsys, "fit", SESSION, "--method", "iv", "--start", fit, "--json", out)
    assert (status, err) == (0, "")
    assert json.loads(out.read_text())["iterations"][0]["instruments"] == "reference"


def test_a_fit_that_diverged_is_told_wherever_it_is_used(capsys, tmp_path):
    good, bad = tmp_path / "good.json", tmp_path / "bad.json"
    assert run(capsys, "fit", SESSION, "--json", good)[0] == 0
    bad.write_text(json.dumps({**json.loads(good.read_text()), "status": "diverged"}))
    assert f"{bad}: its status is diverged" in run(capsys, "validate", bad, SESSION)[1]
    assert f"{bad}: its status is diverged" in run(capsys, "compare", good, bad)[1]
    assert "its status is" not in run(capsys, "validate", good, SESSION)[1]


ARM = """<robot name="r"><link name="a"/><link name="flange"/>
<link name="b"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="c"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="TYPE"><parent link="a"/><child link="b"/><axis xyz="AXIS"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="elbow" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.5 0 0"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="mount" type="fixed"><parent link="c"/><child link="flange"/><axis xyz="0 0 0"/></joint></robot>"""


@pytest.mark.parametrize("kind", ["revolute", "continuous"])
def test_a_movable_joint_needs_an_axis_and_a_fixed_one_none(kind):
    """Exporters write `0 0 0` there. At q = 0 both arms are straight: inertias as of two unit masses by hand."""
    none, urdf = (ARM.replace("TYPE", kind).replace("AXIS", axis) for axis in ("0 0 0", "0 0 1"))
    with pytest.raises(BadInputError, match="joint 'shoulder': axis = '0 0 0': expected a direction"):
        InverseModel(dataclasses.replace(robot_named("scara"), urdf=none))
    idm = InverseModel(dataclasses.replace(robot_named("scara"), urdf=urdf))
    chi = np.array([{"ZZ1": 1.0, "ZZ2": 2.0, "M2": 3.0}.get(name, 0.0) for name in idm.names])
    inertia = direct_model(idm, chi).inertia(np.zeros((1, 2)))[0]
    assert inertia == pytest.approx(np.array([[1.0 + 2.0 + 3.0 * 0.5**2, 2.0], [2.0, 2.0]]), abs=1e-5)


@cache
def simulated():
    robot = robot_named("scara")
    q_ref = random_reference(robot, duration_s=10.0, sample_rate_hz=1000.0, seed=3)
    return closed_loop(robot, q_ref, 1000.0, noise=Noise(position=1e-6, effort_percent=1.0), seed=3)


def test_a_bandwidth_that_is_wrong_is_not_told_as_a_foreign_reference():
    """The reference is compared with the position as it was measured, not as the stated bandwidth lets it through."""
    signals, robot = simulated(), robot_named("scara")
    low = msgspec.structs.replace(robot.controller, bandwidth_hz=0.45)
    slow = dataclasses.replace(signals, robot=dataclasses.replace(robot, controller=low))
    overrides = Overrides(cutoff_hz=25.0, decimation=20)
    try:
        assert identify_iv(slow, overrides, Iteration()).status
    except RobotIdimError as error:
        assert "expected the reference of this recording" not in str(error)  # noqa: PT017


def test_a_joint_that_stands_is_named_by_its_own_parameters():
    signals = simulated()
    rng = np.random.default_rng(1)
    q, effort = np.array(signals.q), np.array(signals.effort)
    q[:, 1] = 0.3 + 1e-6 * rng.standard_normal(len(q))
    effort[:, 1] = 1e-13 * rng.standard_normal(len(q))
    standing = dataclasses.replace(signals, q=q, q_ref=None, effort=effort)
    try:
        fit = identify_ls(standing, Overrides())
    except RobotIdimError as error:
        assert "ZZ1R" not in str(error).split(":")[-1]  # noqa: PT017
    else:
        assert "joint elbow does not move" in fit.warnings


def test_what_the_recorder_warned_of_stands_in_the_fit(tmp_path):
    recording = read_recording(SESSION)
    path = tmp_path / "warned.mcap"
    with RecordingWriter(path, header(recording.robot)) as writer:
        writer.samples(recording.samples)
        writer.event(int(recording.samples["stamp_ns"][-1]), "warning", "SYNC came every 4 ms: expected 8 ms")
    fit = identify_ls(load_signals(path), Overrides())
    assert "recording: SYNC came every 4 ms: expected 8 ms" in fit.warnings
