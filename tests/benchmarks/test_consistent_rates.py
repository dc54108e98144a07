"""A thousand random arms whose estimates no robot has: consistent parameters are found for each of them.

Run with `pytest tests/benchmarks/test_consistent_rates.py -s --benchmark-enable`; it takes minutes.
"""

from physical_cases import lowest
from random_arms import random_estimate

from identification.estimation import consistent_parameters, one_thread

ARMS, TIMES_THE_NOISE = 1000, 10.0


def test_no_arm_is_without_consistent_parameters():
    worst, solve = 0.0, one_thread(consistent_parameters)
    for seed in range(ARMS):
        beta, covariance, K, physical, _ = random_estimate(seed, TIMES_THE_NOISE)
        found = solve(beta, covariance, K, physical)
        assert lowest(physical, found.chi) > 0, seed
        worst = max(worst, found.decrement)
    print(f"\n{ARMS} random arms: none without, largest Newton decrement {worst:.1e}")
    assert worst <= 1e-6
