"""`compare` with --rrd and HTML: parameters of two fits, and their torques on one timeline."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from blueprints import opening_screen
from command_runs import refused, run
from conftest import REPLAY, robot_named
from fits_of_records import cut, ls_of, signals_of
from pictured_fits import Written, made_up

from acquisition.robot import robot_from_files
from identification.data import Recordings
from identification.methods import Iteration
from identification.regression import Decimation, FilteredMotion, Overrides, make_problem
from identification.report import ParameterSet, comparison_section, write_json
from identification.results import fit_file, identify_iv, identify_ls
from identification.study import write_signals
from identification.view import draw_comparison
from identification.view.panels import VERMILLION

SCARA, EMPS = REPLAY / "scara" / "session.mcap", REPLAY / "emps" / "session.mcap"
JOINTS, NO_LAG = ("shoulder", "elbow"), Overrides(torque_lag_s=0.0)


def stored(path, fit):
    write_json(path, fit_file(fit))
    return path


@pytest.fixture
def beside(tmp_path):
    """Fits of one recording by IV and by LS, beside it."""
    shutil.copy(SCARA, tmp_path)
    signals = signals_of(SCARA)
    iv = identify_iv(signals, NO_LAG, Iteration())
    return stored(tmp_path / "iv.json", iv), stored(
        tmp_path / "ls.json", identify_ls(signals, NO_LAG)
    )


@pytest.fixture
def days(tmp_path):
    """Two recordings of one arm with different times and friction, each with its fit."""
    fits, whole = [], signals_of(SCARA)
    for day, rows, more in (("mon", (0, 6000), 0.0), ("tue", (5000, 12000), 0.4)):
        (tmp_path / day).mkdir()
        part = cut(whole, *rows)
        part = replace(
            part,
            t_s=part.t_s - part.t_s[0],
            effort=part.effort + [more, 0.0] * np.sign(np.gradient(part.q, axis=0)),
            measured=None,
            track=None,
        )
        write_signals(tmp_path / day / f"{day}.mcap", part, source="a part of another")
        signals = signals_of(tmp_path / day / f"{day}.mcap")
        fits.append(stored(tmp_path / day / f"{day}.json", identify_ls(signals, NO_LAG)))
    return fits


def compared(capsys, folder, *arguments):
    """The Rerun file of a comparison, its curves in s by panel and key, and what was printed."""
    status, out, err = run(capsys, "compare", *arguments, "--rrd", folder / "out.rrd")
    assert (status, err) == (0, "")
    file = Written(folder / "out.rrd")
    assert file.is_complete()
    curves = {
        path.replace("\\", "")[1:]: (1e-9 * t_ns, x) for path, (t_ns, x) in file.curves.items()
    }
    return file, curves, out


def torque_of(path, log):
    """Measured torque of a recording and that of the two-link planar arm with the parameters in
    the file of a fit, in closed form, both filtered as the rows of torque errors.
    """
    p, signals = (
        {p["name"]: p["value"] for p in json.loads(path.read_text())["parameters"]},
        signals_of(log),
    )
    s = make_problem(signals, NO_LAG).for_errors.settings
    motion = FilteredMotion(signals).between(s.start, s.stop, s.cutoff_hz)
    (v1, v2), (a1, a2), x = motion.dq.T, motion.ddq.T, motion.q[:, 1]
    along = p["MX2"] * np.cos(x) - p["MY2"] * np.sin(x)
    across = p["MX2"] * np.sin(x) + p["MY2"] * np.cos(x)
    turn, length = p["ZZ2"] * (a1 + a2), 0.5
    inner = length * (along * (2 * a1 + a2) - across * (2 * v1 * v2 + v2**2))
    torque = [
        p["ZZ1R"] * a1 + turn + inner + p["Fv1"] * v1 + p["Fc1"] * np.sign(v1),
        turn + length * (along * a1 + across * v1**2) + p["Fv2"] * v2 + p["Fc2"] * np.sign(v2),
    ]
    filtered = Decimation(factor=s.decimation).filtered
    return filtered(signals.effort[s.start : s.stop].T), [filtered(x) for x in torque]


def test_one_recording(beside, capsys, tmp_path):
    page = tmp_path / "out.html"
    _, curves, out = compared(capsys, tmp_path, *beside, "--report", page)
    assert f"Plots: rerun --bind 127.0.0.1 {tmp_path / 'out.rrd'}\n" in out
    assert "not drawn" not in out
    for j, joint in enumerate(JOINTS):
        of = f"torque/{joint}"
        keys = {key for key in curves if key.startswith(of)}
        assert keys == {f"{of}/{x}" for x in ("measured iv", "model iv", "model ls")}
        for name, path in zip(("iv", "ls"), beside, strict=True):
            t_s, x = curves[f"{of}/model {name}"]
            measured, expected = torque_of(path, SCARA)
            scale = np.abs(measured[j]).max()
            np.testing.assert_allclose(x, expected[j], atol=1e-6 * scale)
            np.testing.assert_allclose(curves[f"{of}/measured iv"][1], measured[j], atol=1e-9)
            rest = curves[f"residual/{joint}/residual {name}"]
            np.testing.assert_array_equal(rest[0], t_s)
            np.testing.assert_allclose(rest[1], measured[j] - expected[j], atol=1e-6 * scale)
    seen = opening_screen(tmp_path / "out.rrd")
    assert {f"/{kind}/{joint}" for kind in ("torque", "residual") for joint in JOINTS} < set(seen)
    (intervals,) = (at for view, at in seen.items() if view.startswith("/deviations"))
    assert intervals.tolist() == pytest.approx([0.6, 0.0, 0.4, 1.0])
    titles = re.findall(r"<figcaption[^>]*>([^<]+)<", page.read_text())
    drawn = [f"{kind} {joint} [N m]" for kind in ("torque", "residual") for joint in JOINTS]
    assert [title for title in titles if title in drawn] == drawn
    assert titles[0].startswith("Parameters of iv: "), "what is seen first"


def test_two_days_on_one_timeline(days, capsys, tmp_path):
    file, curves, _ = compared(capsys, tmp_path, *days)
    for j, joint in enumerate(JOINTS):
        for path in days:
            day = path.stem
            measured, expected = torque_of(path, path.with_suffix(".mcap"))
            for kind, values in (("measured", measured), ("model", expected)):
                t_s, x = curves[f"torque/{joint}/{kind} {day}"]
                np.testing.assert_allclose(x, values[j], atol=1e-6 * np.abs(measured[j]).max())
                assert 0.0 <= t_s[0] < 1.0, "from the start of its own recording"
    names = {
        path.replace("\\", ""): columns["SeriesLines:names"][0]
        for path, columns in file.static.items()
        if "SeriesLines:names" in columns
    }
    assert names["/torque/elbow/measured mon"] == "measured, mon"
    assert names["/torque/elbow/model tue"] == "tue"
    texts = next(
        columns["Points2D:labels"]
        for path, columns in file.static.items()
        if path.startswith("/deviations") and path.endswith("texts")
    )
    assert texts[0] == "Fc1", "the friction that was added differs most"


def test_recordings_named(days, beside, capsys, tmp_path):
    """By --log, which the fits need not have seen: one for both, or one each."""
    mon, tue = (path.with_suffix(".mcap") for path in days)
    for path in (mon, tue):
        path.rename(path.with_suffix(".moved"))
    _, curves, out = compared(capsys, tmp_path, *days)
    assert not any(key.startswith("torque") for key in curves)
    assert "Add --log LOG.mcap" in " ".join(out.split())
    for path in (mon, tue):
        shutil.copy(SCARA, path)  # of this name, and not what was fitted
    _, curves, _ = compared(capsys, tmp_path, *days)
    assert not any(key.startswith("torque") for key in curves)
    _, curves, out = compared(capsys, tmp_path, *days, "--log", SCARA)
    keys = {key.split("/")[2] for key in curves if key.startswith("torque")}
    assert keys == {"measured mon", "model mon", "model tue"}
    _, curves, _ = compared(
        capsys, tmp_path, *days, "--log", mon.with_suffix(".moved"), tue.with_suffix(".moved")
    )
    assert "torque/elbow/measured tue" in curves
    for options in (
        ["--log", SCARA, SCARA, SCARA, "--rrd", "a.rrd"],
        ["--log", SCARA],
        ["--log", SCARA, "--report", tmp_path / "a.md"],
    ):
        assert "one or two recordings of two fits" in refused(capsys, "compare", *days, *options)


def test_own_parameters_of_common_recording(days, capsys, tmp_path):
    """Of a fit to several recordings that the other has one of: that recording, with its own
    offset, as the fit in memory predicts it.
    """
    text = robot_named("scara").files["robot.toml"].decode()
    text = text.replace("[[joint]]\n", "[[joint]]\noffset = true\n")
    robot = robot_from_files(
        {"robot.toml": f'{text}\n[identification]\nown = ["Off"]\n'.encode()}, "robot.toml"
    )
    logs = []
    for k, path in enumerate(days):
        signals = signals_of(path.with_suffix(".mcap"))
        logs.append(tmp_path / f"r{k}.mcap")
        effort = signals.effort + np.array([0.5 - k, 0.0])
        write_signals(logs[-1], replace(signals, robot=robot, effort=effort), source="made up")
    both = identify_ls(Recordings(sources=tuple(map(signals_of, logs))), Overrides())
    assert "Off1@r1" in both.estimate.names
    a = stored(tmp_path / "both.json", both)
    b = stored(tmp_path / "one.json", identify_ls(signals_of(logs[1]), Overrides()))
    _, curves, _ = compared(capsys, tmp_path, a, b)
    keys = {key.split("/")[2] for key in curves if key.startswith("torque")}
    assert keys == {"measured both", "model both", "model one"}
    (_, one), shoulder = both.recordings, curves["torque/shoulder/model both"][1]
    scale = np.abs(one.tau[:, 0]).max()
    np.testing.assert_allclose(shoulder, one.tau_predicted[:, 0], atol=1e-6 * scale)
    off = {p.name: p.value for p in fit_file(both).parameters}
    assert abs(off["Off1@r0"] - off["Off1@r1"]) > 0.5, "what their mean would be off by"


def test_fits_in_amperes(capsys, tmp_path):
    log = tmp_path / "a.mcap"
    write_signals(log, made_up(types=("revolute",), unit="A"), source="made up")
    fit = identify_ls(signals_of(log), Overrides())
    paths = stored(tmp_path / "a.json", fit), stored(tmp_path / "b.json", fit)
    file, curves, _ = compared(capsys, tmp_path, *paths)
    assert file.views["/torque/joint\\ 1.x"][1] == "torque joint 1.x [A]"
    expected = fit.recordings[0].tau_predicted[:, 0]
    np.testing.assert_allclose(curves["torque/joint 1.x/model b"][1], expected, atol=1e-9)


def test_prior_has_parameters_alone(capsys, tmp_path):
    tx40 = REPLAY / "tx40"
    file, curves, out = compared(capsys, tmp_path, tx40 / "fit.json", tx40 / "robot.toml")
    assert (curves, "--log" in out) == ({}, False)
    assert {kind for kind, _ in file.views.values()} == {"2D", "TextDocument"}
    options = "--log", SCARA, "--rrd", "a.rrd"
    assert "of two fits" in refused(
        capsys, "compare", tx40 / "fit.json", tx40 / "robot.toml", *options
    )


def test_other_robot_leaves_no_file(beside, capsys, tmp_path):
    other = stored(tmp_path / "emps.json", ls_of(EMPS))
    rrd = tmp_path / "out.rrd"
    assert "Fv1.unit" in refused(capsys, "compare", beside[0], other, "--rrd", rrd)
    options = "--log", EMPS, "--rrd", rrd
    assert "joints recorded = 1" in refused(capsys, "compare", *beside, *options)
    assert not rrd.exists()


def test_largest_difference_first_and_significant_marked(days):
    own, other = (
        ParameterSet.of_file(
            fit_file(identify_ls(signals_of(p.with_suffix(".mcap")), Overrides())), p.stem
        )
        for p in days
    )
    off = {}
    for name, a in own.parameters.items():
        b = other.parameters[name]
        # A half-width is 1.96 standard errors here, in more rows than parameters.
        off[name] = abs(a.value - b.value) / np.hypot(a.half, b.half) * 1.96
    (page, _) = draw_comparison(own, other, comparison_section(own, other), {}).pages
    (chart,) = page.groups["parameters"]
    assert [name for name, _ in chart.names] == sorted(off, key=off.get, reverse=True)
    marked = {
        chart.names[int(mark.row)][0] for mark in chart.columns[1].marks if mark.color == VERMILLION
    }
    assert marked == {name for name, x in off.items() if x > 3.0}
    assert 0 < len(marked) < len(off)
