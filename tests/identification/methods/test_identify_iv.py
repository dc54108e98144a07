"""Instrumental variables: on the real recordings, on simulated robots with known parameters, and where things go wrong."""

import dataclasses
import json
from functools import cache

import msgspec
import numpy as np
import pytest
import scipy.io
from command_runs import refused
from conftest import REPLAY, needs_data, robot_named
from fits_of_records import iv_of, ls_of, signals_of

from acquisition.robot import Robot, load_robot
from identification.commands import main
from identification.data import Signals, load_signals
from identification.errors import BadInputError, RobotIdimError
from identification.methods import Fit, Iteration, identify_iv, identify_ls
from identification.model import InverseModel, base_parameters, described_parameters, direct_model, why_not_positive
from identification.regression import Overrides
from identification.simulation import recorded_loop
from identification.study import Noise, closed_loop, random_reference

RAW = Overrides(cutoff_hz=0)
SERIES = "t_s", "q", "q_ref", "effort"
SCARA = REPLAY / "scara" / "session.mcap"


def error_percent(beta: np.ndarray, true: np.ndarray) -> float:
    return float(100 * np.linalg.norm(beta - true) / np.linalg.norm(true))


def scaled(values: dict[str, float]) -> Iteration:
    """Start from given base parameters."""
    return Iteration(start="given", values=lambda base: np.array([values.get(n, 0.0) for n in base.names]))


# Real recordings


def test_emps_converges_from_anywhere_to_the_same_answer(emps):
    starts = (scaled({"M1": 1.0}), scaled({"M1": 1000.0}), Iteration(start="ls"))
    fits = [*(identify_iv(signals_of(emps), Overrides(), iteration) for iteration in starts), iv_of(emps)]
    for fit in fits:
        assert (fit.status, fit.iv.reference, fit.iv.controller) == ("converged", "recorded", "described")
        assert len(fit.iv.passes) <= 4
        np.testing.assert_allclose(fit.beta, fits[0].beta, rtol=5e-4)
    half = fits[0].intervals.high - fits[0].beta
    assert (np.abs(fits[0].beta - [95.1089, 203.5034, 20.3935, -3.1648]) < half).all()
    assert (half < [0.6, 20, 1.5, 0.7]).all()


def test_emps_without_a_filter_gives_the_same(emps):
    raw = identify_iv(signals_of(emps), RAW, Iteration())
    assert raw.status == "converged"
    np.testing.assert_allclose(raw.beta, iv_of(emps).beta, rtol=3e-3)


def test_tx40_converges_in_three_passes_as_in_the_paper(tx40):
    fit, ls = iv_of(tx40), ls_of(tx40)
    assert (fit.status, len(fit.beta)) == ("converged", 60)
    assert len(fit.iv.passes) <= 4
    assert (fit.iv.reference, fit.iv.controller, fit.iv.start) == ("surrogate", "surrogate", "regular")
    assert any("not strictly exogenous" in text for text in fit.warnings)
    inertial = [i for i, name in enumerate(fit.base.names) if not name.startswith(("Fv", "Fc", "Off"))]
    assert (np.abs(fit.beta - ls.beta)[inertial] < 1.5 * ls.intervals.half[inertial]).all()
    assert fit.iv.tests.first_stage_F > 10


def test_without_the_gain_update_the_first_instruments_of_the_tx40_are_along_the_reference(tx40):
    fit = identify_iv(signals_of(tx40), Overrides(), Iteration(gain_update=False))
    # A wrist of 1 kg m² under gains set for 0.01 kg m² does not follow: only along the reference does the method go on.
    first = fit.iv.passes[0]
    assert first.z.kind == "reference"
    assert "the simulated robot leaves its reference at joint 6" in first.z.reason
    updated = iv_of(tx40)
    assert all(p.z.kind == "simulated" for p in updated.iv.passes)
    assert updated.iv.passes[0].z.tracking_percent < 5
    # Nor are the gains updated for the last simulation, that of the result.
    assert not np.array_equal(fit.replica.motion.q, updated.replica.motion.q)


def test_fewer_instrument_samples_leave_the_estimate_where_it_is(tx40, monkeypatch):
    """All rows are used: which of them are slow turns on single samples, with either rate."""
    signals = signals_of(tx40)
    to_the_end = Iteration(start="ls", tolerance_percent=0.01, max_iterations=6)
    every_row = Overrides(low_speed_percent=0.0)
    coarse = identify_iv(signals, every_row, to_the_end)
    monkeypatch.setattr("identification.simulation.instruments.RATE_PER_BANDWIDTH", 500.0)
    fine = identify_iv(signals, every_row, to_the_end)
    assert len(fine.replica.q) == pytest.approx(5 * len(coarse.replica.q), rel=0.01)
    assert (np.abs(coarse.beta - fine.beta) < 0.1 * fine.estimate.sigma).all()


# Simulated robots


def true_of(robot: Robot) -> np.ndarray:
    dynamics = InverseModel(robot)
    return described_parameters(dynamics, base_parameters(dynamics))


def simulated(name: str, noise: Noise, seed: int) -> tuple[Signals, np.ndarray]:
    """10 s of a described robot, and its base parameters."""
    robot = robot_named(name)
    q_ref = random_reference(robot, duration_s=10.0, sample_rate_hz=1000.0, seed=seed)
    return closed_loop(robot, q_ref, 1000.0, noise=noise, seed=seed), true_of(robot)


def test_simulated_tx40_gives_the_truth_where_least_squares_does_not():
    signals, true = simulated("tx40", Noise(encoder_step=1e-5, position=1.7e-5, effort_percent=3.0), 5)
    fit = identify_iv(signals, RAW, Iteration())
    ls = identify_ls(signals, dataclasses.replace(RAW, low_speed_percent=0.0))  # of all rows
    assert (fit.status, fit.iv.reference) == ("converged", "recorded")
    off = np.abs(fit.beta - true) / fit.intervals.half
    assert (off < 1.5).mean() >= 58 / 60
    assert off.max() < 2.5
    assert error_percent(fit.beta, true) < 0.5 * error_percent(ls.beta, true)


def test_scara_with_a_wrong_filter_and_with_the_tuned_one():
    signals, true = simulated("scara", Noise(position=1e-4, effort_percent=2.0), 3)
    # The wrong filter: none. Then, worse, rows at the full rate, with all the noise of the acceleration in W.
    for wrong, bias, right in ((RAW, 2.0, 0.5), (Overrides(cutoff_hz=0, decimation=1), 90.0, 5.0)):
        ls = identify_ls(signals, dataclasses.replace(wrong, low_speed_percent=0.0))
        iv = identify_iv(signals, wrong, Iteration())
        # In all that noise the instruments say nothing of the viscous friction any more, and the status says so.
        assert iv.status == ("converged" if wrong is RAW else "diverged")
        assert (iv.iv.tests.first_stage_F > 1) == (wrong is RAW)
        assert error_percent(ls.beta, true) > bias
        assert error_percent(iv.beta, true) < right
    ls, iv = identify_ls(signals, Overrides()), identify_iv(signals, Overrides(), Iteration())
    assert error_percent(ls.beta, true) < 1
    assert error_percent(iv.beta, ls.beta) < 1


@cache
def emps_simulated() -> Signals:
    """The axis of the published digits along the reference of its record, without noise."""
    q_ref = scipy.io.loadmat(needs_data("emps", "DATA_EMPS.mat"))["qg"]
    return closed_loop(robot_named("emps"), q_ref, 1000.0, noise=Noise(), seed=0)


def emps_like(position_noise: float, seed: int) -> Signals:
    exact = emps_simulated()
    noise = position_noise * np.random.default_rng(seed).standard_normal(exact.q.shape)
    return dataclasses.replace(exact, q=exact.q + noise)


def test_noise_that_biases_least_squares_does_not_bias_instruments():
    """Figures measured before on this axis: 2 µm, neither filtered nor decimated: M by LS -81 %, by IV +0.3 %; 20 µm at the
    tuned filter: LS -17 %, IV +0.6 %."""
    true = 95.1089
    unfiltered = Overrides(cutoff_hz=0, decimation=1)
    for noise, overrides, least, most in ((2e-6, unfiltered, -95, -70), (20e-6, Overrides(), -20, -12)):
        signals = emps_like(noise, seed=1)
        ls, iv = identify_ls(signals, overrides), identify_iv(signals, overrides, Iteration())
        assert least < 100 * (ls.beta[0] / true - 1) < most
        assert abs(100 * (iv.beta[0] / true - 1)) < 1.0


def test_low_speed_rows_bias_friction_unless_left_out():
    """20 µm of noise, no filter: with all rows Fv is 20 to 30 % low and Fc as much high; without slow rows neither is."""
    bias = {0.0: [], None: []}
    for seed in range(2):
        signals = emps_like(20e-6, seed)
        for low in bias:
            fit = identify_iv(signals, Overrides(cutoff_hz=0, low_speed_percent=low), Iteration(start="ls"))
            bias[low].append(100 * (fit.beta[1:3] / np.array([203.5034, 20.3935]) - 1))
    with_all, without = np.mean(bias[0.0], axis=0), np.mean(bias[None], axis=0)
    assert with_all[0] < -15
    assert with_all[1] > 15
    assert (np.abs(without) < 5).all()


# Where things go wrong


@cache
def with_torque_of_the_wrong_sign() -> Fit:
    signals = signals_of(SCARA)
    return identify_iv(dataclasses.replace(signals, effort=-signals.effort), Overrides(), Iteration())


def test_a_converged_fit_has_a_positive_inertia_matrix_and_one_that_has_not_is_not_called_so():
    signals, fit = signals_of(SCARA), iv_of(SCARA)
    idm = InverseModel(signals.robot)
    assert fit.status == "converged"
    assert why_not_positive(direct_model(idm, fit.base.standard_parameters(fit.beta)).inertia(signals.q[::500])) is None
    # A torque of the wrong sign gives inertias below zero: nothing may be called converged.
    wrong = with_torque_of_the_wrong_sign()
    assert wrong.status == "not_confirmed"
    assert "inertia matrix is not positive" in wrong.iv.reason
    assert all(p.z.kind != "simulated" or p.z.reason is None for p in wrong.iv.passes)


def test_too_few_passes_are_called_what_they_are():
    signals = signals_of(SCARA)
    fit = identify_iv(signals, Overrides(), Iteration(max_iterations=1))
    assert fit.status == "max_iterations"
    assert fit.iv.reason == "after 1 passes only the start is known"
    # One pass on the parameters hardly change; held to a tolerance that nothing meets, they do not settle either.
    for tolerance, told in ((1e-9, " still changes by "), (30.0, None)):
        fit = identify_iv(signals, Overrides(), Iteration(max_iterations=2, tolerance_percent=tolerance))
        assert (fit.iv.reason is None) == (told is None)
        assert fit.iv.passes[-1].residual_settled == (told is None)


def test_a_reference_of_another_recording_is_refused():
    signals = signals_of(SCARA)
    foreign = dataclasses.replace(signals, q_ref=np.array(signals.q_ref[::-1]))
    with pytest.raises(BadInputError, match="expected the reference of this recording"):
        identify_iv(foreign, Overrides(), Iteration())


def test_recordings_of_few_samples_are_fitted():
    """At 40 Hz, 8 times the bandwidth, the rule's cut-off is beyond half the rate; 2 s unfiltered are shorter than borders."""
    signals, true = simulated("scara", Noise(position=1e-6, effort_percent=1.0), 3)
    thinned = {name: getattr(signals, name)[::25] for name in SERIES}  # the controller still runs at the full rate
    slow = identify_iv(dataclasses.replace(signals, sample_rate_hz=40.0, **thinned), Overrides(), Iteration())
    assert slow.settings.cutoff_hz is None
    assert any("no low-pass" in text for text in slow.warnings)
    assert slow.status == "converged"
    assert error_percent(slow.beta, true) < 5
    short = dataclasses.replace(signals, **{k: getattr(signals, k)[3000:4250] for k in SERIES})
    fit = identify_iv(short, RAW, Iteration())
    assert fit.status == "converged"
    assert error_percent(fit.beta, true) < 10
    with pytest.raises(RobotIdimError, match="30 decimated rows"):
        identify_ls(short, Overrides())


def test_a_controller_too_slow_for_the_recording_is_refused():
    signals = signals_of(SCARA)
    slow = msgspec.structs.replace(signals.robot.controller, sample_rate_hz=1.0)
    robot = dataclasses.replace(signals.robot, controller=slow)
    with pytest.raises(BadInputError, match=r"controller.sample_rate_hz = 1: .* expected at least 30"):
        identify_iv(dataclasses.replace(signals, robot=robot), Overrides(), Iteration())


def test_gains_tell_the_inertias_where_least_squares_has_none():
    """A torque of the wrong sign leaves least squares without positive inertias: Kp = J w² then gives those of the gains."""
    robot, fit = signals_of(SCARA).robot, with_torque_of_the_wrong_sign()
    c = robot.controller
    assert any("those that suit the described gains at 5 Hz" in text for text in fit.warnings)
    J = np.array(c.position_gain) / (2 * np.pi * c.bandwidth_hz) ** 2
    np.testing.assert_allclose(recorded_loop(robot).inertias(c.bandwidth_hz), J)
    # From the regular start, 1 kg m² of each motor, the first gains are 1/J and a joint's share.
    assert (fit.iv.passes[0].z.gains >= 1 / J - 1e-9).all()


def test_a_saturated_drive_is_reported(emps):
    signals = signals_of(emps)
    motor = msgspec.structs.replace(signals.robot.motors[0], saturation=2.0)
    robot = dataclasses.replace(signals.robot, motors=(motor,))
    fit = identify_iv(dataclasses.replace(signals, robot=robot), Overrides(), Iteration())
    assert fit.iv.saturated_percent > 1
    assert any(text.startswith("drives at their limit: motor (2 V) in") for text in fit.warnings)


def test_command_line(capsys, tmp_path):
    session, out = SCARA, tmp_path / "iv.json"
    assert main(["fit", str(session), "--method", "iv", "--all", "--json", str(out)]) == 0
    text = capsys.readouterr().out
    assert "passes from start: regular" in text
    assert "status: converged" in text
    fit = json.loads(out.read_text())
    assert (fit["status"], fit["reference"], fit["method"]) == ("converged", "recorded", "iv")
    keys = {"residual_norm", "largest_change_sigma", "gains", "tracking_error_percent", "condition_number_ztw"}
    assert all(keys <= set(p) for p in fit["iterations"])
    # From its own result the method is settled in the pass after the start.
    again = tmp_path / "again.json"
    assert main(["fit", str(session), "--method", "iv", "--start", str(out), "--json", str(again)]) == 0
    assert len(json.loads(again.read_text())["iterations"]) <= 2
    other = tmp_path / "other.json"
    other.write_text(out.read_text().replace("ZZ1R", "XX9"))
    for start, words in ((other, "parameters = 'XX9': expected those of"), ("nowhere.json", "cannot be read")):
        assert words in refused(capsys, "fit", session, "--method", "iv", "--start", start)


def test_gains_of_the_wrong_length_or_sign_are_refused(capsys, tmp_path):
    robot = tmp_path / "robot.toml"
    text = (REPLAY / "scara" / "robot.toml").read_text()
    session = SCARA
    for wrong, message in (
        ("position_gain = [3700.0]", "controller.position_gain = [3700.0]: expected 2 numbers, one per motor"),
        ("position_gain = [3700.0, -60.0]", "expected positive numbers"),
        ("", "controller: position_gain is missing"),
    ):
        robot.write_text("\n".join(wrong if line.startswith("position_gain") else line for line in text.splitlines()))
        assert message in refused(capsys, "fit", session, "--method", "iv", "--robot", robot)


def test_study_reports_both_methods(capsys, tmp_path):
    out = tmp_path / "study.json"
    robot = str(REPLAY / "scara" / "robot.toml")
    assert main(["study", robot, "--runs", "4", "--position-noise", "5e-6", "--json", str(out)]) == 0
    told = capsys.readouterr().out
    assert "SCARA: 4 runs" in told
    assert "cell: position 5e-06, effort_percent 2" in told
    study = json.loads(out.read_text())
    assert [r["number"] for r in study["runs"]] == [0, 1, 2, 3]
    assert [s["method"] for s in study["summaries"]] == ["wls", "iv"]
    for s, kind in zip(study["summaries"], ("ls", "iv"), strict=True):
        fits = [r[kind] for r in study["runs"]]
        low, high, beta = (np.array([one[name] for one in fits]) for name in ("low", "high", "beta"))
        inside = (low <= study["true"]) & (study["true"] <= high)
        assert s["coverage_percent"] == pytest.approx(100 * inside.mean())
        assert s["coverage_percent"] > 80
        bias = beta.mean(axis=0) - study["true"]
        assert s["bias_percent"] == pytest.approx(100 * np.linalg.norm(bias) / np.linalg.norm(study["true"]))
        assert s["bias_percent"] < 0.2
        assert s["runs"] == 4
    for run in study["runs"]:
        assert run["status"] == "converged"
        assert run["iv"]["positive"]
        assert run["iv"]["error"] < 0.005


def test_a_study_in_which_nothing_converges_says_so(capsys, tmp_path):
    out, robot = tmp_path / "study.json", str(REPLAY / "scara" / "robot.toml")
    command = ["study", robot, "--runs", "2", "--duration-s", "2", "--json", str(out)]
    assert main([*command, "--report", str(tmp_path / "s.html"), "--position-noise", "0.05"]) == 0
    told = capsys.readouterr().out
    assert "iv" in told
    summaries = {s["method"]: s for s in json.loads(out.read_text())["summaries"]}
    assert summaries["wls"]["runs"] == 2
    assert (summaries["iv"]["runs"], summaries["iv"]["coverage_percent"]) == (0, None)
    assert (tmp_path / "s.html").stat().st_size > 1000
    told = refused(capsys, "study", robot, "--runs", "2", "--rate-hz", "500")
    assert "no run can be fitted: robot SCARA: controller.sample_rate_hz = 1000: expected 500" in told


def test_robot_whose_law_nobody_tells_uses_a_surrogate_and_says_so(monkeypatch):
    monkeypatch.setattr("identification.methods.observation.law_of", lambda problem: None)
    robot = load_robot(REPLAY / "scara" / "robot.toml")
    law = dict.fromkeys(("structure", "position_gain", "velocity_gain", "sample_rate_hz"))
    bare = msgspec.structs.replace(robot.controller, **law)
    signals = load_signals(SCARA, dataclasses.replace(robot, controller=bare))
    fit = identify_iv(signals, Overrides(), Iteration())
    assert (fit.status, fit.iv.controller, fit.iv.reference) == ("converged", "surrogate", "recorded")
    assert any("simulated with a 5 Hz PD" in text for text in fit.warnings)
