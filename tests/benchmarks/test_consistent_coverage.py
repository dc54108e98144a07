"""Whether 95 % intervals of consistent base parameters hold the truth, the prior being links by their lengths alone.

Run with `pytest tests/benchmarks/test_consistent_coverage.py -s --benchmark-enable`; it takes two minutes.
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

NORMAL = 1.96  # deviations in half a 95 % interval


@pytest.mark.parametrize("times", [0.3, 1.0, 3.0, 10.0])
@pytest.mark.parametrize("correlated", [True, False])
def test_intervals_hold_the_truth(times, correlated):
    """Two hundred random arms at shares and multiples of the noise; the fit's own intervals hold it in 95 %."""
    hit, prior = one_thread(coverage)(times, range(200), correlated=correlated)
    print(
        f"\nnoise x {times:g}: {100 * hit[~prior].mean():.1f} % of {(~prior).sum()} intervals not marked `prior` hold",
        end="",
    )
    print(f"; {100 * hit[prior].mean():.1f} % of {prior.sum()} marked", end="")
    assert hit[~prior].mean() >= 0.90


def coverage(times: float, seeds: range, *, correlated: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Of all base parameters of random arms: whether their interval holds the truth, and whether the prior tells them."""
    hits, marked = [], []
    for seed in seeds:
        beta, C, K, physical, chi = random_estimate(seed, times)
        if not correlated:
            C = np.diag(np.diag(C))
            beta = K @ chi + np.sqrt(np.diag(C)) * np.random.default_rng(seed).normal(size=len(beta))
        found = consistent_parameters(beta, C, K, physical)
        _, of_beta = certainty(found, C, K, physical)
        hits.append(np.abs(found.beta - K @ chi) <= NORMAL * of_beta.sigma)
        marked.append(of_beta.share > FROM_PRIOR)
    return np.concatenate(hits), np.concatenate(marked)
