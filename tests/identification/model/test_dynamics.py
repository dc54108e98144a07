"""The model against physics: pinocchio's Newton-Euler, closed forms, power, and the
field's base parameters.
"""

import numpy as np
import pinocchio as pin
import pytest
from conftest import FROM_PINOCCHIO, REPLAY, robot_named
from urdfs import LIMIT, TWO_TURNING, joint, robot_of_arm, urdf

from acquisition.robot import Robot, load_robot, robot_from_files
from identification.errors import BadInputError
from identification.model import InverseModel, base_parameters, described_parameters

RNG = np.random.default_rng(3)


def states(n: int, count: int = 50) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    q, dq, ddq = RNG.uniform(-3, 3, size=(3, count, n))
    return q, dq, ddq


def tilted_arm() -> Robot:
    """Two turning joints and a slide, none of whose axes is that of a frame, under
    gravity that is tilted too.
    """
    tilted = urdf(lift=joint("lift", "revolute", "column", "arm", LIMIT, axis="0.3 0.9 -0.2"))
    return robot_of_arm(tilted, "gravity_m_s2 = [1.0, -2.0, -9.5]\n")


@pytest.mark.parametrize("robot", ["tx40", "emps", "arm"])
def test_regressor_matches_pinocchio_across_blocks(robot):
    """The arm has tilted axes, a slide and gravity that is tilted too; 4099 samples
    are two blocks and three.
    """
    dynamics = InverseModel(tilted_arm() if robot == "arm" else robot_named(robot))
    n, links = dynamics.robot.n, np.flatnonzero(dynamics.of_links)
    q, dq, ddq = states(n, 4099)
    W = dynamics.regressor(q, dq, ddq)
    data, order = dynamics.model.createData(), FROM_PINOCCHIO
    for k in (0, 1, 2047, 2048, 4095, 4096, 4098):
        expected = pin.computeJointTorqueRegressor(
            dynamics.model, data, q[k], dq[k], ddq[k]
        ).reshape(n, n, 10)
        got = W[k][:, links].reshape(n, n, 10)
        assert np.abs(got - expected[..., order]).max() < 1e-13 * np.abs(expected).max()


def test_scara_matches_paper_closed_form():
    """Section 4 of Janot2014: a planar arm of two links, L = 0.5 m, eight parameters."""
    dynamics = InverseModel(robot_named("scara"))
    base = base_parameters(dynamics)
    assert base.names == ("ZZ1R", "Fv1", "Fc1", "ZZ2", "MX2", "MY2", "Fv2", "Fc2")
    q, dq, ddq = states(2)
    (v1, v2), (a1, a2), L = dq.T, ddq.T, 0.5
    c2, s2 = np.cos(q[:, 1]), np.sin(q[:, 1])
    ZZ1R, Fv1, Fc1, ZZ2, MX2, MY2, Fv2, Fc2 = beta = np.array(
        [3.45, 0.04, 0.82, 0.061, 0.246, 0.014, 0.013, 0.137]
    )
    tau1 = ZZ1R * a1 + ZZ2 * (a1 + a2) + Fv1 * v1 + Fc1 * np.sign(v1)
    tau1 += L * MX2 * ((2 * a1 + a2) * c2 - v2 * (2 * v1 + v2) * s2)
    tau1 -= L * MY2 * ((2 * a1 + a2) * s2 + v2 * (2 * v1 + v2) * c2)
    tau2 = ZZ2 * (a1 + a2) + L * MX2 * (a1 * c2 + v1**2 * s2) + L * MY2 * (v1**2 * c2 - a1 * s2)
    tau2 += Fv2 * v2 + Fc2 * np.sign(v2)
    tau = dynamics.regressor(q, dq, ddq)[:, :, base.columns] @ beta
    np.testing.assert_allclose(tau, np.c_[tau1, tau2], atol=1e-12)


def test_emps_parameters_with_directional_friction():
    base = base_parameters(InverseModel(robot_named("emps")))
    assert base.names == ("M1", "Fv1", "Fc1", "Off1")
    assert base.units == ("kg", "N s/m", "N", "N")
    asymmetric = base_parameters(
        InverseModel(load_robot(REPLAY / "emps" / "robot_published_asymmetric.toml"))
    )
    assert asymmetric.names == ("M1", "Fvp1", "Fcp1", "Fvn1", "Fcn1")


def test_tx40_has_sixty_paper_parameters():
    base = base_parameters(InverseModel(robot_named("tx40")))
    assert base.b == 60
    expressions = dict(zip(base.names, base.expressions, strict=True))
    # Regrouping relations of Khalil2002 for these axes, written out by hand: M6
    # acts 0.225 m off axis 2.
    regrouped = {
        "ZZ2R": "ZZ2 + Ia2 + 0.050625 (M3 + M4 + M5 + M6)",
        "MX2R": "MX2 + 0.225 (M3 + M4 + M5 + M6)",
        "MY5R": "MY5 - MZ6",
        "XX6R": "XX6 - YY6",
        "Ia3": "Ia3",
    }
    assert {name: expressions[name] for name in regrouped} == regrouped
    assert sum(name.startswith(("Fv", "Fc", "Off")) for name in base.names) == 20


def test_coupled_wrist_matches_authors_equations():
    """tau5 += Ia6 ddq6 + Fvm6 dq6 + Fcm6 sign(dq5 + dq6); tau6 has ddq5 and dq5 in their place."""
    dynamics = InverseModel(robot_named("tx40"))
    q, dq, ddq = states(6)
    W = dynamics.regressor(q, dq, ddq)

    def column(name: str) -> np.ndarray:
        return W[:, :, dynamics.names.index(name)]

    zero, sign = np.zeros(len(q)), np.sign(dq[:, 4] + dq[:, 5])
    np.testing.assert_allclose(
        column("Ia6")[:, 4:], np.c_[ddq[:, 5], ddq[:, 4] + ddq[:, 5]], atol=1e-12
    )
    np.testing.assert_allclose(column("Fvm6")[:, 4:], np.c_[dq[:, 5], dq[:, 4]], atol=1e-12)
    np.testing.assert_allclose(column("Fcm6")[:, 4:], np.c_[sign, sign], atol=1e-12)
    np.testing.assert_allclose(column("Ia5")[:, 4:], np.c_[ddq[:, 4], zero], atol=1e-12)
    assert not column("Ia6")[:, :4].any()


def robot_with_matrix(matrix: list[list[float]]):
    text = f"""
name = "two"
motor_matrix = {matrix}
[controller]
bandwidth_hz = 5
"""
    for j, alpha in ((1, 0), (2, 90)):
        text += f"""
[[joint]]
name = "j{j}"
type = "revolute"
dh = {{ alpha_deg = {alpha}, d_m = 0.3, theta_deg = 0, r_m = 0 }}
[[motor]]
name = "m{j}"
effort_unit = "N m"
"""
    return robot_from_files({"robot.toml": text.encode()}, "two.toml")


@pytest.mark.parametrize(
    "matrix", [[[50, 0], [30, 40]], [[50, 0], [0, -40]], [[20, 20], [20, -20]]]
)
def test_rotor_torque_power_matches_kinetic_energy(matrix):
    """Power of the rotor columns = d/dt of sum 1/2 J (motor speed)²; for a differential both
    motors turn both joints.
    """
    dynamics = InverseModel(robot_with_matrix(matrix))
    R = np.array(matrix, dtype=float)
    J = np.array([3e-5, 7e-5])
    q, dq, ddq = states(2)
    M = R.T @ np.diag(J) @ R
    # In the names' convention: the share that acts on one joint alone belongs to that joint's Ia.
    rotor_1, rotor_2 = J * np.diag(R) ** 2
    Ia = {"Ia1": rotor_1 + (J[1] * R[1, 0] ** 2 if R[0, 1] == 0 else 0.0), "Ia2": rotor_2}
    chi = np.array([Ia.get(name, 0.0) for name in dynamics.names])
    tau = dynamics.regressor(q, dq, ddq) @ chi
    np.testing.assert_allclose(tau, ddq @ M, atol=1e-12)
    np.testing.assert_allclose(
        (tau * dq).sum(axis=1), np.einsum("ti,ij,tj->t", dq, M, ddq), atol=1e-11
    )


def urdf_robot(urdf: str, names: tuple[str, str] = ("j1", "j2")):
    text = 'name = "two"\nurdf = "two.urdf"\n[controller]\nbandwidth_hz = 5\n'
    for name in names:
        text += (
            f'[[joint]]\nname = "{name}"\ntype = "revolute"\n[[motor]]\nname = '
            f'"{name}"\neffort_unit = "N m"\n'
        )
    return robot_from_files({"robot.toml": text.encode(), "robot.urdf": urdf.encode()}, "two.toml")


@pytest.mark.parametrize(
    ("urdf", "names", "message"),
    [
        ("<robot", ("j1", "j2"), "URDF: cannot be loaded"),
        ("<robot name='x'><joint/></robot>", ("j1", "j2"), "URDF: cannot be loaded|movable joint"),
        (TWO_TURNING, ("j1", "elbow"), "movable joint = 'elbow': expected one of j1, j2, grip"),
        (TWO_TURNING, ("j2", "j1"), "order of joints = j2, j1: expected j1, j2"),
        (TWO_TURNING, ("j1", "grip"), "joint 'grip': type = 'JointModelPX': expected revolute"),
    ],
)
def test_mismatched_urdf_refused(urdf, names, message):
    with pytest.raises(BadInputError, match=message) as caught:
        InverseModel(urdf_robot(urdf, names))
    assert "\n" not in str(caught.value)


def test_a_priori_values_are_standard_parameters():
    text = (REPLAY / "scara" / "robot.toml").read_text().replace("ZZ2 = 0.061", "ZZ7 = 0.061")
    dynamics = InverseModel(robot_from_files({"robot.toml": text.encode()}, "scara.toml"))
    with pytest.raises(
        BadInputError, match=r"parameters\.ZZ7 = 0\.061: is not a standard parameter"
    ):
        described_parameters(dynamics, base_parameters(dynamics))
