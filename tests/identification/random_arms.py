"""Random arms whose parameters are physical, and noisy estimates of them that are not."""

from collections.abc import Callable

import numpy as np

from acquisition.robot import Robot, robot_from_files
from identification.estimation import PhysicalParameters
from identification.model import (
    LINK,
    InverseModel,
    base_parameters,
    own_shares,
    physical_parameters,
)

ROWS = 150  # states of the made up experiment
NOISE = 0.02  # of a joint's torque, rms


def random_arm(seed: int) -> Robot:
    """Two to six joints of random DH rows, perhaps prismatic ones, perhaps a coupled last motor;
    nothing is known of it.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 7))
    matrix = np.diag(rng.uniform(20, 100, n))
    if n > 2 and rng.random() < 0.5:
        matrix[-1, -2] = matrix[-1, -1]
    text = f'name = "arm"\nmotor_matrix = {matrix.tolist()}\n[controller]\nbandwidth_hz = 5\n'
    for j in range(n):
        slides = rng.random() < 0.15 and not matrix[j:, j][1:].any() and not matrix[j, :j].any()
        kind = "prismatic" if slides else "revolute"
        alpha, theta = rng.choice([-90, 0, 90, 17.3], 2)
        d, r = rng.uniform(-0.5, 0.5, 2) * (rng.random(2) < 0.7)
        text += (
            f'[[joint]]\nname = "j{j}"\ntype = "{kind}"\noffset = '
            f"{str(bool(rng.random() < 0.5)).lower()}\n"
        )
        text += f"dh = {{ alpha_deg = {alpha}, d_m = {d}, theta_deg = {theta}, r_m = {r} }}\n"
        unit = "N m" if kind == "revolute" else "N"
        text += f'[[motor]]\nname = "m{j}"\neffort_unit = "{unit}"\n'
    return robot_from_files({"robot.toml": text.encode()}, "random.toml")


def random_body(rng: np.random.Generator) -> np.ndarray:
    """Ten parameters of a cloud of point masses."""
    points = rng.normal(size=(6, 3)) * rng.uniform(0.02, 0.15) + rng.normal(size=3) * 0.1
    masses = rng.uniform(0.1, 3, 6)
    inertia = sum(
        m * (x @ x * np.eye(3) - np.outer(x, x)) for m, x in zip(masses, points, strict=True)
    )
    return np.concatenate([inertia[np.triu_indices(3)], masses @ points, [masses.sum()]])


def set_own(idm: InverseModel, chi: np.ndarray, values: Callable[[int], np.ndarray]) -> list[int]:
    """Give the rotor inertias and friction of joints and motors such that their sums are `values`
    of so many; their columns.
    """
    terms, shares = own_shares(idm)
    columns = list(terms)
    chi[columns] = np.linalg.solve(shares[:, columns], values(len(columns)))
    return columns


def random_estimate(
    seed: int, times: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, PhysicalParameters, np.ndarray]:
    """Estimate beta, its covariance and K of a random arm, what is asked of it,
    and its true parameters.

    `times` the noise of a made up experiment; own rotor inertias and friction are positive,
    for coupled motors too.
    """
    rng = np.random.default_rng([seed, 1])
    idm = InverseModel(random_arm(seed))
    base, physical = base_parameters(idm), physical_parameters(idm)
    chi = np.zeros(idm.p)
    for columns in physical.links:
        chi[columns] = random_body(rng)
    set_own(idm, chi, lambda count: rng.lognormal(-1.0, 1.0, count))
    q, dq, ddq = (rng.uniform(-s, s, (ROWS, idm.robot.n)) for s in (2.0, 1.5, 4.0))
    W = idm.regressor(q, dq, ddq)
    tau = W @ chi
    sigma = NOISE * np.sqrt((tau**2).mean(axis=0))
    weighted = (W[:, :, base.columns] / sigma[:, None]).reshape(-1, base.b)
    C = times**2 * np.linalg.inv(weighted.T @ weighted)
    beta = base.K @ chi + np.linalg.cholesky(C) @ rng.normal(size=base.b)
    assert len(LINK) == physical.links.shape[1]
    return beta, C, base.K, physical, chi
