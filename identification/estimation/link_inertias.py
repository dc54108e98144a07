"""The pseudo-inertia of a link: linear in its ten parameters, positive definite for a body of positive density."""

import numpy as np

from ..arrays import Array


def pseudo_inertia(parameters: Array) -> Array:
    """Pseudo-inertias P (..., 4, 4) of links' XX XY XZ YY YZ ZZ MX MY MZ M (..., 10): [[tr(I)/2 1 - I, h], [h', M]]."""
    return np.asarray(np.tensordot(parameters, BASIS, axes=1))


def link_parameters(P: Array) -> Array:
    """XX XY XZ YY YZ ZZ MX MY MZ M (..., 10) of pseudo-inertias P (..., 4, 4): the inverse of `pseudo_inertia`."""
    second = P[..., :3, :3]
    inertia = np.trace(second, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - second
    rows, columns = np.triu_indices(3)
    return np.concatenate([inertia[..., rows, columns], P[..., :3, 3], P[..., 3:, 3]], axis=-1)


def _basis() -> Array:
    basis = np.zeros((10, 4, 4))
    for place, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        basis[place, [i, j], [j, i]] = -1.0
        if i == j:
            basis[place, range(3), range(3)] += 0.5
    for i in range(3):
        basis[6 + i, [i, 3], [3, i]] = 1.0
    basis[9, 3, 3] = 1.0
    return basis


BASIS = _basis()  # P = sum of parameter times matrix
