"""The package's simulation of a recording against the independent simulator: same instants, same
law, same motion; its blocks, its rows, and what it says where a robot cannot be simulated.
"""

from dataclasses import replace
from functools import partial

import msgspec
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
from scipy.interpolate import CubicSpline

from identification import simulation
from identification.data import load_signals
from identification.estimation import weighted_least_squares
from identification.model import described_parameters
from identification.regression import (
    Overrides,
    equation_alone,
    make_problem,
    row_blocks,
    rows_of_recording,
    rule_cutoff_hz,
)
from identification.simulation import SimulatedRecording


def simulated(problem, prior, x, covariance, **options):
    prepared = partial(SimulatedRecording, problem, None, prior, **options)
    equation, start = equation_alone(problem)
    about = np.r_[x, start[len(x) :]]
    return simulation.simulate(equation, prepared, (about, (x, covariance, np.zeros(len(x)))))


@pytest.mark.parametrize("name", ["scara", "emps"])
def test_noise_free_motion_matches_robot(name):
    toml = REPLAY / name / "robot.toml"
    body = plant(toml, smooth=0.002)
    reference = references(body, range(1), duration_s=3.0, rate_hz=1000.0)
    runs = simulate(body, described_controller(body), reference, Imperfections(), substeps=1)
    problem = make_problem(runs.signals(description(toml), 0), Overrides())
    true = described_parameters(problem.model, problem.base)
    recording = SimulatedRecording(problem, None, true)
    followed = recording.reference(0, recording.instants)
    # Of two instants in a step of the SCARA, their middle.
    m, inner = {"scara": 2, "emps": 1}[name], slice(9, -9)
    places = recording.first + 0.5 * (m - 1) + m * np.arange(recording.instants)
    for one, other, off in (
        (followed.q, reference.q[0], 1e-8),
        (followed.dq, reference.dq[0], 1e-3),
    ):  # differences are one-sided at the ends, splines unlike
        wanted = CubicSpline(np.arange(len(other)), other)(places)
        assert np.abs(one - wanted)[inner].max() < off * np.abs(wanted).max()
    # What is fed forward is held from sample to sample: its mean in a step.
    counted = np.arange(len(problem.signals.q))[:, None] * np.ones(problem.signals.robot.n)
    fed = replace(problem, signals=replace(problem.signals, feedforward=counted))
    mean = SimulatedRecording(fed, None, true).reference(0, recording.instants).feedforward
    np.testing.assert_allclose(mean[inner, 0], places[inner], atol=1e-6)
    found, rows = simulated(problem, true, true, None)
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
    assert (np.linalg.norm(tau - recorded, axis=0) < 5e-3 * np.linalg.norm(recorded, axis=0)).all()
    # Instruments of the true parameters are the regressor of a recording without noise.
    W, Z = rows.system.W, rows.Z[:, : problem.base.b]
    assert (np.linalg.norm(Z - W, axis=0) < 0.03 * np.linalg.norm(W, axis=0)).all()


def test_long_recording_blocks_match_one_block(monkeypatch):
    """All products of columns; the motion that is kept has its instants of the rows."""
    problem = make_problem(load_signals(REPLAY / "scara" / "session.mcap"), Overrides(decimation=5))
    full = weighted_least_squares((whole := rows_of_recording(*equation_alone(problem))).system)
    asked = problem, full.beta, full.beta, 4 * full.covariance
    one, of_one = simulated(*asked)
    monkeypatch.setattr("identification.regression.problem._SERIES_BLOCK", 1)
    assert len(row_blocks(problem)) == 3
    monkeypatch.setattr("identification.simulation.simulated_recording.CHUNK", 700)
    short, blocks = simulated(*asked)
    A, wanted = (np.c_[x.Z, x.system.W, x.system.Y] for x in (blocks, of_one))
    A, wanted = (x / np.linalg.norm(wanted, axis=0) for x in (A, wanted))
    np.testing.assert_allclose(A.T @ A, wanted.T @ wanted, atol=1e-9)
    np.testing.assert_allclose(short.motion.q, one.motion.q, atol=1e-9)
    monkeypatch.setattr("identification.simulation.instruments.MAX_SERIES", 1)
    long, _ = simulated(*asked)
    assert (len(long.motion.q), long.percent) == (
        len(whole.tau),
        pytest.approx(one.percent, rel=0.01),
    )


def test_no_block_has_a_single_row(monkeypatch):
    """Without decimation blocks have no margins; times of a block are told by two of its rows."""
    problem = make_problem(load_signals(REPLAY / "scara" / "session.mcap"), Overrides(decimation=1))
    rows, block = len(problem.settings.instants), "identification.regression.problem._SERIES_BLOCK"
    monkeypatch.setattr(
        block, (rows - 1) * int(problem.model.nonzero[:, problem.base.columns].sum())
    )
    assert [own.stop - own.start for _, own in row_blocks(problem)] == [rows]


def test_iteration_with_indefinite_inertia_matrix():
    """The SCARA's elbow with an inertia below zero, within its interval: the nearest robot is
    simulated, and tracks.
    """
    problem = make_problem(load_signals(REPLAY / "scara" / "session.mcap"), Overrides())
    true = described_parameters(problem.model, problem.base)
    wrong = np.where(np.array(problem.base.names) == "ZZ2", -0.002, true)
    spread = np.diag(np.where(wrong == true, 0.01 * np.abs(true) + 1e-4, 0.05) ** 2)
    consistent, _ = simulated(problem, true, wrong, spread)
    assert (consistent.kind, consistent.percent < 5) == ("consistent", True)
    assert "inertia matrix is not positive" in consistent.reason
    plain, without = simulated(problem, true, wrong, None)
    assert (plain.kind, plain.percent, plain.by_joint) == ("reference", None, ())
    right, _ = simulated(problem, true, true, spread)
    assert (right.kind, right.reason) == ("simulated", None)
    # What cannot be simulated has the motion that the reference predicts: that of nothing asked.
    recording = SimulatedRecording(problem, None, true)  # at a rate that does not depend on it
    _, nothing = simulation.simulate(
        equation_alone(problem)[0], lambda _: recording, (without.x, None)
    )
    np.testing.assert_array_equal(without.Z, nothing.Z)


def test_tracking_errors_match_definition():
    """By definition, against the low-passed recording; a joint that the reference holds has none of
    position. Between the steps of a controller of 700 Hz positions follow the speeds.
    """
    shipped = load_signals(REPLAY / "scara" / "session.mcap")
    q_ref, q = ([1, share] * x for x, share in ((shipped.q_ref, 0), (shipped.q, 0.01)))
    slower = msgspec.structs.replace(shipped.robot.controller, sample_rate_hz=700.0)
    signals = replace(shipped, q=q, q_ref=q_ref, robot=replace(shipped.robot, controller=slower))
    problem, norm = make_problem(signals, Overrides()), np.linalg.norm
    found, _ = simulated(
        problem, *(described_parameters(problem.model, problem.base) * [[1.0], [1.2]]), None
    )
    m, k = found.motion, np.rint(found.motion.t_s * signals.sample_rate_hz).astype(int)
    q = problem.motion.between(k[0], k[-1] + 1, rule_cutoff_hz(signals)).q[k - k[0], 0]
    percent = 100 * norm(m.q[:, 0] - q) / norm(q - q.mean())
    tau = rows_of_recording(*equation_alone(problem)).tau
    decimation = replace(problem.settings.decimator, factor=round(len(k) / len(tau)))
    rho = 100 * norm(decimation.filtered(m.tau.T).T - tau, axis=0) / norm(tau, axis=0)
    each = [(one.position_error_percent, one.torque_error_percent) for one in found.by_joint]
    wanted = [(pytest.approx(percent), pytest.approx(rho[0])), (None, pytest.approx(rho[1]))]
    off = np.abs(np.gradient(m.q, m.t_s, axis=0) - m.dq)[5:-5] / np.abs(m.dq).max(axis=0)
    assert (found.percent, each, off.max() < 0.05) == (pytest.approx(percent), wanted, True)
