"""One error of a fit, in all that tells it; and how far a fit predicts the motion."""

import csv
import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conftest import REPLAY
from hunt import fit_by_default
from hunt_kinds import cell_of, sound
from independent_simulator import Imperfections, references, simulate, with_control

from identification.commands import main
from identification.data import Recordings
from identification.design import select_friction
from identification.regression import Overrides, make_problem
from identification.results import (
    HORIZONS_S,
    errors_ahead,
    fit_document,
    fit_file,
    identify_ls,
    validate_all,
    validated,
)

SESSION = REPLAY / "scara" / "session.mcap"


def test_all_outputs_report_same_error(tmp_path, monkeypatch, capsys):
    """Headline, tests, friction, validation, fleet, report and files, of least squares."""
    monkeypatch.chdir(tmp_path)
    assert main(["fit", str(SESSION), "--method", "wls", "--json", "f.json", "--all"]) in (0, 3)
    printed = capsys.readouterr().out
    error = json.loads((tmp_path / "f.json").read_text())["relative_error_percent"]
    assert f"Torque error       {error:.3g} % in motion" in printed
    assert f"% held out, {error:.3g} % fitted" in printed
    assert main(["validate", "f.json", str(SESSION), "--json", "v.json"]) == 0
    again = json.loads((tmp_path / "v.json").read_text())
    assert again["relative_error_percent"] == pytest.approx(error, rel=1e-6)
    (tmp_path / "cell").mkdir()
    (tmp_path / "cell" / "one.mcap").write_bytes(SESSION.read_bytes())
    assert main(["fleet", "cell", "-o", "f.csv", "--method", "wls"]) == 0
    (row,) = csv.DictReader((tmp_path / "f.csv").open())
    assert float(row["torque_error_percent"]) == pytest.approx(error, rel=1e-6)


CELL = replace(sound("scara", np.random.default_rng(0)), substeps=1)


@cache
def error_of_rules():
    return fit_by_default(CELL.recording(0)).errors[-1]


@pytest.mark.parametrize("hz", [1.5, 15.0])
def test_error_independent_of_given_bandwidth(hz):
    signals, expected = CELL.recording(0), error_of_rules()
    stated = replace(signals, robot=with_control(signals.robot, bandwidth_hz=hz))
    fit = fit_by_default(stated)
    found = fit.errors[-1]
    assert found.relative_error_percent == pytest.approx(expected.relative_error_percent, rel=0.05)
    assert (found.moving_rows, fit.settings.cutoff_hz) == (
        expected.moving_rows,
        pytest.approx(5 * hz),
    )
    assert len(fit.tau) != len(fit.data.observed.tau)
    document = fit_document(fit_file(fit))
    (shown,) = (line[1] for line in document.sections[1].lines if line[0] == "Torque error")
    assert shown.startswith(f"{found.relative_error_percent:.3g} % in motion")


def test_friction_reports_errors_of_its_fits():
    choice = select_friction(CELL.recording(0))
    for trial, fit in zip((choice.usual, choice.recommended), choice.fits(), strict=True):
        assert trial.fitted_error_percent == pytest.approx(
            fit.errors[-1].relative_error_percent,
            rel=5e-3,  # other weights of joints
        )
        held = fit.held_out_error_percent
        assert np.nanmean(trial.held_out_percents) == pytest.approx(held, rel=0.05)


def test_only_true_values_predict_motion():
    """By the independent simulator, without noise; 20 % more of all inertias falls behind."""
    body, law, robot = cell_of("scara")
    path = references(body, range(3, 4), duration_s=6.0, rate_hz=law.rate_hz)
    runs = simulate(body, law, path, Imperfections(), seed=3, substeps=1)
    problem = make_problem(runs.signals(robot, 0), Overrides()).for_errors
    names = problem.base.names
    fit = identify_ls(runs.signals(robot, 0), Overrides())
    error, way = errors_ahead(problem, fit.beta)
    assert error.shape == way.shape == (len(HORIZONS_S), 2)
    assert (error < 0.02 * way).all()
    inertia = np.array([name.startswith(("ZZ", "MX", "MY")) for name in names])
    off, _ = errors_ahead(problem, np.where(inertia, 1.2, 1.0) * fit.beta)
    assert (off > 5 * error).all()
    assert errors_ahead(problem, -fit.beta) is None
    stored = fit_file(fit)
    (one,), _ = validate_all([(runs.signals(robot, 0), Overrides())], stored, "the fit")
    np.testing.assert_allclose(one.ahead, [error, way], rtol=1e-6)


def test_recordings_share_error_filters():
    """Those of the faster one; a recording that is too short for them is told of."""
    slow = replace(replace(CELL, highest_hz=0.3).recording(1), recording="slow.mcap")
    fast = CELL.recording(0)
    alone = [make_problem(one, Overrides()) for one in (fast, slow)]
    expected, lower = (one.for_errors.settings.cutoff_hz for one in alone)
    fit = identify_ls(Recordings(sources=(slow, fast)), Overrides())
    each, _ = validate_all([(one, Overrides()) for one in (slow, fast)], fit_file(fit), "the fit")
    told = [one.problem.for_errors.settings.cutoff_hz for one in (*fit.recordings, *each)]
    assert told == [expected] * 4
    assert lower < 0.5 * expected
    # so slow that no row would be left
    still = replace(alone[0], settings=replace(alone[0].settings, band_hz=0.01))
    found = validated(still, fit.estimate.values_of(still.base.names)).problem.settings
    assert found.cutoff_hz == still.settings.cutoff_hz
    assert "too short for the filters" in found.warnings[-1]
