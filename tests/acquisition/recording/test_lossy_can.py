"""Made-up lossy CAN recordings: no row mixes SYNCs or is off in time, and most rows are kept; live, too."""

import numpy as np
import pytest
from lossy_can import KINDS, Kind, Outcome, described, made, outcome
from made_up_recordings import header

from acquisition.recording import RecordingFollower, RecordingWriter, decode

LEAST = {Kind(): 1.0, Kind(lost=True): 0.97, Kind(late=True): 0.95, Kind(silent=True): 1.0, Kind(sync="doubled"): 0.95}


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_no_row_mixes_syncs_or_is_off_in_time(kind):
    found = sum((outcome(made(np.random.default_rng([7, k]), kind)) for k in range(8)), Outcome(files=0))
    assert (found.mixed, found.off) == (0, 0)
    assert found.rows >= LEAST.get(kind, 0.2) * found.possible
    assert found.refused <= (4 if kind.late or kind.lost else 0)


@pytest.mark.parametrize(("kind", "number"), [(3, 22), (4, 17), (14, 129), (17, 9), (17, 147), (21, 0), (24, 34)])
def test_pdos_at_unusual_times_prove_no_order(kind, number):
    """Late for some SYNCs in a row, each with one PDO, and then one is lost."""
    found = outcome(made(np.random.default_rng([1, kind, number]), KINDS[kind]))
    assert (found.mixed, found.off) == (0, 0)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind.late and not kind.sync], ids=str)
def test_a_follower_gives_hardly_any_other_rows(tmp_path, kind):
    recording = made(np.random.default_rng([3, 2]), kind)
    robot, bus = described(recording.n, recording.period_ms)
    whole = decode(recording.frames, robot, bus, "log", max_missing=1.0).samples
    edges = np.flatnonzero(np.diff(recording.frames["time_ns"] // (100_000_000 * recording.period_ms))) + 1
    path, rows = tmp_path / "log.mcap", []
    with RecordingWriter(path, header(robot, 1e3 / recording.period_ms)) as writer:
        follower = RecordingFollower(path)
        for part in np.split(recording.frames, edges):
            writer.frames("can0", part)
            writer.flush(sync=False)
            follower.read()
            rows += [] if follower.rows is None else [follower.rows]
    follower.read()
    rows = np.concatenate([*rows, *([] if follower.rows is None else [follower.rows])])
    both, here, there = np.intersect1d(rows["stamp_ns"], whole["stamp_ns"], return_indices=True)
    assert len(both) >= max(0.97 * len(rows), 0.9 * len(whole))
    np.testing.assert_array_equal(rows["position"][here], whole["position"][there])
