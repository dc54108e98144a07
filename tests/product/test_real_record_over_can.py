"""The real TX40 and EMPS records travel over CAN through simulated drives, and come back as they were."""

from pathlib import Path

import numpy as np
import pytest
from conftest import REPLAY, robot_named
from dry_sessions import dry_session
from made_up_recordings import header

from acquisition.importing import import_recording
from acquisition.recording import RecordingWriter, read_recording, sample_dtype
from acquisition.robot import Robot, robot_from_files
from acquisition.session import Task
from acquisition.simulated import TablePlant
from identification.data import load_signals
from identification.methods import identify_ls
from identification.regression import Overrides

RATE_HZ = 500


def with_bus(name: str, *, period_s: float, drive: str) -> Robot:
    """A robot of replay_data with simulated drives."""
    text = (REPLAY / name / "robot.toml").read_text().split("[bus]")[0]
    n = robot_named(name).n
    bus = f'\n[bus]\ninterface = "virtual"\nchannel = "{name}"\nsync_period_s = {period_s}\n'
    drives = "".join(f"[[bus.drive]]\nnode = {i + 1}\n{drive}\n" for i in range(n))
    return robot_from_files({"robot.toml": (text + bus + drives).encode()}, "robot.toml")


@pytest.fixture(scope="session")
def tx40_at_500_hz(tx40: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every tenth row of the real record, as tables would be imported."""
    recording = read_recording(tx40)
    samples = recording.samples[:: round(recording.sample_rate_hz / RATE_HZ)]
    out = tmp_path_factory.mktemp("tx40_500") / "direct.mcap"
    with RecordingWriter(out, header(recording.robot, RATE_HZ)) as writer:
        writer.samples(samples)
    return out


@pytest.fixture(scope="session")
def over_can(tx40_at_500_hz: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    robot = with_bus(
        "tx40",
        period_s=1 / RATE_HZ,
        drive='reference = "6074"\nrated_torque_nm = 0.3\ncounts_per_turn = 1048576',
    )
    table = read_recording(tx40_at_500_hz).samples
    path = tmp_path_factory.mktemp("can") / "session.mcap"
    session = dry_session(
        path, Task(duration_s=(len(table) + 5) / RATE_HZ), robot=robot, plant=TablePlant(table, RATE_HZ)
    )
    assert session.outcome.reason == "finished"
    return path


def test_six_drives_at_500_hz_give_the_table_back(tx40_at_500_hz, over_can):
    table, recording = read_recording(tx40_at_500_hz).samples, read_recording(over_can)
    samples, robot = recording.samples[: len(table)], recording.robot
    assert len(samples) == len(table) == 4500
    assert (np.diff(samples["stamp_ns"]) == 2_000_000).all()  # no gap
    counters = recording.health[-1].counters
    assert (counters["late"], counters["missing"], counters["duplicate"], counters["short"]) == (0, 0, 0, 0)
    # Half a count and half a per mille at the motor, as the motor matrix brings them to the joint.
    half_count, half_step = np.pi / 1048576, 0.5 * 0.3e-3
    position_step = np.abs(np.linalg.inv(robot.R)) @ np.full(6, half_count)
    effort_step = np.abs(robot.R).T @ np.full(6, half_step)
    assert (np.abs(samples["position"] - table["position"]).max(axis=0) <= position_step * (1 + 1e-6)).all()
    assert (np.abs(samples["effort"] - table["effort"]).max(axis=0) <= effort_step * (1 + 1e-6)).all()


def test_a_fit_of_it_is_the_fit_of_the_direct_import(tx40_at_500_hz, over_can):
    direct = identify_ls(load_signals(tx40_at_500_hz), Overrides())
    by_can = identify_ls(load_signals(over_can), Overrides())
    assert direct.estimate.names == by_can.estimate.names
    sigma = np.sqrt(np.diag(direct.estimate.covariance))
    deviation = np.abs(by_can.estimate.beta - direct.estimate.beta) / sigma
    assert deviation.max() < 2.0


def test_decoding_again_with_a_corrected_rated_torque(over_can, tmp_path):
    recording = read_recording(over_can)
    text = recording.attachments["robot.toml"].decode().replace("rated_torque_nm = 0.3", "rated_torque_nm = 0.6")
    corrected = robot_from_files({"robot.toml": text.encode()}, "corrected.toml")
    found = import_recording(over_can, tmp_path / "out.mcap", corrected, "corrected.toml")
    again = read_recording(tmp_path / "out.mcap")
    assert found.samples == len(recording.samples)
    assert again.samples["effort"] == pytest.approx(2 * recording.samples["effort"])
    assert again.samples["position"].tobytes() == recording.samples["position"].tobytes()
    assert [e for e in again.events if e.kind == "phase"] == [e for e in recording.events if e.kind == "phase"]
    assert b"0.6" in again.attachments["robot.toml"]


def test_volts_and_metres_of_the_emps_travel_too(emps, tmp_path):
    recording = read_recording(emps)
    robot = with_bus(
        "emps", period_s=0.001, drive='reference = "6074"\nreference_rule = "mV"\ncounts_per_m = 10_000_000'
    )
    table = recording.samples[:3000].astype(sample_dtype(1, reference=True))
    session = dry_session(tmp_path / "a.mcap", Task(duration_s=3.01), robot=robot, plant=TablePlant(table, 1000.0))
    samples = session.recording.samples[:3000]
    assert np.abs(samples["position"] - table["position"]).max() <= 0.5e-7 * (1 + 1e-6)
    assert np.abs(samples["effort"] - table["effort"]).max() <= 0.5e-3 * 35.15065188 * (1 + 1e-6)
    assert session.recorded.warnings == ()
