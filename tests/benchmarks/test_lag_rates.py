"""How often a lag is found, and how often one is found that is not there, on recordings of the independent simulator.

Run with `LAG_RUNS=40 pytest tests/benchmarks/test_lag_rates.py -s --benchmark-enable`; by default 10 runs of each case.
"""

import os
import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import REPLAY, robot_named
from independent_robots import plant
from independent_simulator import Imperfections, described_controller, references, simulate

from identification.methods.idim import identify_ls
from identification.regression.settings import Overrides

pytestmark = pytest.mark.skipif(
    "--benchmark-enable" not in sys.argv, reason="a benchmark: run `pytest tests/benchmarks -s --benchmark-enable`"
)

RUNS = int(os.environ.get("LAG_RUNS", "10"))
CASES = {"1 % of torque noise": {}, "encoder noise": {"noise": True}, "Stribeck 50 %": {"stribeck": 0.5}}
ENCODER_NOISE = {"emps": 2e-5, "scara": 2e-4}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", ["emps", "scara"])
def test_lags_and_replays(name, case):
    """Rows of a table: share found at t > 4 and share within 0.15 samples, of the joints whose half-width is small enough."""
    toml, robot = REPLAY / name / "robot.toml", robot_named(name)
    body = plant(toml, smooth=0.005)
    body = replace(body, friction=replace(body.friction, stribeck=CASES[case].get("stribeck", 0.0)))
    noise = ENCODER_NOISE[name] if "noise" in CASES[case] else 0.0
    path = references(body, range(RUNS), duration_s=20.0, rate_hz=1000.0)
    alarms = {}
    for lag in (0, 1):
        cell = Imperfections(lag=lag, encoder_noise=noise, torque_noise_percent=1.0)
        runs = simulate(body, described_controller(body), path, cell)
        lines = []
        for k in range(RUNS):
            trust = identify_ls(runs.signals(robot, k), Overrides(), trust=True).trust
            lines.append({line.test: line for line in trust.lines})
        figures = [figure for line in lines for figure in line["lag"].figures]
        told = [figure for figure in figures if figure.half_width <= 0.25]
        off = np.array([figure.value - figure.expected - lag for figure in told])
        near = 100 * np.mean(np.abs(off) < 0.15) if told else float("nan")
        alarms[lag] = 100 * np.mean([line["lag"].level == "caution" for line in lines])
        confirmed = 100 * np.mean([line["replay"].level == "ok" for line in lines])
        gains = [figure.value for line in lines for figure in line["replay"].figures]
        print(
            f"{name}, {case}, lag {lag}: caution {alarms[lag]:.0f} %; "
            f"told {100 * len(told) / len(figures):.0f} % of joints, of "
            f"these within 0.15 samples {near:.0f} %; replay ok {confirmed:.0f} %, gains {min(gains):.4f} to {max(gains):.4f}"
        )
    assert alarms[0] < 3 or RUNS < 34
