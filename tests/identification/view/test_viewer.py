"""The Rerun file of a fit: its layout shows only what is there, and what is there is what was
measured and modelled.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from fits_of_records import picture_of
from pictured_fits import FS, Written, fitted, fitted_iv, made_up, scara

from identification.model import InverseModel
from identification.regression import Decimation, FilteredMotion, differentiate, predicted_torque
from identification.view import curves, rerun_panels, write_rrd
from identification.view.curves import extremes


@pytest.fixture
def written(tmp_path):
    def write(signals, fit=None, name="fit.rrd", **others):
        write_rrd(tmp_path / name, picture_of(fit or fitted(signals), **others))
        return Written(tmp_path / name)

    return write


CASES = {
    "sliding, with reference": {"types": ("prismatic",), "reference": True},
    "seven joints": {"types": ("revolute",) * 7, "samples": 2000},
    "hardly any noise": {"noise": 0.0},
    "long": {"types": ("revolute",), "samples": 12_000},
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_panels_and_data_match(case, written):
    signals = made_up(**case)
    file = written(signals)
    n, errors = signals.robot.n, signals.robot.n * (signals.q_ref is not None)
    kinds = sorted(kind for kind, _ in file.views.values() if kind != "2D")
    assert kinds == ["3D", "TextDocument"] + ["TimeSeries"] * (5 * n + errors)
    assert file.is_complete()
    assert "Verdict: " in file.static["/report"]["TextDocument:text"][0]


@pytest.mark.parametrize("name", ["two joints, with reference", "one joint"])
def test_iv_fit_shows_simulated_robot(name, written):
    signals = made_up(types=("revolute",)) if name == "one joint" else scara()
    fit, ls = fitted_iv(signals), fitted(signals)
    file = written(signals, fit, truth=ls.beta)
    n = signals.robot.n
    assert (
        sorted(kind for kind, _ in file.views.values() if kind != "2D")
        == ["3D", "TextDocument"] + ["TimeSeries"] * 6 * n
    )
    assert file.is_complete()
    simulated, name = fit.recordings[0].simulated.motion, signals.robot.joints[0].name
    k, x = file.curve("q", name, "simulated")
    np.testing.assert_array_equal(k, np.rint(simulated.t_s * FS))
    np.testing.assert_allclose(x, simulated.q[:, 0])
    titles = {origin: title for origin, (_, title) in file.views.items()}
    # what an error of 1 rad or 1 m is drawn as, by its plot's title
    per_unit = {
        f"position error {name} [{p}{signals.robot.joints[0].position_unit}]": factor
        for p, factor in (("", 1.0), ("m", 1e3), ("µ", 1e6))
    }[titles[f"/error/{name}".replace(" ", "\\ ")]]
    k, x = file.curve("error", name, "simulated")
    np.testing.assert_allclose(x / per_unit, fit.recordings[0].simulated.error[:, 0])
    np.testing.assert_allclose(
        signals.q[k, 0] + x / per_unit, simulated.q[:, 0], atol=1e-3 * np.ptp(signals.q[:, 0])
    )
    if signals.q_ref is not None:
        k, x = file.curve("error", name, "reference")
        np.testing.assert_allclose(x / per_unit, (signals.q_ref - signals.q)[k, 0])
    text = file.static["/report"]["TextDocument:text"][0]
    for part in (
        "Difference between simulated robot and recording",
        "Iterations from start",
        "IV and LS",
        "IV and true",
    ):
        assert part in text


def test_unsimulated_robot_has_no_ghost(written):
    fit = fitted_iv(made_up())
    assert (fit.status, fit.recordings[0].simulated.by_joint) == ("not_confirmed", ())
    file = written(made_up(), fit)
    assert file.is_complete()
    assert not any("simulated" in path for path in [*file.curves, *file.moving])
    assert fit.solution.reason in file.static["/report"]["TextDocument:text"][0]


def test_titles_have_joint_and_unit(written):
    titles = {origin: title for origin, (_, title) in written(made_up()).views.items()}
    for quantity, units in {
        "torque": ("N m", "N"),
        "residual": ("N m", "N"),
        "ddq": ("rad/s²", "m/s²"),
    }.items():
        for j, unit in enumerate(units, 1):
            assert titles[f"/{quantity}/joint\\ {j}.x"] == f"{quantity} joint {j}.x [{unit}]"
    in_amperes = written(made_up(types=("revolute",), unit="A"), name="a.rrd").views
    assert in_amperes["/torque/joint\\ 1.x"][1] == "torque joint 1.x [A]"


def test_joints_of_one_type_share_error_unit(written):
    signals = made_up(types=("revolute", "prismatic", "revolute"), reference=True)
    q_ref = signals.q + np.array([2e-3, 3e-5, 5e-6])
    file = written(replace(signals, q_ref=q_ref))
    titles = [file.views[f"/error/joint\\ {j}.x"][1] for j in (1, 2, 3)]
    assert titles == [
        f"position error joint {j}.x [{unit}]" for j, unit in ((1, "mrad"), (2, "µm"), (3, "mrad"))
    ]
    for j, error in enumerate([2.0, 30.0, 5e-3], 1):
        np.testing.assert_allclose(
            file.curve("error", f"joint {j}.x", "reference")[1], error, rtol=1e-6
        )


def test_short_curves_written_per_sample(written):
    signals = made_up(reference=True)
    fit, file = fitted(signals), written(signals)
    plan = fit.settings
    span = np.arange(plan.start, plan.stop)
    whole = FilteredMotion(signals).between(plan.start, plan.stop, plan.cutoff_hz)  # in one pass
    for j, joint in enumerate(signals.robot.joints):
        assert not [path for path in file.curves if re.match("/d?dq/.*/measured$", path)]
        expected = {
            ("torque", "measured"): (np.arange(len(signals.q)), signals.effort),
            ("q", "measured"): (np.arange(len(signals.q)), signals.q),
            ("q", "reference"): (np.arange(len(signals.q)), signals.q_ref),
            ("q", "measured_filtered"): (span, whole.q),
            ("dq", "measured_filtered"): (span, whole.dq),
            ("ddq", "measured_filtered"): (span, whole.ddq),
        }
        for (quantity, key), (samples, values) in expected.items():
            k, x = file.curve(quantity, joint.name, key)
            np.testing.assert_array_equal(k, samples)
            np.testing.assert_allclose(x, values[:, j], rtol=1e-9, atol=1e-9 * np.abs(values).max())


def test_residual_matches_reported_error(written):
    signals = made_up()
    fit, file = fitted(signals), written(signals)
    s = fit.problem.for_errors.settings
    decimation = Decimation(factor=s.decimation)
    Y = decimation.filtered(signals.effort[s.start : s.stop].T)
    motion = FilteredMotion(signals).between(s.start, s.stop, s.cutoff_hz)
    predicted = predicted_torque(motion, InverseModel(signals.robot), fit.base, fit.beta)
    for j, joint in enumerate(signals.robot.joints):
        k, rho = file.curve("residual", joint.name, "residual")
        of = fit.counts[:, j]
        assert 100 * np.linalg.norm(rho[of]) / np.linalg.norm(Y[j][of]) == pytest.approx(
            fit.errors[j].relative_error_percent
        )
        np.testing.assert_allclose(
            rho, Y[j] - decimation.filtered(predicted[:, j]), atol=1e-6 * np.abs(Y[j]).max()
        )
        np.testing.assert_array_equal(file.curve("torque", joint.name, "residual")[1], rho)
        assert k[-1] == s.stop - 1
        assert set(np.diff(k)) == {s.decimation}


def test_long_recording_blocks_have_no_seam(written, monkeypatch):
    signals = made_up()
    whole = written(signals)
    monkeypatch.setattr(curves, "BLOCK_SAMPLES", 700)
    blocks = written(signals, name="blocks.rrd")
    assert whole.curves.keys() == blocks.curves.keys()
    for path, (t, x) in whole.curves.items():
        np.testing.assert_array_equal(blocks.curves[path][0], t)
        np.testing.assert_allclose(
            blocks.curves[path][1], x, rtol=1e-9, atol=1e-9 * np.abs(x).max()
        )


@pytest.mark.parametrize(("N", "step"), [(10, 1), (10, 3), (99, 9), (5, 9)])
def test_thinning_keeps_bucket_extremes(N, step):
    x = np.random.default_rng(N).standard_normal(N)
    k = extremes(x, step)
    assert (np.diff(k) > 0).all()
    if step == 1:
        np.testing.assert_array_equal(k, np.arange(N))
    assert len(k) <= 2 * (N // step) + N % step or step == 1
    for a in range(0, N, step):
        kept, bucket = x[k[(k >= a) & (k < a + step)]], x[a : a + step]
        assert kept.min() == bucket.min()
        assert kept.max() == bucket.max()


def test_missing_and_skipped_items_not_shown(written):
    signals = made_up()
    assert not any(path.endswith("reference") for path in written(signals).curves)
    unfiltered = written(signals, fitted(signals, cutoff_hz=0.0), name="b.rrd")
    k, speed = unfiltered.curve("dq", "joint 1.x", "measured")
    np.testing.assert_allclose(
        speed, differentiate(signals.q, FS)[k, 0], atol=1e-9 * np.abs(speed).max()
    )
    assert not any(path.endswith("filtered") for path in unfiltered.curves)
    assert all(unfiltered.holds(origin, kind) for origin, (kind, _) in unfiltered.views.items())


def test_each_fit_is_own_application(written):
    """A viewer has one layout per application: another fit's titles would stand
    over this one's curves.
    """
    signals = made_up()
    files = [
        written(signals, fit)
        for fit in (fitted(signals), fitted(signals), fitted(signals, cutoff_hz=30.0))
    ]
    assert files[0].application == files[1].application != files[2].application


def test_failure_leaves_no_file_silently(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(rerun_panels, "_show_page", lambda *_, **__: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        write_rrd(tmp_path / "fit.rrd", picture_of(fitted(made_up())))
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")
