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
    for k in range(len(q)):
        state = rigid, data, q[k], dq[k], ddq[k]
        _put(rigid, unit)
        derivatives(*state)
        own = np.array([data.dtau_dq, data.dtau_dv, _symmetric(data.M)])
        for j in range(n):
            _put(rigid, [pin.Inertia.FromDynamicParameters(p) for p in inertias[k, j]])
            derivatives(*state)
            out[0, k] += data.dtau_dq[j] - dummy[k, j] * own[0, j]
            out[1, k] += data.dtau_dv[j] - dummy[k, j] * own[1, j]
            out[2, k] += _symmetric(data.M)[j] - dummy[k, j] * own[2, j]
    return out[0], out[1], out[2]


def smooth_torque(model: DirectModel, motion: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Torque without Coulomb friction (N, n), and its derivatives (3, N, n, n) by q, dq, ddq: the last axis.

    Parameters
    ----------
    model : the equation of motion with given parameters.
    motion : q, dq, ddq, each (N, n).
    """
    q, dq, ddq = (np.ascontiguousarray(x) for x in motion)
    n = q.shape[1]
    tau, slopes = np.empty(q.shape), np.empty((3, *q.shape, n))
    rigid, data = model.rigid, model.data
    for k in range(len(q)):
        pin.computeRNEADerivatives(rigid, data, q[k], dq[k], ddq[k])
        tau[k] = data.tau
        slopes[:, k] = data.dtau_dq, data.dtau_dv, _symmetric(data.M)
    up, down = model.viscous_up, model.viscous_down
    tau += ddq @ model.rotor.T + dq @ model.viscous.T + np.maximum(dq, 0) @ up.T + np.minimum(dq, 0) @ down.T
    slopes[2] += model.rotor
    slopes[1] += model.viscous + (dq > 0)[:, None] * up + (dq < 0)[:, None] * down
    return tau + model.offset, slopes


def _put(rigid: pin.Model, inertias: list[pin.Inertia]) -> None:
    for i, inertia in enumerate(inertias):
        rigid.inertias[i + 1] = inertia


def _symmetric(M: Array) -> Array:
    """The whole matrix, of which pinocchio fills the upper triangle."""
    return np.triu(M) + np.triu(M, 1).T
