"""Recordings with every optional column x load friction, own parameters, drive gains x
two workers.
"""

import pytest
from crossed_recordings import (
    COLUMNS,
    CONCERNS,
    TRUE,
    bits,
    fitted,
    off,
    written,
)

import identification
from identification import validate
from identification.data import Work


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
