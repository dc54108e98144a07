"""Rows of made-up CAN recordings with losses, late answers and repeats: mixed ones, ones off in
time, and the share kept.

The table stands in lossy_can.md. Run with `LOSSY_CAN=393 pytest tests/benchmarks/test_lossy_rows.py
-s --benchmark-enable`.
"""

import os

from lossy_can import Kind, Outcome, outcomes, table

EACH, SEED = int(os.environ.get("LOSSY_CAN", "393")), 1


def test_lossy_recording_rows():
    found = outcomes(SEED, EACH)
    print(f"\nseed {SEED}\n{table(found)}")
    everything = sum(found.values(), Outcome(files=0))
    assert everything.mixed <= 1e-6 * everything.rows
    assert everything.off == 0
    assert everything.refused < 0.06 * everything.files
    for kind, least in {
        Kind(): 1.0,
        Kind(lost=True): 0.985,
        Kind(late=True): 0.95,
        Kind(late=True, lost=True): 0.7,
    }.items():
        assert found[kind].rows >= least * found[kind].possible
