"""Long simulated recordings are computed span by span, and are those of one pass."""

import errno
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from conftest import REPLAY, robot_named
from made_up_recordings import header
from mcap.reader import make_reader

from acquisition.errors import BadInputError
from acquisition.files import on_disk
from acquisition.recording import RecordingWriter, read_recording, sample_dtype, writer
from identification.commands import main
from identification.control import Reference, described_law
from identification.simulation import ClosedLoop
from identification.study import Noise, closed_loop, random_reference, simulated_cell

RATE_HZ, SEED = 1000.0, 5
NOISE = Noise(
    position=1e-4, encoder_step=3e-5, effort_percent=3.0, coloured_percent=2.0, lag_samples=3
)


def by_spans(monkeypatch, rows):
    for module in (on_disk, simulated_cell, writer):
        monkeypatch.setattr(module, "BLOCK_ROWS", rows)
    monkeypatch.setattr(on_disk, "MAX_BYTES_IN_MEMORY", 1000)


def in_one_pass(robot, q_ref):
    """Positions and torques (N, n) of the robot, with the noise that `Noise` states."""
    model, rng = simulated_cell.true_model(robot), np.random.default_rng([SEED, 0])
    dq = np.gradient(q_ref, 1 / RATE_HZ, axis=0)
    ddq = np.gradient(dq, 1 / RATE_HZ, axis=0)
    fastest, loop = np.abs(dq @ model.directions.T).max(axis=0), described_law(robot)
    assert loop is not None
    of_encoder = 1e-4 * rng.standard_normal(q_ref.shape)

    def encoder(q, at=slice(None)):
        return np.rint((q + of_encoder[at]) / 3e-5) * 3e-5

    follower = ClosedLoop(model, loop, (q_ref[0], dq[0]), fastest=fastest, substeps=2)
    done, reason = follower.follow(Reference(q_ref, dq, ddq, seen=encoder), np.full(robot.n, 99.0))
    assert reason is None
    held = done[3, ::2]
    late = np.concatenate([held[[0] * 3], held])[: len(held)]
    tau = 0.5 * (late + np.concatenate([late[:1], late[:-1]]))
    white, drawn = (np.random.default_rng([SEED, k]).standard_normal(tau.shape) for k in (1, 2))
    slow = drawn.copy()
    for k in range(1, len(slow)):
        slow[k] = 0.98 * slow[k - 1] + np.sqrt(1 - 0.98**2) * drawn[k]
    level = 0.01 * np.sqrt(np.mean(tau**2, axis=0))
    return encoder(done[0, ::2]), tau + level * (3 * white + 2 * slow)


@pytest.mark.parametrize("rows", [3, 7, 100, 640, 1000])
@pytest.mark.parametrize("structure", ["pd_velocity_feedforward", "computed_torque"])
def test_segments_match_single_run(monkeypatch, rows, structure):
    """Also those that leave one row for the last; computed torque needs accelerations."""
    robot = robot_named("scara")
    gains = {}
    if structure == "computed_torque":
        gains = {"position_gain": (1000.0, 1000.0), "velocity_gain": (50.0, 50.0)}
    controller = msgspec.structs.replace(robot.controller, structure=structure, **gains)
    robot = replace(robot, controller=controller)
    q_ref = random_reference(robot, duration_s=0.64, sample_rate_hz=RATE_HZ, seed=SEED)
    q, effort = in_one_pass(robot, q_ref)
    assert len(q) == 641
    by_spans(monkeypatch, rows)
    again = random_reference(robot, duration_s=0.64, sample_rate_hz=RATE_HZ, seed=SEED)
    np.testing.assert_allclose(again, q_ref, atol=1e-14)
    found = closed_loop(robot, q_ref, RATE_HZ, noise=NOISE, seed=SEED)
    np.testing.assert_allclose(found.q, q, atol=1e-13)
    np.testing.assert_allclose(found.effort, effort, atol=1e-10)


@pytest.mark.parametrize("rows", [7, 64, 5000])
def test_columns_written_like_rows(tmp_path, monkeypatch, rows):
    """Every tenth row is shown as a joint state, wherever blocks end."""
    robot, rng, count = robot_named("scara"), np.random.default_rng(1), 200
    values = {name: rng.normal(size=(count, 2)) for name in ("position", "effort", "velocity")}
    stamps = 1_000_000 * np.arange(count)
    by_spans(monkeypatch, rows)
    with RecordingWriter(tmp_path / "a.mcap", header(robot)) as out:
        out.columns(stamps, values)
    samples = read_recording(tmp_path / "a.mcap").samples
    assert samples.dtype == sample_dtype(2, reference=False, optional=values)
    np.testing.assert_array_equal(samples["stamp_ns"], stamps)
    for name, true in values.items():
        np.testing.assert_array_equal(samples[name], true)
    with (tmp_path / "a.mcap").open("rb") as file:
        shown = list(make_reader(file).iter_messages(["/joint_states/measured"]))
    assert [message.log_time for _, _, message in shown] == stamps[::10].tolist()


def test_sample_limit_is_one_day():
    q_ref = random_reference(
        robot_named("scara"), duration_s=1200.0, sample_rate_hz=RATE_HZ, seed=SEED
    )
    assert q_ref.shape == (1_200_001, 2)
    np.testing.assert_allclose(q_ref[10_000:], q_ref[:-10_000], atol=1e-11)
    for duration_s, found in ((0.05, "50 samples"), (1e6, "1e.09 samples"), (1e300, "1e.303")):
        with pytest.raises(BadInputError, match=f"{found}.*expected 100 to 100000000"):
            random_reference(
                robot_named("scara"), duration_s=duration_s, sample_rate_hz=RATE_HZ, seed=SEED
            )


def test_full_disk_reported(tmp_path, monkeypatch, capsys):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(on_disk.os, "posix_fallocate", full)
    by_spans(monkeypatch, 100)
    words = (str(REPLAY / "scara" / "robot.toml"), "-o", str(tmp_path / "a.mcap"))
    assert main(["simulate", *words, "--duration-s", "0.3"]) == 1
    assert capsys.readouterr().err == "robot-identify: No space left on device\n"
    assert not (tmp_path / "a.mcap").exists()
