"""References that tell most of the parameters: gradients against differences, limits
between samples, the command.
"""

import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from conftest import REPLAY, robot_named
from friction_models import USUAL, upright, whole_arm
from loops import modelled
from pictured_fits import Written
from urdfs import TURN_AND_SLIDE, TURN_AND_SLIDE_TOML

from acquisition.errors import BadInputError, NoFitError, RobotIdimError
from acquisition.robot import (
    Payload,
    check_limits,
    fourier_reference,
    load_robot,
    robot_from_files,
    table_reference,
)
from identification.commands import main
from identification.data import load_signals
from identification.design import (
    ExcitationSettings,
    Information,
    Series,
    earlier_information,
    excitation_document,
    excite,
    limits_of,
    motion_of,
    prior_information,
    search,
    torque_noise,
)
from identification.model import (
    InverseModel,
    add_payload,
    base_parameters,
    described_parameters,
    direct_model,
    load_parameters,
    obstacles_of,
    torque_of_links,
    torque_without_sliding,
)
from identification.regression import (
    Overrides,
    equation_alone,
    make_problem,
    rows_of_recording,
)
from identification.study import Noise, closed_loop, write_signals
from identification.view import draw_excitation, write_rrd
from identification.view.charts import interval_charts
from identification.view.panels import GREY, ORANGE


def limited(robot):
    """With a saturation of each motor, far above what motions need."""
    drives = robot.bus.drive
    most = [32.767 * drive.rated_torque_nm for drive in drives]
    motors = (
        msgspec.structs.replace(motor, saturation=x)
        for motor, x in zip(robot.motors, most, strict=True)
    )
    return replace(robot, motors=tuple(motors))


SCARA, TX40 = limited(robot_named("scara")), limited(robot_named("tx40"))
SERIES, SHORT = Series(period_s=4.0, harmonics=4), ExcitationSettings(period_s=2.0, harmonics=2)
K = 2 * SERIES.harmonics - 1  # free coefficients of a joint


@pytest.fixture(autouse=True, scope="module")
def one_search():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "STARTS", 1)
        yield


def with_text(name, old, new, count=-1):
    text = (REPLAY / name / "robot.toml").read_text()
    assert old in text
    return limited(robot_from_files({"robot.toml": text.replace(old, new, count).encode()}, "here"))


def asymmetric():
    """The TX40 with friction that differs by direction at its first three joints."""
    text = (REPLAY / "tx40" / "robot.toml").read_text()
    text = text.replace(
        "following_error_deg = 15", 'following_error_deg = 15\nfriction = "asymmetric"', 3
    )
    text = re.sub(r"^(F[vc])([123]) = (.*)$", r"\1p\2 = \3\n\1n\2 = 1\3", text, flags=re.MULTILINE)
    return limited(robot_from_files({"robot.toml": text.encode()}, "here"))


def loaded_scara(terms=(*USUAL, "load")):
    return upright([list(terms)] * 2, "mu1 = 0.3\nmu2 = 0.3\n")


def without_parameters(robot):
    text = robot.files["robot.toml"].decode().partition("[parameters]")[0]
    return robot_from_files({"robot.toml": text.encode()}, "here")


ASYMMETRIC, LOADED = asymmetric(), (limited(loaded_scara()), limited(whole_arm()))


def information_of(robot, model, base):
    noise, earlier = np.random.default_rng(3).uniform(0.5, 2.0, robot.n), np.zeros((base.b, base.b))
    creep = 0.05 * np.array([joint.si("speed") for joint in robot.joints])
    return Information(
        model=model, base=base, noise=noise, rows=300.0, earlier=earlier, creep=creep
    )


def random_x(robot, series=SERIES, seed=0, share=0.6):
    found = fourier_reference(
        robot, period_s=series.period_s, seed=seed, harmonics=series.harmonics, share=share
    )
    return series.coefficients(found)


def test_series_starts_and_ends_at_rest():
    x = np.random.default_rng(0).standard_normal((3, K))
    reference = SERIES.reference(x)
    q, dq, ddq = reference.at(np.array([0.0, SERIES.period_s]))
    assert np.abs(dq).max() < 1e-12 * np.abs(x).max() * 100
    assert np.abs(ddq).max() < 1e-10
    assert q[0] == pytest.approx(x[:, 0])
    assert SERIES.coefficients(reference) == pytest.approx(x)
    at = reference.at(np.arange(50) * SERIES.period_s / 50)
    for given, expected in zip(motion_of(x, SERIES.basis(50)), at, strict=True):
        assert given == pytest.approx(expected)
    # nothing is left out twice
    assert np.linalg.matrix_rank(np.concatenate(SERIES.basis(50)[:1])) == K


@pytest.mark.parametrize("robot", [SCARA, ASYMMETRIC], ids=["scara", "tx40"])
def test_gradient_matches_differences(robot):
    model, base, _ = modelled(robot)
    information, basis, x = information_of(robot, model, base), SERIES.basis(40), random_x(robot)
    plain = np.exp(np.random.default_rng(1).uniform(-1, 1, base.b))

    def value(y):
        return information.criterion(motion_of(y, basis), plain)[0]

    gradients = information.criterion(motion_of(x, basis), plain)[1]
    gradient = sum(g.T @ A for g, A in zip(gradients, basis, strict=True))
    rng, h = np.random.default_rng(2), 1e-5
    directions = [*rng.standard_normal((3, *x.shape)) / math.sqrt(x.size)]
    for j in range(robot.n):
        directions.append(np.zeros(x.shape))
        directions[-1][j, rng.integers(K)] = 1.0
    for d in directions:
        far, near = ((value(x + k * h * d) - value(x - k * h * d)) / (2 * k * h) for k in (2, 1))
        by_differences = (4 * near - far) / 3  # Richardson
        assert (gradient * d).sum() == pytest.approx(
            by_differences, abs=1e-6 * np.abs(gradient).max()
        )


@pytest.mark.parametrize(
    "robot", [ASYMMETRIC, *LOADED], ids=["asymmetric", "loaded scara", "loaded tx40"]
)
def test_limit_jacobian_matches_differences(robot):
    *_, direct = modelled(robot)
    limits, basis, x = (
        limits_of(robot, (direct,), 0.8, "here"),
        SERIES.basis(40),
        random_x(robot, share=0.3),
    )
    n, L = robot.n, len(limits.names)
    slopes = limits.shares_and_slopes(motion_of(x, basis))[1]
    J = limits.jacobian(slopes, basis, np.tile(np.arange(40)[:, None], (1, L)))
    assert J.shape == (40 * L, x.size)
    rng, h = np.random.default_rng(4), 1e-5
    for _ in range(4):
        d = rng.standard_normal(x.shape)
        ends = np.array([limits.shares(motion_of(x + k * h * d, basis)) for k in (-2, -1, 1, 2)])
        slope = (8 * (ends[2] - ends[1]) - (ends[3] - ends[0])) / (12 * h)
        # where an effort changes its side, so does what load friction adds
        same = ends[0] * ends[-1] > 0
        # motion; efforts, whose shares are smaller by far
        for columns in (slice(0, 3 * n), slice(3 * n, None)):
            off, own = np.abs((J @ d.ravel()).reshape(40, L) - slope)[:, columns], same[:, columns]
            assert own.mean() > 0.9
            assert off[own].max() < 1e-6 * np.abs(J.reshape(40, L, -1)[:, columns]).max()


def test_efforts_include_full_friction():
    robot = with_text(
        "tx40", "following_error_deg = 15", "following_error_deg = 15\neffort_nm = 60", 1
    )
    *_, direct = modelled(robot)
    limits = limits_of(robot, (direct,), 0.5, "here")
    assert limits.coulomb[0] == pytest.approx(6.9822)
    assert limits.allowed[0] == pytest.approx(30 - 6.9822)
    # Motor 5 gives (tau5 - tau6) / 45: the friction of joint 5, of joint 6 and,
    # at both, of motor 6.
    assert limits.effort.names[-1] == "motor motor_5"
    motion = motion_of(random_x(robot), SERIES.basis(200))
    tau = direct.torque(*motion)
    shares = np.abs(tau @ limits.effort.directions.T / limits.effort.limits).max(axis=0)
    assert (limits.share_of_whole(motion)[18:] >= shares * (1 - 1e-9)).all()
    assert limits.share_of_whole(motion)[18] <= (np.abs(tau[:, 0]).max() + 2 * 6.9822) / 60


def test_information_matches_least_squares():
    model, base, _ = modelled(SCARA)
    information = information_of(SCARA, model, base)
    motion = motion_of(random_x(SCARA), SERIES.basis(60))
    W = model.regressor(*motion)[..., base.columns]
    rows = (W / information.noise[:, None]).reshape(-1, base.b) * math.sqrt(300 / 60)
    covariance = np.linalg.inv(rows.T @ rows)
    assert information.sigma(motion) == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-9)
    more = replace(information, earlier=3 * rows.T @ rows)
    assert more.sigma(motion) == pytest.approx(0.5 * np.sqrt(np.diag(covariance)), rel=1e-9)


@pytest.fixture(scope="module")
def tx40_excitation():
    robot = with_text(
        "tx40", "following_error_deg = 15\n", "following_error_deg = 15\neffort_nm = 60\n", 1
    )
    settings = ExcitationSettings(period_s=5.0, harmonics=5, periods=1)
    said = []
    return robot, excite(robot, settings, prior_information(robot), "here", said.append), said


def test_reference_beats_plain_design(tx40_excitation):
    _, found, said = tx40_excitation
    smaller = found.plain / found.sigma
    assert np.median(smaller) > 1.7
    assert smaller.min() > 0.9
    assert len(said) > 10
    assert said[-1].startswith("search 1 of 1: standard errors 0.")


def test_limits_hold_between_samples(tx40_excitation):
    robot, found, _ = tx40_excitation
    q, dq, ddq = motion = found.reference.at(np.linspace(0, 5, 5001))
    for j, joint in enumerate(robot.joints):
        low, high = joint.si("position")
        assert np.abs(q[:, j] - (low + high) / 2).max() <= 0.8 * (high - low) / 2
        assert np.abs(dq[:, j]).max() <= 0.8 * joint.si("speed")
        assert np.abs(ddq[:, j]).max() <= 0.8 * joint.si("acceleration")
    *_, direct = modelled(robot)
    torque = np.abs(direct.torque(*motion))[:, 0].max()
    assert 0.5 * 60 < torque <= 0.8 * 60
    # most limits of position and speed, and one effort, are used to the full
    assert (found.used > 0.797).sum() >= 9
    names = dict(zip(found.limits.names, found.used, strict=True))
    assert names["effort of joint joint_1"] >= torque / 60 - 1e-3


def test_infeasible_start_is_scaled():
    """The position at the ends is a hair beyond its limit: drawn to rest there nothing would
    be left of the motion.
    """
    limits = limits_of(SCARA, (), 0.8, "here")
    start = random_x(SCARA, share=0.4)
    x = 2.5 * start
    x[0, 0] = limits.middle[0] + limits.maximum[0, 0] * (1 + 1e-9)
    rest, found = (
        search.shrink(x, SERIES.basis(400), limits, *more) for more in ((), (start, 0.99))
    )
    assert limits.largest(motion_of(rest, SERIES.basis(400)))[0] > 1
    assert not rest[:, 1:].any()
    assert 0.98 < limits.largest(motion_of(found, SERIES.basis(400)))[0] <= 0.99
    share = (found - start)[x != start] / (x - start)[x != start]
    assert share == pytest.approx(share.mean())
    assert share.mean() > 0.05


@pytest.mark.parametrize("robot", [SCARA, TX40], ids=["scara", "tx40"])
def test_search_starts_in_motion(robot):
    """Some of these random references end at the edge of a range."""
    limits = limits_of(robot, (), 0.8, "here")
    problem = search.SearchProblem(
        series=SERIES, information=SimpleNamespace(), limits=limits, plain=np.ones(1)
    )
    for seed in range(40):
        q, *_ = motion_of(search._random_start(problem, seed), problem.finer)
        assert (np.ptp(q, axis=0) > 0.2 * limits.maximum[0]).all()
        assert (np.abs(q - limits.middle) <= limits.maximum[0]).all()


def test_no_worse_parameter_precedes_criterion(monkeypatch):
    sigmas = iter(np.array([[0.3, 1.2], [0.9, 0.9], [0.8, 0.95], [0.9, 1.0]]))
    starts = [random_x(SCARA, seed=seed, share=0.4) for seed in range(4)]
    monkeypatch.setattr(search, "STARTS", 4)
    monkeypatch.setattr(search, "_random_start", lambda problem, seed: starts[seed - 4])
    monkeypatch.setattr(search, "best_series", lambda problem, start, say: start)
    information = SimpleNamespace(sigma=lambda motion: next(sigmas))
    limits = limits_of(SCARA, (), 0.8, "here")
    problem = search.SearchProblem(
        series=SERIES, information=information, limits=limits, plain=np.ones(2)
    )
    x, sigma = search.best_of_searches(problem, 1, "here", lambda text: None)
    assert x is starts[2]
    assert sigma.tolist() == [0.8, 0.95]


def test_search_fails_if_every_motion_exceeds_limits(monkeypatch):
    monkeypatch.setattr(search, "best_series", lambda problem, start, say: 2 * start)
    with pytest.raises(
        NoFitError, match=r"no reference keeps the limits: \w+ of joint \w+ exceeds its limit by"
    ):
        excite(
            SCARA, ExcitationSettings(period_s=2.0, harmonics=3), prior_information(SCARA), "here"
        )


@pytest.mark.parametrize(
    ("old", "new", "harmonics", "says"),
    [
        (
            "bandwidth_hz = 5.0",
            "bandwidth_hz = 1.0",
            8,
            "3 or fewer harmonics, or a period of at least 24 s (harmonics, period_s).",
        ),
        (
            "bandwidth_hz = 5.0",
            "bandwidth_hz = 0.1",
            10,
            "Use a period of at least 300 s (period_s).",
        ),
        ("speed_deg_s = 180\n", "", 10, "joint[0].speed_deg_s: joint shoulder has no speed limit"),
        (
            "acceleration_deg_s2 = 1500\n",
            "",
            10,
            "joint[0].acceleration_deg_s2: joint shoulder has no acceleration limit",
        ),
        (
            "[-120, 120]",
            "[-120, 120]\neffort_nm = 0.9",
            10,
            "Coulomb friction of joint shoulder is 0.82 N m, at least 80 % of its effort limit",
        ),
        ("counts_per_turn = 262144", "counts_per_turn = 1e11", 2, "(motor_1) = "),
    ],
)
def test_impossible_options_refused(old, new, harmonics, says):
    robot = with_text("scara", old, new, 1)
    with pytest.raises((BadInputError, RobotIdimError)) as caught:
        excite(robot, ExcitationSettings(harmonics=harmonics), prior_information(robot), "here")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_excess_gravity_refused():
    robot = with_text(
        "tx40", "acceleration_deg_s2 = 2500", "acceleration_deg_s2 = 2500\neffort_nm = 24"
    )
    robot = replace(robot, gravity=np.array([9.81, 0.0, 0.0]))
    with pytest.raises(
        BadInputError, match=r"joint_2 needs [0-9.]+ N m to start from rest .* effort limit of 24"
    ):
        excite(robot, ExcitationSettings(), prior_information(robot), "here")


NOT_CHECKED = "torques are not checked, because there is neither a fit nor [parameters]"
NOT_LIMITED = (
    "the reference may exceed the torque limits of shoulder, elbow, because robot.toml gives none: "
    "set effort_nm, effort_n or the motor's saturation"
)
LEFT_OUT = (
    "load-dependent friction (mu1, mu2) counts in the effort limits, but not in the expected "
    "intervals"
)


@pytest.mark.parametrize(
    ("robot", "warnings"),
    [
        # the range of the object that reports an effort is no limit
        (robot_named("scara"), (NOT_LIMITED,)),
        (LOADED[0], (LEFT_OUT,)),
        (without_parameters(LOADED[0]), (NOT_CHECKED, LEFT_OUT)),
    ],
)
def test_unchecked_and_excluded_items_reported(robot, warnings):
    found = excite(robot, SHORT, prior_information(robot), "here")
    assert found.warnings == warnings
    assert len(found.limits.effort.limits) == (2 if warnings == (LEFT_OUT,) else 0)
    assert not {"mu1", "mu2"} & set(found.base.names)
    if NOT_CHECKED in warnings:
        assert (found.beta, found.noise.tolist()) == (None, [1.0, 1.0])
    else:
        model, base, _ = modelled(robot)
        values = dict(zip(base.names, described_parameters(model, base), strict=True))
        assert found.beta.tolist() == [values[name] for name in found.base.names]


def test_noise_given_from_fit_or_torque_share(tmp_path):
    model, base, direct = modelled(SCARA)
    motions = [motion_of(random_x(SCARA), SERIES.basis(100))]
    rms = np.sqrt((direct.torque(*motions[0]) ** 2).mean(axis=0))
    knowledge = prior_information(SCARA)
    assert torque_noise(SCARA, direct, knowledge, motions)[0] == pytest.approx(0.02 * rms)
    assert torque_noise(SCARA, direct, prior_information(SCARA, noise=(0.3,)), motions)[
        0
    ].tolist() == [0.3, 0.3]
    with pytest.raises(
        BadInputError, match=r"noise.*expected one number, or one for each of 2 joints"
    ):
        prior_information(SCARA, noise=(1.0, 2.0, 3.0))
    beta = described_parameters(model, base)
    values = zip(base.names, beta, base.units, strict=True)
    parameters = [{"name": n, "value": v, "unit": u, "sigma": 0.1} for n, v, u in values]
    joints = [{"moving_relative_error_percent": 5.0, "autocorrelation": 0.6}] * 2
    (tmp_path / "fit.json").write_text(
        json.dumps({"parameters": parameters, "joints": joints, "method": "iv"})
    )
    known = prior_information(SCARA, fit=tmp_path / "fit.json")
    assert (known.warnings, known.beta_from) == ((), "fit.json")
    assert known.beta == pytest.approx(beta)
    # sqrt(1.6 / 0.4) = 2
    assert torque_noise(SCARA, direct, known, motions)[0] == pytest.approx(0.05 * 2 * rms)


@pytest.fixture(scope="module")
def earlier(tmp_path_factory):
    path, robot = (
        tmp_path_factory.mktemp("earlier") / "log.mcap",
        loaded_scara(("viscous", "coulomb", "load")),
    )
    q_ref = fourier_reference(robot, period_s=3.0, seed=1).at(np.arange(3001) / 1000)[0]
    write_signals(
        path, closed_loop(robot, q_ref, 1000.0, noise=Noise(), seed=1), source="simulated"
    )
    return path


def test_earlier_recordings_add_information(earlier):
    signals = load_signals(earlier)
    knowledge = prior_information(signals.robot, after=[earlier] * 2)
    _, every, _ = modelled(signals.robot)
    noise, base = np.array([0.2, 0.01]), every.without(["mu1", "mu2"])
    assert len(base.names) == len(every.names) - 2
    M = earlier_information(base, noise, knowledge.recordings[:1])
    assert earlier_information(base, noise, knowledge.recordings) == pytest.approx(2 * M)
    alone = equation_alone(replace(make_problem(signals, Overrides()), base=base))
    system = rows_of_recording(*alone).system
    rows = system.W / noise[system.joint_of_row, None]
    assert pytest.approx(rows.T @ rows) == M
    with pytest.raises(
        RobotIdimError, match="base parameters are not those of the described robot"
    ):
        earlier_information(base_parameters(InverseModel(TX40)), np.ones(6), knowledge.recordings)


def test_command_writes_reference(tmp_path, capsys):
    out, toml, after = (
        tmp_path / "ref.csv",
        REPLAY / "scara" / "robot.toml",
        REPLAY / "scara" / "session.mcap",
    )
    options = ["--period=3", "--harmonics=3", "--periods=2", f"--after={after}"]
    assert main(["excite", str(toml), "-o", str(out), *options]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    for part in (
        "SCARA: reference of 2 periods of 3 s, 3 harmonics up to 1 Hz, seed 1",
        "ratio of intervals, plain to this reference: median ",
        "20 random ones with 3 harmonics and the same share of all limits",
    ):
        assert part in printed
    robot = load_robot(toml)
    path = table_reference(out, robot, robot.bus.sync_period_s)  # as `record --track` reads it
    check_limits(path, robot, robot.bus.sync_period_s, str(out))
    assert len(path) == 6001
    assert path[0] == pytest.approx(path[-1], abs=1e-9)
    assert path[0] == pytest.approx(path[3000], abs=1e-6)
    assert main(["excite", str(toml), "-o", str(toml)]) == 1
    assert main(["excite", str(toml), "-o", str(out), "--harmonics", "30"]) == 1
    assert "exceeds a third of the bandwidth of 5 Hz" in capsys.readouterr().err


def capsules(text, base_m=0.1, names="ab"):
    """A planar arm of links of 1 m that can hit its own base."""
    toml = f"""
name = "arm"
gravity_m_s2 = [0, 0, 0]
base_capsule = {{ radius_m = {base_m}, from_m = [0, 0, 0], to_m = [0, 0, 0.5] }}
"""
    for name, d_m in zip(names, (0, *(1,) * (len(names) - 1)), strict=True):
        toml += f"""
[[joint]]
name = "{name}"
type = "revolute"
dh = {{ alpha_deg = 0, d_m = {d_m}, theta_deg = 0, r_m = 0 }}
position_deg = [-175, 175]
speed_deg_s = 180
acceleration_deg_s2 = 900
capsule = {{ radius_m = 0.1, from_m = [0.2, 0, 0], to_m = [1, 0, 0] }}
[[motor]]
name = "m{name}"
effort_unit = "N m"
"""
    return robot_from_files(
        {"robot.toml": f"{text}{toml}[controller]\nbandwidth_hz = 10\n".encode()}, "here"
    )


def obstacles_in(robot, find=lambda name: None, poses=((0.0, 0.0),)):
    return obstacles_of(InverseModel(robot), find, np.array(poses), 0.02)


def test_adjacent_and_near_pairs_excluded():
    """Stretched out: the base reaches into link b, links are 0.2 m or more apart."""
    robot = capsules("ground_m = -0.3", 1.15, "abcde")
    obstacles = obstacles_in(robot, poses=np.zeros((3, 5)))
    apart = [
        "base and c",
        "base and d",
        "base and e",
        "a and c",
        "a and d",
        "a and e",
        "b and d",
        "b and e",
        "c and e",
    ]
    checked = [name.replace("link of ", "") for name in obstacles.names]
    assert checked == [f"ground and {name}" for name in "abcde"] + apart
    assert obstacles.near == ("base and link of b",)
    along = zip(apart, (2.2, 3.2, 4.2, 1.2, 2.2, 3.2, 1.2, 2.2, 1.2), strict=True)
    expected = [x - (1.15 if "base" in name else 0.1) - 0.1 for name, x in along]
    assert obstacles.distances(np.zeros((1, 5)))[0] == pytest.approx([0.2] * 5 + expected)
    assert obstacles.nearest(np.zeros((1, 5))) == (pytest.approx(0.2), "ground and link of a")


def bent(q, base_m):
    """Distance of link b to the base of `capsules`, link b folded back towards it."""
    s = np.linspace(0.2, 1.0, 801)
    return np.sqrt(1 + s**2 + 2 * s * np.cos(q[:, 1:])).min(axis=1) - 0.1 - base_m


def unchecked(monkeypatch, robot, settings):
    """Positions along the reference that is found without a check of distances."""
    with monkeypatch.context() as patched:
        patched.setattr(search, "MARGIN_M", -np.inf)
        return excite(robot, settings, prior_information(robot), "here").reference.at(
            np.linspace(0, 4, 3001)
        )[0]


@pytest.mark.parametrize(("base_m", "seed", "stays"), [(0.95, 3, True), (1.03, 2, False)])
def test_link_distance_holds_between_samples(monkeypatch, base_m, seed, stays):
    """Where the reference keeps it without a check it stays; one that goes
    through the base is moved.
    """
    robot, settings = capsules("", base_m), ExcitationSettings(period_s=4.0, harmonics=4, seed=seed)
    found = excite(robot, settings, prior_information(robot), "here")
    q = found.reference.at(np.linspace(0, 4, 3001))[0]
    apart = bent(q, base_m).min()
    assert 0.0199 < apart < 0.06  # it goes near, and no nearer
    free = bent(unchecked(monkeypatch, robot, settings), base_m).min()
    assert apart == free if stays else free < 0
    assert found.nearest == (pytest.approx(apart, abs=1e-3), "base and link of b")
    told = f"smallest distance: base and link of b, {found.nearest[0]:.3f} m"
    assert excitation_document(found).sections[1].lines == (told,)
    assert found.used.max() <= 0.8 + 1e-6


def test_links_close_at_rest_refused():
    """Too near over the half of its range that may be used for rest; farther apart at the ends."""
    text = capsules("", 0.95).files["robot.toml"].decode()
    folded = text.replace("d_m = 1, theta_deg = 0", "d_m = 1, theta_deg = 180")
    robot = robot_from_files({"robot.toml": folded.encode()}, "here")
    with pytest.raises(
        NoFitError, match=r"keeps the limits: base and link of b are -\d.\d+ m apart at rest"
    ):
        excite(
            robot, ExcitationSettings(period_s=4.0, harmonics=4), prior_information(robot), "here"
        )


def test_overlapping_shapes_missing_meshes_named(tmp_path):
    assert obstacles_in(capsules("ground_m = -0.05")).near == (
        "ground and link of a",
        "ground and link of b",
    )
    shape = '<collision><origin xyz="0 0 0.5"/><geometry>{}</geometry></collision>'
    sphere, mesh = (
        shape.format('<sphere radius="0.1"/>'),
        shape.format('<mesh filename="package://none/a.stl"/>'),
    )

    def arm(solid):
        urdf = TURN_AND_SLIDE.format(effort="80").replace(
            '<link name="base"/>', f'<link name="base">{sphere}</link>'
        )
        urdf = urdf.replace('<link name="slide"/>', f'<link name="slide">{solid}</link>')
        urdf = urdf.replace('<child link="slide"/>', '<child link="slide"/><origin xyz="3 0 0"/>')
        files = {
            "robot.toml": TURN_AND_SLIDE_TOML.format(elbow="", rail="").encode(),
            "robot.urdf": urdf.encode(),
        }
        return robot_from_files(files, "here")

    obstacles = obstacles_in(arm(sphere))
    assert obstacles.names == ("base and slide",)
    assert obstacles.distances(np.array([[0.0, 0.5]]))[0] == pytest.approx([3.5 - 0.2])
    assert obstacles_in(arm(mesh)).missing == ("package://none/a.stl",)
    (tmp_path / "a.stl").write_text("no mesh")
    with pytest.raises(BadInputError, match=r"URDF: a collision shape cannot be read: .*a\.stl"):
        obstacles_in(arm(mesh), lambda name: tmp_path / "a.stl")
    # Two plates as a V that opens towards the base: its hull is nearer than its edges.
    corners = [(x, y, z) for x, y in ((-0.3, 1), (0.3, 0), (-0.3, -1)) for z in (-0.1, 0.1)]
    faces = [(1, 2, 3), (2, 4, 3), (3, 4, 5), (4, 6, 5)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c}" for a, b, c in faces]
    (tmp_path / "a.obj").write_text("\n".join(lines) + "\n")
    meshed = obstacles_in(arm(mesh), lambda name: tmp_path / "a.obj")
    assert (meshed.missing, meshed.names) == ((), ("base and slide",))
    assert meshed.distances(np.array([[0.0, 0.5]])) == pytest.approx(3.5 - 0.3 - 0.1, abs=1e-4)


def test_view_shows_reference_within_limits(tx40_excitation, tmp_path):
    robot, found, _ = tx40_excitation
    write_rrd(tmp_path / "a.rrd", draw_excitation(found, excitation_document(found)))
    file = Written(tmp_path / "a.rrd")
    *_, direct = modelled(robot)
    for j, joint in enumerate(robot.joints):
        for quantity, key in (("q", "position"), ("dq", "speed"), ("torque", None)):
            t_ns, values = file.curves[f"/{quantity}/{joint.name}/reference"]
            motion = found.reference.at(1e-9 * t_ns)
            expected = (
                direct.torque(*motion) if key is None else motion[("position", "speed").index(key)]
            )
            assert values == pytest.approx(expected[:, j], rel=1e-6, abs=1e-6)
            low, high = (
                file.curves.get(f"/{quantity}/{joint.name}/{end}") for end in ("low", "high")
            )
            if key == "speed":
                assert high[1].tolist() == [joint.si("speed")] * 2
            elif key == "position":
                assert (low[1][0], high[1][0]) == joint.si("position")
            elif j == 0:
                assert [low[1][0], high[1][0]] == pytest.approx([-60.0, 60.0])
    marks = [mark for chart in interval_charts(found) for mark in chart.columns[0].marks]
    halves = [[mark.value for mark in marks if mark.color == color] for color in (ORANGE, GREY)]
    assert halves == [pytest.approx(found.half), pytest.approx(found.plain_half)]


PAYLOAD = Payload(2.0, (0.03, 0.02, 0.08))


def test_report_shows_intervals_and_limits(tx40_excitation):
    _, found, _ = tx40_excitation
    expected, limits = excitation_document(found).sections
    first = expected.table.rows[0]
    halves = [1.96 * found.sigma[0], 1.96 * found.plain[0], found.plain[0] / found.sigma[0]]
    assert [first[0], *(cell.exact for cell in first[2:5])] == [
        "ZZ1R",
        *(pytest.approx(x, rel=1e-4) for x in halves),
    ]
    assert [row[0] for row in limits.table.rows] == [
        *(f"joint_{j}" for j in range(1, 7)),
        "motor motor_5",
    ]
    assert limits.table.rows[0][4].exact == pytest.approx(80.0, abs=0.5)


def loaded(robot, payload=PAYLOAD):
    model, base, _ = modelled(robot)
    chi = base.standard_parameters(described_parameters(model, base))
    return direct_model(model, add_payload(model, chi, payload))


def test_payload_reference_keeps_both_effort_limits():
    robot = with_text(
        "scara", "following_error_deg = 15\n", "following_error_deg = 15\neffort_nm = 40\n", 1
    )
    settings, knowledge = (
        ExcitationSettings(period_s=4.0, harmonics=4),
        prior_information(robot, payload=PAYLOAD),
    )
    found = excite(robot, settings, knowledge, "here")
    motion = found.reference.at(np.linspace(0, 4, 2001))
    *_, direct = modelled(robot)
    without, carrying = (
        np.abs(model.torque(*motion))[:, 0].max() for model in (direct, loaded(robot))
    )
    assert without < carrying
    assert 0.9 * 32 < carrying <= 0.8 * 40
    expected, limits = excitation_document(found).sections
    assert (
        "drive gains, from a run without and a run with 2 kg at 0.03, 0.02, 0.08 ± 0.005 m"
        in (expected.lines[-1])
    )
    assert [row[0] for row in limits.table.rows][-2:] == [
        "shoulder with the payload",
        "elbow with the payload",
    ]


def test_gain_errors_by_normal_equations():
    """Of the rows of both runs, what is not stated of the payload, and the gains; a stated
    centre of mass tells more.
    """
    model, base, direct = modelled(SCARA)
    information, motion = (
        information_of(SCARA, model, base),
        motion_of(random_x(SCARA), SERIES.basis(60)),
    )
    per = np.tile(1 / information.noise, 60)[:, None]
    whole = model.regressor(*motion).reshape(120, -1) * per
    W, R = whole[:, base.columns], SCARA.R
    of_motors = [np.linalg.solve(R.T, one.torque(*motion).T).T for one in (direct, loaded(SCARA))]
    E = [(x[:, None] * R.T).reshape(120, -1) * per for x in of_motors]
    inertias = {"XX2", "XY2", "XZ2", "YY2", "YZ2", "ZZ2"}
    found = []
    for center, half_m, free in (
        (None, 0.0, inertias | {"MX2", "MY2", "MZ2"}),
        (PAYLOAD.center_of_mass_m, 0.005, None),
        (PAYLOAD.center_of_mass_m, 0.0, inertias),
    ):
        payload = Payload(2.0, center, center_half_width_m=half_m)
        found.append(information.gain_deviations(motion, (direct, loaded(SCARA)), payload))
        if free:
            L = whole[:, [model.names.index(name) for name in model.names if name in free]]
            X = np.block([[W, 0 * L, -E[0]], [W, L, -E[1]]])
            scale = np.linalg.norm(X, axis=0) + (np.linalg.norm(X, axis=0) == 0)
            inverse = np.linalg.pinv(X / scale, rcond=1e-10)
            sigma = np.sqrt((inverse**2).sum(axis=1))[-2:] / scale[-2:]
            assert found[-1] == pytest.approx(sigma * math.sqrt(60 / information.rows), rel=1e-6)
    assert ((found[0] > found[1]) & (found[1] > found[2])).all()


def test_payload_without_torques_refused(tmp_path, capsys):
    (tmp_path / "robot.toml").write_bytes(
        without_parameters(robot_named("scara")).files["robot.toml"]
    )
    command = ["excite", str(tmp_path / "robot.toml"), "-o", str(tmp_path / "ref.csv"), "--payload"]
    for given, said in (("2@0,0,0.1", "without parameters and drive gains"), ("two", "KG@X,Y,Z")):
        assert main([*command, given]) == 1
        assert said in capsys.readouterr().err


def test_efforts_count_load_friction_against_motion():
    robot = LOADED[1]
    model, base, direct = modelled(robot)
    limits, basis, x = (
        limits_of(robot, (direct,), 0.8, "here"),
        SERIES.basis(40),
        random_x(robot, share=0.3),
    )
    motion = motion_of(x, basis)
    n = robot.n
    of_links = torque_of_links(direct, motion)
    smooth = torque_without_sliding(direct, motion, of_links)[0]
    mu = described_parameters(model, base)[np.isin(base.names, load_parameters(base))]
    scaled = limits.effort.directions / limits.allowed[:, None]
    expected = np.abs(smooth @ scaled.T) + (mu * np.abs(of_links[0])) @ np.abs(scaled).T
    used, _ = limits.shares_and_slopes(motion)
    assert np.abs(used[:, 3 * n :]) == pytest.approx(expected)
    assert limits.shares(motion) == pytest.approx(used)
    true = np.abs(direct.torque(*motion) @ limits.effort.directions.T / limits.effort.limits).max(
        axis=0
    )
    assert (limits.share_of_whole(motion)[3 * n :] >= true * (1 - 1e-9)).all()
