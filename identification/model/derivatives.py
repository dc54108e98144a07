"""Derivatives of the inverse dynamic model by the motion, for the search of exciting references.

A criterion of the regressor W (N, n, b) depends on the motion through G = d criterion / d W. Its
gradient is that of the sum of all products G W with G held constant. Now a row of W times any
parameters is a torque: row j of sample k times G[k, j] is the torque at joint j of a robot that has
the numbers G[k, j] as its parameters. So

    d/dq sum(G * W) = sum_j d/dq tau_j(q, dq, ddq; G[k, j])

and each term is row j of the derivatives of RNEA, for n robots a sample. Rows of other joints are
not used, as each robot belongs to one row. Terms of motors and friction have slopes of their own.

Pinocchio divides by the mass of a link, which G may make zero. The torque is linear in the
parameters, so each link gets a dummy mass, large enough that no sum of masses is zero, and the
derivatives of the robot that consists of the dummies alone, n + 1 in all, are subtracted.

Carpentier, Mansard: Analytical Derivatives of Rigid Body Dynamics Algorithms, RSS 2018.
"""

import numpy as np
import pinocchio as pin

from ..arrays import Array
from .base import BaseParameters
from .direct import MASS, DirectModel, symmetric
from .inverse import FROM_PINOCCHIO, LINK, InverseModel
from .joint_terms import JointTerm

# mass added to each link, times the sum of masses and first moments: no sum of masses is then zero
_DUMMY = 2.0
_MOMENTS = [FROM_PINOCCHIO[LINK.index(name)] for name in ("M", "MX", "MY", "MZ")]


def regressor_gradient(
    model: InverseModel, base: BaseParameters, motion: tuple[Array, Array, Array], G: Array
) -> tuple[Array, Array, Array]:
    """Gradients (N, n) by q, dq and ddq, the `motion`, each (N, n), of sum(G * W): W (N, n, b) is
    the regressor of the base parameters, G (N, n, b) constant.
    """
    q, dq, ddq = (np.ascontiguousarray(x) for x in motion)
    links, out = _split(model, base, dq, G)
    dummy = (_DUMMY * np.abs(links[..., _MOMENTS]).sum(axis=(2, 3)))[..., None]  # (N, n, 1)
    dummy[dummy == 0] = 1.0
    links[..., MASS] += dummy
    slopes = _slopes_of_robots(model, (q, dq, ddq), links)
    for j in range(model.robot.n):
        out += slopes[j, :, :, j] - dummy[:, j] * slopes[-1, :, :, j]
    return out[0], out[1], out[2]


def _split(model: InverseModel, base: BaseParameters, dq: Array, G: Array) -> tuple[Array, Array]:
    """G as parameters of links (N, n, n, 10) by row, in pinocchio's order, and the gradients
    (3, N, n) of motors and friction.
    """
    links = np.zeros((*G.shape[:2], model.robot.n, len(LINK)))
    out = np.zeros((3, *dq.shape))
    for c, column in enumerate(base.columns):
        source = model.sources[column]
        if isinstance(source, JointTerm):
            for j in source.rows:
                by_speed, by_acceleration = source.entry_slopes(int(j), dq)
                out[1] += G[:, j, c, None] * by_speed
                out[2] += G[:, j, c, None] * by_acceleration
        else:
            links[:, :, source[0], FROM_PINOCCHIO[source[1]]] += G[:, :, c]
    return links, out


def _slopes_of_robots(
    model: InverseModel, motion: tuple[Array, Array, Array], links: Array
) -> Array:
    """Derivatives (n + 1, 3, N, n, n) of the torques by q, dq and ddq, of n robots with the
    parameters `links` (N, n, n, 10), and of one whose links have the mass 1 alone.
    """
    (N, n), rigid = motion[0].shape, model.model.copy()
    data, slopes = rigid.createData(), np.empty((n + 1, 3, N, n, n))
    unit = [pin.Inertia(1.0, np.zeros(3), np.zeros((3, 3)))] * n
    for k, state in enumerate(zip(*motion, strict=True)):
        robots = [[pin.Inertia.FromDynamicParameters(p) for p in robot] for robot in links[k]]
        for i, inertias in enumerate([*robots, unit]):
            for link, inertia in enumerate(inertias, 1):
                rigid.inertias[link] = inertia
            pin.computeRNEADerivatives(rigid, data, *state)
            slopes[i, :, k] = data.dtau_dq, data.dtau_dv, data.M
    slopes[:, 2] = symmetric(slopes[:, 2])
    return slopes


def torque_of_links(model: DirectModel, motion: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """tau_rigid, the links' torque (N, n), and its derivatives (3, N, n, n) by q,
    dq, ddq: the last axis.
    """
    shape, data = motion[0].shape, model.data
    tau, slopes = np.empty(shape), np.empty((3, *shape, shape[1]))
    for k, state in enumerate(zip(*map(np.ascontiguousarray, motion), strict=True)):
        pin.computeRNEADerivatives(model.rigid, data, *state)
        tau[k] = data.tau
        slopes[:, k] = data.dtau_dq, data.dtau_dv, data.M
    slopes[2] = symmetric(slopes[2])
    return tau, slopes


def torque_without_sliding(
    model: DirectModel, motion: tuple[Array, Array, Array], of_links: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Torque (N, n) without friction that has a sign, and its derivatives (3, N, n, n) by q, dq,
    ddq, each (N, n); `of_links` are those of `torque_of_links`.
    """
    _, dq, ddq = motion
    slopes, up, down = of_links[1].copy(), model.viscous_up, model.viscous_down
    slopes[2] += model.rotor
    slopes[1] += model.viscous + (dq > 0)[:, None] * up + (dq < 0)[:, None] * down
    return of_links[0] + model.without_sliding(dq, ddq), slopes
