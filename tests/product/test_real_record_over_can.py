"""The real TX40 record travels over CAN through simulated drives, and comes back as it was."""

from pathlib import Path

import numpy as np
import pytest
from conftest import REPLAY
from dry_sessions import dry_session
from made_up_buses import robot_of
from made_up_recordings import header

from acquisition.recording import RecordingWriter, read_recording
from acquisition.session import Task
from acquisition.simulated import TablePlant
from identification.data import load_signals
from identification.methods import identify_ls
from identification.regression import Overrides

RATE_HZ = 500
BUS = '\n[bus]\ninterface = "virtual"\nchannel = "tx40"\nsync_period_s = 0.002\n'
DRIVE = '[[bus.drive]]\nnode = {}\nreference = "6074"\nrated_torque_nm = 0.3\ncounts_per_turn = 1048576\n'


@pytest.fixture(scope="module")
def direct(tx40: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every tenth row of the real record, as tables would be imported."""
    recording = read_recording(tx40)
    out = tmp_path_factory.mktemp("tx40_500") / "direct.mcap"
    with RecordingWriter(out, header(recording.robot, RATE_HZ)) as writer:
        writer.samples(recording.samples[:: round(recording.sample_rate_hz / RATE_HZ)])
    return out


@pytest.fixture(scope="module")
def over_can(direct: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    text = (REPLAY / "tx40" / "robot.toml").read_text().split("[bus]")[0] + BUS
    robot, table = robot_of(text + "".join(map(DRIVE.format, range(1, 7)))), read_recording(direct).samples
    path, task = tmp_path_factory.mktemp("can") / "session.mcap", Task(duration_s=(len(table) + 5) / RATE_HZ)
    assert dry_session(path, task, robot=robot, plant=TablePlant(table, RATE_HZ)).outcome.reason == "finished"
    return path


def test_six_drives_at_500_hz_give_the_table_back(direct, over_can):
    table, recording = read_recording(direct).samples, read_recording(over_can)
    samples, robot = recording.samples[: len(table)], recording.robot
    assert len(samples) == len(table) == 4500
    assert (np.diff(samples["stamp_ns"]) == 2_000_000).all()  # no gap
    counters = recording.health[-1].counters
    assert (counters["late"], counters["missing"], counters["duplicate"], counters["short"]) == (0, 0, 0, 0)
    # Half a count and half a per mille at the motor, as the motor matrix brings them to the joint.
    position_step = np.abs(np.linalg.inv(robot.R)) @ np.full(6, np.pi / 1048576)
    effort_step = np.abs(robot.R).T @ np.full(6, 0.5 * 0.3e-3)
    assert (np.abs(samples["position"] - table["position"]).max(axis=0) <= position_step * (1 + 1e-6)).all()
    assert (np.abs(samples["effort"] - table["effort"]).max(axis=0) <= effort_step * (1 + 1e-6)).all()


def test_a_fit_of_it_is_the_fit_of_the_direct_import(direct, over_can):
    one, other = (identify_ls(load_signals(path), Overrides()).estimate for path in (direct, over_can))
    assert one.names == other.names
    assert (np.abs(other.beta - one.beta) / one.sigma).max() < 2.0
