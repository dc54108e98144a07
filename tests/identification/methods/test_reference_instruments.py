"""Instruments along the motion that the recorded reference predicts, where no simulated
robot confirms others.

Here no simulated robot is ever confirmed: a tracking error of 0 % is asked of it.
"""

import dataclasses
from functools import cache

import crossed_recordings as crossings
import numpy as np
import pytest
from conftest import REPLAY
from described_truth import off
from independent_robots import plant
from independent_simulator import (
    Imperfections,
    Runs,
    described_controller,
    description,
    references,
    simulate,
    without_control_law,
    without_settings,
)

from identification.data import Signals
from identification.regression import FilteredMotion, Overrides, make_problem
from identification.results import Evidence, fit_document, fit_file, identify
from identification.simulation.instruments import predicted_motion

HELD = Overrides(torque_lag_s=-0.0005)  # the command of a tick, held until the next


NO_TRACKING = "identification.methods.solution.MAX_TRACKING_PERCENT", 0.0


@pytest.fixture
def unconfirmed(monkeypatch):
    monkeypatch.setattr(*NO_TRACKING)


@cache
def axis_runs() -> Runs:
    """The EMPS with 20 µm of noise fed back through its loop, twice."""
    body = plant(REPLAY / "emps" / "robot.toml")
    cell, controller = (
        Imperfections(torque_noise_percent=2.0, encoder_noise=20e-6),
        described_controller(body),
    )
    return simulate(
        body,
        controller,
        references(body, range(2), duration_s=10.0, rate_hz=controller.rate_hz),
        cell,
        substeps=2,
    )


def axis_signals(*, law: bool = False) -> list[Signals]:
    robot = without_settings(description(REPLAY / "emps" / "robot.toml"))
    return [axis_runs().signals(robot if law else without_control_law(robot), k) for k in range(2)]


def stands_alone(fit: Evidence) -> bool:
    return fit.passes[fit.solution.returned - 1].by_reference is not None


@pytest.fixture(scope="module")
def fits():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(*NO_TRACKING)
        return [identify(signals, HELD) for signals in axis_signals()]


def test_ls_biased_by_loop_noise_iv_not(fits):
    assert {fit.status for fit in fits} == {"converged"}
    assert all(map(stands_alone, fits))
    true = description(REPLAY / "emps" / "robot.toml").parameters["M1"]
    M = np.array([fit.beta[0] for fit in fits]) / true - 1
    by_ls = np.array([fit.full.beta[0] for fit in fits]) / true - 1
    assert abs(M.mean()) < 0.01
    assert (by_ls < -0.05).all()
    assert np.mean([off(fit) < 1 for fit in fits]) > 0.85


def test_reason_reported_no_law_assumed(fits):
    fit, alone = fits[0], "instruments from the reference"
    assert fit.solution.reason.startswith(alone)
    assert alone in fit_document(fit_file(fit)).title
    line = fit.trust.line("convergence")
    assert (line.level, alone in line.text) == ("ok", True)
    assert "control law" not in [one.what for one in fit.trust.assumed]
    file = fit_file(fit)
    assert (file.status, file.reason, file.iterations[-1].instruments) == (
        "converged",
        fit.solution.reason,
        "reference",
    )
    assert file.pass_returned == len(file.iterations)
    assert np.isfinite(fit.data.lags[0].value_s)


@pytest.mark.parametrize("reference", [True, False])
def test_nothing_confirmed_without_usable_reference(unconfirmed, reference):
    signals = axis_signals(law=reference)[0]
    fit = identify(
        signals if reference else dataclasses.replace(signals, q_ref=None), HELD, method="iv"
    )
    assert (fit.status, stands_alone(fit)) == ("not_confirmed", False)
    assert fit.trust.line("convergence").level == "caution"


def test_torque_delay_found(unconfirmed, fits):
    signals = axis_signals()[0]
    found = identify(
        dataclasses.replace(signals, effort=np.roll(signals.effort, 3, axis=0)), Overrides()
    )
    assert stands_alone(found)
    (lag,) = found.data.lags
    assert abs(lag.value_s - 0.0025) < lag.half_width_s < 0.0015
    assert (np.abs(found.beta - fits[0].beta) < found.intervals.half).all()


@pytest.mark.parametrize("most", [50_000, 700])
def test_error_within_terms_fully_predicted(monkeypatch, most):
    """q - r = -c(r) late, of two joints; the span does not end with the recording."""
    monkeypatch.setattr("identification.simulation.instruments.MOST_SAMPLES", most)
    monkeypatch.setattr("identification.simulation.instruments.DESIGN_SAMPLES", 640)
    signals = crossings.recorded(frozenset(), frozenset({"reference"}), 1)
    r, fs = signals.q_ref, crossings.RATE_HZ
    dr = np.gradient(r, 1 / fs, axis=0)
    late = [np.maximum(np.arange(len(r)) - round(d * fs), 0) for d in (0.02, 0.1)]
    force = 0.003 * np.cos(r[late[0], 0] + r[late[0], 1])
    friction = np.tanh(dr[late[1]] / (0.05 * np.abs(dr).max(axis=0)))
    q = r - 0.02 * dr[late[0]] + force[:, None] - 0.001 * friction
    problem = make_problem(dataclasses.replace(signals, q=q), Overrides(method="iv"))
    span = slice(problem.settings.start, problem.settings.stop)
    at = span.start, span.stop, problem.settings.cutoff_hz
    predicted, true = (
        predicted_motion(problem).between(*at),
        FilteredMotion(problem.signals).between(*at),
    )
    for x, y in ((predicted.q, true.q), (predicted.dq, true.dq), (predicted.ddq, true.ddq)):
        assert (np.abs(x - y).max(axis=0) < 1e-3 * np.std(y, axis=0)).all()
