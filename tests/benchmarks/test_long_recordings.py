"""Instruments of long recordings: memory, and time over length, of the command line as a whole process.

Run with `LONGEST_MINUTES=120 pytest tests/benchmarks/test_long_recordings.py -s --benchmark-enable`: 2 hours of the simulated
TX40 at 1 kHz take half an hour. 20 minutes are the default.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import REPLAY, robot_named

from acquisition.recording import Header, RecordingWriter, sample_dtype
from identification.study import Noise, closed_loop, random_reference

pytestmark = pytest.mark.skipif(
    "--benchmark-enable" not in sys.argv, reason="a benchmark: run `pytest tests/benchmarks -s --benchmark-enable`"
)

PASSES, SHORTEST, LONGEST = 3, 5, int(os.environ.get("LONGEST_MINUTES", "20"))
PERIOD = 10_000  # samples of the reference's period at 1 kHz


def recording(path: Path, minutes: int) -> None:
    """A period of the simulated robot in closed loop again and again, each with noise of its own."""
    robot, rng = robot_named("tx40"), np.random.default_rng(0)
    q_ref = random_reference(robot, duration_s=20.0, sample_rate_hz=1000.0, seed=1, period_s=PERIOD * 1e-3)
    signals = closed_loop(robot, q_ref, 1000.0, noise=Noise(), seed=1)
    steady = slice(len(q_ref) - 1 - PERIOD, len(q_ref) - 1)
    q, effort, reference = (x[steady] for x in (signals.q, signals.effort, q_ref))
    header = Header(
        robot=robot, source="simulated", sample_rate_hz=1000.0, effort_provenance="simulated",
        notes={"effort_timing": "mean over the control period"},
    )  # fmt: skip
    with RecordingWriter(path, header) as writer:
        for k in range(minutes * 60_000 // PERIOD):
            block = np.zeros(PERIOD, sample_dtype(6, reference=True))
            block["stamp_ns"] = (k * PERIOD + np.arange(PERIOD)) * 1_000_000
            block["position"] = q + 1e-5 * rng.standard_normal(q.shape)
            block["effort"] = effort + 0.02 * np.sqrt((effort**2).mean(axis=0)) * rng.standard_normal(q.shape)
            block["reference"] = reference
            for part in np.array_split(block, 100):
                writer.samples(part)


def cost(*command: object) -> tuple[float, float]:
    """CPU seconds and peak memory in GB of a process."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    process = subprocess.Popen([str(part) for part in command], stdout=subprocess.DEVNULL, env=environment)
    _, _, usage = os.wait4(process.pid, 0)
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e6


def test_instruments_of_long_recordings(tmp_path, capsys):
    found, robot = {}, tmp_path / "robot.toml"
    text = (REPLAY / "tx40" / "robot.toml").read_text()
    robot.write_text(f"{text}\n[identification]\nmax_iterations = {PASSES}\n")
    for minutes in (SHORTEST, LONGEST):
        path = tmp_path / f"{minutes}.mcap"
        recording(path, minutes)
        fit = (sys.executable, "-m", "identification", "fit", path, "--method", "iv", "--robot", robot)
        found[minutes] = cost(*fit, "--workers", 1, "--json", tmp_path / f"{minutes}.json")
        path.unlink()
        passes = json.loads((tmp_path / f"{minutes}.json").read_text())["iterations"]
        assert len(passes) == PASSES  # they do not settle in so few
    (short_s, _), (long_s, _) = found.values()
    ratio = long_s / short_s / (LONGEST / SHORTEST)
    with capsys.disabled():
        for minutes, (took_s, peak_gb) in found.items():
            print(
                f"\n3 passes of {minutes} minutes at 1 kHz x 6: {took_s:.0f} s of CPU, peak {peak_gb:.2f} GB (bound 1)",
                end="",
            )
        print(f"\ntime by minute, the longer over the shorter: {ratio:.2f} (bound 1.2)")
    assert max(peak for _, peak in found.values()) < 1.0
    assert ratio < 1.2
