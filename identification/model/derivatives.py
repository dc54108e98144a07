"""Derivatives of the inverse dynamic model by the motion, by pinocchio's derivatives of RNEA.

A row of the regressor times parameters is the torque of a robot with these parameters, whatever they are. So the gradient of
a function of the regressor is, row by row, a derivative of RNEA with the function's own derivative by that row in the place
of the inertias. Carpentier, Mansard: Analytical Derivatives of Rigid Body Dynamics Algorithms, RSS 2018.
"""

import numpy as np
import pinocchio as pin

from ..arrays import Array
from .base import BaseParameters
from .direct import DirectModel
from .inverse import FROM_PINOCCHIO, LINK, InverseModel
from .joint_terms import JointTerm

_MASS = FROM_PINOCCHIO[LINK.index("M")]
_FIRST_MOMENTS = tuple(FROM_PINOCCHIO[LINK.index(name)] for name in ("MX", "MY", "MZ"))
_DUMMY = 2.0  # a mass added to each link, times all masses and first moments together: no sum of masses is zero then


def regressor_gradient(
    model: InverseModel, base: BaseParameters, motion: tuple[Array, Array, Array], G: Array
) -> tuple[Array, Array, Array]:
    """Gradients (N, n) by q, dq and ddq of sum(G * W), W (N, n, b) the regressor of the base parameters.

    Pinocchio divides by masses: a dummy mass is added to each link, and what it gives is subtracted.

    Parameters
    ----------
    model, base : the inverse dynamic model and its base parameters.
    motion : q, dq, ddq, each (N, n).
    G : (N, n, b), constant.
    """
    q, dq, ddq = (np.ascontiguousarray(x) for x in motion)
    n = model.robot.n
    inertias = np.zeros((*G.shape[:2], n, len(LINK)))
    out = np.zeros((3, *q.shape))
    for c, column in enumerate(base.columns):
        source = model.sources[column]
        if isinstance(source, JointTerm):
            for j in source.rows:
                by_speed, by_acceleration = source.entry_slopes(int(j), dq)
                out[1] += G[:, j, c, None] * by_speed
                out[2] += G[:, j, c, None] * by_acceleration
        else:
            inertias[:, :, source[0], FROM_PINOCCHIO[source[1]]] += G[:, :, c]
    rigid = model.model.copy()
    data = rigid.createData()
    sizes = np.abs(inertias[..., [_MASS, *_FIRST_MOMENTS]]).sum(axis=(2, 3))  # (N, n)
    dummy = (_DUMMY * sizes)[..., None]
    dummy[dummy == 0] = 1.0
    inertias[..., _MASS] += dummy
    unit = [pin.Inertia(1.0, np.zeros(3), np.zeros((3, 3)))] * n
    derivatives = pin.computeRNEADerivatives
    made = np.empty((n + 1, 3, *q.shape, n))  # of the dummy and of each joint's inertias: derivatives by q, dq, ddq
    for k in range(len(q)):
        state = rigid, data, q[k], dq[k], ddq[k]
        for i in range(n + 1):
            each = unit if i == n else [pin.Inertia.FromDynamicParameters(p) for p in inertias[k, i]]
            for link, inertia in enumerate(each):
                rigid.inertias[link + 1] = inertia
            derivatives(*state)
            made[i, :, k] = data.dtau_dq, data.dtau_dv, data.M
    made[:, 2] = _symmetric(made[:, 2])
    for j in range(n):
        out += made[j, :, :, j] - dummy[:, j] * made[n, :, :, j]
    return out[0], out[1], out[2]


def torque_of_links(model: DirectModel, motion: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """tau_rigid, the torque of the links alone (N, n), and its derivatives (3, N, n, n) by q, dq, ddq: the last axis."""
    q, dq, ddq = (np.ascontiguousarray(x) for x in motion)
    rigid, data, n = model.rigid, model.data, q.shape[1]
    tau, slopes = np.empty(q.shape), np.empty((3, *q.shape, n))
    for k in range(len(q)):
        pin.computeRNEADerivatives(rigid, data, q[k], dq[k], ddq[k])
        tau[k] = data.tau
        slopes[:, k] = data.dtau_dq, data.dtau_dv, data.M
    slopes[2] = _symmetric(slopes[2])
    return tau, slopes


def sliding_apart(
    model: DirectModel, motion: tuple[Array, Array, Array], of_links: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Torque without friction that has the sign of a speed (N, n), and its derivatives (3, N, n, n) by q, dq, ddq.

    Parameters
    ----------
    model : the equation of motion with given parameters.
    motion : q, dq, ddq, each (N, n).
    of_links : the links' torque and its derivatives, as `torque_of_links` gives them.
    """
    _, dq, ddq = motion
    slopes, up, down = of_links[1].copy(), model.viscous_up, model.viscous_down
    slopes[2] += model.rotor
    slopes[1] += model.viscous + (dq > 0)[:, None] * up + (dq < 0)[:, None] * down
    return of_links[0] + model.without_sliding(dq, ddq), slopes


def _symmetric(M: Array) -> Array:
    """The whole matrices (..., n, n), of which pinocchio fills the upper triangles."""
    return np.triu(M) + np.triu(M, 1).swapaxes(-1, -2)
