"""Drive gains of pairs of recordings against the truth, and a payload weighed with them, by the independent simulator.

Run with `GAIN_RUNS=40 GAIN_WEIGHED=20 pytest tests/benchmarks/test_gain_coverage.py -s --benchmark-enable`, the defaults. With
fewer the tables are only printed.
"""

import os
import sys
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest
from gain_cases import CASES, WEIGHED, Fitted, GainCase, fitted_gains, weighed_masses

from identification.data import Signals

pytestmark = pytest.mark.skipif(
    "--benchmark-enable" not in sys.argv or "payload" not in Signals.__dataclass_fields__,
    reason="a benchmark: run `pytest tests/benchmarks -s --benchmark-enable`",
)

RUNS, WEIGHINGS = int(os.environ.get("GAIN_RUNS", "40")), int(os.environ.get("GAIN_WEIGHED", "20"))
CHUNK = 20  # pairs simulated side by side
LEAST_COVERAGE, MOST_WIDTH = 85.0, 1.3  # percent of the gains; median half-width over 1.96 deviations from pair to pair


@dataclass(frozen=True, kw_only=True)
class Gains:
    """Of the pairs of a case: gains and half-widths (S, n) in parts of the truth, and whether each is determined."""

    case: GainCase
    values: np.ndarray
    half: np.ndarray
    determined: np.ndarray

    @property
    def bias(self) -> np.ndarray:
        """(n,) mean error in percent."""
        return 100 * (self.values.mean(axis=0) - 1)

    @property
    def spread(self) -> np.ndarray:
        """(n,) deviation from pair to pair in percent."""
        return 100 * self.values.std(axis=0, ddof=1)

    @property
    def width(self) -> np.ndarray:
        """(n,) median half-width over 1.96 deviations."""
        return 100 * np.median(self.half, axis=0) / (1.96 * self.spread)

    @property
    def coverage(self) -> np.ndarray:
        """(n,) share in percent of the intervals that hold the truth."""
        return 100 * np.mean(np.abs(self.values - 1) <= self.half, axis=0)

    @property
    def most_bias(self) -> np.ndarray:
        """(n,) how far the mean may be from the truth, in percent."""
        return self.case.most_bias + 2 * self.spread / np.sqrt(len(self.values)) * bool(self.case.coloured)

    def rows(self) -> list[str]:
        """A row of the table for each motor."""
        return [
            f"| {self.case.name} | {k + 1} | {len(self.values)} | {self.bias[k]:+.2f} | {self.spread[k]:.2f} "
            f"| {self.width[k]:.2f} | {self.coverage[k]:.0f} | {100 * self.determined[:, k].mean():.0f} |"
            for k in range(self.values.shape[1])
        ]

    def broken(self) -> list[str]:
        """What is outside the bounds."""
        found = [f"motor {k + 1}: bias {self.bias[k]:+.2f} %" for k in np.flatnonzero(abs(self.bias) > self.most_bias)]
        found += [f"coverage {self.coverage.mean():.1f} %"] if self.coverage.mean() < LEAST_COVERAGE else []
        found += [f"half-width {np.median(self.width):.2f}"] if np.median(self.width) > MOST_WIDTH else []
        return [f"{self.case.name}: {text}" for text in found]


HEADER = (
    "| case | motor | pairs | bias, % | spread, % | half-width over 1.96 × spread, median | coverage, % | determined, % |\n"
    "|---|---|---|---|---|---|---|---|"
)


def gains_of(case: GainCase, fits: list[Fitted]) -> Gains:
    values, half = (np.array([getattr(fit, name) / case.gains for fit in fits]) for name in ("values", "half"))
    return Gains(case=case, values=values, half=half, determined=np.array([fit.determined for fit in fits]))


def test_gains_are_without_bias_and_their_intervals_hold_the_truth():
    print(f"\n{HEADER}")
    alike, outside = defaultdict(list), list[str]()
    for case in CASES:
        alike[case.robot, case.mass_kg, case.loop].append(case)
    chunks = [range(first, min(RUNS, first + CHUNK)) for first in range(0, RUNS, CHUNK)]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        waiting = [(cases, [pool.submit(fitted_gains, cases, chunk) for chunk in chunks]) for cases in alike.values()]
        for cases, futures in waiting:
            parts = [future.result() for future in futures]
            for k, case in enumerate(cases):
                found = gains_of(case, [fit for part in parts for fit in part[k]])
                print(*found.rows(), sep="\n", flush=True)
                outside += found.broken()
    print(f"outside the bounds: {'; '.join(outside) or 'nothing'}")
    if RUNS >= 40:
        assert not outside


def test_a_payload_is_weighed_with_the_gains_of_another_pair():
    """Gains of one pair, with their intervals; another payload on other references, whose mass nobody states."""
    chunks = [range(first, min(WEIGHINGS, first + CHUNK // 2)) for first in range(0, WEIGHINGS, CHUNK // 2)]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        found = [one for part in pool.map(weighed_masses, chunks) for one in part]
    masses, half = np.array(found).T
    inside = int(np.sum(np.abs(masses - WEIGHED.mass_kg) <= half))
    print(
        f"\n{WEIGHED.mass_kg:g} kg weighed {len(found)} times: {masses.mean():.3f} ± {np.median(half):.3f} kg, spread "
        f"{masses.std(ddof=1):.3f} kg, true mass inside {inside} times"
    )
    if WEIGHINGS >= 20:
        assert inside >= 17
