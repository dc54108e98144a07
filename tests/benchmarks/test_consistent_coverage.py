"""Whether 95 % intervals of consistent base parameters hold the truth, the prior being links by their lengths alone.

Run with `pytest tests/benchmarks/test_consistent_coverage.py -s --benchmark-enable`; it takes minutes.
"""

import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import REPLAY
from coverage_cases import ARM, controller_of
from independent_robots import plant
from independent_simulator import description, references, simulate
from random_arms import random_estimate

from identification.estimation import consistent_parameters, one_thread, parameter_certainty
from identification.methods import identify_ls, with_consistent
from identification.model import InverseModel, described_parameters
from identification.regression import Overrides

pytestmark = pytest.mark.skipif(
    "--benchmark-enable" not in sys.argv, reason="a benchmark: run `pytest tests/benchmarks -s --benchmark-enable`"
)

ARMS = 60
NORMAL = 1.96  # deviations in half a 95 % interval


@pytest.mark.parametrize("times", [1.0, 10.0])
def test_intervals_hold_the_truth(times):
    """Arms of random links, which no rods are, at the noise of a made up experiment and at ten times it."""
    hits, shares, solve = [], [], one_thread(consistent_parameters)
    for seed in range(ARMS):
        beta, C, K, physical, chi = random_estimate(seed, times)
        found = solve(beta, C, K, physical)
        _, (sigma, share) = parameter_certainty(found, C, K, physical)
        hits.append(np.abs(found.beta - K @ chi) <= NORMAL * sigma)
        shares.append(share)
    hit, prior = np.concatenate(hits), np.concatenate(shares) > 0.5
    percent = 100 * hit[~prior].mean()
    print(
        f"\nnoise x {times:g}: {percent:.1f} % of {(~prior).sum()} intervals hold the truth; {prior.sum()} more are the prior's"
    )
    assert percent >= 90


def test_intervals_of_an_arm_of_the_independent_simulator_hold_the_truth():
    """Eight recordings of the TX40, white noise fed back, the estimate by least squares, links by their lengths alone."""
    case, toml = ARM[0], REPLAY / "tx40" / "robot.toml"
    body, controller, robot = plant(toml), controller_of(case), description(toml)
    reference = references(body, range(8), duration_s=case.duration_s, rate_hz=controller.rate_hz)
    runs = simulate(body, controller, reference, case.cell, seed=0)
    known, bare = Overrides(torque_lag_s=-0.5 / controller.rate_hz), replace(robot, parameters={})
    hit, of_fit = [], []
    for k in range(8):
        fit = with_consistent(identify_ls(runs.signals(bare, k), known))
        true, c = described_parameters(InverseModel(robot), fit.base), fit.consistent_set
        hit += list((np.abs(c.beta - true) <= c.base_half)[~c.base_from_prior])
        of_fit += list(np.abs(fit.beta - true) <= fit.intervals.half)
    percent, fits = 100 * np.mean(hit), 100 * np.mean(of_fit)
    print(f"\nsimulated TX40: {percent:.1f} % of {len(hit)} intervals hold the truth; of the fit's own {fits:.1f} %")
    assert np.mean(hit) >= max(0.88, np.mean(of_fit) - 0.01)
