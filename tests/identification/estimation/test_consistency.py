"""The nearest physically consistent parameters: against differences, against another optimiser,
and what a robot asks.
"""

from unittest.mock import Mock

import numpy as np
import pytest
from conftest import robot_named
from physical_cases import body, covariance, covariance_with, lowest, one_link, tx40
from random_arms import random_estimate
from scipy.optimize import minimize

from acquisition.robot import Robot, robot_from_files
from identification.errors import NoFitError
from identification.estimation import (
    consistency,
    consistent_parameters,
    parameter_certainty,
    pseudo_inertia,
)
from identification.estimation.consistency import _inverse_root, _Objective
from identification.model import InverseModel, corner_speeds, physical_parameters, requirements

rng = np.random.default_rng(8)


@pytest.mark.parametrize("arm", ["one link", "random"])
def test_gradient_and_hessian_match_differences(arm):
    if arm == "random":
        _, C, K, physical, chi = random_estimate(7, 1.0)
    else:
        (K, physical), C = one_link(), covariance(7, 0.1)
        chi = physical.start
    b, p = K.shape
    objective = _Objective(
        K @ chi + rng.normal(size=b), _inverse_root(np.ones(b), C), K, physical, 0.7, 0.02
    )
    g, J = objective.derivatives(chi)
    H, steps = J.T @ J, (h := 3e-7) * np.eye(p)
    by_values = [(objective.value(chi + d) - objective.value(chi - d)) / (2 * h) for d in steps]
    by_gradients = [
        (objective.derivatives(chi + d)[0] - objective.derivatives(chi - d)[0]) / (2 * h)
        for d in steps
    ]
    np.testing.assert_allclose(g, by_values, rtol=1e-6, atol=1e-6 * np.abs(g).max())
    np.testing.assert_allclose(H, by_gradients, rtol=1e-5, atol=1e-8 * np.abs(H).max())


def test_optimum_matches_other_optimiser():
    """An estimate without a positive rotor inertia, and weights that let the barrier be seen."""
    K, physical = one_link()
    C, wrong = covariance(7, 0.05), np.concatenate([body(5), [-0.4, 0.1, 0.3, -0.2]])
    found = consistent_parameters(K @ wrong, C, K, physical, gamma=0.5, gamma_x=0.1)

    # written a second time: P = L L', x = exp(z), and no constraint is left
    def cost(z: np.ndarray) -> float:
        L = np.zeros((4, 4))
        L[np.tril_indices(4)] = z[:10]
        P, (own, x, a, b) = L @ L.T, np.exp(z[10:])
        tensor = np.trace(P[:3, :3]) * np.eye(3) - P[:3, :3]
        # [[a, x], [x, b + x²/a]] has the determinant a b
        last = [own + 0.3 * x, x, a, b + x**2 / a]
        rho = K @ (np.concatenate([tensor[np.triu_indices(3)], P[:3, 3], P[3:, 3], last]) - wrong)
        divergence = np.trace(np.linalg.solve(physical.prior[0], P)) - np.log(np.linalg.det(P))
        return float(
            0.5 * rho @ np.linalg.solve(C, rho)
            + 0.5 * divergence
            - 0.05 * (z[10] + z[11] + 100 * (z[12] + z[13]))
        )

    root = np.linalg.cholesky(pseudo_inertia(physical.start[:10]))
    start = np.concatenate([root[np.tril_indices(4)], -np.ones(4)])
    best = minimize(cost, start, options={"gtol": 1e-7, "maxiter": 5000})
    mine = np.linalg.cholesky(pseudo_inertia(found.chi[:10]))
    x, a, b = found.chi[11:]
    at = np.concatenate(
        [mine[np.tril_indices(4)], np.log([*physical.combinations @ found.chi, a, b - x**2 / a])]
    )
    assert cost(at) == pytest.approx(best.fun, abs=1e-6)
    np.testing.assert_allclose(np.abs(at), np.abs(best.x), rtol=1e-3, atol=1e-3)
    assert found.decrement <= 1e-6


def test_inconsistent_arm_becomes_consistent(monkeypatch):
    idm, K, chi, physical = tx40(described=False)
    assert lowest(physical, physical.start) > 0
    names = list(idm.names)
    wrong = chi.copy()
    wrong[[names.index(name) for name in ("ZZ6", "YY6", "Ia6", "Fc5")]] *= -1.0
    beta = K @ wrong
    sigma = 0.02 * np.abs(beta) + 0.002
    C = covariance_with(covariance(len(beta), 1.0), sigma)
    newton_step = Mock(wraps=consistency._newton_step)
    monkeypatch.setattr(consistency, "_newton_step", newton_step)
    found = consistent_parameters(beta, C, K, physical)
    assert lowest(physical, found.chi) > 0
    np.testing.assert_allclose(K @ found.chi, found.beta)
    rho = found.beta - beta
    assert found.chi_squared == pytest.approx(rho @ np.linalg.solve(C, rho), rel=1e-6)
    np.testing.assert_allclose(found.deviations, rho / sigma)
    assert np.abs(found.deviations).max() > 3
    assert found.decrement <= 1e-6
    assert newton_step.call_count < 60


def test_consistent_arm_unchanged():
    """The prior being its own, by the reach of the barrier of friction and rotors alone; else by
    that of the links too.
    """
    for described, reach in ((True, 1e-3), (False, 1.5)):
        _, K, chi, physical = tx40(described=described)
        beta = K @ chi
        found = consistent_parameters(beta, np.diag((0.01 * np.abs(beta) + 1e-3) ** 2), K, physical)
        assert np.abs(found.deviations).max() < reach
        sharp = consistent_parameters(beta, np.diag((1e-5 * np.abs(beta) + 1e-6) ** 2), K, physical)
        assert np.abs(sharp.beta - beta).max() < 1e-4 * np.abs(beta).max()


def test_coupled_wrist_constraints():
    """Ia5 - Ia6, a positive viscous matrix, Coulomb power at the three corners: the published
    values have all of it.

    Though Fv6 = 0.689 is below Fvm6 = 0.8: motor 6 alone does not feed joint 6 what
    joint 5 does not take.
    """
    robot = robot_named("tx40")
    idm = InverseModel(robot)
    chi = np.array([robot.parameters.get(name, 0.0) for name in idm.names])
    found = requirements(idm, shaped=False)
    asked = {text: matrix for matrix, _, text in found}
    viscous, corners = (
        "viscous friction of joint_5 and joint_6",
        ("Fc5 + Fcm6", "Fc6 + Fcm6", "Fc5 + Fc6"),
    )
    alone = {f"{x}{j}" for x in ("Fv", "Fc", "Ia") for j in range(1, 5)}
    assert set(asked) == alone | {"Ia5 - Ia6", "Ia6", viscous, *corners}
    least = {text: np.linalg.eigvalsh(matrix @ chi)[0] for text, matrix in asked.items()}
    assert least[viscous] == pytest.approx(0.2242, abs=1e-4)
    assert [least[text] for text in corners] == pytest.approx([5.0092, 3.4313, 5.2405])
    physical = physical_parameters(idm)
    assert lowest(physical, chi) > 0
    assert lowest(physical, physical.start) > 0
    names = list(idm.names)
    # Rotors of the motors' own inertias 1 to 6, motor 6 turning with joints 5 and 6.
    own, R = np.arange(1.0, 7.0), np.eye(6)
    R[5, 4] = 1.0
    rotor = np.zeros((6, 6))
    columns = [names.index(f"Ia{j}") for j in range(1, 7)]
    shares = np.array(
        [matrix[0, 0, columns] for matrix, first, _ in found if first.kind == "rotor"]
    )
    for c, value in zip(columns, np.linalg.solve(shares, own), strict=True):
        rotor += value * idm.sources[c].matrix
    np.testing.assert_allclose(rotor, R.T @ np.diag(own) @ R)


URDF = """<robot name="arm"><link name="base"/>
<link name="one"><inertial><origin xyz="0.1 0 0"/><mass value="2"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial></link>
<link name="two"/>
<joint name="a" type="revolute"><parent link="base"/><child link="one"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="b" type="revolute"><parent link="one"/><child link="two"/>
<origin xyz="0.4 0 0"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>"""


def urdf_arm() -> Robot:
    joint = (
        '[[joint]]\nname = "{0}"\ntype = "revolute"\n[[motor]]\nname = "{0}"\neffort_unit = "N m"\n'
    )
    text = (
        'name = "arm"\nurdf = '
        f'"arm.urdf"\n{joint.format("a")}{joint.format("b")}[controller]\nbandwidth_hz = 5.0\n'
    )
    return robot_from_files(
        {"robot.toml": text.encode(), "robot.urdf": URDF.encode()}, "robot.toml"
    )


def test_expected_links_from_urdf_or_plausible():
    physical = physical_parameters(InverseModel(urdf_arm()))
    link = physical.start[physical.links]
    np.testing.assert_allclose(link[0], [0.01, 0, 0, 0.04, 0, 0.04, 0.2, 0, 0, 2.0], atol=1e-12)
    assert 0.1 < link[1, 9] < 10  # nothing is said of it
    np.testing.assert_allclose(physical.prior, pseudo_inertia(link))
    # A rod of the TX40's length from joint 2 to joint 3: its middle is half way.
    idm, _, _, plain = tx40(described=False)
    M = plain.start[plain.links][1]
    np.testing.assert_allclose(
        M[6:9] / M[9], 0.5 * np.array(idm.model.jointPlacements[3].translation), atol=1e-12
    )
    assert np.linalg.norm(M[6:9] / M[9]) == pytest.approx(0.5 * np.hypot(0.225, 0.035))


def test_non_finite_estimates_refused():
    K, physical = one_link()
    for beta, C, text in (
        (np.full(7, np.nan), np.eye(7), "did not converge"),
        (np.ones(7), -np.eye(7) + 2 * np.ones((7, 7)), "covariance of the estimates is not"),
    ):
        with pytest.raises(NoFitError, match=text):
            consistent_parameters(beta, C, K, physical)


@pytest.mark.parametrize("rows", [[[1, 1], [1, -1]], [[1, 0.5, 0], [0, 1, 1]]])
def test_coulomb_corners_bound_power_at_all_speeds(rows):
    """Joints of their own and motors that turn with several, values of either sign: the corners say
    what random speeds say.
    """
    directions = np.concatenate([np.eye(len(rows[0])), rows])
    rng = np.random.default_rng(2)
    drawn, v = rng.normal(0.5, 1.0, (200, len(directions))), rng.normal(size=(20_000, len(rows[0])))
    v = np.concatenate([v, 0.02 * v[:5000] + rng.choice([-1.0, 0.0, 1.0], (5000, len(rows[0])))])
    found = (drawn @ corner_speeds(directions).T).min(axis=1)
    expected = (drawn @ np.abs(directions @ v.T)).min(axis=1)
    clear = np.abs(found) > 0.1  # random speeds come near a corner, not onto it
    assert 5 < (found[clear] > 0).sum() < clear.sum() - 5
    np.testing.assert_array_equal(found[clear] > 0, expected[clear] > 0)


def test_direction_without_friction_has_no_corner():
    """One motor over two joints that have no friction else: only its own speed counts."""
    np.testing.assert_allclose(corner_speeds(np.array([[1.0, 1.0]])), [[1.0]])
    np.testing.assert_allclose(corner_speeds(np.array([[0.0, 2.0, 0.0]])), [[1.0]])


def test_intervals_from_inverse_hessian():
    """Without the barrier; base parameters have what they moved in their interval."""
    K, physical = one_link()
    C = covariance(7, 0.05)
    beta = K @ np.concatenate([5 * body(5), physical.start[10:]])
    found = consistent_parameters(beta, C, K, physical)
    (of_chi, _), (of_beta, _) = parameter_certainty(found, C, K, physical)
    _, J = _Objective(found.beta, _inverse_root(found.beta, C), K, physical, 1.0, 0.0).derivatives(
        found.chi
    )
    d = np.linalg.norm(J, axis=0)
    H = np.linalg.pinv(J / d, rcond=1e-13) @ np.linalg.pinv(J / d, rcond=1e-13).T / np.outer(d, d)
    np.testing.assert_allclose(of_chi[:10], np.sqrt(np.diag(H))[:10], rtol=1e-5)
    plain = np.diag(K @ H @ K.T)
    moved = (found.beta - beta) ** 2
    assert (moved > 0.1 * plain).any()
    np.testing.assert_allclose(of_beta, np.sqrt(plain + moved), rtol=1e-5)
