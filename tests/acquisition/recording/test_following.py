"""A recording is read while it is written: the same rows as when it is whole, and one line where it cannot go on."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_buses import bus_of, bus_text, flat, robot_of, session
from made_up_recordings import header

from acquisition.errors import BadInputError
from acquisition.recording import Block, RecordingFollower, RecordingWriter, decode
from acquisition.session import Recorder

ROBOT = robot_of(bus_text(2))
BUS = bus_of(ROBOT)


def late_by(intervals: list[list[object]], by: np.ndarray, node: int) -> Block:
    """Frames where the PDO of a node for SYNC k comes `by[k]` intervals later, in order; at the end all are there."""
    rows: list[list[object]] = [[row for row in interval if row[1] != 0x180 + node] for interval in intervals]  # type: ignore[index]
    last = len(intervals) - 1
    for k, to in enumerate(np.minimum(np.maximum.accumulate(np.arange(last + 1) + by), last).tolist()):
        (pdo,) = (row for row in intervals[k] if row[1] == 0x180 + node)  # type: ignore[index]
        sync_ns = intervals[to][0][0]  # type: ignore[index]
        rows[to].append((sync_ns + 100_000 + 10 * k % 90_000, *pdo[1:]))  # type: ignore[index]
    for interval in rows:
        interval.sort(key=lambda row: row[0])  # type: ignore[index]
    return flat(rows)


def tenths(frames: Block) -> list[int]:
    """Where blocks of 100 ms begin."""
    return (np.flatnonzero(np.diff(frames["time_ns"] // 100_000_000)) + 1).tolist()


def written(path: Path, frames: Block, edges: list[int]) -> Iterator[RecordingFollower]:
    """Write frames block by block; the follower after each of its reads."""
    with RecordingWriter(path, header(ROBOT, 500.0)) as writer:
        follower = RecordingFollower(path)
        for part in np.split(frames, edges):
            writer.frames("can0", part)
            writer.flush(sync=False)
            follower.read()
            yield follower
    follower.read()
    assert follower.ended
    yield follower


def shown(path: Path, frames: Block) -> Block:
    return np.concatenate([f.rows for f in written(path, frames, tenths(frames)) if f.rows is not None])


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([0.0, 0.02, 0.3]), st.booleans())
def test_rows_are_those_of_the_whole_recording(tmp_path_factory, seed, share, targets):
    """Late PDOs at the borders of blocks included, to the bit."""
    rng = np.random.default_rng(seed)
    intervals = session(syncs=1500, targets=targets)
    by = rng.integers(1, 4, 1500) * (rng.random(1500) < share)
    frames = late_by(intervals, by, 2)
    rows = shown(tmp_path_factory.mktemp("follow") / "log.mcap", frames)
    whole = decode(frames, ROBOT, BUS, "log").samples
    assert len(whole) == 1500
    assert rows.tobytes() == whole.tobytes()


def test_a_row_is_given_with_the_block_that_completes_it(tmp_path):
    frames = flat(session(syncs=400))
    edges = tenths(frames)
    for k, follower in enumerate(written(tmp_path / "log.mcap", frames, edges)):
        if follower.rows is None:
            assert follower.ended
            continue
        last_ns = frames["time_ns"][edges[k] - 1] if k < len(edges) else frames["time_ns"][-1]
        assert 0 <= last_ns - follower.rows["stamp_ns"][-1] < 2_000_000


def test_a_drive_late_for_long_waits_and_is_in_order(tmp_path):
    """Over two blocks each interval has one PDO of each drive, as if nothing was late."""
    by = np.zeros(400, int)
    by[110:260] = 1
    frames = late_by(session(syncs=400), by, 1)
    rows = shown(tmp_path / "log.mcap", frames)
    assert rows.tobytes() == decode(frames, ROBOT, BUS, "log").samples.tobytes()


@pytest.mark.parametrize("seed", range(6))
def test_where_frames_are_lost_no_other_row_is_shown(tmp_path, seed):
    rng = np.random.default_rng(seed)
    frames = late_by(session(syncs=1500), rng.integers(1, 4, 1500) * (rng.random(1500) < 0.02), 2)
    kept = np.ones(len(frames), bool)
    for at in rng.integers(0, len(frames), 6):
        kept[at : at + rng.integers(1, 12)] = False
    frames = frames[kept]
    rows = shown(tmp_path / "log.mcap", frames)
    whole = decode(frames, ROBOT, BUS, "log").samples
    both, here, there = np.intersect1d(rows["stamp_ns"], whole["stamp_ns"], return_indices=True)
    assert len(both) > 0.95 * len(whole)
    np.testing.assert_array_equal(rows["position"][here], whole["position"][there])


def test_a_counter_that_wraps_in_dropped_frames_counts_on(tmp_path):
    robot, frames = robot_of(bus_text(2)), flat(session(syncs=3000))
    pdo = (frames["can_id"] > 0x180) & (frames["can_id"] < 0x200)
    values = np.ascontiguousarray(frames["data"]).view([("status", "<u2"), ("position", "<i4"), ("effort", "<i2")])[
        :, 0
    ]
    values["position"][pdo] += 2**31 - 1 - 5000
    frames["data"] = values.view(np.uint8).reshape(-1, 8)
    rows = shown(tmp_path / "log.mcap", frames)
    whole = decode(frames, robot, BUS, "log")
    assert any("wrapped" in text for text in whole.warnings)
    np.testing.assert_allclose(rows["position"], whole.samples["position"], rtol=1e-12)


def begun(path: Path) -> tuple[RecordingWriter, RecordingFollower]:
    writer = RecordingWriter(path, header(ROBOT, 500.0))
    writer.frames("can0", flat(session(syncs=100)))
    writer.flush()
    return writer, RecordingFollower(path)


@pytest.mark.parametrize(
    ("harm", "text"),
    [
        (lambda path: path.unlink(), "is gone"),
        (lambda path: os.truncate(path, 100), "was cut"),
        (lambda path: (path.with_suffix(".new").write_bytes(path.read_bytes()), path.with_suffix(".new").rename(path)),
         "was replaced"),
        (lambda path: path.write_bytes(path.read_bytes() + b"\x06" + (9).to_bytes(8, "little") + b"not chunk"), "damaged at"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_followed_any_more(tmp_path, harm, text):
    path = tmp_path / "log.mcap"
    writer, follower = begun(path)
    assert follower.read() is False or follower.rows is not None
    harm(path)
    with pytest.raises(BadInputError, match=text) as raised:
        follower.read()
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)
    writer.close()


def test_half_a_record_is_awaited(tmp_path):
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


def test_a_recorder_hands_over_each_block_at_once_in_few_bytes(tmp_path, monkeypatch):
    """The disk is waited for every half second only; of two slow drives a frame takes 12 bytes at most."""
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
