"""The choice of friction terms by several recordings: held out one by one, against least
squares by hand; their page.
"""

import dataclasses
import json
from functools import cache

import msgspec
import numpy as np
import pytest
from conftest import REPLAY
from friction_models import LOAD, ROOT, WITHOUT_LAG, recorded, upright
from scipy import stats

from identification.commands import main
from identification.data import Recordings
from identification.design import Trial, select_friction, smallest_near_best, with_terms
from identification.errors import RobotIdimError
from identification.regression import (
    equation_alone,
    make_problem,
    rows_of_recording,
    torque_of_recording,
    weights_at,
    with_common_band,
)
from identification.results import fit_file, identify_ls
from identification.study import write_signals
from identification.view import recording_panels

USUAL = ["viscous", "coulomb"]
MORE = "Fr1 = 0.8\nmu1 = 0.3\nmu2 = 0.3\n"
# of all sets of terms: the rule lets slower samples count where a set has root or load friction
RULES = dataclasses.replace(WITHOUT_LAG, low_speed_percent=4.0)


def with_own(robot, *own: str):
    return dataclasses.replace(
        robot, identification=msgspec.structs.replace(robot.identification, own=own)
    )


@cache
def several(own: tuple[str, ...] = ()):
    """Three recordings, one shorter, of a robot with root friction at the shoulder and load
    friction at both joints.
    """
    usual = [*USUAL, "offset"] if own else USUAL
    robot = with_own(upright([[*usual, "root", "load"], [*usual, "load"]], MORE), *own)
    found = []
    for seed, duration_s in ((1, 6.0), (2, 4.0), (3, 6.0)):
        signals = recorded(robot, seed, duration_s)
        if own:
            signals = dataclasses.replace(
                signals, effort=signals.effort + seed * np.array([3.0, 0.5])
            )
        found.append(dataclasses.replace(signals, recording=f"r{seed}.mcap", sha256=f"{seed:064x}"))
    return tuple(found)


@cache
def chosen(own: tuple[str, ...] = ()):
    return select_friction(Recordings(sources=several(own)), RULES)


def weighted_rows(problem) -> tuple[np.ndarray, np.ndarray]:
    """W (n, rows, b) and Y (n, rows), every column computed at the recording's rate."""
    s = problem.settings
    m = problem.motion.between(s.start, s.stop, s.cutoff_hz)
    whole = problem.model.regressor(m.q, m.dq, m.ddq)[..., problem.base.columns]
    w = weights_at(problem, m.t_s)
    W = s.decimator.filtered(w[:, None] * whole.transpose(1, 2, 0)).transpose(0, 2, 1)
    return W, s.decimator.filtered(w * m.tau.T)


def in_fifths(rows: int) -> np.ndarray:
    return np.searchsorted(np.ceil(np.arange(1, 5) * rows / 5), np.arange(rows), side="right")


@pytest.mark.parametrize(("count", "own"), [(1, ()), (3, ("Off",))])
def test_cross_validation_by_hand(count, own):
    """By hand: weighted rows of the other parts, recordings or fifths, error of moving rows;
    own offsets fitted to it.
    """
    recordings = Recordings(sources=several(own)[:count])
    choice = chosen(own) if count > 1 else select_friction(recordings, RULES)
    assert choice.recommended.terms == (ROOT | LOAD, LOAD)
    w = identify_ls(recordings, choice.overrides).estimate.weights[:, None]
    problems = with_common_band(
        [make_problem(signals, choice.overrides) for signals in recordings.sources]
    )
    plain = [rows_of_recording(*equation_alone(problem)) for problem in problems]
    fast = np.concatenate([one.counts for one in plain]).T
    each = zip(*map(weighted_rows, problems), strict=True)
    W, Y = (np.concatenate(x, axis=1) for x in each)
    if count > 1:
        assert choice.held_out == ("r1.mcap", "r2.mcap", "r3.mcap")
        part = np.repeat(range(count), [len(one.tau) for one in plain])
    else:
        part = in_fifths(fast.shape[1])
    off, fitted = np.array([name.startswith("Off") for name in plain[0].system.names]), []
    for k in range(part.max() + 1):
        A = np.concatenate(
            [W[..., ~off], *(W[..., off] * (part == i)[:, None] for i in range(part.max() + 1))],
            axis=2,
        )
        of_others, of_part = fast & (part != k), fast & (part == k)
        beta = np.zeros(len(off))
        beta[~off] = np.linalg.lstsq((A * w[..., None])[of_others], (Y * w)[of_others])[0][
            : (~off).sum()
        ]
        if off.any():
            rho = Y - W @ beta
            beta[off] = np.linalg.lstsq((W[..., off] * w[..., None])[of_part], (rho * w)[of_part])[
                0
            ]
        rho = Y - W @ beta
        assert choice.usual.scores[k] == pytest.approx((((rho * w)[of_part]) ** 2).sum(), rel=1e-6)
        fitted.append(beta)
    of_each = [
        torque_of_recording(
            *equation_alone(problem.for_errors), fitted if count == 1 else fitted[k : k + 1]
        )
        for k, problem in enumerate(problems)
    ]
    tau, predicted, counts = (
        np.concatenate(x) for x in zip(*((t, p, c) for t, (p,), c, *_ in of_each), strict=True)
    )
    # a fifth ends where one of the fit does
    judged = np.concatenate([np.full(len(at), k) for k, (*_, at) in enumerate(of_each)])
    judged = judged if count > 1 else part[np.minimum(of_each[0][-1], len(part) - 1)]
    for k in range(part.max() + 1):
        shown = counts & (judged == k)[:, None]
        error = 100 * np.linalg.norm((tau - predicted)[shown]) / np.linalg.norm(tau[shown])
        within = 1e-6 if count > 1 else 0.02  # the samples of rows beside a border
        assert choice.usual.held_out_percents[k] == pytest.approx(error, rel=within)


def test_insignificant_terms_removed_per_joint():
    """Root and load friction at all joints predict best; in a fit of these the root of
    the elbow is not seen.
    """
    both = next(trial for trial in chosen().trials if trial.terms == (ROOT | LOAD,) * 2)
    assert both.significant_terms == chosen().recommended.terms
    sources = (
        dataclasses.replace(one, robot=with_terms(one.robot, both.terms)) for one in several()
    )
    fit = identify_ls(Recordings(sources=tuple(sources)), WITHOUT_LAG)
    t = dict(zip(fit.estimate.names, fit.estimate.beta / fit.intervals.sigma, strict=True))
    limit = stats.t.isf(0.02 / 2 / 6, fit.intervals.freedom)  # three terms at two joints are tried
    assert abs(t["Fr2"]) < limit < min(t["Fr1"], t["mu1"], t["mu2"])


def test_smallest_set_within_one_error():
    def trial(count, *scores):
        terms = tuple(frozenset({"root"} if k < count else ()) for k in range(3))
        errors = {"fitted_error_percent": 1.0, "held_out_percents": np.ones(4)}
        return Trial(
            terms=terms, significant_terms=terms, scores=np.array(scores, dtype=float), **errors
        )

    best, near, far = trial(3, 9, 11, 10, 10), trial(2, 11, 10, 12, 9), trial(1, 12, 14, 12, 13)
    # The paired differences have the means 0.5 and 2.75 and the standard errors 0.87 and 0.25.
    assert smallest_near_best([far, near, best]) is near
    assert smallest_near_best([far, best]) is best


def test_choice_independent_of_recording_order():
    again = select_friction(Recordings(sources=several()[::-1]), RULES)
    assert [trial.terms for trial in again.trials] == [trial.terms for trial in chosen().trials]
    assert [trial.score for trial in again.trials] == [trial.score for trial in chosen().trials]


def test_unpredicted_recording_named():
    still = []
    for signals in several()[:2]:
        q = signals.q.copy()
        q[:, 1] = 0.3
        still.append(dataclasses.replace(signals, q=q))
    choice = select_friction(Recordings(sources=(*still, several()[2])), WITHOUT_LAG)
    assert choice.held_out == ("r1.mcap", "r2.mcap")
    (line,) = [line for line in choice.left_out if "predicted" in line]
    assert line.startswith("r3.mcap cannot be predicted by the others, which do not determine ")
    assert "Fc2" in line
    with pytest.raises(RobotIdimError) as refused:
        select_friction(Recordings(sources=(still[0], several()[2])), WITHOUT_LAG)
    assert (refused.value.key, refused.value.value) == ("parts held out", 1)
    assert "r3.mcap cannot be predicted by the others" in str(refused.value)


@pytest.mark.parametrize("names", [["r1.mcap"], ["r3.mcap", "r2.mcap", "r1.mcap"]])
def test_command_prints_and_stores_terms(names, tmp_path, capsys):
    for signals in several():
        write_signals(tmp_path / signals.recording, signals, source="test")
    text = (
        "gravity_m_s2 = [0, -9.81, 0] # it hangs\n" + (REPLAY / "scara" / "robot.toml").read_text()
    )
    toml, result = tmp_path / "robot.toml", tmp_path / "out.json"
    stated = ["viscous = true", "coulomb = true # both"]
    toml.write_text(text.replace("rotor_inertia", "\n".join([*stated, "rotor_inertia"]), 1))
    page = tmp_path / "a.html"
    options = [
        "--robot",
        str(toml),
        "--torque-lag-s=none",
        "--json",
        str(result),
        "--write",
        "--report",
        str(page),
    ]
    assert main(["friction", *(str(tmp_path / name) for name in names), *options]) == 0
    stored, several_names = json.loads(result.read_text()), names if len(names) > 1 else []
    terms = {"shoulder": [*USUAL, "root", "load"], "elbow": [*USUAL, "load"]}
    assert (stored["recommended"], stored["recording"]) == (terms, names[0])
    assert [one["recording"] for one in stored.get("recordings", [])] == several_names
    assert sorted(stored["held_out"]) == (
        sorted(several_names) or [f"fifth {k}" for k in range(1, 6)]
    )
    for one in stored["sets"]:
        assert (len(one["held_out_percents"]), one["held_out_error_percent"]) == (
            len(stored["held_out"]),
            pytest.approx(np.mean(one["held_out_percents"])),
        )
        assert 0.1 < one["fitted_error_percent"] < one["held_out_error_percent"]
    assert stored["sets"][0]["held_out_error_percent"] < 1
    out, comments = capsys.readouterr().out, [f"# {line}" for line in stated]
    expected = text.replace("rotor_inertia", "\n".join([*comments, "rotor_inertia"]), 1)
    for joint, own in terms.items():
        line = f"friction = {json.dumps(own)}"
        assert f"{line} # {joint}\n" in out
        expected = expected.replace(f'name = "{joint}"\n', f'name = "{joint}"\n{line}\n')
    assert toml.read_text() == expected
    assert all(
        f"friction {joint}, {fit} [" in page.read_text()
        for joint in terms
        for fit in ("usual", "recommended")
    )
    held = ", ".join(several_names) or "fifths of the recording"
    assert f"held out: {held}, each predicted by the fit of the others" in " ".join(out.split())


@pytest.mark.parametrize(("terms", "own"), [(["root"], ("Fv",)), (["root", "load"], ())])
def test_view_shows_each_joint_over_recordings(terms, own, monkeypatch):
    """Rows of all recordings; curves and intervals of the shared parameters, at three loads; of
    own parameters the mean.
    """
    monkeypatch.setattr(recording_panels, "MAX_DOTS", 10**9)  # each row
    values = "Fr1 = 0.8\nmu1 = 0.3\n" if len(terms) > 1 else "Fr1 = 0.8\n"
    robot = with_own(upright([[*USUAL, *terms], USUAL], values), *own)
    sources = tuple(dataclasses.replace(one, robot=robot) for one in several())
    fit = identify_ls(Recordings(sources=sources), WITHOUT_LAG)

    def columns(v, load, labels):
        """(k, b) friction of the shoulder per unit of the parameters; of their own
        the mean over recordings.
        """
        g = np.zeros((len(v), len(fit.estimate.names)))
        shapes = {
            "Fv1": v,
            "Fc1": np.sign(v),
            "Fr1": np.sqrt(np.abs(v)) * np.sign(v),
            "mu1": load * np.sign(v),
        }
        for i, (name, _, label) in enumerate(x.partition("@") for x in fit.estimate.names):
            if name in shapes and label in ("", *labels):
                g[:, i] = shapes[name] / (len(labels) if label else 1)
        return g

    def rows_of(recordings, labels):
        """Points (2, k) of the rows of the shoulder, whose curves and intervals are
        those of the parameters.
        """
        shoulder, _ = recording_panels.friction_charts(fit_file(fit), recordings)
        assert len(shoulder.curves) == 6 * (3 if "load" in terms else 1)
        for curve, *edges in zip(*[iter(shoulder.curves)] * 3, strict=True):
            v, torque = curve.line
            g = columns(v, float(curve.name.split()[1]) if "load" in terms else 0.0, labels)
            half = fit.intervals.reach * np.sqrt(np.sum(g @ fit.intervals.covariance * g, axis=1))
            # the load is rounded
            np.testing.assert_allclose(torque, g @ fit.estimate.beta, rtol=0.01)
            for edge, side in zip(edges, (-1, 1), strict=True):
                assert (edge.name, edge.dashed) == ("95 % interval", True)
                np.testing.assert_allclose(edge.line[1] - torque, side * half, rtol=0.02)
        return np.concatenate([points for points, _ in shoulder.dots]).T

    whole, each = rows_of(fit.recordings, ["r1", "r2", "r3"]), []
    for fitted, label in zip(fit.recordings, ("r1", "r2", "r3"), strict=True):
        dots = rows_of([fitted], [label])
        *_, speed, _, _ = torque_of_recording(*equation_alone(fitted.problem.for_errors))
        v, rho = speed[:, 0], (fitted.tau - fitted.tau_predicted)[:, 0]
        rows = np.abs(v) > 0.02 * np.abs(v).max()
        if own:
            expected = np.stack([v, columns(v, 0.0, [label]) @ fit.estimate.beta + rho])[:, rows]
            np.testing.assert_allclose(dots, expected, rtol=1e-9, atol=1e-9)
        # of the peak that all have
        each.append(dots[:, np.abs(dots[0]) > 0.02 * np.abs(whole[0]).max()])
    assert len(whole[0]) > 100
    # in any order of loads
    found, expected = (x[:, np.lexsort(x)] for x in (whole, np.concatenate(each, axis=1)))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
