"""A recording is read while it is written: the same rows as when it is whole, and one line
where it cannot go on.
"""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from foreign_sync import PERIOD_NS, jittery
from foreign_sync import ROBOT as FOREIGN
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_buses import bus_of, bus_text, flat, robot_of, session
from made_up_recordings import header

from acquisition.errors import BadInputError
from acquisition.recording import Block, RecordingFollower, RecordingWriter, decode
from acquisition.robot import Robot
from acquisition.session import Recorder

ROBOT = robot_of(bus_text(2))
BUS = bus_of(ROBOT)


def late_by(intervals: list[list[object]], by: np.ndarray, node: int) -> Block:
    """Frames where the PDO of a node for SYNC k comes `by[k]` intervals later, in order; at
    the end all are there.
    """
    frames = flat(intervals)
    sync_ns, theirs = frames["time_ns"][frames["can_id"] == 0x80], frames["can_id"] == 0x180 + node
    k = np.arange(len(by))
    frames["time_ns"][theirs] = (
        sync_ns[np.minimum(np.maximum.accumulate(k + by), k[-1])] + 100_000 + 10 * k % 90_000
    )
    return frames[np.argsort(frames["time_ns"], kind="stable")]


def tenths(frames: Block) -> list[int]:
    return (np.flatnonzero(np.diff(frames["time_ns"] // 100_000_000)) + 1).tolist()


def written(
    path: Path, frames: Block, edges: list[int], robot: Robot = ROBOT
) -> Iterator[RecordingFollower]:
    with RecordingWriter(path, header(robot, 500.0)) as writer:
        follower = RecordingFollower(path)
        for part in np.split(frames, edges):
            writer.frames("can0", part)
            writer.flush(sync=False)
            follower.read()
            yield follower
    follower.read()
    assert follower.ended
    yield follower


def shown(path: Path, frames: Block, robot: Robot = ROBOT) -> Block:
    return np.concatenate(
        [f.rows for f in written(path, frames, tenths(frames), robot) if f.rows is not None]
    )


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([0.0, 0.02, 0.3]), st.booleans())
def test_rows_match_whole_recording(tmp_path_factory, seed, share, targets):
    rng = np.random.default_rng(seed)
    by = rng.integers(1, 4, 800) * (rng.random(800) < share)
    frames = late_by(session(syncs=800, targets=targets), by, 2)
    rows = shown(tmp_path_factory.mktemp("follow") / "log.mcap", frames)
    whole = decode(frames, ROBOT, BUS, "log").samples
    assert len(whole) == 800
    assert rows.tobytes() == whole.tobytes()


def test_row_is_given_with_completing_block(tmp_path):
    frames = flat(session(syncs=400))
    edges = tenths(frames)
    for k, follower in enumerate(written(tmp_path / "log.mcap", frames, edges)):
        if follower.rows is None:
            assert follower.ended
            continue
        last_ns = frames["time_ns"][edges[k] - 1] if k < len(edges) else frames["time_ns"][-1]
        assert 0 <= last_ns - follower.rows["stamp_ns"][-1] < 2_000_000


def test_counter_wrap_in_dropped_frames_continues(tmp_path):
    frames = flat(session(syncs=1500))
    pdo = (frames["can_id"] > 0x180) & (frames["can_id"] < 0x200)
    payload = frames["data"].view([("status", "<u2"), ("position", "<i4"), ("effort", "<i2")])[:, 0]
    payload["position"][pdo] += 2**31 - 1 - 5000
    rows = shown(tmp_path / "log.mcap", frames)
    whole = decode(frames, ROBOT, BUS, "log")
    assert any("wrapped" in text for text in whole.warnings)
    np.testing.assert_allclose(rows["position"], whole.samples["position"], rtol=1e-12)


@pytest.mark.parametrize(
    ("harm", "text"),
    [
        (lambda path: path.unlink(), "was moved or deleted"),
        (lambda path: os.truncate(path, 100), "was truncated to 100 bytes"),
        (
            lambda path: Path(shutil.copy(path, path.with_suffix(".new"))).rename(path),
            "was replaced",
        ),
        (
            lambda path: path.write_bytes(
                path.read_bytes() + b"\x06\x09" + bytes(7) + b"not chunk"
            ),
            "damaged at",
        ),
    ],
)
def test_file_cannot_be_followed(tmp_path, harm, text):
    path = tmp_path / "log.mcap"
    with RecordingWriter(path, header(ROBOT, 500.0)) as writer:
        writer.frames("can0", flat(session(syncs=100)))
        writer.flush()
        follower = RecordingFollower(path)
        assert follower.read() is False or follower.rows is not None
        harm(path)
        with pytest.raises(BadInputError, match=text) as raised:
            follower.read()
    assert str(raised.value).startswith(f"{path}: ")


def test_partial_record_is_awaited(tmp_path):
    whole, path = tmp_path / "whole.mcap", tmp_path / "log.mcap"
    with RecordingWriter(whole, header(ROBOT, 500.0)) as writer:
        described = whole.stat().st_size
        writer.frames("can0", flat(session(syncs=100)))
    content = whole.read_bytes()
    path.write_bytes(content[:described])
    follower, rows = RecordingFollower(path), 0
    with path.open("ab") as file:
        for byte in range(described, len(content), 97):
            file.write(content[byte : byte + 97])
            file.flush()
            follower.read()
            rows += 0 if follower.rows is None else len(follower.rows)
    assert follower.ended
    assert rows == 100


def test_recorder_passes_small_blocks_at_once(tmp_path, monkeypatch):
    """The disk is waited for every half second only; of two slow drives a frame
    takes 12 bytes at most.
    """
    synced, path = [], tmp_path / "log.mcap"
    monkeypatch.setattr(os, "fsync", synced.append)
    recorder = Recorder(path, ROBOT, source="test", place="robot.toml")
    follower, frames = RecordingFollower(path), flat(session(syncs=2500))
    begun_bytes, begun_syncs, rows = path.stat().st_size, len(synced), 0
    for part in np.split(frames, tenths(frames)):
        recorder.add(part)
        follower.read()
        rows += len(follower.rows)
        recorder.tick(int(part["time_ns"][-1]), 0)
    assert rows == 2500
    assert 9 <= len(synced) - begun_syncs <= 11
    assert path.stat().st_size - begun_bytes <= 12 * len(frames)
    recorder.close()


def test_live_rows_of_late_drive_match_decoding(tmp_path):
    by = np.zeros(400, int)
    by[110:260] = 1
    frames = late_by(session(syncs=400), by, 1)
    assert (
        shown(tmp_path / "log.mcap", frames).tobytes()
        == decode(frames, ROBOT, BUS, "log").samples.tobytes()
    )


@pytest.mark.parametrize(("doubled", "lost"), [(0.0, 0.0), (0.01, 0.0), (0.0, 0.005)])
@pytest.mark.parametrize("sd", [0.05, 0.2])
def test_live_rows_of_late_foreign_sync_match(tmp_path, sd, doubled, lost):
    """Only times differ, by less than half a period: later SYNCs show what a delay was."""
    for seed in range(3):
        recording = jittery(seed, sd, syncs=1200, doubled=doubled, lost=lost)
        whole = recording.decoded()[0].samples
        rows = shown(tmp_path / f"{seed}.mcap", recording.frames, FOREIGN)
        assert len(whole) > 1180
        assert rows["position"].tolist() == whole["position"].tolist()
        assert np.abs(rows["stamp_ns"] - whole["stamp_ns"]).max() < 0.5 * PERIOD_NS
