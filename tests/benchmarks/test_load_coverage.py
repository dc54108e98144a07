"""How often the intervals of several recordings' fit hold the truth where the robot has
root and load friction.

Recordings are of the independent simulator. The last case has the same encoder noise in the
recording alone: noise that the controller acts on moves the robot above the low-pass, where
abs(tau_rigid) turns it into a mean that no position shows.

Figures stand in friction_rates.md. Run with `LOAD_RUNS=20 pytest
tests/benchmarks/test_load_coverage.py -s --benchmark-enable`.
"""

import os
from dataclasses import replace

import numpy as np
import pytest
from conftest import REPLAY
from described_truth import off
from independent_robots import plant
from independent_simulator import (
    Imperfections,
    described_controller,
    description,
    references,
    simulate,
)

from identification.data import Recordings
from identification.design import with_terms
from identification.methods import Iteration
from identification.regression import Overrides
from identification.results import identify_iv, identify_ls

RUNS = int(os.environ.get("LOAD_RUNS", "20"))
EACH = 2  # recordings of a fit
TERMS = frozenset({"root", "load"}), frozenset({"load"})


@pytest.mark.parametrize(
    ("noise", "in_loop", "lowest", "lowest_of_mu"),
    [(1e-6, True, 88, 80), (1e-5, True, 65, 0), (1e-5, False, 88, 80)],
)
def test_joint_fit_intervals_cover_truth(noise, in_loop, lowest, lowest_of_mu):
    toml = REPLAY / "scara" / "robot.toml"
    body = plant(toml, smooth=0.002)
    body = replace(
        body, friction=replace(body.friction, root=np.array([0.6, 0.0]), load=np.array([0.3, 0.3]))
    )
    controller, robot = described_controller(body), with_terms(description(toml), TERMS)
    robot = replace(robot, identification=type(robot.identification)())
    values = robot.parameters | {"Fr1": 0.6, "mu1": 0.3, "mu2": 0.3}
    cell = Imperfections(encoder_noise=noise if in_loop else 0.0, torque_noise_percent=2.0)
    reference = references(body, range(EACH * RUNS), duration_s=8.0, rate_hz=controller.rate_hz)
    runs = simulate(body, controller, reference, cell, seed=1)
    rng, sources = np.random.default_rng(3), []
    for k in range(EACH * RUNS):
        signals = runs.signals(robot, k)
        q = signals.q if in_loop else signals.q + noise * rng.normal(size=signals.q.shape)
        sources.append(replace(signals, q=q, recording=f"r{k}.mcap", sha256=f"{k:064x}"))
    for method in ("LS", "IV"):
        inside, of_mu, left_out = [], [], 0
        for k in range(0, EACH * RUNS, EACH):
            given = Recordings(sources=tuple(sources[k : k + EACH]))
            fit = (
                identify_ls(given, Overrides())
                if method == "LS"
                else identify_iv(given, Overrides(), Iteration())
            )
            apart = off(fit, replace(robot, parameters=values))
            inside += list(apart < 1)
            of_mu += [
                x < 1
                for x, name in zip(apart, fit.estimate.names, strict=True)
                if name.startswith("mu")
            ]
            left_out += not {"mu1", "mu2"} < set(fit.estimate.names)
        covered, covered_mu = 100 * np.mean(inside), 100 * np.mean(of_mu)
        where = "in the loop" if in_loop else "in the recording alone"
        print(
            f"\n{RUNS} fits of {EACH} recordings by {method}, {1e6 * noise:g} µrad {where}: "
            f"{covered:.1f} % inside, "
            f"load {covered_mu:.1f} %, {left_out} without it",
            flush=True,
        )
        if RUNS >= 20:
            assert covered >= lowest
            assert covered_mu >= lowest_of_mu
            assert left_out == 0
