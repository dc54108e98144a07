"""The package's simulation of an experiment against the independent simulator: same instants, same law, same motion."""

import numpy as np
import pytest
from conftest import REPLAY
from independent_robots import plant
from independent_simulator import Imperfections, described_controller, description, references, simulate

from identification.model.base import base_parameters
from identification.model.inverse import InverseModel
from identification.regression.problem import make_problem
from identification.regression.settings import Overrides
from identification.replica.experiment import make_experiment
from identification.replica.instruments import simulated_motion
from identification.study.synthetic import truth


@pytest.mark.parametrize("name", ["scara", "emps"])
def test_the_simulated_motion_is_that_of_the_robot_without_noise(name):
    """With the true parameters only friction near standstill differs: far less than one sample of delay would."""
    toml = REPLAY / name / "robot.toml"
    body = plant(toml, smooth=0.002)
    reference = references(body, range(1), duration_s=3.0, rate_hz=1000.0)
    runs = simulate(body, described_controller(body), reference, Imperfections())
    robot = description(toml)
    signals = runs.signals(robot, 0)
    dynamics = InverseModel(robot)
    true = truth(dynamics, base_parameters(dynamics))
    e = make_experiment(make_problem(signals, Overrides()), true)
    at = np.rint(e.times_s * 1000).astype(int)
    np.testing.assert_allclose(e.times_s, at / 1000, atol=1e-9)
    np.testing.assert_allclose(e.reference.q, reference.q[0, at], atol=1e-12)
    inner = slice(1, -1)  # differences are one-sided at the ends
    np.testing.assert_allclose(
        e.reference.dq[inner], reference.dq[0, at[inner]], atol=1e-3 * np.abs(reference.dq).max()
    )
    grid = np.rint(e.grid_s * 1000).astype(int)
    found = simulated_motion(e, true)
    assert found.motion is not None
    for one, other, slope in (
        (found.motion.q, runs.q_true[0, grid], np.abs(runs.dq_true)),
        (found.motion.dq, runs.dq_true[0, grid], np.abs(reference.ddq)),
    ):
        off = np.sqrt(np.mean((one - other) ** 2, axis=0))
        sample = 1e-3 * np.sqrt(np.mean(slope[0] ** 2, axis=0))
        assert (off < 0.2 * sample).all(), off / sample
    # The command of a tick is held after it: the torque of the same instants is the recorded one.
    tau, recorded = found.motion.tau, runs.effort[0, grid]
    assert (np.linalg.norm(tau - recorded, axis=0) < 0.02 * np.linalg.norm(recorded, axis=0)).all()
