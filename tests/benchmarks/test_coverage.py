"""Coverage of the printed 95 % intervals, by the independent simulator: the table of coverage.md.

Run with `COVERAGE_RUNS=200 pytest tests/benchmarks/test_coverage.py -s --benchmark-enable`; the arm
has a fifth as many. The bounds are those of 200 runs: with fewer the table is only printed, as the
shares then spread by more than the bounds leave.
"""

import os
from dataclasses import replace

import numpy as np
from coverage_cases import ARM, AXES, HEADER, Coverage, covered

RUNS = int(os.environ.get("COVERAGE_RUNS", "200"))


def broken(c: Coverage, lowest: float, worst: float) -> list[str]:
    """What is outside the bounds of a case."""
    largest = c.half_over_spread.max()
    found = [
        *([] if lowest <= c.whole <= 98 else [f"coverage {c.whole:.1f} %"]),
        *(
            []
            if c.by_parameter.min() >= worst
            else [f"worst parameter {c.by_parameter.min():.0f} %"]
        ),
        *([] if largest <= 1.6 else [f"half-width {largest:.2f}"]),
    ]
    return [f"{c.case.name}: {text}" for text in found]


def test_intervals_cover_truth():
    print(f"\n{HEADER}")
    found, outside = [], []
    for cases, runs, lowest, worst in ((AXES, RUNS, 90, 82), (ARM, max(2, RUNS // 5), 86, 75)):
        for c in covered(cases, runs, os.cpu_count() or 1):
            print(c.row(), flush=True)
            found.append(c)
            outside += broken(c, lowest, worst)
    mean = np.mean([c.whole for c in found if c.case in AXES])
    print(
        f"mean over EMPS and SCARA: {mean:.1f} %; outside the bounds: "
        f"{'; '.join(outside) or 'nothing'}"
    )
    if RUNS >= 200:
        assert not outside
        assert 93 <= mean <= 97


def test_iv_is_as_efficient_as_ls():
    """With exact positions, white torque noise and a known delay least squares is efficient."""
    cases = [replace(case, delay_known=True) for case in AXES if case.what == "noise-free position"]
    spread = {
        (c.case.robot, c.case.method): np.std(c.beta - c.true, axis=0)
        for c in covered(cases, RUNS, os.cpu_count() or 1)
    }
    ratios = [spread[robot, "iv"] / spread[robot, "wls"] for robot in ("emps", "scara")]
    print(f"\nspread of IV over LS: {' '.join(f'{x:.4f}' for x in np.concatenate(ratios))}")
    assert np.abs(np.concatenate(ratios) - 1).max() < 0.01
