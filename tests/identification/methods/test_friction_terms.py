"""Friction terms: their columns against formulas, what exact data give back, simulated motion against physics, the choice."""

import dataclasses
import re

import msgspec
import numpy as np
import pytest
from conftest import REPLAY
from fits_of_records import signals_of
from friction_models import (
    ALL,
    LOAD,
    NONE,
    ROOT,
    USUAL,
    WITHOUT_LAG,
    axis,
    described,
    direct_of,
    exact_problem,
    model_of,
    moved,
    recorded,
    simulated,
    two_speeds,
    upright,
    whole_arm,
    with_friction,
)
from loops import free, simulate
from stacked_recordings import system_of

from acquisition.errors import BadInputError
from acquisition.robot import fourier_reference, robot_from_files
from identification.commands import main
from identification.data import RecordingFile, Recordings, Work
from identification.design import select_friction, with_terms
from identification.estimation import System
from identification.export import replace_in_tables, split_parameters
from identification.export.exported_model import random_states, representable, whole_regressor
from identification.methods import identify, identify_ls, least_squares, with_consistent
from identification.methods.settled import independent_norm
from identification.model import InverseModel, JointTerm
from identification.regression import Overrides, recorded_power
from identification.regression.filtering import lowpass
from identification.simulation import Reference, surrogate_loop
from identification.study import write_signals
from identification.view.charts import friction_charts


@pytest.fixture(scope="module")
def arm():
    return whole_arm()


# --- the description


@pytest.mark.parametrize(
    ("lines", "key", "expected"),
    [
        ('friction = ["viscous", "viscous"]', "joint[0].friction", "each term once"),
        (
            'friction = ["viscuos"]',
            "joint[0].friction[0]",
            "'asymmetric', 'coulomb', 'load', 'offset', 'root', 'stribeck'",
        ),
        ('friction = "odd"', "joint[0].friction", "'asymmetric', 'symmetric'"),
        ('friction = ["root"]\noffset = true', "joint[0].offset", "no such key"),
        ('friction = ["stribeck"]', "joint[0].stribeck_speed_deg_s", "37 %"),
        ("stribeck_speed_deg_s = 5", "joint[0].stribeck_speed_deg_s", '"stribeck" in friction'),
        ('friction = ["stribeck"]\nstribeck_speed_m_s = 5', "joint[0].stribeck_speed_m_s", "deg"),
    ],
)
def test_a_list_of_terms_that_means_nothing_is_refused(lines, key, expected):
    text = (REPLAY / "scara" / "robot.toml").read_text().replace('"revolute"\n', f'"revolute"\n{lines}\n', 1)
    with pytest.raises(BadInputError) as refused:
        robot_from_files({"robot.toml": text.encode()}, "scara.toml")
    assert refused.value.key == key
    assert expected in str(refused.value.expected)


def test_the_old_words_keep_their_parameters_and_a_list_has_its_own():
    text = (REPLAY / "scara" / "robot.toml").read_text()
    word = text.replace('"revolute"\n', '"revolute"\nfriction = "asymmetric"\noffset = true\n', 1)
    names = {}
    for key, content in (("old", text), ("word", word)):
        names[key] = InverseModel(robot_from_files({"robot.toml": content.encode()}, key)).names
    names["list"] = InverseModel(described("scara", [["viscous", "coulomb"]] * 2)).names
    assert names["list"] == names["old"]
    assert set(names["word"]) - set(names["old"]) == {"Fvp1", "Fvn1", "Fcp1", "Fcn1", "Off1"}
    assert set(InverseModel(described("scara", [ALL, ["load"]])).names) - set(names["old"]) == {
        "Off1", "Fa1", "Fr1", "Fs1", "mu1", "mu2"
    }  # fmt: skip


# --- the model


def test_columns_and_units_are_those_of_the_formulas(arm):
    """A coupled motor has its own root and Stribeck friction, at dq5 + dq6; |v| and load are of joints."""
    model, _, _ = model_of(arm)
    q, dq, ddq = np.random.default_rng(0).uniform(-2, 2, (3, 40, 6))
    W = model.regressor(q, dq, ddq)
    units = dict(zip(model.names, model.units, strict=True))

    def column(name):
        return W[:, :, model.names.index(name)]

    v, u, own = dq[:, 2], dq[:, 4] + dq[:, 5], np.eye(6)[2]
    speed = np.deg2rad(20.0)
    np.testing.assert_allclose(column("Fa3"), np.outer(np.abs(v), own))
    np.testing.assert_allclose(column("Fr3"), np.outer(np.sqrt(np.abs(v)) * np.sign(v), own))
    np.testing.assert_allclose(column("Fs3"), np.outer(np.exp(-((v / speed) ** 2)) * np.sign(v), own))
    both = np.array([0, 0, 0, 0, 1.0, 1.0])
    np.testing.assert_allclose(column("Frm6"), np.outer(np.sqrt(np.abs(u)) * np.sign(u), both))
    np.testing.assert_allclose(column("Fsm6"), np.outer(np.exp(-((u / speed) ** 2)) * np.sign(u), both))
    assert [units[name] for name in ("Fa3", "Fr3", "Frm6", "Fs3", "mu3")] == [
        "N m s/rad", "N m (s/rad)^½", "N m (s/rad)^½", "N m", ""
    ]  # fmt: skip
    assert "mum6" not in units
    assert "Fam6" not in units


def test_direct_and_inverse_model_agree_with_every_term(arm):
    """tau = W beta + mu |tau_rigid| sign(dq), tau_rigid the base columns whose own parameter is a link's, times beta."""
    model, base, beta = model_of(arm)
    q, dq, ddq = np.random.default_rng(1).uniform(-2, 2, (3, 40, 6))
    W = model.regressor(q, dq, ddq)[:, :, base.columns]
    links = [not re.fullmatch(r"(Ia|F..?|Off|mu)\d", model.names[c]) for c in base.columns]
    rigid = W[:, :, links] @ beta[links]
    mu = np.array([beta[base.names.index(f"mu{j}")] for j in range(1, 7)])
    expected = W @ beta + mu * np.abs(rigid) * np.sign(dq)
    direct = direct_of(model, base, beta)
    for signs in (None, dq):
        np.testing.assert_allclose(direct.torque(q, dq, ddq, signs), expected, rtol=1e-10, atol=1e-10)


def test_slopes_of_the_terms_are_differences_of_their_columns(arm):
    """Of friction with a sign, those of the rounded column; this is the column itself but near rest."""
    model, _, _ = model_of(arm)
    dq = np.random.default_rng(2).uniform(0.2, 1.0, (30, 6)) * np.random.default_rng(3).choice([-1.0, 1.0], (30, 1))
    creep, steps = np.linspace(0.1, 0.3, 6), 1e-5 * np.eye(6)
    kinds = ("coulomb", "asymmetric", "root", "stribeck")
    for term in (s for s in model.sources if isinstance(s, JointTerm) and s.kind in kinds):
        (j, *_) = (int(j) for j in term.rows)
        slopes, none = term.entry_slopes(j, dq)
        assert not none.any()
        if term.kind == "asymmetric":
            below, above = ([term.entry(j, dq + side * d, dq) for d in steps] for side in (-1, 1))
        else:
            assert not slopes.any()
            slopes = np.outer(term.rounded(dq, creep)[1], term.direction)
            below, above = ([term.rounded(dq + side * d, creep)[0] for d in steps] for side in (-1, 1))
            fast, _ = term.rounded(dq, 1e-6 * creep)
            np.testing.assert_allclose(fast, term.entry(j, dq, dq), rtol=3e-3)
        expected = (np.array(above) - below).T / 2e-5
        np.testing.assert_allclose(slopes, expected, rtol=1e-6, atol=1e-8)


def test_export_counts_what_a_format_cannot_say_of_these_terms():
    """Viscous and Coulomb friction are written as they are; what is missing is told by joint, with its torque."""
    robot = described(
        "scara", [["viscous", "coulomb", "root", "load"], ["viscous", "coulomb"]], "Fr1 = 0.6\nmu1 = 0.3\n"
    )
    model, base, _ = model_of(robot)
    chi = np.array([robot.parameters.get(name, 0.0) for name in model.names])
    links = {"XX1": 3.0, "YY1": 3.0, "XX2": 0.1, "YY2": 0.1, "M1": 20.0, "M2": 5.0}
    chi[[model.names.index(name) for name in links]] = list(links.values())
    mechanism = split_parameters(model, chi, "test")
    states = random_states(model.robot.joints)
    whole = direct_of(model, base, base.K @ chi).torque(*states)
    np.testing.assert_allclose(whole_regressor(mechanism, *states) @ chi, whole, rtol=1e-9, atol=1e-9)
    represented, losses = representable(mechanism, motors=True)
    ((what, (rms, _)),) = losses.items()
    assert what == "friction (Fr1, mu1)"
    columns = [model.names.index(name) for name in ("Fr1", "mu1")]
    missing = whole_regressor(mechanism, *states)[:, :, columns] @ chi[columns]
    np.testing.assert_allclose(rms, np.sqrt(np.mean(missing**2, axis=0)), rtol=1e-9)
    assert rms[0] > 0.1
    assert rms[1] == 0
    np.testing.assert_array_equal(represented.damping, mechanism.damping)
    np.testing.assert_array_equal(represented.frictionloss, [robot.parameters["Fc1"], robot.parameters["Fc2"]])


@pytest.fixture(scope="module")
def exact(arm):
    t = np.arange(0.0, 6.0, 1 / 250.0)  # of 3 s the first step cannot tell mu4
    return exact_problem(arm, fourier_reference(arm, period_s=6.0, seed=5).at(t))


def test_exact_motion_gives_every_term_back(exact):
    problem, known = exact
    settled, full = least_squares(system_of(problem))
    assert settled.problem.settings.warnings == problem.settings.warnings  # nothing is left out
    np.testing.assert_allclose(full.beta, known, rtol=1e-8, atol=1e-8)


def test_load_friction_is_the_same_where_a_term_beside_the_links_is_left_out():
    """Root friction follows the links' columns: without it these stay where they are."""
    whole = upright([["load"], ["root", "load"]], "mu1 = 0.3\nmu2 = 0.3\n")
    more = dataclasses.replace(whole, parameters={k: v for k, v in whole.parameters.items() if k[0] != "F"})
    less = with_terms(more, (frozenset({"load"}),) * 2)
    x = fourier_reference(less, period_s=3.0, seed=5).at(np.arange(0.0, 3.0, 1 / 250.0))
    known = []
    for robot in (more, less):
        problem, beta = exact_problem(robot, x)
        found = system_of(problem)
        known.append((found.without({"Fr2": "a test"}) if robot is more else found, beta))
    (without, _), (never, beta) = known
    assert without.names == never.names
    for name in ("W", "Y"):
        found, expected = (getattr(one.about(beta).system, name) for one in (without, never))
        np.testing.assert_array_equal(found, expected)


# --- simulated motion


def push(robot, force: float, v0: float, seconds: float = 0.4, rate_hz: float = 4000.0):
    """The robot of one axis under a constant force, from rest or the speed v0: t, q and dq."""
    model, base, beta = model_of(robot)
    direct = dataclasses.replace(direct_of(model, base, beta), offset=np.array([-force]))
    zero = np.zeros((round(seconds * rate_hz), 1))
    scale = np.full_like(zero, 0.1)
    done = simulate(
        direct, free(1, rate_hz), Reference(zero, scale, zero), start=(np.zeros(1), np.array([v0])), bound=1e9
    )
    return np.arange(len(zero)) / rate_hz, done.q[:, 0], done.dq[:, 0]


def test_root_friction_stops_a_mass_as_its_equation_says():
    """M dv/dt = -Fr sqrt(v): sqrt(v) = sqrt(v0) - Fr t / 2 M, and at rest it stays."""
    t, q, v = push(axis(["root"], Fr=120.0), 0.0, 0.05)
    left = np.maximum(np.sqrt(0.05) - 120.0 * t / (2 * 95.0), 0.0)
    np.testing.assert_allclose(v, left**2, atol=5e-5)  # half of the speed below which it creeps
    assert np.abs(v[t > 0.38]).max() < 1e-7
    assert q[-1] == pytest.approx(2 * 95.0 / 120.0 * 0.05**1.5 / 3, rel=2e-3)


@pytest.mark.parametrize(("share", "held"), [(1.31, False), (1.29, True), (0.71, True), (0.69, False)])
def test_load_friction_holds_a_weight_within_its_share(share, held):
    """M (a + g) (1 ± 0.3) = force: up where force > 1.3 M g, down where force < 0.7 M g, held in between."""
    weight = 95.0 * 9.81
    t, _, v = push(axis(["load"], vertical=True, mu=0.3), share * weight, 0.0)
    if held:
        assert np.abs(v).max() < 1e-3 * 0.1
    else:
        up = share > 1
        a = share * 9.81 / (1.3 if up else 0.7) - 9.81
        np.testing.assert_allclose(v[t > 0.1], a * t[t > 0.1], rtol=0.03)


def test_stribeck_friction_holds_more_than_it_resists():
    """20 N at rest, of which 15 fall with speed: 19 N do not start the mass, and keep it moving."""
    robot = axis(["coulomb", "stribeck"], Fc=5.0, Fs=15.0)
    assert np.abs(push(robot, 19.0, 0.0)[2]).max() < 1e-3 * 0.1
    _, _, v = push(robot, 19.0, 0.08)
    assert v[-1] > 0.08


def test_friction_only_takes_energy(arm):
    """From a push, without control: the energy of links and rotors never rises, with stick phases and every term."""
    values = dict(arm.parameters) | {name: 0.0 for name in arm.parameters if name.startswith(("Off", "Fa"))}
    model, base, beta = model_of(dataclasses.replace(arm, parameters=values, gravity=np.zeros(3)))
    direct = direct_of(model, base, beta)
    loop, zero, scale = free(6, 1000.0), np.zeros((500, 6)), np.full((500, 6), 2.0)
    start = (np.array([0.3, -0.4, 0.5, 0.2, 0.6, 0.1]), np.array([2.0, 1.5, -2.0, 3.0, -2.0, 4.0]))
    done = simulate(direct, loop, Reference(zero, scale, zero), start=start, bound=1e9, substeps=4)
    energy = 0.5 * np.einsum("ti,tij,tj->t", done.dq, direct.inertia(done.q), done.dq)
    assert done.reason is None
    assert energy[0] > 2
    assert energy[-1] < 1e-6 * energy[0]  # all comes to rest
    assert np.diff(energy).max() < 1e-4 * energy[0]


def test_a_simulated_motion_obeys_the_inverse_model(arm):
    """IDM(q, dq, ddq) = tau but near reversals, where friction is implicit."""
    model, base, beta = model_of(arm)
    direct = direct_of(model, base, beta)
    t = np.arange(0.0, 2.0, 1e-3)
    q, dq, ddq = fourier_reference(arm, period_s=2.0, seed=3).at(t)
    loop = surrogate_loop(10.0, np.array([1.5, 1.5, 0.4, 0.1, 0.1, 0.05]), 1000.0)
    done = simulate(direct, loop, Reference(q, dq, ddq), substeps=2)
    assert done.reason is None
    middle = 0.5 * (done.dq[1:] + done.dq[:-1])
    fast = (np.abs(middle @ direct.directions.T) > 0.1 * np.abs(middle @ direct.directions.T).max(axis=0)).all(axis=1)
    off = (direct.torque(0.5 * (done.q[1:] + done.q[:-1]), middle, done.ddq[:-1]) - done.tau[:-1])[fast]
    assert fast.sum() > 300
    assert np.sqrt(np.mean(off**2, axis=0) / np.mean(done.tau[:-1][fast] ** 2, axis=0)).max() < 0.02


# --- what a recording cannot tell


def test_what_other_columns_leave_of_a_column_is_what_least_squares_leaves():
    """Of columns nearly alike, exactly alike, and of zeros."""
    W = np.random.default_rng(3).normal(size=(50, 6))
    W[:, 1] = W[:, 0] + 1e-3 * W[:, 1]
    W[:, 3], W[:, 4] = 1e3 * W[:, 2] - 2 * W[:, 5], 0.0
    names = tuple("abcdef")
    system = System.whole(W, W[:, 0], np.repeat([0, 1], 25), names)
    expected = {}
    for i, name in enumerate(names):
        others = np.delete(W, [i, 4], axis=1)
        rho = W[:, i] - others @ np.linalg.lstsq(others, W[:, i], rcond=1e-12)[0]
        expected[name] = np.linalg.norm(rho) / np.linalg.norm(W[:, i]) if name != "e" else 0.0
    assert 5e-4 < expected["a"] < 2e-3
    found = independent_norm(system, names[1:])
    assert set(found) == set(names[1:])
    np.testing.assert_allclose(list(found.values()), [expected[name] for name in names[1:]], rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("term", "vertical", "motion", "left_out"),
    [
        ({"root": 30.0}, False, (1.0, (0.1, 0.2)), "Fr1"),  # of two speeds Coulomb and viscous friction say all
        ({"root": 30.0}, False, (1.0, (0.05, 0.1, 0.2)), None),
        ({"load": 0.2}, True, (0.1,), "mu1"),  # of a weight that hardly accelerates it is Coulomb friction
        ({"load": 0.2}, True, (4.0,), None),
    ],
)
def test_a_term_that_a_recording_cannot_tell_is_named_and_left_out(term, vertical, motion, left_out):
    ((kind, value),) = term.items()
    values = {"Fv": 100.0, "Fc": 20.0, {"root": "Fr", "load": "mu"}[kind]: value}
    problem, known = two_speeds(axis(["viscous", "coulomb", kind], vertical=vertical, **values), *motion)
    settled, full = least_squares(system_of(problem))
    told = [text for text in settled.problem.settings.warnings if "left out" in text]
    if left_out is None:
        assert told == []
        np.testing.assert_allclose(full.beta, known, rtol=1e-8)
    else:
        assert [name for name in full.names if name.startswith(("Fr", "mu"))] == []
        (text,) = told
        assert text.startswith(
            f"{kind} friction of joint axis left out: {left_out} cannot be distinguished from the others"
        )


def test_friction_that_would_drive_a_joint_is_told_and_signs_of_its_terms_are_not():
    """|v| beyond viscous friction drives backward; viscous friction below zero beside a larger root does not."""
    for values, told in (
        ({"Fv": 30.0, "Fc": 5.0, "Fa": 90.0}, True),
        ({"Fv": -30.0, "Fc": 10.0, "Fr": 80.0}, False),
    ):
        robot = axis(["viscous", "coulomb", "asymmetric", "root"], **values)
        fit = identify_ls(moved(robot, 2), Overrides(torque_lag_s="none", edges="smooth"))
        line = fit.trust.line("physical")
        assert (line.level == "do not use") == told, line.text
        assert ("friction would drive joint axis at -" in line.text) == told
        assert "below zero: " not in line.text
        # What the verdict has nothing against, the consistent set leaves as it is, and the other way round.
        made = with_consistent(fit).consistent_set
        assert made.chi_squared == fit.trust.line("consistent").value
        assert (np.abs(made.moves).max() > 1) == told
        power = recorded_power([one.problem for one in fit.recordings], made.beta)
        assert (power @ made.chi).min() > 0


# --- the choice of terms


@pytest.mark.parametrize("seed", range(2))
def test_the_terms_that_a_robot_has_are_recommended(seed):
    usual = ["viscous", "coulomb"]
    plain = upright([usual] * 2)
    assert select_friction(recorded(plain, seed), WITHOUT_LAG).recommended.terms == (NONE, NONE)
    more = upright([[*usual, "root", "load"], [*usual, "load"]], "Fr1 = 0.8\nmu1 = 0.3\nmu2 = 0.3\n")
    choice = select_friction(recorded(more, seed), WITHOUT_LAG)
    assert choice.recommended.terms == (ROOT | LOAD, LOAD)
    assert list(choice.described.values()) == [("viscous", "coulomb", "root", "load"), ("viscous", "coulomb", "load")]


# --- several recordings


LINEAR = [["viscous", "coulomb", "offset", "asymmetric", "root"], ["viscous", "coulomb"]]


@pytest.mark.parametrize(("method", "own"), [("wls", ()), ("wls", ("Off",)), ("iv", ("Off",))])
def test_terms_of_recordings_hold_the_truth(method, own):
    """Terms are shared; offsets may be of each recording. Friction is drawn and tested by recording."""
    robot = described("scara", LINEAR, "Fr1 = 0.6\nOff1 = 0.3\nFa1 = 0.2\n")
    robot = dataclasses.replace(robot, identification=msgspec.structs.replace(robot.identification, own=own))
    fit = identify(simulated(robot, 3, 4), Overrides(), method=method)
    assert fit.status in ("solved", "converged")
    _, base, known = model_of(robot)
    expected = np.array([known[base.names.index(name.partition("@")[0])] for name in fit.estimate.names])
    assert ("Off1@r3" in fit.estimate.names) == bool(own)
    off = np.abs(fit.estimate.beta - expected) / fit.intervals.half
    assert (off < 1).sum() >= len(expected) - 2
    assert off.max() < 3
    assert fit.trust.line("physical").level == "ok", fit.trust.line("physical").text
    value = dict(zip(fit.estimate.names, fit.estimate.beta, strict=True))
    for one in fit.recordings:
        v, torque = friction_charts(fit.on(one))[0].curves[0].line
        expected = (value["Fv1"] * np.abs(v) + value["Fc1"] + value["Fr1"] * np.sqrt(np.abs(v))) * np.sign(v)
        np.testing.assert_allclose(torque, expected + value["Fa1"] * np.abs(v), rtol=1e-6, atol=1e-9)


def test_friction_of_its_own_is_judged_in_its_own_recording():
    """Viscous friction below zero that Coulomb friction makes up for, once; that of two recordings added up would drive."""
    x = [fourier_reference(axis(USUAL[:2]), period_s=6.0, seed=seed).at(np.arange(0.0, 6.0, 1e-3)) for seed in (2, 3)]
    fastest = min(np.abs(dq).max() for _, dq, _ in x)
    robot = axis(["viscous", "coulomb", "root"], Fv=-14.0 / fastest, Fc=20.0, Fr=5.0)
    own = msgspec.structs.replace(robot.identification, own=("Fv",))
    robot = dataclasses.replace(robot, identification=own)
    fit = identify_ls(moved(robot, 2, 3, noise=0.1), Overrides(torque_lag_s="none", edges="smooth"))
    assert {"Fv1@r2", "Fv1@r3"} < set(fit.estimate.names)
    assert fit.trust.line("physical").level == "ok", fit.trust.line("physical").text


@pytest.mark.parametrize("method", ["wls", "iv"])
def test_terms_that_several_recordings_cannot_tell_are_left_out_of_all(method, tmp_path):
    """Stribeck friction at a speed far beyond the motion is Coulomb friction; tasks in other processes know it too."""
    text = with_friction((REPLAY / "scara" / "robot.toml").read_text(), [["viscous", "coulomb", "stribeck"], USUAL[:2]])
    text = text.replace('"stribeck"]\n', '"stribeck"]\nstribeck_speed_deg_s = 20000\n')
    robot = robot_from_files({"robot.toml": text.encode()}, "scara.toml")
    sources = []
    for signals in simulated(described("scara", [USUAL[:2]] * 2), 3, 4).sources:
        write_signals(tmp_path / signals.recording, signals, source="simulated")
        sources.append(RecordingFile.at(tmp_path / signals.recording, robot))
    work = Work(2 if method == "iv" else 1)
    fit = identify(Recordings(sources=tuple(sources), work=work), Overrides(), method=method)
    (told,) = [warning for warning in fit.warnings if "left out" in warning]
    assert told.startswith("stribeck friction of joint ")
    usual = identify(simulated(described("scara", [USUAL[:2]] * 2), 3, 4), Overrides(), method=method)
    assert fit.estimate.names == usual.estimate.names
    assert np.abs((fit.estimate.beta - usual.estimate.beta) / usual.intervals.half).max() < 1e-2


# --- the command


TABLES = """# of two joints
[[joint]] # the first
name = "a"
speed = 3 # fast
friction = [
    "root", # a remark
]
  viscous = true
[[ joint ]]
name = "b"
[controller]
bandwidth_hz = 5
"""


@pytest.mark.parametrize(
    ("values", "changed"),
    [
        ({"a": {"friction": ["load"]}}, {'[\n    "root", # a remark\n]': '["load"]'}),
        ({"a": {"speed": 2.5, "viscous": None}}, {"speed = 3 #": "speed = 2.5 #", "  viscous": "#   viscous"}),
        ({"a": {"offset": None}, "b": {"unit": "N m", "gain": 2}}, {'"b"\n': '"b"\ngain = 2\nunit = "N m"\n'}),
        ({"a": {"friction": None}}, None),  # the lines after the first remain
        ({"b": {"bandwidth_hz": 1.0}}, None),  # it is not of the joint
        ({"c": {"speed": 1.0}}, None),
    ],
)
def test_values_in_tables_of_a_description_are_replaced_line_by_line(values, changed):
    if changed is None:
        with pytest.raises(BadInputError) as refused:
            replace_in_tables(TABLES, "joint", values, "robot.toml")
        assert (refused.value.place, refused.value.key) == ("robot.toml", "[[joint]]")
    else:
        expected = TABLES
        for old, new in changed.items():
            expected = expected.replace(old, new)
        assert replace_in_tables(TABLES, "joint", values, "robot.toml") == expected


def test_a_description_whose_lines_cannot_be_replaced_stays(tmp_path, capsys):
    write_signals(
        tmp_path / "log.mcap", recorded(upright([["viscous", "coulomb"]] * 2), 0, duration_s=4.0), source="test"
    )
    assert main(["friction", str(tmp_path / "log.mcap"), "--write"]) == 1
    assert "--robot" in capsys.readouterr().err
    toml = tmp_path / "robot.toml"
    text = (REPLAY / "scara" / "robot.toml").read_text().replace("[[joint]]", "[['joint']]", 1)
    toml.write_text(text)
    assert main(["friction", str(tmp_path / "log.mcap"), "--robot", str(toml), "--write"]) == 1
    assert "robot.toml: [[joint]]: cannot be replaced line by line" in capsys.readouterr().err
    assert toml.read_text() == text


# --- the real records


def test_the_real_tx40_needs_root_friction_and_load_friction_of_joint_3(tx40):
    signals = signals_of(tx40)
    thin = {x: lowpass(getattr(signals, x), 400.0, signals.sample_rate_hz)[::5] for x in ("q", "effort")}
    signals = dataclasses.replace(signals, **thin, t_s=signals.t_s[::5], sample_rate_hz=signals.sample_rate_hz / 5)
    choice = select_friction(signals, Overrides())
    terms = choice.recommended.terms
    assert "load" in terms[2]
    assert sum("root" in more for more in terms) >= 4
    assert choice.usual.held_out_error_percent > 5.9
    assert choice.recommended.held_out_error_percent < 4.4
    fit = identify_ls(dataclasses.replace(signals, robot=with_terms(signals.robot, terms)), Overrides())
    assert fit.errors[2].moving_relative_error_percent < 3.2
    mu = fit.estimate.names.index("mu3")
    assert fit.beta[mu] == pytest.approx(0.32, abs=0.01)
    assert fit.trust.line("physical").level == "ok"


def test_the_real_emps_needs_asymmetric_and_root_friction(emps):
    choice = select_friction(signals_of(emps), Overrides())
    assert choice.recommended.terms == (frozenset({"asymmetric", "root"}),)
    assert choice.recommended.fitted_error_percent < 2.95
