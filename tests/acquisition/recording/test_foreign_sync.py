"""SYNC of another producer that is received with delays and in bursts, doubled or not at all: its
times are right, and no row is lost.
"""

import numpy as np
import pytest
from foreign_sync import jittery, of_frames
from hypothesis import given, settings
from hypothesis import strategies as st


@pytest.mark.parametrize("sd", [0.0, 0.05, 0.1, 0.15, 0.2])
def test_late_sync_gives_true_times_and_all_rows(sd):
    for seed in range(40):
        found, which, off, raw = jittery(seed, sd).decoded()
        assert which.tolist() == [*range(300)]
        assert (np.abs(off) <= np.maximum(0.5, raw + 1e-6)).all()
        assert np.sqrt(np.mean(off**2)) <= np.sqrt(np.mean(raw**2)) + 1e-6
        assert not any("TPDO" in text or "recorded" in text for text in found.warnings)


@pytest.mark.parametrize(
    ("harm", "least"),
    [
        ({"doubled": 0.01}, 0.999),
        ({"lost": 0.01}, 0.99),
        ({"doubled": 0.01, "lost": 0.01}, 0.9),
        ({"missing": 0.01}, 0.975),
        ({"doubled": 0.01, "missing": 0.01}, 0.95),
        ({"pauses": 3}, 0.999),
        ({"pauses": 2, "doubled": 0.01}, 0.999),
    ],
    ids=str,
)
@pytest.mark.parametrize("sd", [0.0, 0.05, 0.1, 0.2])
def test_duplicate_lost_and_paused_syncs_keep_times(sd, harm, least):
    rows, errors = 0, np.zeros(0)
    for seed in range(20):
        _, which, off, raw = jittery(seed, sd, syncs=600, **harm).decoded()
        assert (np.abs(off) <= np.maximum(0.5, raw + 1e-6)).all()
        rows, errors = rows + len(which), np.append(errors, off)
    assert rows >= least * 20 * 600
    assert np.sqrt(np.mean(errors**2)) <= 0.4 * sd + 0.001


@pytest.mark.parametrize("sd", [0.0, 0.05, 0.1])
def test_timer_restart_keeps_earlier_times(sd):
    for seed in range(20):
        _, which, off, raw = jittery(seed, sd, syncs=600, restart=0.7).decoded()
        assert which.tolist() == [*range(600)]
        assert (np.abs(off) <= np.maximum(0.5, raw + 1e-6)).all()


@pytest.mark.parametrize("sd", [0.0, 0.1])
def test_syncs_lost_before_clock_step_are_counted(sd):
    recording = jittery(1, sd, syncs=1000, lost=0.01)
    half = len(recording.frames) // 2
    recording.frames["time_ns"][half:] -= 500_000_000
    found, which, off, _ = recording.decoded()
    assert which.tolist() == [*range(1000)]
    assert np.ptp(off[:490]) < 0.5
    assert np.ptp(off[510:]) < 0.5
    assert found.warnings[0].startswith("the clock was set back by 0.")


@pytest.mark.parametrize("sent", [False, True])
@pytest.mark.parametrize("at_once", [False, True])
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32), most=st.sampled_from([2, 3, 5, 12]), apart=st.floats(0.001, 0.6))
def test_answered_sync_bursts_give_all_rows(sent, at_once, seed, most, apart):
    """Bursts of `most` or up to as many, the last SYNC of each on time; drives answer each SYNC at
    once, or all of them are received behind the last one.
    """
    rng, k = np.random.default_rng(seed), np.arange(500)
    sizes = np.full(500, most) if rng.random() < 0.5 else rng.integers(1, most + 1, 500)
    burst = np.repeat(k, sizes)[:500]
    last = np.searchsorted(burst, burst, "right") - 1
    received = last - (last - k) * apart
    came = last + 1e-5 * (k - last) if at_once else received
    parts = [(received, k, 0)]
    parts += [(came + 0.2 * by * (0.2 if at_once else apart), k, by) for by in (1, 2)]
    found, which, _, _ = of_frames(parts, k, received, sent=sent).decoded()
    assert which.tolist() == k.tolist()
    assert found.syncs_lost == 0
    if not at_once or (most - 1) * apart < 0.5:  # no drive is late
        assert not any("TPDO" in text for text in found.warnings)
