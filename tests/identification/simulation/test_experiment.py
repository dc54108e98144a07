"""The package's simulation of an experiment against the independent simulator: same instants,
same law, same motion.
"""

import numpy as np
import pytest
from conftest import REPLAY
from independent_robots import plant
from independent_simulator import (
    Imperfections,
    described_controller,
    description,
    references,
    simulate,
)

from identification.data import load_signals
from identification.estimation import (
    SPANS,
    instrumental_variables,
    intervals,
    intervals_of,
    weighted_least_squares,
)
from identification.model import InverseModel, base_parameters, described_parameters
from identification.regression import Overrides, make_problem, row_blocks, rows_of_recording
from identification.simulation.experiment import Experiment
from identification.simulation.instruments import simulate_instruments


@pytest.mark.parametrize("name", ["scara", "emps"])
def test_the_simulated_motion_is_that_of_the_robot_without_noise(name):
    toml = REPLAY / name / "robot.toml"
    body = plant(toml, smooth=0.002)
    reference = references(body, range(1), duration_s=3.0, rate_hz=1000.0)
    runs = simulate(body, described_controller(body), reference, Imperfections(), substeps=1)
    robot = description(toml)
    signals = runs.signals(robot, 0)
    dynamics = InverseModel(robot)
    true = described_parameters(dynamics, base_parameters(dynamics))
    e = Experiment(make_problem(signals, Overrides()), true)
    places, followed = e.places(0, e.instants), e.reference(0, e.instants)
    at = np.rint(places).astype(int)
    np.testing.assert_allclose(places, at, atol=1e-6)
    np.testing.assert_allclose(followed.q, reference.q[0, at], atol=1e-12)
    inner = slice(1, -1)  # differences are one-sided at the ends
    np.testing.assert_allclose(
        followed.dq[inner], reference.dq[0, at[inner]], atol=1e-3 * np.abs(reference.dq).max()
    )
    (found,) = simulate_instruments(e, true, true, None).replicas
    assert found.motion is not None
    grid = np.rint(found.motion.t_s * 1000).astype(int)
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


def test_blocks_of_a_long_recording_give_what_its_rows_give(monkeypatch):
    signals = load_signals(REPLAY / "scara" / "session.mcap")
    problem = make_problem(signals, Overrides(decimation=5))
    whole = rows_of_recording(problem)
    full = weighted_least_squares(whole.system)
    spread = 4 * full.covariance
    e = Experiment(problem, full.beta)
    one = simulate_instruments(e, full.beta, full.beta, spread)
    wanted = instrumental_variables(whole.system, one.Z, full.weights)
    rho = wanted.weights[whole.system.joint_of_row] * (
        whole.system.Y - whole.system.W @ wanted.beta
    )
    monkeypatch.setattr("identification.regression.problem._SERIES_BLOCK", 1)
    assert len(row_blocks(problem)) == 3
    e = Experiment(problem, full.beta)
    short = simulate_instruments(e, full.beta, full.beta, spread)
    np.testing.assert_allclose(short.Z, one.Z, atol=1e-9 * np.abs(one.Z).max())
    errors = ([joint.torque_error_percent for joint in x.replicas[0].direct] for x in (short, one))
    assert next(errors) == pytest.approx(next(errors), rel=1e-6)
    np.testing.assert_allclose(short.replicas[0].motion.q, one.replicas[0].motion.q, atol=1e-9)
    e = Experiment(problem, full.beta, spans=SPANS)
    long = simulate_instruments(e, full.beta, full.beta, spread)
    assert len(long.rows[0].Z) < len(one.Z)
    found = instrumental_variables(long.rows[0].system, long.rows[0].Z, full.weights)
    assert np.abs((found.beta - wanted.beta) / wanted.sigma).max() < 1e-6
    np.testing.assert_allclose(
        found.covariance, wanted.covariance, rtol=1e-6, atol=1e-9 * wanted.covariance.max()
    )
    assert (found.rows, found.residual_norm) == pytest.approx(
        (wanted.rows, wanted.residual_norm), rel=1e-9
    )
    assert long.tracking_percent == pytest.approx(one.tracking_percent, rel=1e-6)
    # Intervals, of spans that count as instants.
    of_spans = intervals_of(long.rows[0].system, found)
    of_rows = intervals(wanted, rho * whole.system.used, whole.system.joint_of_row[-1] + 1)
    np.testing.assert_allclose(of_spans.sigma, of_rows.sigma, rtol=0.15)
    assert of_spans.freedom == of_rows.freedom


def test_a_pass_whose_inertia_matrix_is_not_positive():
    """The SCARA's elbow with an inertia below zero, within its interval: the nearest robot is
    simulated, and tracks.
    """
    signals = load_signals(REPLAY / "scara" / "session.mcap")
    problem = make_problem(signals, Overrides())
    dynamics = InverseModel(signals.robot)
    true = described_parameters(dynamics, base_parameters(dynamics))
    e = Experiment(problem, true)
    wrong = np.where(np.array(problem.base.names) == "ZZ2", -0.002, true)
    spread = np.diag(np.where(wrong == true, 0.01 * np.abs(true) + 1e-4, 0.05) ** 2)
    consistent = simulate_instruments(e, wrong, wrong, spread)
    assert (consistent.kind, consistent.tracking_percent < 5) == ("consistent", True)
    assert "inertia matrix is not positive" in consistent.reason
    np.testing.assert_array_equal(consistent.x, wrong)
    plain = simulate_instruments(e, wrong, wrong, None)
    assert (plain.kind, plain.tracking_percent) == ("reference", None)
    right = simulate_instruments(e, true, true, spread)
    assert (right.kind, right.reason) == ("simulated", None)
    assert [bool(one.replicas[0].direct) for one in (consistent, plain, right)] == [
        True,
        False,
        True,
    ]
