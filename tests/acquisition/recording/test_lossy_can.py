"""Made-up lossy CAN recordings: no row mixes SYNCs or is off in time, and most
rows are kept; live, too.
"""

import numpy as np
import pytest
from lossy_can import KINDS, SYNCS, Kind, Outcome, made, outcome

from acquisition.recording import Syncs, recorded_syncs

BURSTS = {
    Kind(bursts=True): 0.93,
    Kind(bursts=True, lost=True): 0.8,
    Kind(bursts=True, late=True): 0.7,
}
LEAST = BURSTS | {Kind(): 1.0, Kind(lost=True): 0.97, Kind(late=True): 1.0, Kind(silent=True): 1.0}
LEAST |= {Kind(sync="doubled"): 0.95, Kind(sync="lost"): 1.0}


@pytest.mark.parametrize("kind", [*KINDS, *BURSTS], ids=str)
def test_rows_mix_no_syncs_and_have_true_times(kind):
    found = sum(
        (outcome(made(np.random.default_rng([7, k]), kind)) for k in range(8)), Outcome(files=0)
    )
    assert (found.mixed, found.off) == (0, 0)
    assert found.rows >= LEAST.get(kind, 0.2) * found.possible
    assert found.refused <= (4 if kind.late or kind.lost else 0)


def test_pending_last_answers_keep_late_rows():
    """Late from begin to end: no edge is proven but the first and the last."""
    found = outcome(made(np.random.default_rng([1, 1, 25]), KINDS[1]))
    assert found.rows >= 0.99 * SYNCS


@pytest.mark.parametrize("ours", [True, False])
def test_swapped_syncs_are_sorted_clock_step_kept(ours):
    even = 10**9 + 2_000_000 * np.arange(20)
    swapped, back = even[[*range(8), 9, 8, *range(10, 20)]], even - 5_000_000 * (np.arange(20) >= 8)
    rows, period = np.arange(20, dtype=np.int32), 2e6
    for times, right in ((swapped, even), (back.copy(), back)):
        # the drives answer each SYNC
        syncs = Syncs(rows=2 * rows, times=times, ours=ours, period=period)
        assert recorded_syncs(syncs, [2 * rows + 1]).times.tolist() == right.tolist()
