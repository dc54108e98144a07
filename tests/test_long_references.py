"""Long simulated recordings repeat their reference: they excite as well as ten seconds do."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from conftest import robot_named

from identification.methods import Iteration, identify_iv
from identification.model import InverseModel, base_parameters
from identification.regression import Overrides
from identification.study import Noise, closed_loop, random_reference, study_truth
from identification.study.simulated_cell import periodic_reference

LONG = (10.0, 300.0, 3600.0)


def condition(name: str, duration_s: float) -> float:
    """Of the regressor along the reference, 20 samples a second."""
    robot = robot_named(name)
    t_s = np.arange(round(20 * duration_s)) / 20
    motion = periodic_reference(robot, duration_s=duration_s, seed=1).at(t_s)
    model = InverseModel(robot)
    W = model.regressor(*motion)[:, :, base_parameters(model).columns].reshape(-1, base_parameters(model).b)
    return float(np.linalg.cond(W))


@pytest.mark.parametrize("name", ["emps", "scara"])
def test_five_minutes_and_an_hour_excite_as_ten_seconds_do(name):
    conditions = [condition(name, duration_s) for duration_s in LONG]
    assert conditions[0] < 25
    np.testing.assert_allclose(conditions, conditions[0], rtol=0.02)


def test_whole_periods_of_about_the_length_asked_for():
    robot = robot_named("scara")
    for duration_s, period_s, expected in ((4.0, 10.0, 4.0), (12.0, 10.0, 12.0), (24.0, 10.0, 12.0), (24.0, 6.0, 6.0)):
        reference = periodic_reference(robot, duration_s=duration_s, seed=1, period_s=period_s)
        assert reference.period_s == expected
        q, dq, _ = reference.at(np.array([0.0, duration_s]))
        np.testing.assert_allclose(q[0], q[1], atol=1e-12)
        np.testing.assert_allclose(dq, 0.0, atol=1e-9)
    q = random_reference(robot, duration_s=30.0, sample_rate_hz=100.0, seed=1)
    np.testing.assert_allclose(q[:1001], q[2000:], atol=1e-12)


@pytest.mark.slow
def test_five_minutes_by_iv_converge():
    """One period as long as the recording: `diverged`."""
    robot = robot_named("scara")
    slow = msgspec.structs.replace(
        robot.controller, structure=None, sample_rate_hz=None, position_gain=None, velocity_gain=None,
        velocity_estimate=None, bandwidth_hz=1.0,
    )  # fmt: skip
    robot = replace(robot, controller=slow)
    q_ref = random_reference(robot, duration_s=300.0, sample_rate_hz=100.0, seed=1)
    signals = closed_loop(robot, q_ref, 100.0, noise=Noise(encoder_step=1e-5, effort_percent=2.0), seed=1)
    fit = identify_iv(signals, Overrides(), Iteration())
    true = study_truth(robot)[1]
    assert fit.status == "converged"
    assert np.linalg.norm(fit.beta - true) < 0.02 * np.linalg.norm(true)
