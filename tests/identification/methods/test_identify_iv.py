"""Instrumental variables: on the real recordings, on simulated robots with known parameters, and
where things go wrong.
"""

import dataclasses
import json
import re
from functools import cache

import msgspec
import numpy as np
import pytest
from command_runs import refused
from conftest import REPLAY, robot_named
from described_truth import truth_of
from fits_of_records import iv_of, ls_of, signals_of, thinned

from acquisition.robot import robot_from_files
from identification.commands import main
from identification.control import described_law
from identification.data import Signals, load_signals
from identification.errors import BadInputError, RobotIdimError
from identification.estimation import intervals_of, system
from identification.methods import Iteration, solve
from identification.model import (
    direct_model,
    why_not_positive,
)
from identification.regression import Overrides
from identification.results import identify, identify_iv, identify_ls
from identification.study import Noise, closed_loop, random_reference

RAW = Overrides(cutoff_hz=0)
SERIES = "t_s", "q", "q_ref", "effort"
SCARA = REPLAY / "scara" / "session.mcap"


# Real recordings


def test_emps_converges_from_any_start(emps):
    light = Iteration(
        start="given", values=lambda base: np.array([1.0 * (name == "M1") for name in base.names])
    )
    fits = [identify_iv(signals_of(emps), Overrides(), light), iv_of(emps)]
    for fit in fits:
        assert (fit.status, fit.reference, fit.controller) == (
            "converged",
            "recorded",
            "described",
        )
        assert len(fit.passes) <= 4
        np.testing.assert_allclose(fit.beta, fits[0].beta, rtol=5e-4)
    half = fits[0].intervals.high - fits[0].beta
    assert (np.abs(fits[0].beta - [95.1089, 203.5034, 20.3935, -3.1648]) < half).all()
    assert (half < [0.6, 20, 1.5, 0.7]).all()


def test_tx40_converges_in_three_iterations(tx40):
    """Of a tenth of its samples: rows are those of a cut-off at 50 Hz."""
    fit, ls = (identify(thinned(tx40), Overrides(), method=method) for method in ("iv", "wls"))
    assert (fit.status, len(fit.beta)) == ("converged", 60)
    assert len(fit.passes) <= 4
    assert (fit.reference, fit.controller, fit.solution.start) == (
        "surrogate",
        "surrogate",
        "ls",
    )
    assert any("not strictly exogenous" in text for text in fit.warnings)
    inertial = [
        i for i, name in enumerate(fit.base.names) if not name.startswith(("Fv", "Fc", "Off"))
    ]
    assert (np.abs(fit.beta - ls.beta)[inertial] < 1.5 * ls.intervals.half[inertial]).all()
    assert fit.data.first_stage_F > 10


def test_no_gain_update_uses_reference_instruments(tx40):
    fit, updated = (
        solve(
            thinned(tx40),
            Overrides(),
            method="iv",
            iteration=Iteration(start="regular", gain_update=update),
        )
        for update in (False, True)
    )
    # A wrist of 1 kg m² under gains set for 0.01 kg m² does not follow: only along the reference
    # does the method go on.
    first = fit.passes[0]
    assert first.kind == "reference"
    assert "the simulated robot leaves its reference at joint 6" in first.reason
    assert all(p.kind == "simulated" for p in updated.passes)
    assert updated.passes[0].tracking_percent < 5
    # Nor are the gains updated for the last simulation, that of the result.
    first, second = (one.simulated[0].motion.q for one in (fit, updated))
    assert not np.array_equal(first, second)


# Simulated robots


def error_percent(beta: np.ndarray, true: np.ndarray) -> float:
    return float(100 * np.linalg.norm(beta - true) / np.linalg.norm(true))


@cache
def simulated(noise: Noise) -> Signals:
    """10 s of the described SCARA."""
    robot = robot_named("scara")
    q_ref = random_reference(robot, duration_s=10.0, sample_rate_hz=1000.0, seed=3)
    return closed_loop(robot, q_ref, 1000.0, noise=noise, seed=3)


def test_scara_with_and_without_filter():
    """The wrong filter is none."""
    signals = simulated(Noise(position=1e-4, effort_percent=2.0))
    ls, iv = (
        identify_ls(signals, Overrides(cutoff_hz=0, low_speed_percent=0.0)),
        identify_iv(signals, RAW, Iteration()),
    )
    assert iv.status == "converged"
    assert error_percent(ls.beta, truth_of(ls)) > 2
    assert error_percent(iv.beta, truth_of(iv)) < 0.5
    ls, iv = identify_ls(signals, Overrides()), identify_iv(signals, Overrides(), Iteration())
    assert error_percent(ls.beta, truth_of(ls)) < 1
    assert error_percent(iv.beta, ls.beta) < 1


def test_time_blocks_limit_position_noise(monkeypatch):
    """20 µm on the EMPS: half-widths by spans beside those by instants, of the same rows, in the
    mean of four.
    """
    signals, rng = load_signals(REPLAY / "emps" / "session.mcap"), np.random.default_rng(0)
    half, count = [], system.FINE_SPANS
    monkeypatch.setattr(system, "FINE_SPANS", 1_000_000)
    for _ in range(4):
        q = signals.q + 20e-6 * rng.standard_normal(signals.q.shape)
        fit = solve(
            dataclasses.replace(signals, q=q), Overrides(torque_lag_s=0.0), method="iv"
        ).inputs
        rows, instants = fit.observed.system, int(fit.observed.system.spans[0][-1])
        spans = dataclasses.replace(
            rows,
            span=rows.span * count // instants,
            spans=(-(-np.arange(count + 1) * instants // count),),
        )
        half.append([intervals_of(one, fit.estimate).half for one in (spans, rows)])
    assert np.mean(np.divide(*np.mean(half, axis=0))) < 1.2


def test_recordings_of_few_samples_fitted():
    """At 40 Hz, 8 times the bandwidth, the rule's cut-off is beyond half the rate; 2 s unfiltered
    are shorter than borders.
    """
    signals = simulated(Noise(position=1e-6, effort_percent=1.0))
    # the controller still runs at the full rate
    thinned = {name: getattr(signals, name)[::25] for name in SERIES}
    slow = dataclasses.replace(signals, sample_rate_hz=40.0, **thinned)
    short = dataclasses.replace(signals, **{k: getattr(signals, k)[3000:4250] for k in SERIES})
    for few, overrides, most in ((slow, Overrides(), 5), (short, RAW, 10)):
        fit = identify_iv(few, overrides, Iteration())
        assert (fit.settings.cutoff_hz, fit.status) == (None, "converged")
        assert error_percent(fit.beta, truth_of(fit)) < most
    with pytest.raises(RobotIdimError, match="30 decimated rows"):
        identify_ls(short, Overrides())


# Where things go wrong


def test_wrong_torque_sign_does_not_converge():
    signals, right = signals_of(SCARA), ls_of(SCARA)
    inertia = direct_model(right.problem.model, right.base.standard_parameters(right.beta)).inertia(
        signals.q[::500]
    )
    assert why_not_positive(inertia) is None
    fit = identify_iv(
        dataclasses.replace(signals, effort=-signals.effort),
        Overrides(),
        Iteration(start="regular"),
    )
    assert fit.status == "not_confirmed"
    assert "inertia matrix is not positive" in fit.solution.reason
    assert all(p.kind != "simulated" or p.reason is None for p in fit.passes)
    # Least squares has no positive inertias either: Kp = J w² then gives those of the gains.
    robot, c = signals.robot, signals.robot.controller
    assert any("those that suit the described gains at 5 Hz" in text for text in fit.warnings)
    J = np.array(c.position_gain) / (2 * np.pi * c.bandwidth_hz) ** 2
    np.testing.assert_allclose(described_law(robot).inertias(c.bandwidth_hz), J)
    # From the regular start, 1 kg m² of each motor, the first gains are 1/J and a joint's share.
    assert (fit.passes[0].gains >= 1 / J - 1e-9).all()


@pytest.mark.parametrize(
    ("most", "tolerance", "settled"), [(1, 1.0, None), (2, 1e-9, False), (2, 30.0, True)]
)
def test_too_few_iterations_reported(most, tolerance, settled):
    """One pass on the parameters hardly change; held to a tolerance that nothing meets,
    they do not settle either.
    """
    fit = solve(
        signals_of(SCARA),
        Overrides(),
        method="iv",
        iteration=Iteration(max_iterations=most, tolerance_percent=tolerance),
    )
    assert (fit.reason is None) == (settled is True)
    if settled is None:
        assert (fit.status, fit.reason) == (
            "max_iterations",
            "after iteration 1 there is only the start",
        )
    else:
        assert (fit.passes[-1].residual_change_percent is None) == settled


@pytest.mark.parametrize(
    ("line", "key", "value"),
    [
        ("sample_rate_hz = 1.0", "controller.sample_rate_hz", 1.0),
        ("position_gain = [3700.0]", "controller.position_gain", [3700.0]),
        ("position_gain = [3700.0, -60.0]", "controller.position_gain", [3700.0, -60.0]),
        ("position_gain_ = 0", "controller: position_gain", None),
    ],
)
def test_unsimulatable_controller_refused(line, key, value):
    text = (REPLAY / "scara" / "robot.toml").read_text()
    own = line.split(" =")[0].strip("_")
    text = re.sub(rf"(?m)^{own} = .*$", "" if value is None else line, text)

    def fit() -> None:
        robot = robot_from_files({"robot.toml": text.encode()}, "robot.toml")
        identify_iv(dataclasses.replace(signals_of(SCARA), robot=robot), Overrides(), Iteration())

    with pytest.raises(BadInputError) as told:
        fit()
    assert (told.value.key, told.value.value) == (key, value)


def test_inertias_of_regular_start():
    with pytest.raises(BadInputError, match="start = 'ls': expected regular if inertias are given"):
        Iteration(inertias=np.ones(2))


def test_command_line(capsys, tmp_path):
    out, again, other = (tmp_path / f"{name}.json" for name in ("iv", "again", "other"))
    assert main(["fit", str(SCARA), "--method", "iv", "--all", "--json", str(out)]) == 0
    assert "Iterations from start: ls" in capsys.readouterr().out
    fit = json.loads(out.read_text())
    assert (fit["status"], fit["reference"], fit["method"]) == ("converged", "recorded", "iv")
    keys = {
        "residual_norm",
        "largest_change_sigma",
        "gains",
        "tracking_error_percent",
        "condition_number_ztw",
    }
    assert all(keys <= set(p) for p in fit["iterations"])
    # From its own result the method is settled in the pass after the start.
    assert (
        main(["fit", str(SCARA), "--method", "iv", "--start", str(out), "--json", str(again)]) == 0
    )
    assert len(json.loads(again.read_text())["iterations"]) <= 2
    other.write_text(out.read_text().replace("ZZ1R", "XX9"))
    for start, words in (
        (other, "parameters = 'XX9': expected those of"),
        ("nowhere.json", "cannot be read"),
    ):
        assert words in refused(capsys, "fit", SCARA, "--method", "iv", "--start", start)


def test_study_without_convergence_says_so(capsys, tmp_path):
    out, robot = tmp_path / "study.json", str(REPLAY / "scara" / "robot.toml")
    command = ["study", robot, "--runs", "2", "--duration-s", "2", "--json", str(out)]
    assert main([*command, "--report", str(tmp_path / "s.html"), "--position-noise", "0.05"]) == 0
    summaries = {s["method"]: s for s in json.loads(out.read_text())["summaries"]}
    assert summaries["wls"]["runs"] == 2
    assert (summaries["iv"]["runs"], summaries["iv"]["coverage_percent"]) == (0, None)
    assert (tmp_path / "s.html").stat().st_size > 1000
    told = refused(capsys, "study", robot, "--runs", "2", "--rate-hz", "500")
    assert (
        "no run could be fitted: robot SCARA: its controller runs at 1000 Hz, but the recording is "
        "simulated at 500 Hz" in told
    )


def test_unknown_controller_uses_default_pd(monkeypatch):
    monkeypatch.setattr("identification.methods.model.law_of", lambda problem: None)
    robot = robot_named("scara")
    law = dict.fromkeys(("structure", "position_gain", "velocity_gain", "sample_rate_hz"))
    bare = dataclasses.replace(robot, controller=msgspec.structs.replace(robot.controller, **law))
    fit = identify_iv(load_signals(SCARA, bare), Overrides(), Iteration())
    assert (fit.status, fit.controller, fit.reference) == (
        "converged",
        "surrogate",
        "recorded",
    )
    assert any("simulated with a 5 Hz PD" in text for text in fit.warnings)
