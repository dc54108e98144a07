"""How often the trust block is wrong: recordings of the independent simulator, clean and with one fault each.

Run with `TRUST_RUNS=40 pytest tests/benchmarks/test_trust_rates.py -s --benchmark-enable`; by default 10 runs of each case.
"""

import os
import sys
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from conftest import REPLAY
from independent_robots import plant
from independent_simulator import (
    Imperfections,
    described_controller,
    description,
    designed_pd,
    references,
    simulate,
)

from identification.data.signals import Signals
from identification.methods.fit import Fit
from identification.methods.idim import identify_iv, identify_ls
from identification.methods.iteration import Iteration
from identification.regression.settings import Overrides

pytestmark = pytest.mark.skipif(
    "--benchmark-enable" not in sys.argv, reason="a benchmark: run `pytest tests/benchmarks -s --benchmark-enable`"
)

RUNS = int(os.environ.get("TRUST_RUNS", "10"))
BATCH = 10  # recordings simulated side by side
CLEAN = {
    "white": Imperfections(encoder_noise=1e-6, torque_noise_percent=2.0),
    "20 µm": Imperfections(encoder_noise=2e-5, torque_noise_percent=1.0),
    "AR(0.98)": Imperfections(encoder_noise=1e-6, coloured_noise_percent=2.0),
}
FAULTS = {
    "asymmetric friction": {"asymmetry": 0.2},
    "drift": {"drift_percent": 30.0},
    "Stribeck friction": {"stribeck": 0.5},
    "tilt of gravity": {"tilt_deg": 3.0},
}
METHODS = ("iv", "wls")


def recordings(name: str, cell: Imperfections, fault: dict[str, float], runs: int):
    """Signals of runs of 10 s, each with a reference and noise of its own."""
    toml = REPLAY / name / "robot.toml"
    described = plant(toml)
    controller = designed_pd(described, 10.0, 1000.0) if name == "tx40" else described_controller(described)
    body = plant(toml, tilt_rad=np.deg2rad(fault.get("tilt_deg", 0.0)))
    friction = {key: fault[key] for key in ("asymmetry", "stribeck") if key in fault}
    body = replace(body, friction=replace(body.friction, **friction))
    cell = replace(cell, drift_percent=fault.get("drift_percent", 0.0))
    robot = description(toml, controller if name == "tx40" else None)
    for first in range(0, runs, BATCH):
        seeds = range(1000 + first, 1000 + min(runs, first + BATCH))
        reference = references(described, seeds, duration_s=10.0, rate_hz=controller.rate_hz)
        made = simulate(body, controller, reference, cell, seed=first)
        yield from (made.signals(robot, run) for run in range(len(seeds)))


def fitted(signals: Signals, method: str) -> Fit:
    if method == "iv":
        return identify_iv(signals, Overrides(), Iteration())
    return identify_ls(signals, Overrides(), method=method)


def test_clean_recordings_are_trusted(capsys):
    """`caution` in under 5 % of all runs, `do not use` in none."""
    verdicts = Counter()
    for name in ("emps", "scara"):
        for noise, cell in CLEAN.items():
            found = {method: [] for method in METHODS}
            for signals in recordings(name, cell, {}, RUNS):
                for method in METHODS:
                    found[method].append(fitted(signals, method).trust)
            for method, trusts in found.items():
                verdicts.update(trust.verdict for trust in trusts)
                why = Counter(line.test for t in trusts for line in t.lines if line.level in ("caution", "do not use"))
                caution = sum(trust.verdict == "caution" for trust in trusts)
                with capsys.disabled():
                    print(
                        f"{name}, {noise}, {method}: caution {caution} of {len(trusts)} {dict(why) or ''}", flush=True
                    )
    total = verdicts.total()
    with capsys.disabled():
        print(f"all: caution {verdicts['caution']} of {total}")
    assert verdicts["do not use"] == 0
    assert verdicts["caution"] < 0.05 * total


@pytest.mark.parametrize("fault", FAULTS)
def test_the_right_column_is_named_first(fault, capsys):
    """In 90 % of runs, each by each robot and method."""
    named = Counter()
    robots = ("tx40",) if fault == "tilt of gravity" else ("emps", "scara", "tx40")
    for name in robots:
        runs = RUNS if name != "tx40" else max(2, RUNS // 4)
        count = Counter()
        for signals in recordings(name, CLEAN["white"], FAULTS[fault], runs):
            for method in METHODS:
                line = fitted(signals, method).trust.line("added columns")
                count[method] += line.level == "caution" and line.text.startswith(fault)
        named[name] = runs
        with capsys.disabled():
            print(
                *(f"{name}, {method}: {fault} named first in {count[method]} of {runs}" for method in METHODS), sep="\n"
            )
        named[fault] += sum(count.values())
    total = len(METHODS) * sum(named[name] for name in robots)
    with capsys.disabled():
        print(f"all: {named[fault]} of {total}", flush=True)
    assert named[fault] >= 0.9 * total
