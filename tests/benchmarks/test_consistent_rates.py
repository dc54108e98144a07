"""A thousand random arms whose estimates no robot has: consistent parameters are found for each of them."""

import pytest
from random_arms import random_estimate
from test_consistency import lowest

from identification.estimation.consistency import CERTIFIED, consistent_parameters
from identification.estimation.estimators import one_thread

ARMS, TIMES_THE_NOISE = 1000, 10.0


@pytest.mark.skipif("not config.getoption('--benchmark-only')", reason="minutes: with --benchmark-only")
def test_no_arm_is_without_consistent_parameters(benchmark):
    def run():
        failed, worst = 0, 0.0
        for seed in range(ARMS):
            beta, covariance, K, physical, _ = random_estimate(seed, TIMES_THE_NOISE)
            found = one_thread(consistent_parameters)(beta, covariance, K, physical)
            failed += not lowest(physical, found.chi) > 0
            worst = max(worst, found.decrement)
        return failed, worst

    failed, worst = benchmark.pedantic(run, rounds=1)
    print(f"\n{ARMS} random arms: {failed} failed, largest Newton decrement {worst:.1e}")
    assert failed == 0
    assert worst <= CERTIFIED
