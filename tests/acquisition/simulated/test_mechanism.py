"""What a dry run moves: the robot of `[parameters]` where the description has them, else a stand-in that weighs something."""

from importlib.metadata import EntryPoints

import numpy as np
import pytest
from conftest import REPLAY, described_chi
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.errors import BadInputError
from acquisition.recording import read_recording
from acquisition.robot import load_robot
from acquisition.session import RecordOptions, UserInterface, record
from acquisition.simulated import driven_plant
from identification.model import InverseModel


def test_a_dry_run_moves_the_described_robot_and_tracks(tmp_path):
    place = REPLAY / "tx40" / "robot.toml"
    robot = load_robot(place)
    # 0.6 s out and back by 0.2 rad near the middle of the ranges, with a rest at both ends.
    t_s = np.linspace(0, 1.0, 501)
    bow = np.where((t_s > 0.2) & (t_s < 0.8), 0.1 * (1 - np.cos(2 * np.pi * (t_s - 0.2) / 0.6)), 0.0)
    reference = 0.3 + np.array([np.mean(joint.si("position")) for joint in robot.joints]) + bow[:, None]
    table = tmp_path / "reference.csv"
    names = ",".join(joint.name for joint in robot.joints)
    np.savetxt(table, np.column_stack([t_s, reference]), delimiter=",", header=f"time_s,{names}", comments="")
    outcome, _ = record(
        robot, str(place), tmp_path / "a.mcap", RecordOptions(dry_run=True, track=table), UserInterface()
    )
    assert (outcome.reason, outcome.unconfirmed) == ("finished", ())
    recording = read_recording(tmp_path / "a.mcap")
    # Its copy of the description states the law of the simulated drives; theirs is the described one where there is one.
    assert recording.robot.controller.structure == "pid"
    assert not [e.text for e in recording.events if e.kind == "warning"]
    samples = recording.samples
    stamps = {e.text: e.stamp_ns for e in recording.events}
    track = (samples["stamp_ns"] >= stamps["track"]) & (samples["stamp_ns"] < stamps["stop"])
    error = np.abs(samples["position"] - samples["reference"])[track].max(axis=0)
    assert np.degrees(error).max() < 1.0  # of 15 deg allowed
    assert np.degrees(error[:3]).max() < 0.3
    # The effort is that of the described dynamics along the motion: at rest after it friction and gravity alone.
    still = samples[samples["stamp_ns"] < stamps["track"]][-20:]
    dynamics = InverseModel(robot)
    zero = np.zeros((1, robot.n))
    gravity = (dynamics.regressor(still["position"][-1:], zero, zero) @ described_chi(dynamics))[0]
    friction = [robot.parameters[f"Fc{j + 1}"] + robot.parameters.get("Fcm6", 0.0) for j in range(robot.n)]
    assert (np.abs(still["effort"].mean(axis=0) - gravity) < np.array(friction) + 0.1).all()
    assert np.abs(gravity[1:3]).max() > 3.0  # the shoulder leans: it carries the arm


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
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: EntryPoints())
    scara = load_robot(REPLAY / "scara" / "robot.toml")
    alone = driven_plant(scara, bus_of(scara))
    assert "no installed package offers the robot's dynamics (entry points robot_idim.plants)" in alone.warning


def test_parameters_that_describe_no_robot_are_refused_in_one_line():
    robot = robot_of((REPLAY / "scara" / "robot.toml").read_text().replace("ZZ2 = 0.061", "ZZ2 = -1000.0"))
    with pytest.raises(BadInputError, match="cannot be simulated: the inertia matrix is not positive"):
        driven_plant(robot, bus_of(robot))
