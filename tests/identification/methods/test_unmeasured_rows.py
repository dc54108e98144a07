"""Rows that nobody measured weigh nothing: fits of recordings with gaps and lost efforts against
the arm itself, by every kind of weights, and against the fits of what was measured alone.
"""

from dataclasses import replace

import numpy as np
import pytest
from pinocchio_arm import arm_of
from urdfs import six_joints

import identification
from acquisition.errors import NoFitError
from acquisition.recording import Header, RecordingWriter, sample_dtype
from acquisition.robot import Controller
from identification.data import Recordings, load_signals, signals_from_arrays
from identification.methods import Iteration, read_model
from identification.options import Overrides
from identification.regression import ROWS, make_problem, sample_weights
from identification.results import identify, identify_iv, identify_ls, validate_all

JOINTS, RATE_HZ, SECONDS = ("pan", "lift", "elbow"), 500.0, 8.0
N = round(RATE_HZ * SECONDS)
ROW = np.arange(N)


def rows_of(*spans):
    return np.any([(first <= ROW) & (last > ROW) for first, last in spans], axis=0)


def without(x, lost):
    """x (N, n) on straight lines where rows are missing."""
    return np.stack([np.interp(ROW, ROW[~lost], own[~lost]) for own in x.T], axis=1)


BURSTS, ONE = rows_of(*((k, k + 30) for k in range(250, N, 500))), rows_of((1500, 1900))
GAP, GAPS = rows_of((1500, 1700)), rows_of((750, 875), (2500, 2650))
LOSSES = {
    "a gap": (lambda q, u: (without(q, GAP), without(u, GAP)), GAP),
    "two gaps": (lambda q, u: (without(q, GAPS), without(u, GAPS)), GAPS),
    "efforts in bursts": (lambda q, u: (q, np.where(BURSTS[:, None], 0.0, u)), BURSTS),
    "one motor's effort": (
        lambda q, u: (q, np.where(ONE[:, None] & (np.arange(3) == 1), u[1499], u)),
        ONE,
    ),
}
WEIGHTS = {
    "ramps": Overrides(),
    "no slow rows left out": Overrides(low_speed_percent=0.0),
    "rows": Overrides(ramp_rows=ROWS),
}


@pytest.fixture(scope="module")
def arm():
    return arm_of(six_joints(), JOINTS)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "six.urdf"
    path.write_text(six_joints())
    return identification.read_robot(path, joints=JOINTS, bandwidth_hz=8)


@pytest.fixture(scope="module")
def measured(arm):
    return arm.measured(1, SECONDS, RATE_HZ)


@pytest.fixture(scope="module")
def driven(arm):
    return arm.driven(2, SECONDS, RATE_HZ)


def torque_of(fit):
    model, columns = fit.data.problem.model, fit.data.problem.base.columns
    return lambda *motion: model.regressor(*motion)[..., columns] @ fit.beta


def worst_percent(arm, fit):
    """The largest error of a joint's torque along a motion that was not recorded."""
    return arm.errors_percent(torque_of(fit)).max()


@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("loss", LOSSES)
def test_fit_as_good_as_without_loss(arm, robot, measured, loss, weights):
    change, lost = LOSSES[loss]
    signals = signals_from_arrays(*change(*measured), RATE_HZ, robot)
    np.testing.assert_array_equal(signals.measured, ~lost)
    fit = identify_ls(signals, WEIGHTS[weights])
    assert worst_percent(arm, fit) < 0.1
    if weights == "ramps":  # the loss matters
        believed = identify_ls(replace(signals, measured=None), WEIGHTS[weights])
        assert worst_percent(arm, believed) > 1
    (line,) = (line for line in fit.trust.lines if line.test == "rows")
    assert line.level == "ok"
    assert f"{lost.sum()} " in line.text


@pytest.mark.parametrize("loss", ["efforts in bursts", "a gap"])
def test_instruments_skip_lost_rows(arm, robot, driven, loss):
    """The reference goes on where efforts are lost; in a gap it is missing too."""
    change, lost = LOSSES[loss]
    q, u, reference = driven
    if loss == "a gap":
        reference = without(reference, lost)
    signals = signals_from_arrays(*change(q, u), RATE_HZ, robot, reference)
    fit = identify_iv(signals, Overrides(), Iteration())
    assert fit.status == "converged"
    assert worst_percent(arm, fit) < 0.2
    believed = identify_iv(
        replace(signals, measured=None), Overrides(), Iteration(max_iterations=len(fit.passes))
    )
    assert worst_percent(arm, believed) > 1


def test_gap_rows_match_two_recordings(arm, robot, measured):
    """The fit of a recording with a gap, and that of its two parts."""
    signals = signals_from_arrays(*(without(x, GAP) for x in measured), RATE_HZ, robot)
    parts = [
        signals_from_arrays(*(x[part] for x in measured), RATE_HZ, robot)
        for part in (slice(0, 1500), slice(1700, N))
    ]
    named = tuple(replace(x, recording=f"part {k}") for k, x in enumerate(parts))
    settings = Overrides(torque_lag_s="none", ramp_rows=2.0)
    one = identify_ls(signals, settings)
    two = identify(Recordings(sources=named), settings, method="wls")
    motion = arm.motion(7, 6.0, 100.0)
    found, expected = (torque_of(fit)(*motion) for fit in (one, two))
    off = np.linalg.norm(found - expected, axis=0) / np.linalg.norm(expected, axis=0)
    assert 100 * off.max() < 0.05
    assert one.estimate.rows == pytest.approx(two.estimate.rows, rel=0.03)


def test_errors_and_counts_use_measured_rows(arm, robot):
    q, u = arm.measured(1, 2 * SECONDS, RATE_HZ)
    bursts = (np.arange(len(u)) - 250) % 500 < 30
    signals = signals_from_arrays(q, np.where(bursts[:, None], 0.0, u), RATE_HZ, robot)
    fit, clean = (
        identify_ls(x, Overrides()) for x in (signals, signals_from_arrays(q, u, RATE_HZ, robot))
    )
    (whole, _), (of_all, _) = ((x.errors[-1], x) for x in (fit, clean))
    # of a sixth of the rows
    assert whole.relative_error_percent == pytest.approx(of_all.relative_error_percent, rel=0.15)
    assert 100 < whole.moving_rows < 0.5 * of_all.moving_rows
    _, errors = validate_all([(signals, Overrides())], identification.Fit.of(fit).file, "fit")
    assert errors[-1].relative_error_percent == pytest.approx(whole.relative_error_percent, rel=0.2)


def test_law_estimated_despite_lost_efforts(robot, driven):
    """Its gains are those of the recording without a loss."""
    change, _ = LOSSES["efforts in bursts"]
    q, u, reference = driven
    whole, lossy = (
        read_model(signals_from_arrays(q, x, RATE_HZ, robot, reference), Overrides(), print).laws[0]
        for x in (u, change(q, u)[1])
    )
    np.testing.assert_allclose(lossy.gains[:2], whole.gains[:2], rtol=0.02)


def recording_with_gaps(path, robot, measured, there):
    header = Header(robot=robot, source="a test", sample_rate_hz=RATE_HZ, effort_provenance="")
    rows = np.zeros(there.sum(), sample_dtype(3, reference=False))
    rows["stamp_ns"] = np.rint(ROW[there] * 1e9 / RATE_HZ)
    rows["position"], rows["effort"] = (x[there] for x in measured)
    with RecordingWriter(path, header) as writer:
        writer.samples(rows)
    return path


def test_recording_with_gaps_fitted(arm, robot, measured, tmp_path):
    signals = load_signals(recording_with_gaps(tmp_path / "a.mcap", robot, measured, ~GAPS))
    assert len(signals.q) == N
    np.testing.assert_array_equal(signals.measured, ~GAPS)
    assert "275 are missing in 2 gap(s)" in signals.unmeasured
    assert worst_percent(arm, identify_ls(signals, Overrides())) < 0.1


def test_unmeasured_samples_have_zero_weight(robot, measured):
    for overrides in WEIGHTS.values():
        signals = signals_from_arrays(*(without(x, GAPS) for x in measured), RATE_HZ, robot)
        w = sample_weights(make_problem(signals, overrides)).between(0, N)
        assert not w[:, GAPS].any()
        assert (w[:, 1600:2350] > 0).any()


def test_losses_leaving_no_row_named(robot, measured):
    q, u = measured
    lost = np.where(ROW[:, None] % 10 == 0, 0.0, u)
    with pytest.raises(NoFitError, match="400 have lost efforts, of 4000 rows"):
        identify_ls(signals_from_arrays(q, lost, RATE_HZ, robot), Overrides())


@pytest.mark.parametrize("stands", [2, 3, 5])
def test_oversampled_arrays_thinned(arm, robot, stands):
    """Without a stated bandwidth, too, which is then found from the rows that are new."""
    unstated = replace(robot, controller=Controller())
    longer = arm.measured(1, 2 * SECONDS, RATE_HZ)
    held = [x[np.arange(len(x)) // stands * stands] for x in longer]
    signals = signals_from_arrays(*held, RATE_HZ, unstated)
    assert signals.sample_rate_hz == pytest.approx(RATE_HZ / stands)
    assert worst_percent(arm, identify_ls(signals, Overrides())) < 0.2
    (told,) = signals.events
    assert f"it repeats each position {stands} times" in told.text


def test_positions_keep_recording_rate(robot, measured, tmp_path):
    """Another rate is told and not taken; a correction of a clock, and any of a copy, is."""
    log = load_signals(recording_with_gaps(tmp_path / "a.mcap", robot, measured, ROW < 2000))
    signals = signals_from_arrays(log.q, log.effort, 1000, robot)
    assert signals.sample_rate_hz == pytest.approx(500)
    assert signals.t_s[-1] == pytest.approx((len(log.q) - 1) / 500)
    assert any("recorded at 500 Hz: the fit uses this rate" in x.text for x in signals.events)
    for q, rate_hz in ((log.q, 499.0), (log.q.copy(), 1000)):
        assert signals_from_arrays(q, log.effort, rate_hz, robot).sample_rate_hz == rate_hz
