"""How often a clean recording is trusted, and how well its intervals cover: EMPS, SCARA, TX40 and
seven joints of a URDF, with and without a described control law, and without a reference.

Run with `CLEAN_RUNS=40 pytest tests/benchmarks/test_clean.py -s --benchmark-enable`, the default:
recordings of each cell, by the simulator that shares no code with the package, each with a
reference, noise and, in half of them, efforts whose instants are not stated. The default method.
The table stands in clean.md.
"""

import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
from hunt import fit_by_default, true_values
from hunt_kinds import sound, without_law, without_reference

from identification.errors import RobotIdimError
from identification.estimation import one_thread

RUNS = int(os.environ.get("CLEAN_RUNS", "40"))
ROBOTS = ("emps", "scara", "tx40", "seven")
LACKS = {"law described": (), "no law": (without_law,), "no reference": (without_reference,)}


@one_thread
def told(name: str, lacks: str, seed: int) -> tuple[str, str, np.ndarray]:
    """Verdict, the worst test, and which intervals (b,) hold the truth."""
    setup = sound(name, np.random.default_rng([seed, len(name), 4242]))
    for change in LACKS[lacks]:
        setup = change(setup)
    try:
        fit = fit_by_default(setup.recording(9000 + seed))
    except RobotIdimError as error:
        return "refused", str(error), np.zeros(0, dtype=bool)
    true = np.array([true_values(name)[one] for one in fit.estimate.names])
    inside = (fit.intervals.low <= true) & (true <= fit.intervals.high)
    return fit.trust.verdict, fit.trust.lines[0].test, inside


@pytest.mark.parametrize("lacks", LACKS)
def test_clean_recordings_are_trusted(lacks):
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        waiting = {
            name: [pool.submit(told, name, lacks, seed) for seed in range(RUNS)] for name in ROBOTS
        }
        print("\n| cell | `trust` | inside | otherwise told first |\n|---|---|---|---|")
        trusted, wrong = 0, list[str]()
        for name, futures in waiting.items():
            verdicts, firsts, inside = zip(*(one.result() for one in futures), strict=True)
            count, share = verdicts.count("trust"), 100 * np.concatenate(inside).mean()
            others = Counter(
                first for word, first in zip(verdicts, firsts, strict=True) if word != "trust"
            )
            text = ", ".join(f"{first} {times}" for first, times in others.most_common())
            cell = f"{name.upper()}, {lacks}"
            print(f"| {cell} | {count} of {RUNS} | {share:.1f} % | {text or '-'} |", flush=True)
            trusted += count
            if share < 93 or (lacks != "no reference" and count < 0.9 * RUNS):
                wrong.append(cell)
    print(f"{lacks}: `trust` {trusted} of {RUNS * len(ROBOTS)}; too few, or not inside: {wrong}")
    assert trusted >= (0.85 if lacks == "no reference" else 0.95) * RUNS * len(ROBOTS)
    assert not wrong
