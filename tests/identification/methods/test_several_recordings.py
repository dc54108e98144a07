"""Several recordings in one fit: against their rows stacked by hand, in any order, on any
workers, held out, refused.
"""

import json
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
from conftest import REPLAY, robot_named
from described_truth import off
from scipy import stats

from acquisition.robot import robot_from_files
from identification.commands import main
from identification.data import Recordings, Signals, Work, check_one_robot, signals_from_arrays
from identification.errors import BadInputError, NoFitError
from identification.export import model_of_fit
from identification.methods import Iteration, read_model
from identification.model import InverseModel, base_parameters, described_parameters
from identification.regression import (
    Overrides,
    equation_alone,
    make_problem,
    make_unknowns,
    rows_of_recording,
    torque_of_recording,
    with_common_band,
)
from identification.report import ParameterSet, differences, read_fit, write_json
from identification.results import (
    fit_file,
    fitted_parameters,
    identify,
    identify_iv,
    identify_ls,
    with_consistent,
)
from identification.study import Noise, closed_loop, random_reference, write_signals

USUAL = ("viscous", "coulomb")
CELL = Noise(encoder_step=1e-5, effort_percent=2.0)


@cache
def recorded(seed: int, rate_hz: float = 1000.0) -> Signals:
    """Five seconds of the SCARA, four with the seed 3: lengths differ."""
    robot = robot_named("scara")
    # The simulated mean has no lag; stated, sums by hand need not look for one.
    robot = replace(
        robot, identification=msgspec.structs.replace(robot.identification, torque_lag_s=0.0)
    )
    if rate_hz != 1000.0:
        law = msgspec.structs.replace(robot.controller, sample_rate_hz=rate_hz)
        robot = replace(robot, controller=law)
    q_ref = random_reference(
        robot, duration_s=4.0 if seed == 3 else 5.0, sample_rate_hz=rate_hz, seed=seed
    )
    signals = closed_loop(robot, q_ref, rate_hz, noise=CELL, seed=seed)
    return replace(signals, recording=f"r{seed}.mcap", sha256=f"{seed:064x}")


def several(*signals: Signals, work=None) -> Recordings:
    return Recordings(sources=signals, **({"work": work} if work else {}))


@cache
def fitted(method: str):
    return identify(several(*map(recorded, (1, 2, 3))), Overrides(), method=method)


def test_least_squares_matches_stacked_rows():
    fit = fitted("wls")
    ramps = Overrides(ramp_rows=fit.settings.ramp_rows)
    problems = with_common_band([make_problem(recorded(k), ramps) for k in (1, 2, 3)])
    systems = [rows_of_recording(*equation_alone(problem)).system for problem in problems]
    W, Y, joint = (
        np.concatenate([getattr(s, name) for s in systems]) for name in ("W", "Y", "joint_of_row")
    )
    s = np.ones(2)
    for j in range(2):
        own, rows = W[joint == j], Y[joint == j]
        own = own[:, own.any(axis=0)]
        b, _, rank, _ = np.linalg.lstsq(own, rows)
        s[j] = np.sqrt(np.sum((rows - own @ b) ** 2) / (sum(one.rows[j] for one in systems) - rank))
    beta = np.linalg.lstsq(W / s[joint][:, None], Y / s[joint])[0]
    assert (np.abs(fit.estimate.beta - beta) < 1e-9 * fit.intervals.half).all()
    # The errors of each are those of its own torque, without weights, in rows that count.
    for one, problem in zip(fit.recordings, problems, strict=True):
        problem = problem.for_errors
        counts, s = rows_of_recording(*equation_alone(problem)).counts.T, problem.settings
        motion = problem.motion.between(s.start, s.stop, s.cutoff_hz)
        full = (
            problem.model.regressor(motion.q, motion.dq, motion.ddq)[..., problem.base.columns]
            @ fit.estimate.beta
        )
        tau, rho = (s.decimator.filtered(x.T) for x in (motion.tau, motion.tau - full))
        assert one.errors[-1].relative_error_percent == pytest.approx(
            100 * np.linalg.norm(rho[counts]) / np.linalg.norm(tau[counts]), rel=1e-6
        )


def test_truth_in_intervals_verdict_trust():
    fit = fitted("iv")
    assert off(fit).max() < 2.0
    assert (fit.status, fit.trust.verdict) == ("converged", "trust")
    assert {line.level for line in fit.trust.lines} == {"ok"}


def test_held_out_predicted_by_others():
    fit, others = fitted("wls"), identify_ls(several(recorded(1), recorded(2)), Overrides())
    last, problem = (
        fit.recordings[2],
        make_problem(recorded(3), Overrides()).for_errors,
    )
    beta = others.estimate.beta
    tau, (predicted,), counts, *_ = torque_of_recording(*equation_alone(problem), [beta])
    error = 100 * np.linalg.norm((tau - predicted)[counts]) / np.linalg.norm(tau[counts])
    assert last.held_out.error_percent == pytest.approx(error, rel=2e-3)
    figures = fit.trust.line("cross-validation").figures
    assert figures[2][3] < figures[2][1] == last.held_out.error_percent
    assert [name for name, *_ in figures] == ["r1.mcap", "r2.mcap", "r3.mcap"]


def test_unpredicted_recording_is_caution():
    other = recorded(2)
    fit = identify_ls(
        several(recorded(1), replace(other, effort=1.3 * other.effort, sha256="e" * 64)),
        Overrides(),
    )
    line = fit.trust.line("cross-validation")
    assert line.level == "caution"
    assert line.value > 1.5 * np.mean([expected for *_, expected in line.figures])


class LastFirst(Work):
    """Does the last task first."""

    def run(self, function, tasks):
        return iter([function(*task) for task in reversed(tasks)][::-1])


def bits(fit) -> list[bytes]:
    arrays = fit.estimate.beta, fit.intervals.covariance, fit.intervals.low, fit.data.predicted
    return [x.tobytes() for x in arrays] + [repr(fit.trust.lines).encode()]


@pytest.mark.parametrize("method", ["wls", "iv"])
def test_same_bits_in_any_order(method):
    recordings = several(*map(recorded, (3, 1, 2)), work=LastFirst())
    assert bits(identify(recordings, Overrides(), method=method)) == bits(fitted(method))


def fit_files(tmp_path, name, *arguments) -> dict:
    out = tmp_path / f"{name}.json"
    assert main(["fit", *map(str, arguments), "--json", str(out)]) in (0, 3)
    return json.loads(out.read_text())


def with_a_joint_held(seed: int, still: int) -> Signals:
    """The exact model with noise, one joint held by its brake."""
    like = recorded(seed)
    q = np.array(like.q_ref)
    q[:, still] = q[0, still]
    dq = np.gradient(q, 1e-3, axis=0)
    dynamics = InverseModel(like.robot)
    base = base_parameters(dynamics)
    regressor = dynamics.regressor(q, dq, np.gradient(dq, 1e-3, axis=0))[:, :, base.columns]
    tau = regressor @ described_parameters(dynamics, base)
    noise = np.random.default_rng(seed).normal(size=tau.shape) * 0.02 * tau.std(axis=0)
    return replace(like, q=q, q_ref=None, effort=tau + noise, recording=f"r{seed}.mcap")


def test_recordings_excite_half_each(tmp_path, capsys):
    halves = with_a_joint_held(1, still=1), with_a_joint_held(2, still=0)
    for one in halves:
        with pytest.raises(NoFitError):
            identify_ls(one, Overrides())
        write_signals(tmp_path / one.recording, one, source="test")
    fit = identify_ls(several(*halves), Overrides())
    assert off(fit).max() < 2.0
    line = fit.trust.line("cross-validation")
    assert (line.level, line.value) == ("inconclusive", None)
    stored = fit_files(
        tmp_path, "halves", *(tmp_path / one.recording for one in halves), "--workers", "1"
    )
    for one, names in zip(
        stored["recordings"], ({"ZZ1R", "Fv1", "Fc1"}, {"Fv2", "Fc2"}), strict=True
    ):
        assert one["held_out_error_percent"] is None
        assert names <= set(one["undetermined"])
    assert "r1.mcap cannot be predicted from the others: " in capsys.readouterr().out.replace(
        "\n", " "
    )


def test_lowest_row_rate_and_cutoff_shared():
    slow, fast = recorded(6, rate_hz=500.0), recorded(1)
    wide = replace(
        fast.robot, controller=msgspec.structs.replace(fast.robot.controller, bandwidth_hz=12.0)
    )
    problems = read_model(several(replace(fast, robot=wide), slow), Overrides(), print).problems
    settings = [one.settings for one in problems]
    assert {s.cutoff_hz for s in settings} == {5 * slow.robot.controller.bandwidth_hz}
    rates = {
        one.signals.sample_rate_hz / s.decimation for one, s in zip(problems, settings, strict=True)
    }
    assert rates == {500.0 / make_problem(slow, Overrides()).settings.decimation}


def test_several_recordings_validated(tmp_path, capsys):
    files, out = [tmp_path / f"r{seed}.mcap" for seed in (2, 3)], tmp_path / "v.json"
    for seed, path in zip((2, 3), files, strict=True):
        write_signals(path, recorded(seed), source="test")
    assert (
        main(["validate", str(REPLAY / "scara" / "fit.json"), *map(str, files), "--json", str(out)])
        == 0
    )
    found = json.loads(out.read_text())
    assert [one["recording"] for one in found["recordings"]] == ["r2.mcap", "r3.mcap"]
    errors = [one["relative_error_percent"] for one in found["recordings"]]
    assert min(errors) < found["relative_error_percent"] < max(errors)
    assert main(["view", *map(str, files), "-o", str(tmp_path / "x.rrd")]) == 1
    assert "--out = " in capsys.readouterr().err


def with_part(one: Signals, part: str, at: int, **values) -> Signals:
    """The recording with other values of a joint or motor of its description, of the
    description or of its own.
    """
    if part == "recording":
        return replace(one, **values)
    if part != "robot":
        parts = list(getattr(one.robot, part))
        parts[at] = msgspec.structs.replace(parts[at], **values)
        values = {part: tuple(parts)}
    return replace(one, robot=replace(one.robot, **values))


STRIBECK = {"friction": ("viscous", "stribeck"), "stribeck_speed_deg_s": 10.0}


@pytest.mark.parametrize(
    ("part", "at", "first", "other", "key"),
    [
        ("joints", 0, {}, {"name": "hip"}, "joint hip: name"),
        ("joints", 1, {}, {"dh": robot_named("scara").joints[0].dh}, "joint elbow: dh"),
        # described with both, by the keys
        ("joints", 1, {}, {"coulomb": False}, "joint elbow: friction"),
        ("joints", 1, {}, {"friction": ("viscous", "root", "coulomb")}, "joint elbow: friction"),
        ("joints", 1, {}, {"friction": "asymmetric"}, "joint elbow: friction"),
        (
            "joints",
            1,
            STRIBECK,
            STRIBECK | {"stribeck_speed_deg_s": 9.0},
            "joint elbow: stribeck_speed_deg_s",
        ),
        ("motors", 0, {}, {"effort_unit": "N"}, "motor motor_1: effort_unit"),
        ("robot", 0, {}, {"gravity": np.array([0.0, 0.0, 9.81])}, "gravity_m_s2"),
        ("recording", 0, {}, {"sha256": f"{1:064x}"}, ""),
        # a list in any order, and the keys that mean the same
        ("joints", 1, {}, {"friction": USUAL}, None),
        ("joints", 1, {}, {"friction": USUAL[::-1]}, None),
    ],
)
def test_recordings_of_other_robot_refused(part, at, first, other, key):
    both = [with_part(recorded(k), part, at, **values) for k, values in ((1, first), (2, other))]
    if key is None:
        check_one_robot(both)
        return
    with pytest.raises(BadInputError) as told:
        identify_ls(several(*both), Overrides())
    assert (told.value.place, told.value.key) == ("r2.mcap", key)


def not_stated(one):
    stated = msgspec.structs.replace(one.robot.identification, torque_lag_s=None)
    return replace(one, robot=replace(one.robot, identification=stated), effort_timing="unknown")


def with_offsets(
    kinds: tuple[str, ...], offsets: tuple[float, ...] = (0.2, -0.1, 0.05)
) -> list[Signals]:
    """The recordings with a torque offset of the shoulder each, described with
    offsets, `own` as asked.
    """
    text = (
        robot_named("scara")
        .files["robot.toml"]
        .decode()
        .replace("[[joint]]\n", "[[joint]]\noffset = true\n")
        + f"\n[identification]\nown = {[*kinds]}\ntorque_lag_s = 0.0\n"
    )
    robot = robot_from_files({"robot.toml": text.encode()}, "robot.toml")
    return [
        replace(one, robot=robot, effort=one.effort + np.array([value, 0.0]))
        for one, value in zip(map(recorded, (1, 2, 3)), offsets, strict=False)
    ]


@cache
def fit_of_offsets(*kinds: str):
    return identify_ls(several(*with_offsets(kinds)), Overrides())


def test_per_recording_offsets():
    found, shared = fit_of_offsets("Off"), fit_of_offsets()
    names = found.estimate.names
    assert "Off1" not in names
    for name, value in (("Off1@r1", 0.2), ("Off1@r2", -0.1), ("Off1@r3", 0.05), ("Off2@r1", 0.0)):
        k = names.index(name)
        assert abs(found.estimate.beta[k] - value) < 1.5 * found.intervals.half[k]
    assert found.own.names == tuple(name for name in names if "@" in name)
    assert found.own.p_effective < 1e-6
    alike = identify_ls(several(*with_offsets(("Off",), (0.1, 0.1, 0.1))), Overrides())
    assert found.errors[-1].relative_error_percent < 0.8 * shared.errors[-1].relative_error_percent
    # A recording's own offset is fitted to it when it is held out; a shared one is not.
    for (_, own, _, trained), (_, other, *_) in zip(
        *(one.trust.line("cross-validation").figures for one in (found, shared)), strict=True
    ):
        assert own < 1.05 * trained < other
    assert shared.own is None
    assert alike.own.p_effective > 0.01


def test_per_recording_parameters_exported(tmp_path):
    file, fit, shared = tmp_path / "fit.json", fit_of_offsets("Off"), fit_of_offsets()

    def stored(fit):
        write_json(file, fit_file(fit))
        return read_fit(file)

    free, names = stored(fit), list(fit.estimate.names)
    assert (free.covariance.names, free.left_out) == (names, [])
    assert "adjusted to be physically consistent" in model_of_fit(free, "fit.json")[1][-1]
    a, b = (ParameterSet.of_file(free, label) for label in ("a", "b"))
    assert [(row.name, row.off) for row in differences(a, b)] == [(name, 0.0) for name in names]
    beside = {row.name: row.b.name for row in differences(a, fitted_parameters(shared))}
    assert beside == {name: name.split("@")[0] for name in names}
    made = with_consistent(fit)
    np.testing.assert_array_equal(
        model_of_fit(stored(made), "fit.json")[0].chi, [p.value for p in made.standard_parameters]
    )


def test_per_recording_parameters_by_hand():
    """F of the sums of squares of two systems, one with a column of the offset for each recording,
    one with a single one.
    """
    recordings, fit = with_offsets(("Off",)), fit_of_offsets("Off")
    given = Overrides(ramp_rows=fit.settings.ramp_rows)
    alone = [equation_alone(make_problem(one, given)) for one in recordings]
    systems = [rows_of_recording(*one).system for one in alone]
    left = {}
    for own in (True, False):
        blocks = []
        for k, s in enumerate(systems):
            is_own = np.array([own and name.startswith("Off") for name in s.names])
            apart = np.kron(np.arange(3) == k, s.W[:, is_own])
            blocks.append(
                np.c_[s.W[:, ~is_own], apart, s.Y] * fit.estimate.weights[s.joint_of_row][:, None]
            )
        A = np.concatenate(blocks)
        left[own] = np.sum((A[:, -1] - A[:, :-1] @ np.linalg.lstsq(A[:, :-1], A[:, -1])[0]) ** 2)
    freedom = sum(s.rows.sum() for s in systems) - len(fit.estimate.names)
    F = (left[False] - left[True]) / 4 / (left[True] / freedom)
    assert pytest.approx(F, rel=1e-6) == fit.own.F
    assert fit.own.p_value == pytest.approx(stats.f.sf(F, 4, freedom), rel=1e-4)


def test_unidentifiable_own_offsets_refused():
    robot = replace(
        recorded(1).robot, identification=with_offsets(("Off",))[0].robot.identification
    )
    with pytest.raises(BadInputError) as told:
        identify_ls(several(*(replace(recorded(k), robot=robot) for k in (1, 2))), Overrides())
    assert (told.value.key, told.value.value) == ("identification.own", "Off")
    # A vertical slide with a motor: M (ddq + g) + Ia ddq + Off has three columns of rank two.
    slide = """
name = "lift"
motor = [{ name = "m", effort_unit = "N" }]
controller = { bandwidth_hz = 5.0 }
identification = { own = ["Off"] }
[[joint]]
name = "z"
type = "prismatic"
offset = true
dh = { alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0 }
"""
    lift = robot_from_files({"robot.toml": slide.encode()}, "lift")
    t = np.arange(5000) / 1000
    q = 0.1 * np.sin(2 * np.pi * t)[:, None]
    problems = [make_problem(signals_from_arrays(q, 50 + q, 1000.0, lift), Overrides())] * 2
    with pytest.raises(BadInputError) as told:
        make_unknowns(problems)
    assert (told.value.place, told.value.key, told.value.value) == (
        "robot lift",
        "identification.own",
        "Off",
    )


def test_delays_in_samples_of_first_recording():
    """Both torques 4 ms late: four samples at 1 kHz, whatever the other's rate."""
    slow, fast = recorded(6, rate_hz=500.0), recorded(1)
    late = [
        replace(one, effort=np.roll(one.effort, k, axis=0)) for one, k in ((fast, 4), (slow, 2))
    ]
    fit = identify_iv(several(*map(not_stated, late)), Overrides(), Iteration())
    assert [lag.recordings for lag in fit.data.lags] == [("r1.mcap",), ("r6.mcap",)], (
        "of two rates, each has its own"
    )
    np.testing.assert_allclose([1e3 * lag.value_s for lag in fit.data.lags], 4.0, atol=0.3)
    assert fit.trust.line("delay").value == pytest.approx(4.0, abs=0.3)


def test_worst_recording_gives_recomputed_output():
    loud = replace(recorded(2), effort=1.2 * recorded(2).effort)
    line = identify_ls(several(recorded(1), loud), Overrides()).trust.line("control law")
    assert (line.level, line.text.partition(":")[0]) == ("caution", "r2.mcap")
    assert line.value == pytest.approx(1.2, abs=0.02)


def test_each_recording_is_simulated_with_its_own():
    fit = identify_iv(several(*with_offsets(("Off",), (2.0, -2.0))), Overrides(), Iteration())
    for one, offset in zip(fit.recordings, (2.0, -2.0), strict=True):
        model = one.simulated.motion.tau.mean(axis=0) - one.tau.mean(axis=0)
        assert abs(model[0]) < 0.3, offset
