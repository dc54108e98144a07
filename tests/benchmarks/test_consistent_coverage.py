"""Whether 95 % intervals of consistent base parameters hold the truth, the prior being links by their lengths alone.

Run with `pytest tests/benchmarks/test_consistent_coverage.py -s --benchmark-enable`; it takes minutes.
"""

import sys

import numpy as np
import pytest
from random_arms import random_estimate

from identification.estimation import certainty, consistent_parameters, one_thread
from identification.methods.consistent import FROM_PRIOR

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
        _, of_beta = certainty(found, C, K, physical)
        hits.append(np.abs(found.beta - K @ chi) <= NORMAL * of_beta.sigma)
        shares.append(of_beta.share)
    hit, prior = np.concatenate(hits), np.concatenate(shares) > FROM_PRIOR
    percent = 100 * hit[~prior].mean()
    print(
        f"\nnoise x {times:g}: {percent:.1f} % of {(~prior).sum()} intervals hold the truth; {prior.sum()} more are the prior's"
    )
    assert percent >= 90
