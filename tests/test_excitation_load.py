"""Load friction in the excitation: its columns are those of the torque, its gradients those of differences."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_excitation import SERIES, information_of, modelled, random_x
from test_friction_terms import ALL, USUAL, described, upright

from acquisition.robot import fourier_reference, robot_from_files
from identification.design import Settings, excite, knowledge_of, search
from identification.design.knowledge import earlier_information
from identification.design.limits import limits_of
from identification.design.load import given_load
from identification.design.series import motion_of
from identification.model import direct_model, sliding_apart, torque_of_links, truth
from identification.regression import Overrides, load_friction, make_problem, regression_of_recording
from identification.study import Noise, closed_loop, write_signals


def tx40():
    """All terms at all joints, in values of usual sizes."""
    values = "".join(f"Off{j} = 0.{j}\nFa{j} = 0.1\nFr{j} = 0.7\nFs{j} = 0.4\nmu{j} = 0.{j + 1}\n" for j in range(1, 7))
    return described("tx40", [ALL] * 6, f"{values}Frm6 = 0.5\nFsm6 = 0.3\n")


def scara(terms=(*USUAL, "load")):
    return upright([list(terms)] * 2, "mu1 = 0.3\nmu2 = 0.3\n" if "load" in terms else "")


ROBOTS = {"scara": scara(), "tx40": tx40()}


@pytest.fixture(scope="module", params=ROBOTS)
def known(request):
    """The robot, its model, base parameters and their values, and information with load friction."""
    robot = ROBOTS[request.param]
    model, base, direct = modelled(robot)
    beta, plain = truth(model, base), information_of(robot, model, base)
    motion = motion_of(random_x(robot), SERIES.basis(40))
    load = given_load(load_friction(model, base), direct, beta, [motion], plain.creep)
    return robot, model, base, beta, replace(plain, load=load)


def test_the_gradient_with_load_friction_is_that_of_differences(known):
    """Along straight lines on which no joint's speed changes its sign, to 1e-6 of the largest component."""
    robot, _, base, _, information = known
    basis, x = tuple(A[1:] for A in SERIES.basis(40)), random_x(robot)  # but for the instant of rest
    plain = np.exp(np.random.default_rng(1).uniform(-1, 1, base.b))

    def value(y):
        return information.criterion(motion_of(y, basis), plain)[0]

    gradients = information.criterion(motion_of(x, basis), plain)[1]
    gradient = sum(g.T @ A for g, A in zip(gradients, basis, strict=True))
    rng, h, tried = np.random.default_rng(2), 1e-5, 0
    for _ in range(50):
        d = rng.standard_normal(x.shape) / math.sqrt(x.size)
        u = np.array([motion_of(x + k * h * d, basis)[1] for k in (-2, 2)])
        if (u[0] * u[1] < 0).any():
            continue
        tried += 1
        far, near = ((value(x + k * h * d) - value(x - k * h * d)) / (2 * k * h) for k in (2, 1))
        assert (gradient * d).sum() == pytest.approx((4 * near - far) / 3, abs=1e-6 * np.abs(gradient).max())
        if tried == 6:
            break
    assert tried == 6


def test_sigma_is_that_of_the_derivatives_of_the_torque(known):
    """The columns against differences by the parameters of the equation of motion, which has load friction of its own."""
    robot, model, base, beta, information = known
    motion = motion_of(random_x(robot, seed=3), SERIES.basis(61))
    moving = [x[1:] for x in motion]  # at rest nothing has a sign

    def torque(values):
        return direct_model(model, base.standard_parameters(values)).torque(*moving)

    W = np.empty((60, robot.n, base.b))
    for i, h in enumerate(1e-5 * np.maximum(np.abs(beta), 1e-2)):
        step = h * np.eye(base.b)[i]
        W[..., i] = (torque(beta + step) - torque(beta - step)) / (2 * h)
    V = (W / information.noise[:, None]).reshape(-1, base.b) * math.sqrt(information.rows / 60)
    scale = 1 / np.linalg.norm(V, axis=0)
    expected = scale * np.sqrt(np.diag(np.linalg.inv((V * scale).T @ (V * scale))))
    assert information.sigma(moving) == pytest.approx(expected, rel=1e-4)


def test_efforts_count_load_friction_against_the_motion(known):
    robot = known[0]
    model, base, direct = modelled(robot)
    limits, basis, x = limits_of(robot, direct, 0.8, "here"), SERIES.basis(40), random_x(robot, share=0.3)
    motion = motion_of(x, basis)
    n = robot.n
    of_links = torque_of_links(direct, motion)
    smooth, mu = sliding_apart(direct, motion, of_links)[0], truth(model, base)[list(load_friction(model, base).places)]
    scaled = limits.effort.directions / limits.allowed[:, None]
    expected = np.abs(smooth @ scaled.T) + (mu * np.abs(of_links[0])) @ np.abs(scaled).T
    used, slopes = limits.used_and_slopes(motion)
    assert np.abs(used[:, 3 * n :]) == pytest.approx(expected)
    assert limits.used(motion) == pytest.approx(used)
    true = np.abs(direct.torque(*motion) @ limits.effort.directions.T / limits.effort.limits).max(axis=0)
    assert (limits.share_of_whole(motion)[3 * n :] >= true * (1 - 1e-9)).all()
    m = len(limits.effort.limits)
    J = limits.jacobian(slopes, basis, np.tile(np.arange(40)[:, None], (1, 3 * n + m))).reshape(40, 3 * n + m, -1)
    rng, h = np.random.default_rng(4), 1e-6
    for _ in range(3):
        d = rng.standard_normal(x.shape)
        low, high = (limits.used(motion_of(x + k * h * d, basis))[:, 3 * n :] for k in (-1, 1))
        found, expected = J[:, 3 * n :] @ d.ravel(), (high - low) / (2 * h)
        same = low * high > 0  # where an effort changes its side, so does what load adds
        assert same.mean() > 0.9
        assert np.abs(found - expected)[same].max() < 1e-6 * np.abs(J[:, 3 * n :]).max()


@pytest.fixture(scope="module")
def designed():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "STARTS", 1)
        settings = Settings(period_s=4.0, harmonics=5, periods=1)
        return excite(scara(), settings, knowledge_of(scara())[0], "here")


def test_a_designed_reference_tells_more_of_load_friction_than_a_plain_one(designed):
    robot = scara()
    smaller = dict(zip(designed.base.names, designed.plain / designed.sigma, strict=True))
    assert smaller["mu1"] > 1.15
    assert smaller["mu2"] > 1.15
    # The same by other arithmetic: errors of mu by least squares of rows with white noise, along either reference.
    model, base, direct = modelled(robot)
    beta = truth(model, base)
    load = given_load(load_friction(model, base), direct, beta, [designed.reference.at(np.arange(99) / 25)], np.ones(2))
    spread = []
    for reference in (fourier_reference(robot, period_s=4.0, seed=1), designed.reference):
        motion = reference.at(np.arange(1, 400) / 100)
        W = model.regressor(*motion)[..., base.columns]
        load.exact(W, motion)
        V = (W / designed.noise[:, None]).reshape(-1, base.b)
        errors = np.linalg.lstsq(V, np.random.default_rng(0).standard_normal((len(V), 300)))[0].std(axis=1)
        spread.append(errors[[base.names.index("mu1"), base.names.index("mu2")]])
    assert (spread[1] < 0.9 * spread[0]).all()


def test_without_parameters_load_friction_is_said_to_be_left_out(monkeypatch):
    monkeypatch.setattr(search, "STARTS", 1)
    text = scara().files["robot.toml"].decode().split("[parameters]")[0]
    robot = robot_from_files({"robot.toml": text.encode()}, "here")
    found = excite(robot, Settings(period_s=2.0, harmonics=2), knowledge_of(robot)[0], "here")
    assert not {"mu1", "mu2"} & set(found.base.names)
    assert found.warnings[1] == (
        "load friction (mu1, mu2) is not in the criterion: its columns depend on the parameters of the links, which "
        "neither a fit nor [parameters] give"
    )


def test_earlier_recordings_add_their_load_friction_about_the_parameters(tmp_path):
    robot = scara(("viscous", "coulomb", "load"))
    q_ref = fourier_reference(robot, period_s=3.0, seed=1).at(np.arange(3001) / 1000)[0]
    write_signals(tmp_path / "log.mcap", closed_loop(robot, q_ref, 1000.0, noise=Noise(), seed=1), source="simulated")
    knowledge, _ = knowledge_of(robot, after=[tmp_path / "log.mcap"])
    _, base, _ = modelled(robot)
    noise = np.array([0.2, 0.01])
    M = earlier_information(base, noise, knowledge.recordings, knowledge.beta)
    problem = make_problem(knowledge.recordings[0], Overrides())
    system = regression_of_recording(problem, beta=knowledge.beta).system
    rows = system.W[system.used > 0] / noise[system.joint_of_row[system.used > 0], None]
    assert pytest.approx(rows.T @ rows) == M
    mu = base.names.index("mu2")
    assert M[mu, mu] > 0
    # Without parameters the information is of the other parameters alone.
    fewer = base.without(["mu1", "mu2"])
    plain = earlier_information(fewer, noise, knowledge.recordings, None)
    assert plain.shape == (base.b - 2, base.b - 2)
