"""The commonest law of arms: a PD, and gravity at the measured position;
simulated by pinocchio alone.
"""

from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from conftest import REPLAY
from urdfs import packaged_urdf

from acquisition.errors import BadInputError
from acquisition.robot import Controller, load_robot
from identification.control import Control, Reference, described_law
from identification.data import Signals
from identification.export import read_chain, robot_of_chain
from identification.model import InverseModel, direct_model, known_parameters
from identification.regression import Overrides
from identification.results import identify

UR5 = packaged_urdf("ur5_robot.urdf")
RATE_HZ, DURATION_S, BANDWIDTH_HZ = 500.0, 5.0, 6.0
ROTOR, VISCOUS, COULOMB = (
    np.array(x) for x in ([0.6, 0.6, 0.4, 0.1, 0.1, 0.1], [8, 8, 5, 1, 1, 1], [10, 12, 8, 2, 2, 2])
)


@cache
def recorded() -> Signals:
    """A PD with speed and gravity fed forward, described with all its gains but
    without its bandwidth.
    """
    model = pin.buildModelFromUrdf(str(UR5))
    model.armature = ROTOR
    data, rng, n = model.createData(), np.random.default_rng(3), model.nv
    t = np.arange(round(DURATION_S * RATE_HZ) + 1)[:, None] / RATE_HZ
    x = np.clip(np.minimum(t, DURATION_S - t) / 2.0, 0.0, 1.0)
    omega, phase = 2 * np.pi * rng.uniform(0.1, 1.0, (5, n)), rng.uniform(0, 6.28, (5, n))
    size = 3 * rng.uniform(0.1, 0.2, (5, n)) / omega
    path = sum(s * np.sin(t * w + p) for w, p, s in zip(omega, phase, size, strict=True))
    q_ref = x**3 * (10 - 15 * x + 6 * x**2) * path
    q_ref[:, 1] -= 1.2
    dq_ref = np.gradient(q_ref, 1 / RATE_HZ, axis=0)
    w = 2 * np.pi * BANDWIDTH_HZ
    J = np.diag(pin.crba(model, data, q_ref[0]))
    kp, kd = w**2 * J, 1.6 * w * J
    q, v, before, rows = q_ref[0].copy(), np.zeros(n), q_ref[0], []
    for k in range(len(t)):
        seen = q + 3e-6 * rng.standard_normal(n)
        tau = kp * (q_ref[k] - seen) + kd * (dq_ref[k] - (seen - before) * RATE_HZ * (k > 0))
        tau += pin.computeGeneralizedGravity(model, data, seen)
        before = seen
        rows.append((seen, tau))
        for _ in range(4):
            v = v + pin.aba(model, data, q, v, tau - VISCOUS * v - COULOMB * np.tanh(v / 0.005)) / (
                4 * RATE_HZ
            )
            q = q + v / (4 * RATE_HZ)
    measured, effort = (np.array(x) for x in zip(*rows, strict=True))
    effort += 0.005 * effort.std(axis=0) * rng.standard_normal(effort.shape)
    controller = Controller(
        structure="pd_velocity_feedforward", sample_rate_hz=RATE_HZ, position_gain=tuple(kp),
        velocity_gain=tuple(kd),
        velocity_estimate="backward_difference", gravity_feedforward=True,
        bandwidth_hz=BANDWIDTH_HZ,
    )  # fmt: skip
    robot = replace(robot_of_chain(read_chain(UR5)), controller=controller)
    return Signals(
        t_s=t[:, 0], q=measured, q_ref=q_ref, effort=effort, sample_rate_hz=RATE_HZ, robot=robot,
        recording="ur5",
        effort_timing="command",
    )  # fmt: skip


def described(**keys: object) -> Signals:
    signals = recorded()
    controller = msgspec.structs.replace(signals.robot.controller, **keys)
    return replace(signals, robot=replace(signals.robot, controller=controller))


def replayed(signals: Signals):
    return identify(signals, Overrides(), method="wls").trust.line("control law")


def test_recomputed_output_subtracts_gravity():
    line = replayed(described())
    assert line.level == "ok", line.text
    assert line.text.endswith("gravity fed forward is fitted and subtracted")
    assert replayed(described(gravity_feedforward=False)).level == "caution"
    line = replayed(replace(described(), effort=1.1 * recorded().effort))
    assert (line.level, line.value) == ("caution", pytest.approx(1.1, abs=0.02))


def test_law_adds_gravity_at_measured_position():
    robot, q = described().robot, np.array([0.3, -1.0, 0.5, 0.2, 0.1, 0.0])
    dynamics = InverseModel(robot)
    model, still = direct_model(dynamics, known_parameters(dynamics)), np.zeros(6)
    torques = []
    for gravity in (False, True):
        law = msgspec.structs.replace(robot.controller, gravity_feedforward=gravity)
        loop = described_law(replace(robot, controller=law))
        control = Control(model, loop, q, still)
        control.take(Reference(q[None] + 0.01, still[None], still[None]))
        torques.append(control.torque(0, q, still))
    np.testing.assert_allclose(
        torques[1] - torques[0], model.gravity(q[None])[0], rtol=1e-12, atol=1e-12
    )


def test_computed_torque_includes_gravity(tmp_path):
    text = (REPLAY / "scara" / "robot.toml").read_text()
    law = 'structure = "computed_torque"\ngravity_feedforward = true'
    (tmp_path / "robot.toml").write_text(text.replace('structure = "pd_velocity_feedforward"', law))
    with pytest.raises(BadInputError) as told:
        load_robot(tmp_path / "robot.toml")
    assert (told.value.key, told.value.value) == ("controller.gravity_feedforward", True)
