"""Load friction in the excitation: limits of efforts count it, the criterion leaves it out."""

from dataclasses import replace

import numpy as np
import pytest
from test_excitation import SERIES, modelled, random_x
from test_friction_terms import ALL, USUAL, described, upright

from acquisition.robot import fourier_reference, robot_from_files
from identification.design import ExcitationSettings, excite, prior_information, search
from identification.design.information import earlier_information
from identification.design.limits import limits_of, motion_of
from identification.model import described_parameters, torque_of_links, torque_without_sliding
from identification.regression import Overrides, load_friction, make_problem, regression_of_recording
from identification.study import Noise, closed_loop, write_signals


def tx40():
    """All terms at all joints, in values of usual sizes."""
    values = "".join(f"Off{j} = 0.{j}\nFa{j} = 0.1\nFr{j} = 0.7\nFs{j} = 0.4\nmu{j} = 0.{j + 1}\n" for j in range(1, 7))
    return described("tx40", [ALL] * 6, f"{values}Frm6 = 0.5\nFsm6 = 0.3\n")


def scara(terms=(*USUAL, "load")):
    return upright([list(terms)] * 2, "mu1 = 0.3\nmu2 = 0.3\n" if "load" in terms else "")


ROBOTS = {"scara": scara(), "tx40": tx40()}


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_efforts_count_load_friction_against_the_motion(robot):
    model, base, direct = modelled(robot)
    limits, basis, x = limits_of(robot, direct, 0.8, "here"), SERIES.basis(40), random_x(robot, share=0.3)
    motion = motion_of(x, basis)
    n = robot.n
    of_links = torque_of_links(direct, motion)
    smooth, mu = (
        torque_without_sliding(direct, motion, of_links)[0],
        described_parameters(model, base)[list(load_friction(model, base).places)],
    )
    scaled = limits.effort.directions / limits.allowed[:, None]
    expected = np.abs(smooth @ scaled.T) + (mu * np.abs(of_links[0])) @ np.abs(scaled).T
    used, slopes = limits.shares_and_slopes(motion)
    assert np.abs(used[:, 3 * n :]) == pytest.approx(expected)
    assert limits.shares(motion) == pytest.approx(used)
    true = np.abs(direct.torque(*motion) @ limits.effort.directions.T / limits.effort.limits).max(axis=0)
    assert (limits.share_of_whole(motion)[3 * n :] >= true * (1 - 1e-9)).all()
    m = len(limits.effort.limits)
    J = limits.jacobian(slopes, basis, np.tile(np.arange(40)[:, None], (1, 3 * n + m))).reshape(40, 3 * n + m, -1)
    rng, h = np.random.default_rng(4), 1e-6
    for _ in range(3):
        d = rng.standard_normal(x.shape)
        low, high = (limits.shares(motion_of(x + k * h * d, basis))[:, 3 * n :] for k in (-1, 1))
        found, expected = J[:, 3 * n :] @ d.ravel(), (high - low) / (2 * h)
        same = low * high > 0  # where an effort changes its side, so does what load adds
        assert same.mean() > 0.9
        assert np.abs(found - expected)[same].max() < 1e-6 * np.abs(J[:, 3 * n :]).max()


@pytest.mark.parametrize("known", [True, False])
def test_load_friction_is_said_to_be_left_out_of_the_criterion(known, monkeypatch):
    monkeypatch.setattr(search, "STARTS", 1)
    text = scara().files["robot.toml"].decode()
    if not known:
        text = text.split("[parameters]")[0]
    robot = robot_from_files({"robot.toml": text.encode()}, "here")
    found = excite(robot, ExcitationSettings(period_s=2.0, harmonics=2), prior_information(robot), "here")
    assert not {"mu1", "mu2"} & set(found.base.names)
    assert found.warnings[-1].startswith("load friction (mu1, mu2) is not in the criterion")
    assert (found.beta is not None) == known
    if found.beta is not None:
        model, base, _ = modelled(robot)
        values = dict(zip(base.names, described_parameters(model, base), strict=True))
        assert found.beta.tolist() == [values[name] for name in found.base.names]


def test_earlier_recordings_add_what_they_know_of_all_but_load_friction(tmp_path):
    robot = scara(("viscous", "coulomb", "load"))
    q_ref = fourier_reference(robot, period_s=3.0, seed=1).at(np.arange(3001) / 1000)[0]
    write_signals(tmp_path / "log.mcap", closed_loop(robot, q_ref, 1000.0, noise=Noise(), seed=1), source="simulated")
    knowledge = prior_information(robot, after=[tmp_path / "log.mcap"])
    _, base, _ = modelled(robot)
    noise, fewer = np.array([0.2, 0.01]), base.without(["mu1", "mu2"])
    problem = make_problem(knowledge.recordings[0], Overrides())
    system = regression_of_recording(replace(problem, base=fewer)).system
    rows = system.W[system.used > 0] / noise[system.joint_of_row[system.used > 0], None]
    assert rows.shape[1] == base.b - 2
    assert pytest.approx(rows.T @ rows) == earlier_information(fewer, noise, knowledge.recordings)
