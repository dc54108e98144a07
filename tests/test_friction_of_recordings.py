"""The choice of friction terms by several recordings: held out one by one, against least squares by hand; their page."""

import dataclasses
import json
from functools import cache

import msgspec
import numpy as np
import pytest
from conftest import REPLAY
from scipy import stats
from test_friction_terms import LOAD, ROOT, WITHOUT_LAG, recorded, upright

from identification import view
from identification.commands import main
from identification.data import RecordingFile, Recordings
from identification.design import select_friction, with_terms
from identification.design.selection import Trial, smallest_near_best
from identification.errors import IdentificationError
from identification.methods import identify_ls
from identification.regression import make_problem, regression_of_recording
from identification.study import write_signals
from identification.view import charts

USUAL = ["viscous", "coulomb"]
MORE = "Fr1 = 0.8\nmu1 = 0.3\nmu2 = 0.3\n"


def with_own(robot, *own: str):
    return dataclasses.replace(robot, identification=msgspec.structs.replace(robot.identification, own=own))


@cache
def several(own: tuple[str, ...] = ()):
    """Three recordings, one shorter, of a robot with root friction at the shoulder and load friction at both joints."""
    usual = [*USUAL, "offset"] if own else USUAL
    robot = with_own(upright([[*usual, "root", "load"], [*usual, "load"]], MORE), *own)
    found = []
    for seed, duration_s in ((1, 6.0), (2, 4.0), (3, 6.0)):
        signals = recorded(robot, seed, duration_s=duration_s)
        if own:
            signals = dataclasses.replace(signals, effort=signals.effort + seed * np.array([3.0, 0.5]))
        found.append(dataclasses.replace(signals, recording=f"r{seed}.mcap", sha256=f"{seed:064x}"))
    return tuple(found)


@cache
def chosen(own: tuple[str, ...] = ()):
    return select_friction(Recordings(sources=several(own)), WITHOUT_LAG)


@pytest.mark.slow
@pytest.mark.parametrize("own", [(), ("Off",)])
def test_recordings_are_held_out_one_by_one(own):
    """By hand: weighted rows of the other recordings, the error in the moving rows of the one; its own offsets fitted to it."""
    choice, recordings = chosen(own), several(own)
    assert choice.recommended.terms == (ROOT | LOAD, LOAD)
    assert choice.held_out == ("r1.mcap", "r2.mcap", "r3.mcap")
    weights = identify_ls(Recordings(sources=recordings), WITHOUT_LAG).estimate.weights
    plain = [regression_of_recording(make_problem(signals, WITHOUT_LAG)) for signals in recordings]
    names = plain[0].system.names
    off = np.array([name.startswith("Off") for name in names])
    peak = np.max([np.abs(one.speed).max(axis=0) for one in plain], axis=0)
    blocks = []  # by recording, a row of weights beside W and Y
    for one in plain:
        w = weights[one.system.joint_of_row]
        blocks.append((one.system.W * w[:, None], one.system.Y * w, one.system.used > 0))
    for k, one in enumerate(plain):
        others = [i for i in range(3) if i != k]
        A, b = [], []
        for place, i in enumerate(others):
            W, Y, used = blocks[i]
            each = np.zeros((len(W), off.sum() * len(others)))
            each[:, place * off.sum() : (place + 1) * off.sum()] = W[:, off]
            A.append(np.c_[W[:, ~off], each][used])
            b.append(Y[used])
        beta = np.linalg.lstsq(np.concatenate(A), np.concatenate(b))[0][: (~off).sum()]
        W, Y, used = blocks[k]
        rho = Y - W[:, ~off] @ beta
        if off.any():
            rho = rho - W[:, off] @ np.linalg.lstsq(W[used][:, off], rho[used])[0]
        moving = (np.abs(one.speed) > 0.02 * peak).T.reshape(-1)
        assert choice.usual.scores[k] == pytest.approx((rho[moving] ** 2).sum(), rel=1e-6)
        rho = rho / weights[one.system.joint_of_row]
        tau = one.tau.T.reshape(-1)
        error = 100 * np.linalg.norm(rho[moving]) / np.linalg.norm(tau[moving])
        assert choice.usual.held_out_percents[k] == pytest.approx(error, rel=1e-6)


def test_terms_whose_interval_holds_0_go_joint_by_joint():
    """Root and load friction at all joints predict best; in a fit of these the root of the elbow is not seen."""
    both = next(trial for trial in chosen().trials if trial.terms == (ROOT | LOAD,) * 2)
    assert both.significant_terms == chosen().recommended.terms
    sources = (dataclasses.replace(one, robot=with_terms(one.robot, both.terms)) for one in several())
    fit = identify_ls(Recordings(sources=tuple(sources)), WITHOUT_LAG)
    t = dict(zip(fit.estimate.names, fit.estimate.beta / fit.intervals.sigma, strict=True))
    limit = stats.t.isf(0.02 / 2 / 6, fit.intervals.freedom)  # three terms at two joints are tried
    assert abs(t["Fr2"]) < limit < min(t["Fr1"], t["mu1"], t["mu2"])


def test_of_sets_within_one_standard_error_of_the_best_the_smallest_is_taken():
    def trial(count, *scores):
        terms = tuple(frozenset({"root"} if k < count else ()) for k in range(3))
        return Trial(
            terms=terms,
            significant_terms=terms,
            fitted_error_percent=1.0,
            held_out_percents=np.ones(4),
            scores=np.array(scores, dtype=float),
        )

    best, near, far = trial(3, 9, 11, 10, 10), trial(2, 11, 10, 12, 9), trial(1, 12, 14, 12, 13)
    # The paired differences have the means 0.5 and 2.75 and the standard errors 0.87 and 0.25.
    assert smallest_near_best([far, near, best]) is near
    assert smallest_near_best([far, best]) is best


def test_the_choice_does_not_depend_on_the_order_of_the_recordings():
    again = select_friction(Recordings(sources=several()[::-1]), WITHOUT_LAG)
    assert [trial.terms for trial in again.trials] == [trial.terms for trial in chosen().trials]
    assert [trial.score for trial in again.trials] == [trial.score for trial in chosen().trials]


def test_a_recording_that_the_others_cannot_predict_is_named():
    """The elbow moves in one of three recordings: the others say nothing of it. Of two no part is left."""
    still = []
    for signals in several()[:2]:
        q = signals.q.copy()
        q[:, 1] = 0.3
        still.append(dataclasses.replace(signals, q=q))
    choice = select_friction(Recordings(sources=(*still, several()[2])), WITHOUT_LAG)
    assert choice.held_out == ("r1.mcap", "r2.mcap")
    (line,) = [line for line in choice.left_out if "predicted" in line]
    assert line.startswith("r3.mcap cannot be predicted by the others: ")
    assert "Fc2" in line
    with pytest.raises(IdentificationError) as refused:
        select_friction(Recordings(sources=(still[0], several()[2])), WITHOUT_LAG)
    assert (refused.value.key, refused.value.value) == ("parts held out", 1)
    assert "r3.mcap cannot be predicted by the others" in str(refused.value)


@pytest.mark.slow
def test_the_command_takes_several_recordings(tmp_path, capsys):
    files, toml, result = [], tmp_path / "robot.toml", tmp_path / "out.json"
    for signals in several():
        files.append(str(tmp_path / signals.recording))
        write_signals(tmp_path / signals.recording, signals, source="test")
    toml.write_text("gravity_m_s2 = [0, -9.81, 0]\n" + (REPLAY / "scara" / "robot.toml").read_text())
    options = ["--robot", str(toml), "--torque-lag-s", "none", "--json", str(result), "--write"]
    assert main(["friction", *files[::-1], *options]) == 0
    stored = json.loads(result.read_text())
    assert stored["recommended"] == {"shoulder": [*USUAL, "root", "load"], "elbow": [*USUAL, "load"]}
    assert stored["recording"] == "r3.mcap"
    assert [one["recording"] for one in stored["recordings"]] == ["r3.mcap", "r2.mcap", "r1.mcap"]
    assert sorted(stored["held_out"]) == ["r1.mcap", "r2.mcap", "r3.mcap"]
    assert all(len(one["held_out_percents"]) == 3 for one in stored["sets"])
    out = capsys.readouterr().out
    sets = {cells[1].strip(): cells[-2].strip() for line in out.splitlines() if len(cells := line.split("│")) == 8}
    assert {"root; load", "load", "asymmetric; root"} <= set(sets)  # no names where all joints have the term
    assert (sets["root: shoulder; load"], sets["none"]) == ("recommended", "usual")
    assert "held out: r3.mcap, r2.mcap, r1.mcap, each predicted by the fit of the others" in " ".join(out.split())
    assert 'friction = ["viscous", "coulomb", "root", "load"]' in toml.read_text()
    found = select_friction(
        Recordings(sources=tuple(map(RecordingFile.at, map(tmp_path.joinpath, files)))), WITHOUT_LAG
    )
    assert found.recommended.terms == (ROOT | LOAD, LOAD)


def test_the_page_has_each_joint_over_all_recordings(monkeypatch):
    """Rows of all recordings, and the curve of the parameters that they share; of own parameters the mean."""
    monkeypatch.setattr(charts, "MAX_DOTS", 10**9)  # each row
    robot = with_own(upright([[*USUAL, "root"], USUAL], "Fr1 = 0.8\n"), "Fv")
    sources = tuple(dataclasses.replace(one, robot=robot) for one in several())
    fit = identify_ls(Recordings(sources=sources), WITHOUT_LAG)
    values = dict(zip(fit.estimate.names, fit.estimate.beta, strict=True))
    own = [values[f"Fv1@r{k}"] for k in (1, 2, 3)]

    def drawn(fit):
        """Points (2, k) of the rows of the shoulder, and of its curve."""
        shoulder, _ = charts.friction_charts(fit)
        ((dots, _),) = shoulder.dots
        return dots.T, np.concatenate([curve.line for curve in shoulder.curves[::3]], axis=1)

    def friction(v, Fv):
        return Fv * v + (values["Fc1"] + values["Fr1"] * np.sqrt(np.abs(v))) * np.sign(v)

    whole, (v, torque) = drawn(fit)
    np.testing.assert_allclose(torque, friction(v, np.mean(own)), rtol=1e-9, atol=1e-9)
    each = []
    for fitted, Fv in zip(fit.recordings, own, strict=True):
        dots, (v, torque) = drawn(fit.on(fitted))
        np.testing.assert_allclose(torque, friction(v, Fv), rtol=1e-9, atol=1e-9)
        v, rho = (x[fitted.rows, 0] for x in (fit.speed, fit.tau - fit.tau_predicted))
        rows = np.abs(v) > 0.02 * np.abs(v).max()
        np.testing.assert_allclose(dots, np.stack([v, friction(v, Fv) + rho])[:, rows], rtol=1e-9, atol=1e-9)
        each.append(dots[:, np.abs(dots[0]) > 0.02 * np.abs(whole[0]).max()])  # of the peak that all have
    assert len(whole[0]) > 100
    np.testing.assert_allclose(whole, np.concatenate(each, axis=1), rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3])
def test_the_page_of_the_command_has_curves_and_intervals_of_the_fits(tmp_path, count, monkeypatch):
    files, drawn = [], []
    for signals in several()[:count]:
        files.append(str(tmp_path / signals.recording))
        write_signals(tmp_path / signals.recording, signals, source="test")
    monkeypatch.setattr(view, "write_html", lambda path, picture: drawn.append(picture))
    assert main(["friction", *files, "--torque-lag-s", "none", "--report", str(tmp_path / "a.html")]) == 0
    ((page,),) = (picture.pages for picture in drawn)
    charts = {chart.path[1:]: chart for of_joint in page.groups.values() for chart in of_joint}
    names = {"usual": (frozenset(),) * 2, "recommended": (ROOT | LOAD, LOAD)}
    joints = ("shoulder", "elbow")
    assert list(charts) == [(joint, name) for joint in joints for name in names]
    for name, terms in names.items():
        signals = (dataclasses.replace(one, robot=with_terms(one.robot, terms)) for one in several()[:count])
        fit = identify_ls(Recordings(sources=tuple(signals)), WITHOUT_LAG)
        moved = np.abs(fit.speed) > 0.02 * np.abs(fit.speed).max(axis=0)
        for j, joint in enumerate(joints, 1):
            chart = charts[joint, name]
            assert chart.title.startswith(f"friction {joint}, {name} [")
            texts = dict.fromkeys(curve.name for curve in chart.curves)
            loads = [float(text.split()[1]) for text in texts if text.startswith("load")]
            assert len(loads) == (3 if name == "recommended" else 0)
            assert len(chart.curves) == 6 * max(1, len(loads))
            for k, (curve, *edges) in enumerate(zip(*[iter(chart.curves)] * 3, strict=True)):
                v, torque = curve.line
                g = np.zeros((len(v), len(fit.estimate.names)))
                for parameter, column in (
                    (f"Fv{j}", v),
                    (f"Fc{j}", np.sign(v)),
                    (f"Fr{j}", np.sqrt(np.abs(v)) * np.sign(v)),
                    (f"mu{j}", (loads or [0, 0, 0])[k // 2] * np.sign(v)),
                ):
                    if parameter in fit.estimate.names:
                        g[:, fit.estimate.names.index(parameter)] = column
                half = fit.intervals.reach * np.sqrt(np.sum(g @ fit.intervals.covariance * g, axis=1))
                np.testing.assert_allclose(
                    torque, g @ fit.estimate.beta, atol=0.01 * np.abs(torque).max()
                )  # load rounded
                for edge, side in zip(edges, (-1, 1), strict=True):
                    assert (edge.name, edge.dashed) == ("95 % interval", True)
                    np.testing.assert_allclose(edge.line[1] - torque, side * half, rtol=0.02)
            points = np.concatenate([points for points, _ in chart.dots])
            every = max(1, moved[:, j - 1].sum() // 400)
            expected = fit.speed[moved[:, j - 1], j - 1][::every]
            np.testing.assert_allclose(np.sort(points[:, 0]), np.sort(expected))
