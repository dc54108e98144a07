"""Recordings with every optional column x load friction, own parameters, drive gains x
two workers, long ones, instruments along the reference.
"""

from functools import partial

import numpy as np
import pytest
from crossed_recordings import (
    BRIEF,
    COLUMNS,
    CONCERNS,
    TRUE,
    as_long,
    bits,
    fitted,
    written,
)
from described_truth import off

import identification
from identification import validate
from identification.data import Work
from identification.estimation import system
from identification.regression import problem

TRACKED = "identification.methods.solution.MAX_TRACKING_PERCENT"


@pytest.mark.parametrize(
    ("concerns", "columns", "tracked"),
    [
        *((concerns, "all", 20.0) for concerns in ("plain", "all")),
        *((concerns, "reference", 20.0) for concerns in CONCERNS),
        *((concerns, "payload", 20.0) for concerns in ("plain", "load", "all")),
        ("own", "velocity", 20.0),
        ("gains", "known_torque", 20.0),
        ("all", "all", 0.0),  # no simulated robot tracks: instruments along the reference
    ],
)
def test_two_recordings_fitted_with_their_data(concerns, columns, tracked, tmp_path, monkeypatch):
    monkeypatch.setattr(TRACKED, tracked)
    concerns = frozenset({"all": CONCERNS, "plain": ()}.get(concerns, (concerns,)))
    columns = frozenset(COLUMNS if columns == "all" else (columns,))
    paths = written(tmp_path, concerns, columns)
    fit = fitted(paths, concerns, Work())
    # with all, each meets two workers, and all columns
    assert len(concerns) == 1 or bits(fitted(paths, concerns, Work(2))) == bits(fit)
    assert fit.status == ("converged" if "reference" in columns else "solved")
    assert not fit.passes or (
        (fit.passes[-1].by_reference is None) == bool(tracked)
        and fit.controller == "found"
        and all(law.reason is None for law in fit.solution.model.laws)
    )
    assert (off(fit) < 1.5).all()
    assert (fit.own is None, fit.gains == ()) == (
        not {"own", "gains"} & concerns,
        "gains" not in concerns,
    )
    if fit.gains:
        assert abs(fit.gains[0].value - TRUE[1]) < 2 * fit.gains[0].half_width < 0.25
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
        again, told = validate(identification.Fit.of(fit), path), one.errors[-1]
        assert (again.relative_error_percent, again.warnings) == (
            pytest.approx(told.relative_error_percent, rel=tolerance),
            [],
        )


@pytest.mark.parametrize(
    ("count", "concerns", "columns"),
    [(2, CONCERNS, ["payload"]), (1, ["load"], COLUMNS), (1, [], ["known_torque"])],
)
def test_two_workers_fit_long_recordings_alike(count, concerns, columns, tmp_path, monkeypatch):
    """Each of several, which is read again; the blocks of one, which end within spans of time."""
    if count == 1:
        monkeypatch.setattr(problem, "_SERIES_BLOCK", 1_200)
    monkeypatch.setattr("identification.methods.model.MAX_HELD", 100)
    run, ran = Work.run, list[int]()
    monkeypatch.setattr(
        Work,
        "run",
        lambda work, task, *of: ran.append(work.workers) or run(work, partial(as_long, task), *of),
    )
    paths = written(tmp_path, concerns := frozenset(concerns), frozenset(columns), 4.0, count)
    fit, other = (as_long(fitted, paths, concerns, Work(n), decimation=1) for n in (1, 2))
    assert len(fit.data.observed.tau) / count > BRIEF
    assert len(problem.row_blocks(fit.problem)) > 16 * (2 - count)  # more than are sent at once
    assert 2 in ran  # a single block, as of torque errors, stays in this process
    assert bits(fit) == bits(other)
    assert validate(identification.Fit.of(fit), paths[-1]).relative_error_percent == pytest.approx(
        fit.recordings[-1].errors[-1].relative_error_percent, rel=0.06
    )


@pytest.mark.parametrize(
    ("concerns", "tracked", "block", "tolerance"),
    [(CONCERNS, 20, None, 1e-9), (CONCERNS, 0, 12_000, 0.01), (["load"], 20, 12_000, 1e-9)],
)
def test_long_recordings_fitted_like_short(
    concerns, tracked, block, tolerance, tmp_path, monkeypatch
):
    """R factors of spans in place of the rows, and samples read again where they are needed; with a
    simulated robot, and where none tracks, along the reference and with blocks of rows, the first
    of which do not show a lag; and by least squares without a reference.
    """
    monkeypatch.setattr(TRACKED, tracked)
    monkeypatch.setattr(system, "FINE_SPANS", 10)
    monkeypatch.setattr(system, "SPANS", 10)
    columns = frozenset(COLUMNS if concerns is CONCERNS else ())
    paths = written(tmp_path, concerns := frozenset(concerns), columns, 6.0 if block else 4.0)
    short = fitted(paths, concerns, Work(), decimation=2)
    monkeypatch.setattr(system, "SHORT", 0)
    monkeypatch.setattr(problem, "_SERIES_BLOCK", block or problem._SERIES_BLOCK)
    monkeypatch.setattr("identification.methods.model.MAX_HELD", 100)
    fit = fitted(paths, concerns, Work(), decimation=2)
    assert (len(problem.row_blocks(fit.problem)) > 1) == bool(block)
    assert len(fit.data.observed.system.Y) < 0.7 * len(short.data.observed.system.Y)
    assert (fit.estimate.names, fit.status) == (short.estimate.names, short.status)
    assert fit.status == ("converged" if columns else "solved")
    moved = np.abs(fit.estimate.beta - short.estimate.beta) / short.intervals.half
    assert moved.max() < tolerance
    np.testing.assert_allclose(fit.intervals.half, short.intervals.half, rtol=tolerance)
    told, expected = (
        [one.errors[-1].relative_error_percent for one in x.recordings] for x in (fit, short)
    )
    assert told == pytest.approx(expected, rel=tolerance)
    for x, y in zip(fit.trust.lines, short.trust.lines, strict=True):
        assert (x.test, x.level, x.finding) == (y.test, y.level, y.finding)
        assert x.value == (y.value and pytest.approx(y.value, rel=100 * tolerance))
