"""Instruments of long recordings to the end of the passes: memory, and time over length, of the command line as a process.

Run with `LONGEST_MINUTES=60 pytest tests/benchmarks/test_long_recordings.py -s --benchmark-enable`: an hour of the simulated
TX40 at 500 Hz. 20 minutes are the default.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import robot_named

from acquisition.recording import Header, RecordingWriter, sample_dtype
from identification.study import Noise, closed_loop, random_reference

pytestmark = pytest.mark.skipif(
    "--benchmark-enable" not in sys.argv, reason="a benchmark: run `pytest tests/benchmarks -s --benchmark-enable`"
)

SHORTEST, LONGEST = 5, int(os.environ.get("LONGEST_MINUTES", "20"))
RATE_HZ, PERIOD_S = 500.0, 10.0  # of the reference
PERIOD = round(RATE_HZ * PERIOD_S)


def recording(path: Path, minutes: int) -> None:
    """A period of the simulated robot in closed loop again and again, each with noise of its own."""
    robot, rng = robot_named("tx40"), np.random.default_rng(0)
    q_ref = random_reference(robot, duration_s=2 * PERIOD_S, sample_rate_hz=RATE_HZ, seed=1, period_s=PERIOD_S)
    signals = closed_loop(robot, q_ref, RATE_HZ, noise=Noise(), seed=1)
    steady = slice(len(q_ref) - 1 - PERIOD, len(q_ref) - 1)
    q, effort, reference = (x[steady] for x in (signals.q, signals.effort, q_ref))
    header = Header(
        robot=robot, source="simulated", sample_rate_hz=RATE_HZ, effort_provenance="simulated",
        notes={"effort_timing": "mean over the control period"},
    )  # fmt: skip
    with RecordingWriter(path, header) as writer:
        for k in range(round(minutes * 60 / PERIOD_S)):
            block = np.zeros(PERIOD, sample_dtype(6, reference=True))
            block["stamp_ns"] = (k * PERIOD + np.arange(PERIOD)) * round(1e9 / RATE_HZ)
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
    found = {}
    for minutes in (SHORTEST, LONGEST):
        path, out = tmp_path / f"{minutes}.mcap", tmp_path / f"{minutes}.json"
        recording(path, minutes)
        found[minutes] = cost(
            sys.executable, "-m", "identification", "fit", path, "--method", "iv", "--workers", 1, "--json", out
        )
        path.unlink()
        fit = json.loads(out.read_text())
        with capsys.disabled():
            took_s, peak_gb = found[minutes]
            print(
                f"\n{minutes} minutes at {RATE_HZ:g} Hz x 6, {fit['status']} after {len(fit['iterations'])} passes",
                end="",
            )
            print(f": {took_s:.0f} s of CPU, peak {peak_gb:.2f} GB (bound 1)")
        assert fit["status"] == "converged"
    (short_s, _), (long_s, _) = found.values()
    ratio = long_s / short_s / (LONGEST / SHORTEST)
    with capsys.disabled():
        print(f"time by minute, the longer over the shorter: {ratio:.2f} (bound 1.2)")
    assert max(peak for _, peak in found.values()) < 1.0
    assert ratio < 1.2
