"""Friction terms: their columns against formulas, what exact data give back, simulated
motion against physics.
"""

import dataclasses
import re

import msgspec
import numpy as np
import pytest
from command_runs import refused
from conftest import REPLAY
from fits_of_records import signals_of, thinned
from friction_models import (
    EVERY,
    USUAL,
    axis,
    described,
    direct_of,
    exact_problem,
    model_of,
    moved,
    simulated,
    two_speeds,
    upright,
    whole_arm,
)
from loops import free, simulate
from stacked_recordings import system_of

from acquisition.errors import BadInputError
from acquisition.robot import FRICTION, FrictionTerm, fourier_reference, robot_from_files
from identification.control import Reference
from identification.data import RecordingFile, Recordings, Work
from identification.design import select_friction, with_terms
from identification.estimation import one_thread
from identification.export import replace_in_tables
from identification.methods import least_squares
from identification.model import JointTerm
from identification.regression import Overrides, recorded_power
from identification.results import identify, identify_ls, with_consistent
from identification.study import write_signals


@pytest.fixture(scope="module")
def arm():
    return whole_arm()


# --- the description


@pytest.mark.parametrize(
    ("lines", "key", "expected"),
    [
        ('friction = ["viscous", "viscous"]', "joint[0].friction", "it is listed twice"),
        ('friction = ["viscuos"]', "joint[0].friction[0]", "'load', 'offset', 'root'"),
        ('friction = "odd"', "joint[0].friction", "'asymmetric', 'symmetric'"),
        (
            'friction = ["root"]\noffset = true',
            "joint[0].offset",
            "friction lists all terms. Remove offset",
        ),
        ('friction = ["stribeck"]', "joint[0].stribeck_speed_deg_s", "37 %"),
        ("stribeck_speed_deg_s = 5", "joint[0].stribeck_speed_deg_s", 'no term "stribeck"'),
        ('friction = ["stribeck"]\nstribeck_speed_m_s = 5', "joint[0].stribeck_speed_m_s", "deg"),
    ],
)
def test_meaningless_term_list_refused(lines, key, expected):
    text = (
        (REPLAY / "scara" / "robot.toml")
        .read_text()
        .replace('"revolute"\n', f'"revolute"\n{lines}\n', 1)
    )
    with pytest.raises(BadInputError) as refused:
        robot_from_files({"robot.toml": text.encode()}, "scara.toml")
    assert refused.value.key == key
    assert expected in str(refused.value)


# --- the model


def test_columns_and_units_match_formulas(arm):
    """A coupled motor has its own root and Stribeck friction, at dq5 + dq6; |v|
    and load are of joints.
    """
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
    np.testing.assert_allclose(
        column("Fs3"), np.outer(np.exp(-((v / speed) ** 2)) * np.sign(v), own)
    )
    both = np.array([0, 0, 0, 0, 1.0, 1.0])
    np.testing.assert_allclose(column("Frm6"), np.outer(np.sqrt(np.abs(u)) * np.sign(u), both))
    np.testing.assert_allclose(
        column("Fsm6"), np.outer(np.exp(-((u / speed) ** 2)) * np.sign(u), both)
    )
    assert [units[name] for name in ("Fa3", "Fr3", "Frm6", "Fs3", "mu3")] == [
        "N m s/rad", "N m (s/rad)^½", "N m (s/rad)^½", "N m", ""
    ]  # fmt: skip
    assert not {"mum6", "Fam6"} & {*units}


def test_direct_and_inverse_model_agree():
    """tau = W beta + mu |tau_rigid| sign(dq), tau_rigid the base columns whose own parameter
    is a link's, times beta.
    """
    assert {*FrictionTerm.__args__} == {*FRICTION, "viscous", "offset"}  # each name has its row
    model, base, beta = model_of(whole_arm(EVERY))
    q, dq, ddq = np.random.default_rng(1).uniform(-2, 2, (3, 40, 6))
    W = model.regressor(q, dq, ddq)[:, :, base.columns]
    links = [not re.fullmatch(r"(Ia|F..?|Off|mu)\d", model.names[c]) for c in base.columns]
    rigid = W[:, :, links] @ beta[links]
    mu = np.array([beta[base.names.index(f"mu{j}")] for j in range(1, 7)])
    expected = W @ beta + mu * np.abs(rigid) * np.sign(dq)
    direct = direct_of(model, base, beta)
    for signs in (None, dq):
        np.testing.assert_allclose(
            direct.torque(q, dq, ddq, signs), expected, rtol=1e-10, atol=1e-10
        )


def test_term_slopes_match_differences():
    """Of friction with a sign, those of the rounded column; this is the
    column itself but near rest.
    """
    model, _, _ = model_of(whole_arm(EVERY))
    dq = np.random.default_rng(2).uniform(0.2, 1.0, (30, 6)) * np.random.default_rng(3).choice(
        [-1.0, 1.0], (30, 1)
    )
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
            below, above = (
                [term.rounded(dq + side * d, creep)[0] for d in steps] for side in (-1, 1)
            )
            fast, _ = term.rounded(dq, 1e-6 * creep)
            np.testing.assert_allclose(fast, term.entry(j, dq, dq), rtol=3e-3)
        expected = (np.array(above) - below).T / 2e-5
        np.testing.assert_allclose(slopes, expected, rtol=1e-6, atol=1e-8)


def test_exact_motion_recovers_every_term(arm):
    t = np.arange(0.0, 6.0, 1 / 250.0)  # of 3 s the first step cannot tell mu4
    problem, known = exact_problem(arm, fourier_reference(arm, period_s=6.0, seed=5).at(t))
    model = system_of(problem)
    model, found = one_thread(least_squares)(model, model.rows(model.start()))
    assert model.left_out == {}
    np.testing.assert_allclose(found.estimate.beta, known, rtol=1e-8, atol=1e-8)


# --- simulated motion


def test_load_friction_unaffected_by_dropped_term():
    """Root friction follows the links' columns: without it these stay where they are."""
    whole = upright([["load"], ["root", "load"]], "mu1 = 0.3\nmu2 = 0.3\n")
    more = dataclasses.replace(
        whole, parameters={k: v for k, v in whole.parameters.items() if k[0] != "F"}
    )
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
        found, expected = (
            getattr(one.rows(np.r_[beta, 0.0]).system, name) for one in (without, never)
        )
        np.testing.assert_array_equal(found, expected)


def push(robot, force: float, v0: float, seconds: float = 0.4, rate_hz: float = 4000.0):
    """The robot of one axis under a constant force, from rest or the speed v0: t, q and dq."""
    model, base, beta = model_of(robot)
    direct = dataclasses.replace(direct_of(model, base, beta), offset=np.array([-force]))
    zero = np.zeros((round(seconds * rate_hz), 1))
    scale = np.full_like(zero, 0.1)
    done = simulate(
        direct,
        free(1, rate_hz),
        Reference(zero, scale, zero),
        start=(np.zeros(1), np.array([v0])),
        bound=1e9,
    )
    return np.arange(len(zero)) / rate_hz, done.q[:, 0], done.dq[:, 0]


def test_square_root_friction_stops_mass():
    """M dv/dt = -Fr sqrt(v): sqrt(v) = sqrt(v0) - Fr t / 2 M, and at rest it stays."""
    t, q, v = push(axis(["root"], Fr=120.0), 0.0, 0.05)
    left = np.maximum(np.sqrt(0.05) - 120.0 * t / (2 * 95.0), 0.0)
    np.testing.assert_allclose(v, left**2, atol=5e-5)  # half of the speed below which it creeps
    assert np.abs(v[t > 0.38]).max() < 1e-7
    assert q[-1] == pytest.approx(2 * 95.0 / 120.0 * 0.05**1.5 / 3, rel=2e-3)


@pytest.mark.parametrize(("share", "held"), [(1.31, False), (1.29, True), (0.69, False)])
def test_load_friction_holds_weight_within_share(share, held):
    """M (a + g) (1 ± 0.3) = force: up where force > 1.3 M g, down where force <
    0.7 M g, held in between.
    """
    weight = 95.0 * 9.81
    t, _, v = push(axis(["load"], vertical=True, mu=0.3), share * weight, 0.0)
    if held:
        assert np.abs(v).max() < 1e-3 * 0.1
    else:
        up = share > 1
        a = share * 9.81 / (1.3 if up else 0.7) - 9.81
        np.testing.assert_allclose(v[t > 0.1], a * t[t > 0.1], rtol=0.03)


# --- what a recording cannot tell


@pytest.mark.parametrize(
    ("values", "vertical", "motions", "left_out"),
    [
        # of two speeds Coulomb and viscous friction say all
        ({"Fr": 30.0}, False, [(1.0, (0.1, 0.2))], ["root"]),
        ({"Fr": 30.0}, False, [(1.0, (0.05, 0.1, 0.2))], []),
        # never slow: its column is zero
        ({"Fs": 30.0}, False, [(1.0, (0.15, 0.2))], ["stribeck"]),
        # of a weight that hardly accelerates it is Coulomb friction
        ({"mu": 0.2}, True, [(0.1,)], ["load"]),
        ({"mu": 0.2}, True, [(4.0,)], []),
        ({"Fr": 30.0, "mu": 0.2}, True, [(0.1,), (0.1,)], ["root", "load"]),
        ({"Fr": 30.0, "mu": 0.2}, True, [(4.0,), (4.0, (0.05, 0.15))], []),
    ],
)
def test_unidentifiable_term_named_and_dropped(values, vertical, motions, left_out):
    kinds = [{"Fr": "root", "mu": "load", "Fs": "stribeck"}[name] for name in values]
    robot = axis(["viscous", "coulomb", *kinds], vertical=vertical, Fv=100.0, Fc=20.0, **values)
    made = [two_speeds(robot, *motion) for motion in motions]
    model = system_of(*(problem for problem, _ in made))
    model, found = least_squares(model, model.rows(model.start()))
    told = [text for text in model.problem.settings.warnings if "left out" in text]
    assert [text.split(" ")[0] for text in told] == left_out
    assert list(model.left_out.values()) == told
    if left_out:
        assert not any(name.startswith(("Fr", "mu", "Fs")) for name in found.estimate.names)
    else:
        np.testing.assert_allclose(found.estimate.beta, made[0][1], rtol=1e-7)


@pytest.mark.parametrize(
    ("values", "told"),
    [({"Fv": 30.0, "Fc": 5.0, "Fa": 90.0}, True), ({"Fv": -30.0, "Fc": 10.0, "Fr": 80.0}, False)],
)
def test_negative_friction_reported_signs_not(values, told):
    """|v| beyond viscous friction drives backward; viscous friction below zero beside
    a larger root does not.
    """
    robot = axis(["viscous", "coulomb", "asymmetric", "root"], **values)
    fit = with_consistent(
        identify_ls(moved(robot, 2), Overrides(torque_lag_s="none", edges="smooth"))
    )
    line, made = fit.trust.line("physical plausibility"), fit.consistent_set
    assert (
        (line.level == "do not use")
        == ("friction would drive joint axis at -" in line.text)
        == told
    )
    # What the verdict has nothing against, the consistent set leaves as it is, and
    # the other way round.
    assert made.chi2 == fit.trust.line("physically consistent").value
    assert (made.largest_move > 1) == told
    beta, chi = (
        np.array([p.value for p in of]) for of in (made.base_parameters, fit.standard_parameters)
    )
    assert (recorded_power([one.problem for one in fit.recordings], beta) @ chi).min() > 0


# --- several recordings


def test_own_friction_judged_in_own_recording():
    """Viscous friction below zero that Coulomb friction makes up for, once; that of two
    recordings added up would drive.
    """
    x = [
        fourier_reference(axis(USUAL[:2]), period_s=6.0, seed=seed).at(np.arange(0.0, 6.0, 1e-3))
        for seed in (2, 3)
    ]
    fastest = min(np.abs(dq).max() for _, dq, _ in x)
    robot = axis(["viscous", "coulomb", "root"], Fv=-14.0 / fastest, Fc=20.0, Fr=5.0)
    own = msgspec.structs.replace(robot.identification, own=("Fv",))
    robot = dataclasses.replace(robot, identification=own)
    fit = identify_ls(moved(robot, 2, 3, noise=0.1), Overrides(torque_lag_s="none", edges="smooth"))
    assert {"Fv1@r2", "Fv1@r3"} < set(fit.estimate.names)
    assert fit.trust.line("physical plausibility").level == "ok", fit.trust.line(
        "physical plausibility"
    ).text


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


def test_unidentifiable_terms_dropped_from_all(tmp_path):
    """Stribeck friction at a speed far beyond the motion is Coulomb friction; tasks in other
    processes know it too.
    """
    text = (
        described("scara", [["viscous", "coulomb", "stribeck"], USUAL[:2]])
        .files["robot.toml"]
        .decode()
    )
    text = text.replace("stribeck_speed_deg_s = 20", "stribeck_speed_deg_s = 20000")
    robot = robot_from_files({"robot.toml": text.encode()}, "scara.toml")
    sources = []
    for signals in simulated(described("scara", [USUAL[:2]] * 2), 3, 4).sources:
        write_signals(tmp_path / signals.recording, signals, source="simulated")
        sources.append(RecordingFile.at(tmp_path / signals.recording, robot))
    fit = identify(Recordings(sources=tuple(sources), work=Work(2)), Overrides())
    (told,) = [warning for warning in fit.warnings if "left out" in warning]
    assert told.startswith("stribeck friction of joint ")
    assert not any(name.startswith("Fs") for name in fit.estimate.names)
    assert fit.status == "converged"


@pytest.mark.parametrize(
    ("values", "changed"),
    [
        ({"a": {"friction": ["load"]}}, {'[\n    "root", # a remark\n]': '["load"]'}),
        (
            {"a": {"speed": 2.5, "viscous": None}},
            {"speed = 3 #": "speed = 2.5 #", "  viscous": "#   viscous"},
        ),
        (
            {"a": {"offset": None}, "b": {"unit": "N m", "gain": 2}},
            {'"b"\n': '"b"\ngain = 2\nunit = "N m"\n'},
        ),
        ({"a": {"friction": None}}, None),  # the lines after the first remain
        ({"b": {"bandwidth_hz": 1.0}}, None),  # it is not of the joint
        ({"c": {"speed": 1.0}}, None),
    ],
)
def test_table_values_replaced_line_by_line(values, changed):
    if changed is None:
        with pytest.raises(BadInputError) as refused:
            replace_in_tables(TABLES, "joint", values, "robot.toml")
        assert (refused.value.place, refused.value.key) == ("robot.toml", "[[joint]]")
    else:
        expected = TABLES
        for old, new in changed.items():
            expected = expected.replace(old, new)
        assert replace_in_tables(TABLES, "joint", values, "robot.toml") == expected


def test_irreplaceable_description_unchanged(tmp_path, capsys):
    log, toml = REPLAY / "scara" / "session.mcap", tmp_path / "robot.toml"
    assert "--robot" in refused(capsys, "friction", log, "--write")
    text = (REPLAY / "scara" / "robot.toml").read_text().replace("[[joint]]", "[['joint']]", 1)
    toml.write_text(text)
    told = refused(capsys, "friction", log, "--robot", toml, "--write")
    assert "robot.toml: [[joint]]: cannot be replaced line by line" in told
    assert toml.read_text() == text


# --- the real records


def test_tx40_needs_root_and_load_friction(tx40):
    signals = thinned(tx40)
    choice = select_friction(signals, Overrides())
    terms = choice.recommended.terms
    assert "load" in terms[2]
    assert sum("root" in more for more in terms) >= 4
    assert choice.usual.held_out_error_percent == pytest.approx(5.85, abs=0.05)
    assert choice.recommended.held_out_error_percent == pytest.approx(4.75, abs=0.05)
    fit = identify_ls(
        dataclasses.replace(signals, robot=with_terms(signals.robot, terms)), Overrides()
    )
    assert fit.errors[2].relative_error_percent == pytest.approx(3.21, abs=0.05)
    assert fit.beta[fit.estimate.names.index("mu3")] == pytest.approx(0.333, abs=0.01)
    assert fit.trust.line("physical plausibility").level == "ok"


def test_emps_needs_asymmetric_and_root_friction(emps):
    choice = select_friction(signals_of(emps), Overrides())
    assert choice.recommended.terms == (frozenset({"asymmetric", "root"}),)
    assert choice.recommended.fitted_error_percent < 2.95
