"""The live page of a recording that is being written: what it shows, how soon, and how it ends."""

import os
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from conftest import REPLAY
from rerun.chunk import RrdReader

from acquisition.recording import Recording, read_recording
from acquisition.session import Recorder
from identification.commands import main
from identification.data import load_signals
from identification.errors import BadInputError
from identification.model import InverseModel, base_parameters
from identification.regression import Decimation, Overrides, make_problem, predicted_torque
from identification.report import read_fit, write_json
from identification.results import fit_file, identify_ls, stored_beta
from identification.view import follow_recording, live

SCARA = REPLAY / "scara" / "session.mcap"
BLOCK_NS = 100_000_000


@pytest.fixture(scope="module")
def recorded() -> Recording:
    return read_recording(SCARA)


class Session(threading.Thread):
    """Writes a recording again, block by block, as the recorder does; each block takes `pace_s`.

    Begun, not finished.
    """

    def __init__(
        self, recording: Recording, out: Path, seconds: float, pace_s: float = 0.02
    ) -> None:
        super().__init__(daemon=True)
        self.recording, self.until_ns, self.pace_s = recording, round(seconds * 1e9), pace_s
        self.recorder = Recorder(out, recording.robot, source="CAN, active", place="robot.toml")
        self.recorder.granted = {"sched_fifo": 0.0}
        (self.frames,) = recording.frames.values()

    def run(self) -> None:
        events = [e for e in self.recording.events if e.kind != "warning"]
        times = self.frames["time_ns"]
        for stamp in range(int(times[0]), int(times[0]) + self.until_ns, BLOCK_NS):
            begin, end = np.searchsorted(times, [stamp, stamp + BLOCK_NS])
            while events and events[0].stamp_ns <= stamp:
                event = events.pop(0)
                self.recorder.event(event.stamp_ns, event.kind, event.text)
            self.recorder.add(self.frames[begin:end])
            self.recorder.tick(stamp + BLOCK_NS, 0)
            time.sleep(self.pace_s)
        self.recorder.finish(int(times[0]) + self.until_ns)


def values(rrd: Path, entity: str) -> tuple[np.ndarray, np.ndarray]:
    """Times in ns from the first event, and numbers, of one entity."""
    times, rows = [], []
    for chunk in RrdReader(rrd).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and "time" in batch.schema.names:
            (name,) = (n for n in batch.schema.names if n.endswith("scalars"))
            times += batch.column("time").cast("int64").to_pylist()
            rows += batch.column(name).to_pylist()
    order = np.argsort(times, kind="stable")
    return np.array(times)[order], np.array(rows)[order]


def test_view_has_rows_of_recording(tmp_path, recorded):
    session, rrd, warnings = (
        Session(recorded, tmp_path / "log.mcap", 4.0),
        tmp_path / "live.rrd",
        [],
    )
    session.start()
    follow_recording(tmp_path / "log.mcap", None, rrd, warnings.append)
    session.join()
    whole = read_recording(tmp_path / "log.mcap").samples
    first_ns = recorded.events[0].stamp_ns
    for j in range(recorded.robot.n):
        t_ns, position = values(rrd, f"/position/{j + 1}/measured")
        assert t_ns.tolist() == (whole["stamp_ns"] - first_ns).tolist()
        np.testing.assert_array_equal(position[-50:, 1], whole["position"][-50:, j])
        _, effort = values(rrd, f"/effort/{j + 1}/measured")
        np.testing.assert_array_equal(effort[:, 0], whole["effort"][:, j])
        _, error = values(rrd, f"/error/{j + 1}/measured")
        expected = whole["position"][1:, j] - whole["reference"][:-1, j]
        np.testing.assert_array_equal(error[-500:, 0], expected[-500:])
        _, levels = values(rrd, f"/error/{j + 1}/levels")
        limit = recorded.robot.joints[j].si("following_error")
        np.testing.assert_allclose(levels, np.tile([limit, -limit], (len(levels), 1)))
    assert len(warnings) == 1
    assert "another machine" in warnings[0]


def begun(recorded: Recording, path: Path) -> Session:
    session = Session(recorded, path, 3.0, 0.0)
    session.recorder.finish = lambda stamp_ns: None
    session.run()
    return session


def clocked(monkeypatch: pytest.MonkeyPatch, at_poll: Callable[[], object]) -> None:
    """The follower's time goes on by a poll where it waits, whatever the machine does meanwhile."""
    polls = [0]

    def wait() -> None:
        polls[0] += 1
        at_poll()

    monkeypatch.setattr(live, "time", SimpleNamespace(monotonic=lambda: polls[0] * live.POLL_S))
    monkeypatch.setattr(live, "_wait", wait)


@pytest.mark.parametrize(
    ("harm", "text"),
    [
        (Path.unlink, "the recording was moved or deleted"),
        (lambda path: os.truncate(path, 30_000), "the recording was truncated"),
        (lambda path: path.with_suffix(".b").write_bytes(path.read_bytes())
         and path.with_suffix(".b").rename(path), "the recording was replaced"),
        (lambda path: None, "has not grown"),
    ],
)  # fmt: skip
def test_unfollowable_recording_ends_in_one_line(
    tmp_path, recorded, monkeypatch, capsys, harm, text
):
    path, polls = tmp_path / "log.mcap", iter(range(10**6))
    session = begun(recorded, path)
    monkeypatch.setattr(os, "nice", lambda by: by)
    clocked(monkeypatch, lambda: harm(path) if next(polls) == 2 else None)
    assert main(["view", str(path), "--follow", "-o", str(tmp_path / "live.rrd")]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert [
        line
        for line in lines
        if not line.startswith("warning: the session runs without SCHED_FIFO")
    ] == lines[-1:]
    assert lines[-1].startswith(f"robot-identify: {path}: ")
    assert text in lines[-1]
    session.recorder.close()


def state(rrd: Path) -> tuple[str, list[int]]:
    text, colors = "", []
    for chunk in RrdReader(rrd).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if (
                chunk.entity_path == "/state/text"
                and name.endswith("labels")
                and "show" not in name
            ):
                text = batch.column(name).to_pylist()[-1][-1]
            if chunk.entity_path == "/state/bar" and name.endswith("colors"):
                colors = batch.column(name).to_pylist()[-1]
    return text, colors


def test_state_red_when_file_stops_growing(tmp_path, recorded, monkeypatch):
    path, rrd = tmp_path / "log.mcap", tmp_path / "live.rrd"
    session = begun(recorded, path)
    red = [int.from_bytes(bytes((*live.RED, 255)), "big")]
    monkeypatch.setattr(live, "STALLED_S", 0.2)
    clocked(monkeypatch, lambda: None)
    for give_up_s in (0.1, 0.6):  # before and after
        monkeypatch.setattr(live, "GIVE_UP_S", give_up_s)
        with pytest.raises(BadInputError, match="not grown"):
            follow_recording(path, None, rrd, lambda text: None)
        text, color = state(rrd)
        assert "late 0" in text
        assert ("STOPPED GROWING" in text, color == red) == (give_up_s > 0.2, give_up_s > 0.2)
    session.recorder.close()


def test_residual_matches_whole_recording(tmp_path, recorded):
    signals = load_signals(SCARA)
    fit = identify_ls(signals, Overrides())
    write_json(tmp_path / "fit.json", fit_file(fit))
    stored = read_fit(tmp_path / "fit.json")
    rms = np.sqrt(np.mean((fit.tau - fit.tau_predicted) ** 2, axis=0, where=fit.counts))
    np.testing.assert_allclose([joint.residual_rms for joint in stored.joints], rms)
    path, rrd = tmp_path / "log.mcap", tmp_path / "live.rrd"
    session = Session(recorded, path, 10.0)
    session.start()
    follow_recording(path, tmp_path / "fit.json", rrd, lambda text: None)
    session.join()
    model = InverseModel(signals.robot)
    base, problem = (
        base_parameters(model),
        make_problem(signals, Overrides(torque_lag_s=stored.torque_lag_s)).for_errors,
    )
    first = problem.settings.start  # beyond the ends of the low-pass
    motion = problem.motion.between(first, len(signals.q), problem.settings.cutoff_hz)
    rho = motion.tau - predicted_torque(motion, model, base, stored_beta(stored, base, "fit.json"))
    n_d, stamps = (
        problem.settings.decimation,
        recorded.samples["stamp_ns"] - recorded.events[0].stamp_ns,
    )
    for j in range(signals.robot.n):
        t_ns, shown = values(rrd, f"/residual/{j + 1}/measured")
        assert len(shown) > 60
        at = np.searchsorted(stamps, t_ns)
        assert (stamps[at] == t_ns).all()
        # Decimation keeps the last sample: the whole recording is cut so that each row shown
        # is one that is kept.
        ends = [k + 1 + 50 * n_d - first for k in at]
        expected = [Decimation(factor=n_d).filtered(rho[:end, j])[-51] for end in ends]
        largest = np.abs(expected).max()  # of a joint that sticks, which rings in other rows
        assert np.abs(shown[:, 0] - expected).max() < 0.05 * 4 * rms[j] + 0.01 * largest
        _, band = values(rrd, f"/residual/{j + 1}/levels")
        np.testing.assert_allclose(band[-1], [4 * rms[j], -4 * rms[j]])


def test_effort_level_is_effective_limit():
    """The smaller of the joint's own and its drive's, as of `excite`; none where none is stated."""
    robot = read_recording(SCARA).robot
    motor = msgspec.structs.replace(robot.motors[0], saturation=2.0)
    limited = replace(robot, motors=(motor, robot.motors[1]))
    most = 2.0 * abs(robot.R[0, 0])
    for effort_nm, expected in ((None, most), (0.5 * most, 0.5 * most), (2 * most, most)):
        joint = msgspec.structs.replace(robot.joints[0], effort_nm=effort_nm)
        levels = live._effort_levels(replace(limited, joints=(joint, robot.joints[1])))
        assert levels[0]["limit"][1] == pytest.approx(expected)
        assert "limit" not in levels[1]
