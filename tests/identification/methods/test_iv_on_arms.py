"""Instrumental variables get through on arms: noise fed back through a loop unknown to the
description, cuts of a real record.

Descriptions here have no `[parameters]`: the nearest consistent links know nothing of the truth.

`pytest tests/identification/methods/test_iv_on_arms.py -s --benchmark-enable` runs the whole
samples, some four minutes.
"""

import dataclasses
from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest
from conftest import REPLAY
from described_truth import off
from fits_of_records import cut, iv_of, ls_of, signals_of, thinned
from independent_robots import Plant, plant
from independent_simulator import (
    Controller,
    Imperfections,
    Runs,
    description,
    designed_pd,
    references,
    simulate,
)

from acquisition.robot import Robot
from identification.methods import Iteration
from identification.regression import Overrides
from identification.results import Evidence, identify_iv

SETTLED = ("converged", "not_confirmed")
POSITIONS = 20


@pytest.fixture(scope="module")
def whole(request) -> bool:
    return bool(request.config.getoption("--benchmark-enable"))


def without_parameters(robot: Robot) -> Robot:
    return dataclasses.replace(robot, parameters={})


def pi_loop(body: Plant, bandwidth_hz: float) -> Controller:
    """P of the position around PI of the speed: another law than the surrogate's."""
    w = 2 * np.pi * bandwidth_hz
    gains = {"position_gain": np.full(body.n, w / 1.6), "integral_gain": np.full(body.n, w / 2)}
    return dataclasses.replace(
        designed_pd(body, bandwidth_hz, 1000.0), structure="cascade_p_pi", **gains
    )


def half_widths_off(fit: Evidence) -> float:
    """How far the worst essential parameter is from the truth of the described robot, in
    half-widths of its interval.
    """
    apart = off(fit, description(REPLAY / "tx40" / "robot.toml"))
    return float(apart[np.isin(fit.estimate.names, fit.essential.names)].max())


def fits(runs: Runs, robot: Robot) -> Iterator[Evidence]:
    for run in range(len(runs.q)):
        yield identify_iv(runs.signals(without_parameters(robot), run), Overrides(), Iteration())


def test_unknown_loop_with_noise(whole):
    """TX40, recorded reference, 50 µrad of noise in a PI loop, a disturbance of 5 %: settles,
    within five half-widths.
    """
    body, count = plant(REPLAY / "tx40" / "robot.toml", smooth=0.005), 40 if whole else 1
    cell = Imperfections(
        encoder_noise=5e-5, encoder_step=1e-5, torque_noise_percent=3.0, disturbance_percent=5.0
    )
    reference = references(body, range(count), duration_s=8.0 if whole else 4.0, rate_hz=1000.0)
    runs = simulate(body, pi_loop(body, 10.0), reference, cell, substeps=4 if whole else 2)
    found = list(fits(runs, description(REPLAY / "tx40" / "robot.toml")))
    settled = [half_widths_off(fit) for fit in found if fit.status in SETTLED]
    print(
        Counter(fit.status for fit in found),
        f"worst essential parameter {max(settled):.2f} half-widths off",
    )
    assert len(settled) >= 0.95 * count
    assert max(settled) < 5
    assert {(fit.reference, fit.controller) for fit in found} == {("recorded", "found")}


def test_real_record_converges_for_any_cut(tx40, whole):
    """Its start moved through 20 positions by 0 to 5 % of the whole, and of its half, and
    without `[parameters]`; two cuts have a tenth of the samples.

    Simulated with the estimate itself, cuts 14 and 15 of the half have no fixed point: a wrist of
    no inertia does not track.
    """
    signals = signals_of(tx40) if whole else thinned(tx40)
    plain = dataclasses.replace(signals, robot=without_parameters(signals.robot))
    N, every = len(signals.t_s), range(POSITIONS)
    for s, first, cuts in (
        [(signals, 0, every), (signals, N // 2, every), (plain, N // 2, (0, 10, 19))]
        if whole
        else [(signals, N // 2, (14, 15))]
    ):
        starts = (first + int(0.05 * (N - first) * k / (POSITIONS - 1)) for k in cuts)
        found = [identify_iv(cut(s, start, None), Overrides(), Iteration()) for start in starts]
        print(
            Counter(fit.status for fit in found),
            [round(fit.data.first_stage_F, 1) for fit in found],
        )
        assert all(fit.status in SETTLED for fit in found)
        assert len({fit.trust.verdict for fit in found}) == 1
        moves = [
            (np.abs(fit.beta - found[0].beta) / found[0].intervals.half).max() for fit in found
        ]
        assert max(moves) < 1


def test_distance_to_consistent_model_reported():
    """A torque of the wrong sign at the SCARA's elbow: no robot is near, and that is said."""
    path = REPLAY / "scara" / "session.mcap"
    signals, right = signals_of(path), iv_of(path)
    turned = dataclasses.replace(signals, effort=signals.effort * np.array([1.0, -1.0]))
    wrong = identify_iv(turned, Overrides(), Iteration())
    assert {p.kind for p in right.passes} == {"simulated"}
    assert all(p.reason is not None for p in wrong.passes if p.kind != "simulated")
    line = right.trust.line("physically consistent")
    assert (line.level, "chi² = " in line.text) == ("ok", True)
    assert line.value < 10
    line = wrong.trust.line("physically consistent")
    assert line.level == "caution"
    assert line.value > 1000
    # chi-squared of 8 degrees of freedom is above 26.12 in 0.1 % of cases, by any table
    assert "above the 0.1 % limit of 26.1" in line.text
    assert ls_of(path).trust.line("physically consistent").level == "ok"
