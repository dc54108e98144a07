"""Samples that stand weigh nothing: the weights by their formula, what they leave out exactly,
and how ramps are chosen.
"""

import dataclasses
from itertools import product

import msgspec
import numpy as np
import pytest
from conftest import REPLAY
from described_truth import off

from acquisition.robot import LowSpeed
from identification.data import Recordings, load_signals
from identification.errors import NoFitError
from identification.methods import solve
from identification.regression import (
    ROWS,
    Decimation,
    FilteredMotion,
    Overrides,
    equation_alone,
    make_problem,
    make_settings,
    rows_of_recording,
    sample_weights,
    weights_at,
)
from identification.regression.blocks import SampleWeights
from identification.results import identify_ls
from identification.study import Noise, closed_loop

SCARA = load_signals(REPLAY / "scara" / "session.mcap")


def scara(**changes):
    """The shipped SCARA as a problem, with other signals."""
    return make_problem(dataclasses.replace(SCARA, **changes), Overrides(torque_lag_s="none"))


def by_formula(moves: np.ndarray, L: int) -> np.ndarray:
    """Moving samples eroded by L, convolved with a Hann window of 2 L + 1 samples of sum
    1, zero where it stood.
    """
    window = np.sin(np.pi * np.arange(1, 2 * L + 2) / (2 * L + 2)) ** 2
    found, N = np.zeros(len(moves)), len(moves)
    for k in np.flatnonzero(moves):
        near = [
            all(moves[max(0, i - L) : i + L + 1])
            for i in np.clip(np.arange(k - L, k + L + 1), 0, N - 1)
        ]
        found[k] = np.dot(near, window) / window.sum()
    return found


def test_weights_match_formula_in_any_block():
    moves = np.ones((400, 2), dtype=bool)
    moves[150:160, 0] = moves[300:, 0] = moves[40:60, 1] = False
    problem = scara()
    settings = dataclasses.replace(
        problem.settings, used=range(400), decimator=Decimation(factor=10)
    )
    problem = dataclasses.replace(problem, settings=settings)
    weights = SampleWeights(problem, moves)
    expected = np.stack([by_formula(own, 20) for own in moves.T])
    np.testing.assert_allclose(weights.between(0, 400), expected, atol=1e-12)
    np.testing.assert_allclose(weights.between(137, 211), expected[:, 137:211], atol=1e-12)
    assert expected[0, 160 + 20] == pytest.approx(0.5, abs=0.03)
    assert (expected[0, 200:260] == pytest.approx(1.0), expected[0, 150:160].max()) == (True, 0.0)


def test_standstill_within_half_cutoff_period():
    """A joint that follows a known speed: zero where it is below 4 % of its peak within 20
    ms, at 1 kHz and 25 Hz.
    """
    t = SCARA.t_s
    q = np.stack([np.sin(2 * np.pi * t), 0.5 * np.sin(np.pi * t)], axis=1)  # far below the cut-off
    problem = scara(q=q)
    s = problem.settings
    speed = np.abs(
        np.stack([2 * np.pi * np.cos(2 * np.pi * t), 0.5 * np.pi * np.cos(np.pi * t)], axis=1)
    )
    slow = speed < 0.04 * speed.max(axis=0)
    near = np.array([slow[max(0, k - 20) : k + 21].any(axis=0) for k in range(len(t))])
    found = ~sample_weights(problem).moves[s.start : s.stop]
    assert 0.05 < near[s.start : s.stop].mean() < 0.2
    assert (found != near[s.start : s.stop]).mean() < 2e-3  # samples at the threshold


def test_coupled_joints_rest_with_their_motor(monkeypatch):
    """At equal speeds of opposite sign a motor on both joints stands."""
    t = SCARA.t_s
    q = np.stack([np.sin(2 * np.pi * 0.5 * t), -np.sin(2 * np.pi * 0.5 * t)], axis=1)
    problem = scara(q=q)
    assert sample_weights(problem).moves.mean() > 0.8
    monkeypatch.setattr(
        problem.model, "coulomb_directions", np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    )
    # The sum of both speeds is rounding alone: its peak is no speed, and what is below 4
    # deviations of noise stands.
    q = q + np.c_[0 * t, 1e-3 * np.sin(2 * np.pi * 0.1 * t)]
    problem = dataclasses.replace(problem, motion=FilteredMotion(dataclasses.replace(SCARA, q=q)))
    both = sample_weights(problem).moves
    assert (both[:, 0] == both[:, 1]).mean() > 0.9


def test_rows_and_columns_share_weights():
    """Y = F[w tau] and W beta = F[w W beta] by hand, and the weight of a row F[w]
    over the filter's gain.
    """
    problem = scara()
    s, plain = problem.settings, rows_of_recording(*equation_alone(problem))
    motion = problem.motion.between(s.start, s.stop, s.cutoff_hz)
    w, F = weights_at(problem, motion.t_s), s.decimator.filtered
    share = F(w) / F(np.ones_like(w))
    counts = share > 0.1
    beta = np.arange(1.0, 9.0)
    full = (
        problem.model.regressor(motion.q, motion.dq, motion.ddq)[..., problem.base.columns] @ beta
    )
    by_hand = np.stack([F(w * motion.tau.T), F(w * full.T)], axis=2)
    rows = np.c_[plain.system.Y, plain.system.W @ beta]
    for j, span in product(range(2), range(0, 120, 7)):
        part = slice(*plain.system.spans[0][span : span + 2])
        own = by_hand[j, part][counts[j, part]]
        found = rows[(plain.system.joint_of_row == j) & (plain.system.span == span)]
        np.testing.assert_allclose(found.T @ found, own.T @ own, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(plain.share.T, np.where(counts, share, 0.0), atol=1e-3)
    assert plain.system.rows == pytest.approx(
        (np.where(counts, share, 0.0) ** 2).sum(axis=1), rel=1e-3
    )


def test_zero_threshold_disables_weights():
    """Decimated torque and regressor as they are: the digits that are published.

    The number is that of the method.
    """
    problem = make_problem(SCARA, Overrides(low_speed_percent=0.0, torque_lag_s="none"))
    plain, s = rows_of_recording(*equation_alone(problem)), problem.settings
    assert (plain.share == 1.0).all()
    squares = np.bincount(plain.system.joint_of_row, plain.system.Y**2)
    np.testing.assert_allclose(squares, (plain.tau**2).sum(axis=0), rtol=1e-12)
    assert plain.system.rows.tolist() == [len(plain.tau)] * 2
    found = weights_at(problem, np.arange(s.start, s.stop) / SCARA.sample_rate_hz)
    np.testing.assert_array_equal(found, np.ones((2, s.stop - s.start)))
    given = Overrides(low_speed_percent=LowSpeed(ls=0.0, iv=10.0))
    by_method = [
        make_settings(SCARA, dataclasses.replace(given, method=method)) for method in ("wls", "iv")
    ]
    assert [one.low_speed_percent for one in by_method] == [0.0, 10.0]


def test_short_moves_shorten_taper():
    t = SCARA.t_s
    quick = np.stack([np.sin(2 * np.pi * 0.5 * t), 0.05 * np.sin(2 * np.pi * 4 * t)], axis=1)
    ramps = sample_weights(scara(q=quick)).ramps
    assert ramps[0] == 2.0
    assert ramps[1] < 2.0
    problem = scara(q=np.stack([quick[:, 0], 0.05 * np.sin(2 * np.pi * 24.9 * t)], axis=1))
    with pytest.raises(NoFitError, match="joint elbow never moves for longer than a period"):
        identify_ls(problem.signals, Overrides())


def test_too_short_moves_unweighted_in_motion():
    """The elbow of two reverses too often for any ramp: torque and regressor of its rows as
    they are, and it is said.
    """
    t = SCARA.t_s
    problem = scara(
        q=np.stack([np.sin(2 * np.pi * 0.5 * t), 0.05 * np.sin(2 * np.pi * 10 * t)], axis=1)
    )
    weights, s = sample_weights(problem), problem.settings
    plain = rows_of_recording(*equation_alone(problem))
    assert tuple(weights.ramps) == (2.0, ROWS)
    at = s.start + s.decimator.instants(s.stop - s.start)
    np.testing.assert_array_equal(plain.share[:, 1], weights.moves[at, 1])
    assert 0 < plain.share[:, 1].sum() < len(at)
    own, squares = plain.system.Y[plain.system.joint_of_row == 1], plain.tau[:, 1] ** 2
    assert own @ own == pytest.approx(squares[plain.counts[:, 1]].sum(), rel=1e-12)
    assert (weights.between(s.start, s.stop)[1] == 1).all()


def short_moves(seed: int):
    """The SCARA, whose joints move one after the other for less than half a second,
    as a recording of 12 s.
    """
    robot, rng, s = SCARA.robot, np.random.default_rng(seed), np.linspace(0, 1, 400)[:, None]
    q, now = [], np.zeros(2)
    for k in range(18):
        after = np.where(np.arange(2) == k % 2, rng.uniform(-0.6, 0.6), now)
        q += [
            now + (10 * s**3 - 15 * s**4 + 6 * s**5) * (after - now),
            np.repeat(after[None], 260, axis=0),
        ]
        now = after
    signals = closed_loop(
        robot, np.concatenate(q), 1000.0, noise=Noise(effort_percent=2.0), seed=seed
    )
    slow = msgspec.structs.replace(robot.controller, bandwidth_hz=2.5)  # half of what it is
    return dataclasses.replace(
        signals,
        robot=dataclasses.replace(robot, controller=slow),
        recording=f"s{seed}.mcap",
        sha256=f"{seed:064x}",
    )


def test_recordings_of_short_moves_fitted():
    """No ramps suit their moves: chosen for both together, and told with joint and bandwidth."""
    fit = identify_ls(Recordings(sources=(short_moves(1), short_moves(2))), Overrides())
    for name in ("shoulder", "elbow"):
        text = (
            f"joint {name}: its moves are short for a bandwidth of 2.5 Hz: no weights, but "
            "rows in which it moves"
        )
        assert text in fit.warnings
    assert (off(fit) < 2.0).all()


def test_chosen_taper_has_smaller_half_widths():
    """By the median ratio of the half-widths of whole fits with each ramp stated."""
    chosen, long, short = (
        solve(SCARA, Overrides(ramp_rows=ramp), method="wls").inputs for ramp in (None, 2.0, 0.5)
    )
    chosen, *stated = (one.problem.settings.ramp_rows for one in (chosen, long, short))
    assert stated == [2.0, 0.5]
    ratio = np.median(long.intervals.half / short.intervals.half)
    assert abs(ratio - 1) > 0.02
    assert chosen == (2.0 if ratio < 1 else 0.5)


def with_friction(signals, *terms):
    joints = tuple(
        msgspec.structs.replace(joint, friction=("viscous", "coulomb", *terms))
        for joint in signals.robot.joints
    )
    return dataclasses.replace(signals, robot=dataclasses.replace(signals.robot, joints=joints))


@pytest.mark.parametrize("noise", [0.0, 8e-4])
def test_slow_terms_count_rows_down_to_noise(noise):
    """A quarter of 4 % of the peak; or 4 deviations of the noise of the filtered speed, which is
    told by another filter here.
    """
    shift = noise * np.random.default_rng(0).standard_normal(SCARA.q.shape)
    signals = dataclasses.replace(SCARA, q=SCARA.q + shift)
    usual, slow, quarter = (
        make_problem(with_friction(signals, *terms), Overrides(low_speed_percent=percent))
        for terms, percent in (((), None), (("root",), None), (("root",), 1.0))
    )
    moves = [sample_weights(one).moves.mean() for one in (usual, slow, quarter)]
    assert moves[0] < moves[1] - 0.01
    if not noise:
        assert moves[1] == moves[2]
        return
    assert moves[1] < moves[2]
    s, fs = slow.settings, signals.sample_rate_hz
    own = FilteredMotion(dataclasses.replace(signals, q=shift)).between(0, len(shift), s.cutoff_hz)
    clean = FilteredMotion(SCARA).between(0, len(shift), s.cutoff_hz)
    blur = round(0.5 * fs / s.cutoff_hz)
    for j in range(2):
        speed = np.abs(clean.dq[s.start : s.stop, j] + own.dq[s.start : s.stop, j])
        limit = 4 * own.dq[s.start : s.stop, j].std()
        assert limit > 0.01 * speed.max()
        stood = ~sample_weights(slow).moves[s.start : s.stop, j]
        near = np.convolve(stood, np.ones(2 * blur + 1), "same") > 0
        assert (near | (speed > 0.9 * limit)).all()
        assert (speed[~near] > 0.9 * limit).all()
