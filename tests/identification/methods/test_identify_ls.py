"""Least squares on simulated robots whose parameters are known, and its statistics."""

import dataclasses

import numpy as np
import pytest
from conftest import REPLAY, described_chi, robot_named
from described_truth import off
from fits_of_records import ls_of

from acquisition.robot import fourier_reference
from identification.data import Signals, signals_from_arrays
from identification.errors import BadInputError, NoFitError
from identification.estimation import System, ordinary_least_squares, weighted_least_squares
from identification.model import InverseModel, base_parameters, described_parameters
from identification.regression import Motion, Overrides, decimation_rule, make_settings


def exact_motion(
    model: InverseModel, *, duration_s: float, sample_rate_hz: float, seed: int
) -> Motion:
    """Motion along a random exciting reference, with the torques of the inverse dynamic model;
    no controller, no noise.
    """
    t_s = np.arange(round(duration_s * sample_rate_hz) + 1) / sample_rate_hz
    q, dq, ddq = fourier_reference(model.robot, period_s=duration_s, seed=seed).at(t_s)
    tau = model.regressor(q, dq, ddq) @ described_chi(model)
    return Motion(t_s=t_s, q=q, dq=dq, ddq=ddq, tau=tau)


@pytest.mark.parametrize(
    ("name", "count", "solve"),
    [
        ("scara", 8, ordinary_least_squares),
        ("scara", 8, weighted_least_squares),
        ("tx40", 60, weighted_least_squares),
    ],
)
def test_exact_motion_recovers_parameters(name, count, solve):
    dynamics = InverseModel(robot_named(name))
    base = base_parameters(dynamics)
    motion = exact_motion(dynamics, duration_s=20.0, sample_rate_hz=50.0, seed=4)
    W = (
        dynamics.regressor(motion.q, motion.dq, motion.ddq)[:, :, base.columns]
        .transpose(1, 0, 2)
        .reshape(-1, base.b)
    )
    joint_of_row = np.repeat(np.arange(motion.q.shape[1]), len(motion.q))
    estimate = solve(System.whole(W, motion.tau.T.reshape(-1), joint_of_row, base.names))
    true = described_parameters(dynamics, base)
    assert len(true) == count
    # Relative to the parameter, or to its size in the torque's own digits where it is zero.
    scale = np.maximum(np.abs(true), 1e-3 * np.abs(true).max())
    assert (np.abs(estimate.beta - true) / scale).max() < 1e-8
    assert estimate.residual_norm < 1e-8 * np.linalg.norm(motion.tau * estimate.weights)


def test_shipped_recording_recovers_truth():
    fit = ls_of(REPLAY / "scara" / "session.mcap")
    assert (off(fit) < 1.75).all()
    assert fit.errors[-1].moving_relative_error_percent < 1.0


def test_inseparable_parameters_named():
    rng = np.random.default_rng(2)
    W = rng.normal(size=(200, 4))
    W[:, 2] = 2 * W[:, 0]
    problem = System.whole(
        W, rng.normal(size=200), np.zeros(200, dtype=int), ("ZZ1R", "Ia1", "Fv1", "Fc1")
    )
    with pytest.raises(
        NoFitError, match=r"cannot distinguish ZZ1R, Fv1: the rank is 3 for 4 parameters"
    ):
        ordinary_least_squares(problem)


def synthetic_signals(name: str = "scara", seconds: float = 30.0) -> Signals:
    robot = robot_named(name)
    motion = exact_motion(InverseModel(robot), duration_s=seconds, sample_rate_hz=500.0, seed=3)
    noise = 0.02 * np.random.default_rng(1).normal(size=motion.tau.shape)
    signals = signals_from_arrays(motion.q.copy(), motion.tau + noise, 500.0, robot)
    return dataclasses.replace(signals, recording="made.mcap")


def test_non_finite_signals_refused():
    signals = synthetic_signals(seconds=5.0)
    broken = signals.effort.copy()
    broken[70, 1] = np.inf
    with pytest.raises(BadInputError) as told:
        dataclasses.replace(signals, effort=broken)
    assert (told.value.place, told.value.key) == ("made.mcap", "effort[70]")


@pytest.mark.parametrize(
    ("rate_hz", "bandwidth_hz", "n_d"),
    [(1000, 20, 10), (5000, 10, 100), (1000, 10, 20), (100, 40, 1), (3400, 20, 33)],
)
def test_decimation_follows_default(rate_hz, bandwidth_hz, n_d):
    assert decimation_rule(rate_hz, bandwidth_hz) == n_d


def test_low_cutoff_warns_and_options_override():
    signals = synthetic_signals()
    assert make_settings(signals, Overrides()).cutoff_hz == 25.0
    assert make_settings(signals, Overrides()).warnings == ()
    plan = make_settings(signals, Overrides(cutoff_hz=10.0, decimation=7))
    assert (plan.cutoff_hz, plan.decimation) == (10.0, 7)
    assert "less than 5 times the bandwidth of 5 Hz" in plan.warnings[0]
    assert make_settings(signals, Overrides(cutoff_hz=0)).cutoff_hz is None
    (told,) = make_settings(signals, Overrides(decimation=30)).warnings
    assert "keeps 6.66667 Hz, less than twice the bandwidth of 5 Hz" in told
    with pytest.raises(BadInputError, match="cut-off = 300 Hz: expected less than 250 Hz"):
        make_settings(signals, Overrides(cutoff_hz=300.0))
    with pytest.raises(NoFitError, match="needs 60000, for 30 decimated rows"):
        make_settings(signals, Overrides(decimation=2000))


def test_default_segment_is_motion_after_tracking():
    signals = synthetic_signals()
    still = np.repeat(signals.q[:1], 2000, axis=0)
    padded = dataclasses.replace(
        signals,
        t_s=np.arange(len(signals.q) + 4000) / 500.0,
        q=np.concatenate([still, signals.q, np.repeat(signals.q[-1:], 2000, axis=0)]),
        effort=np.concatenate([still, signals.effort, still]),
    )
    plan = make_settings(padded, Overrides())
    assert plan.start == pytest.approx(2000, abs=200)
    assert plan.stop == pytest.approx(2000 + len(signals.q), abs=200)
    # A joint that stands has noise only, all the time: it does not tell when motion begins.
    noise = 1e-5 * np.random.default_rng(2).normal(size=len(padded.q))
    one_stands = dataclasses.replace(padded, q=np.stack([padded.q[:, 0], 0.3 + noise], axis=1))
    stands = make_settings(one_stands, Overrides())
    assert plan.start <= stands.start < plan.start + 500 < stands.stop <= plan.stop
    assert "joint elbow does not move" in stands.warnings
    everything = make_settings(padded, Overrides(span="all"))
    assert (everything.start, everything.stop) == (100, len(padded.q) - 100)
    tracked = make_settings(dataclasses.replace(padded, track=(3000, 9000)), Overrides())
    assert (tracked.start, tracked.stop, tracked.span) == (
        3000,
        9000,
        "the recording's tracking phase",
    )
