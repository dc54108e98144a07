"""Recordings with every optional column x load friction, own parameters, drive gains x
two workers, long ones.
"""

from dataclasses import replace

import numpy as np
import pytest
from crossed_recordings import (
    COLUMNS,
    CONCERNS,
    LONG_S,
    STATED,
    TRUE,
    as_long,
    bits,
    fitted,
    off,
    recorded,
    written,
)

import identification
from identification import validate
from identification.data import Work
from identification.methods import Fit, identify
from identification.regression import Overrides


@pytest.mark.parametrize(
    ("concerns", "columns"),
    [
        *((concerns, "all") for concerns in ("plain", "all")),
        *((concerns, "reference") for concerns in CONCERNS),
        *((concerns, "payload") for concerns in ("plain", "load", "all")),
        ("own", "velocity"),
        ("gains", "known_torque"),
    ],
)
def test_two_recordings_are_fitted_with_what_they_have(concerns, columns, tmp_path):
    concerns = frozenset({"all": CONCERNS, "plain": ()}.get(concerns, (concerns,)))
    columns = frozenset(COLUMNS if columns == "all" else (columns,))
    paths = written(tmp_path, concerns, columns)
    fit = fitted(paths, concerns, Work())
    assert bits(fitted(paths, concerns, Work(2))) == bits(fit)
    assert fit.status == ("converged" if "reference" in columns else "solved")
    assert fit.iv is None or (
        fit.iv.controller == "found"
        and all(one.problem.law.reason is None for one in fit.recordings)
    )
    assert (off(fit) < 1.5).all()
    assert (fit.own is not None) == bool({"own", "gains"} & concerns)
    assert (fit.gains is not None) == ("gains" in concerns)
    if fit.gains:
        assert abs(fit.gains.values[0] - TRUE[1]) < 2 * fit.gains.half[0] < 0.25
    # The mean of own parameters is validated, and load friction where the fit has it linearised.
    tolerance = (
        0.06
        if "gains" in concerns
        else 0.02
        if "own" in concerns
        else 1e-4
        if "load" in concerns
        else 1e-9
    )
    for one, path in zip(fit.recordings, paths, strict=True):
        again = validate(identification.Fit(**vars(fit)), path)
        assert again.relative_error_percent == pytest.approx(
            one.errors[-1].relative_error_percent, rel=tolerance
        )
        assert again.warnings == []


def test_long_recordings_are_fitted_as_held_ones(tmp_path):
    concerns = frozenset({"own"})
    paths = written(tmp_path, concerns, frozenset({"payload"}), LONG_S)
    held = fitted(paths, concerns, Work(), **STATED)
    fit = as_long(lambda: fitted(paths, concerns, Work(), **STATED))
    assert (fit.estimate.names, fit.status, fit.distrust) == (
        held.estimate.names,
        held.status,
        held.distrust,
    )
    assert (np.abs(fit.estimate.beta - held.estimate.beta) < 0.1 * held.intervals.half).all()
    np.testing.assert_allclose(fit.intervals.half, held.intervals.half, rtol=0.1)
    assert (off(fit) < 1.5).all()
    assert pytest.approx(held.own.F, rel=0.05) == fit.own.F


@pytest.mark.parametrize(("method", "drift"), [("wls", 0.05), ("iv", 0.05), ("wls", 0.0)])
def test_all_of_a_long_recording_is_tested(method, drift):
    """A torque that drifts from the middle on, by a share of its rms: nothing of
    it is in the beginning.
    """
    signals = recorded(frozenset(), frozenset({"reference"}), 1, LONG_S)
    ramp = np.maximum(0.0, 2 * signals.t_s / signals.t_s[-1] - 1)[:, None] * [1.0, 0.0]
    signals = replace(
        signals, effort=signals.effort + drift * np.sqrt(np.mean(signals.effort**2, axis=0)) * ramp
    )

    def run() -> Fit:
        return identify(signals, Overrides(**STATED), method=method)

    held, fit = run(), as_long(run)
    one, other = (x.trust.line("added columns") for x in (fit, held))
    assert (one.level, one.finding, one.value) == (
        other.level,
        other.finding,
        pytest.approx(other.value, rel=0.02),
    )
    assert fit.trust.line("added columns").finding == ("drift of joint shoulder" if drift else "")
