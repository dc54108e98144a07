"""What a follower on the same machine costs: the recorder's turn, and the jitter of SYNC, with and without it in turn."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import REPLAY, ROOT

from acquisition.recording import read_recording
from acquisition.session import Recorder

pytestmark = pytest.mark.skipif(
    "--benchmark-enable" not in sys.argv, reason="a benchmark: run `pytest tests/benchmarks -s --benchmark-enable`"
)

ROUNDS, BLOCKS = 4, 60  # of each kind; blocks of 0.1 s
SYNC = """
import os, sys, time
sys.path.insert(0, {root!r})
from acquisition.session import real_time_scheduling
with real_time_scheduling() as granted:
    begin, off = time.monotonic_ns(), []
    for k in range({count}):
        due = begin + (k + 1) * 2_000_000
        while (left := due - time.monotonic_ns()) > 0:
            time.sleep(left * 1e-9)
        off.append(time.monotonic_ns() - due)
off = [x * 1e-6 for x in sorted(off)]
print(int(granted.fifo), sum(off) / len(off), off[int(0.99 * len(off))], off[-1])
"""


def test_what_a_follower_costs(tmp_path):
    recording = read_recording(REPLAY / "tx40" / "session.mcap")
    (frames,) = recording.frames.values()
    edges = np.searchsorted(
        frames["time_ns"], frames["time_ns"][0] + np.arange(1, BLOCKS + 1) * 100_000_000 + 5 * 10**8
    )
    blocks = np.split(frames, edges)[:BLOCKS]
    turns: dict[bool, list[float]] = {False: [], True: []}
    sync: dict[bool, list[str]] = {False: [], True: []}
    for k in range(2 * ROUNDS):
        followed, path = bool(k % 2), tmp_path / f"{k}.mcap"
        recorder = Recorder(path, recording.robot, source="benchmark", place="robot.toml")
        follow = [sys.executable, "-m", "identification", "view", str(path), "--follow", "-o", f"{path}.rrd"]
        follower = subprocess.Popen(follow, cwd=ROOT, stderr=subprocess.PIPE) if followed else None
        time.sleep(6)  # until it runs
        script = SYNC.format(root=str(ROOT), count=50 * BLOCKS - 200)
        loop = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
        begin = time.monotonic()
        for n, block in enumerate(blocks, 1):
            time.sleep(max(0.0, begin + 0.1 * n - time.monotonic()))
            started = time.perf_counter()
            recorder.add(block)
            recorder.tick(int(block["time_ns"][-1]), 0)
            turns[followed].append(1e3 * (time.perf_counter() - started))
        sync[followed].append(loop.communicate()[0].strip())
        if follower is not None:
            assert follower.poll() is None, follower.communicate()
            assert Path(f"{path}.rrd").stat().st_size > 0
            follower.kill()
            follower.communicate()
        recorder.close()
    for followed, name in ((False, "alone"), (True, "followed")):
        median, high, worst = np.percentile(turns[followed], [50, 95, 100])
        print(f"\n{name}: recorder's turn {median:.2f} ms median, {high:.2f} 95 %, {worst:.2f} worst")
        for line in sync[followed]:
            fifo, mean, high, worst = map(float, line.split())
            print(f"  SYNC of 2 ms, FIFO {fifo:g}: late {mean:.3f} ms mean, {high:.3f} 99 %, {worst:.3f} worst")
