"""Parameters of bodies, of a link and of an arm, with what is asked of them, and
covariances of estimates.
"""

import dataclasses

import numpy as np
from conftest import described_chi, robot_named
from random_arms import random_body

from identification.estimation import PhysicalParameters, pseudo_inertia
from identification.model import InverseModel, base_parameters, physical_parameters


def body(seed: int) -> np.ndarray:
    """Ten parameters of a cloud of point masses."""
    return random_body(np.random.default_rng(seed))


def one_link() -> tuple[np.ndarray, PhysicalParameters]:
    """K (7, 14) and what is asked of a link with a rotor inertia of which a share is
    another's, and viscous friction.
    """
    start = np.concatenate([body(1), [0.5, 0.2, 0.4, 0.3]])
    combinations, matrix = np.zeros((2, 14)), np.zeros((2, 2, 14))
    combinations[0, 10], combinations[0, 11], combinations[1, 11] = 1.0, -0.3, 1.0
    matrix[0, 0, 12] = matrix[1, 1, 13] = matrix[0, 1, 11] = matrix[1, 0, 11] = 1.0
    physical = PhysicalParameters(
        links=np.arange(10)[None],
        prior=pseudo_inertia(body(2))[None],
        combinations=combinations,
        matrices=(matrix,),
        start=start,
    )
    return np.random.default_rng(3).normal(size=(7, 14)), physical


def covariance(b: int, scale: float) -> np.ndarray:
    A = np.random.default_rng(4).normal(size=(b, b))
    return scale**2 * (A @ A.T + np.eye(b))


def covariance_with(covariance: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """The same correlations, other deviations."""
    scale = sigma / np.sqrt(np.diag(covariance))
    return covariance * np.outer(scale, scale)


def tx40(
    *, described: bool = True
) -> tuple[InverseModel, np.ndarray, np.ndarray, PhysicalParameters]:
    """Model, K, base parameters of a physical arm, and what is asked of it; its description says
    its values, or nothing.
    """
    robot = robot_named("tx40")
    chi = described_chi(InverseModel(robot))
    idm = InverseModel(robot if described else dataclasses.replace(robot, parameters={}))
    return idm, base_parameters(idm).K, chi, physical_parameters(idm)


def lowest(physical: PhysicalParameters, chi: np.ndarray) -> float:
    """The smallest of what must be positive."""
    P = [*pseudo_inertia(chi[physical.links]), *(matrix @ chi for matrix in physical.matrices)]
    return min(*(np.linalg.eigvalsh(one).min() for one in P), (physical.combinations @ chi).min())
