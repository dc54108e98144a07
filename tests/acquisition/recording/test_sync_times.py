"""Times of SYNCs: what we sent keeps its own, what another sent loses its delays and keeps its
pauses; clocks that are set.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acquisition.recording import Syncs, SyncTimes, sync_times, usual_period

START_NS, PERIOD_NS = 1_000_000_000, 2_000_000


def timed(times, *, ours: bool, index=None, nominal_ns: int = PERIOD_NS) -> SyncTimes:
    index = np.arange(len(times)) if index is None else np.array(index)
    times = np.array(times, np.int64)
    syncs = Syncs(
        rows=np.arange(len(times), dtype=np.int32),
        times=times,
        ours=ours,
        period=usual_period(times, nominal_ns),
    )
    return sync_times(syncs, index, int(index[-1]) + 1, nominal_ns)


def test_own_sync_keeps_its_send_times():
    times = [1_000_000, 3_000_000, 5_700_000, 7_000_000, 11_200_000, 13_000_000]
    found = timed(times, ours=True, index=[0, 1, 2, 3, 5, 6])
    assert found.stamps.tolist() == [
        1_000_000,
        3_000_000,
        5_700_000,
        7_000_000,
        9_100_000,
        11_200_000,
        13_000_000,
    ]
    found = timed([5_000_000, 7_000_000, 7_000_000, 7_000_000, 9_000_000], ours=True)
    # times grow
    assert found.stamps.tolist() == [5_000_000, 7_000_000, 7_000_001, 7_000_002, 9_000_000]
    jittery = timed(
        START_NS + PERIOD_NS * np.arange(50) + 20_000 * (-1) ** np.arange(50), ours=True
    )
    assert jittery.jitter_s[0] == pytest.approx(20e-6, rel=0.01)
    made_up_for = np.sort(
        PERIOD_NS * np.arange(3000) + np.random.default_rng(1).exponential(1.5e6, 3000).astype(int)
    )
    for factor in (1, 3):
        assert timed(START_NS + factor * made_up_for, ours=True).period_s == pytest.approx(
            0.002 * factor, rel=0.05
        )


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32))
def test_reception_delays_go_and_pauses_stay(seed):
    """SYNC of a controller, read late by up to 8 periods in bursts; between two
    SYNCs it pauses for 2 s.
    """
    rng = np.random.default_rng(seed)
    true_ns = START_NS + PERIOD_NS * np.arange(2000) + 2_000_000_000 * (np.arange(2000) >= 1000)
    delay = np.abs(rng.normal(0, 5_000, 2000))
    # nothing is read for a while, then all of it at once
    for k in rng.integers(0, 1900, 8).tolist():
        until = k + int(rng.integers(1, 9))
        if k < 1000 <= until:
            continue
        delay[k:until] = np.maximum(delay[k:until], true_ns[until] - true_ns[k:until])
    read_ns = np.maximum.accumulate(true_ns + np.rint(delay).astype(np.int64))
    found = timed(read_ns, ours=False)
    # of 2 ms; the ordinary delay has a deviation of 3 µs
    assert np.abs(found.stamps - true_ns).max() < 25_000
    assert found.pauses.tolist() == [999]
    assert found.period_s == pytest.approx(0.002, rel=1e-3)
    own = timed(read_ns, ours=True)
    # as they are, and growing by 1 ns where they came at once
    assert (own.stamps - read_ns).max() <= 20


def test_clock_set_back_is_found():
    times = START_NS + PERIOD_NS * np.arange(100)
    times[40:] -= 500_000_000
    found = timed(times, ours=True)
    assert found.stamps.tolist() == (START_NS + PERIOD_NS * np.arange(100)).tolist()
    assert found.set_back == ((40, pytest.approx(0.5)),)


@pytest.mark.parametrize("late", [[0.6], [0.9, 0.7], [0.6, 0.0, 0.8]])
def test_late_first_sync_is_corrected(late):
    true_ns = START_NS + PERIOD_NS * np.arange(200)
    delay = np.zeros(200)
    delay[: len(late)] = late
    read_ns = true_ns + np.rint(delay * PERIOD_NS).astype(int)
    assert np.abs(timed(read_ns, ours=False).stamps - true_ns).max() <= 1
