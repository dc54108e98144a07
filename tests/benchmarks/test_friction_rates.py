"""How often `robot-identify friction` recommends the terms that a robot has, on recordings of the
independent simulator.

Run with `FRICTION_RUNS=100 pytest tests/benchmarks/test_friction_rates.py -s --benchmark-enable`;
by default 10 runs of a case. The table stands in friction_rates.md.
"""

import os
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

from identification.design import select_friction
from identification.regression import Overrides

RUNS = int(os.environ.get("FRICTION_RUNS", "10"))
BATCH = 20  # recordings simulated side by side
WHITE = Imperfections(encoder_noise=1e-6, torque_noise_percent=2.0)
COLOURED = Imperfections(encoder_noise=1e-6, coloured_noise_percent=2.0)
# ten times as much would hide this root friction
SLOW = Imperfections(encoder_noise=1e-6, coloured_noise_percent=0.2)
NONE, ROOT, LOAD = frozenset(), frozenset({"root"}), frozenset({"load"})


@pytest.mark.parametrize(
    ("name", "cell", "root", "load"),
    [
        ("scara", WHITE, (0, 0), (0, 0)),
        ("scara", COLOURED, (0, 0), (0, 0)),
        ("scara", WHITE, (0.6, 0), (0, 0.3)),
        ("scara", WHITE, (0.6, 0), (0.3, 0.3)),
        ("scara", SLOW, (0.6, 0), (0, 0.3)),
        ("emps", WHITE, (0,), (0,)),
        ("tx40", WHITE, (0,), (0,)),
    ],
)
def test_true_friction_terms_are_selected(name, cell, root, load):
    """In 95 % of the recordings, those terms and no other."""
    toml = REPLAY / name / "robot.toml"
    own = tuple(
        (ROOT if r else NONE) | (LOAD if mu else NONE) for r, mu in zip(root, load, strict=True)
    )
    # friction of the package has no v0: next to no noise, more would be seen
    body = plant(toml, smooth=0.002)
    if any(own):
        body = replace(
            body, friction=replace(body.friction, root=np.array(root), load=np.array(load))
        )
    controller = designed_pd(body, 10.0, 1000.0) if name == "tx40" else described_controller(body)
    robot = description(toml)
    robot = replace(robot, identification=type(robot.identification)())  # the rules of the package
    known = (
        Overrides()
        if robot.controller.sample_rate_hz
        else Overrides(torque_lag_s=-0.5 / controller.rate_hz)
    )
    exact, all_named, found = 0, 0, {}
    for first in range(0, RUNS, BATCH):
        seeds = range(3000 + first, 3000 + min(RUNS, first + BATCH))
        reference = references(body, seeds, duration_s=10.0, rate_hz=controller.rate_hz)
        runs = simulate(body, controller, reference, cell, seed=first)
        for k in range(len(seeds)):
            choice = select_friction(runs.signals(robot, k), known)
            terms, expected = choice.recommended.terms, own if any(own) else choice.usual.terms
            exact += terms == expected
            all_named += all(
                of_robot <= more for of_robot, more in zip(expected, terms, strict=True)
            )
            if terms != expected:
                told = ", ".join("+".join(sorted(more)) or "-" for more in terms)
                found[told] = found.get(told, 0) + 1
    case = f"{name}, {root=}, {load=}, {cell.coloured_noise_percent=}"
    print(
        f"\n{case}: exactly in {exact} of {RUNS}, all named in {all_named}; others "
        f"{found or 'none'}",
        flush=True,
    )
    assert exact >= 0.95 * RUNS
