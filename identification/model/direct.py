"""The robot's direct dynamic model: its equation of motion with given parameters; and derivatives of the inverse one.

A row of the regressor times parameters is the torque of a robot with these parameters, whatever they are. So the gradient of
a function of the regressor is, row by row, a derivative of RNEA with the function's own derivative by that row in the place
of the inertias. Carpentier, Mansard: Analytical Derivatives of Rigid Body Dynamics Algorithms, RSS 2018.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from ..arrays import Array
from .base import BaseParameters
from .inverse import FROM_PINOCCHIO, LINK, InverseModel
from .joint_terms import FRICTION, SHAPES, JointTerm, Kind

_POSES = 300  # positions of a trajectory at which M is looked at
_DUMMY = 2.0  # a mass added to each link, times all masses and first moments together: no sum of masses is zero then
_MASS = FROM_PINOCCHIO[LINK.index("M")]
_FIRST_MOMENTS = tuple(FROM_PINOCCHIO[LINK.index(name)] for name in ("MX", "MY", "MZ"))


@dataclass(frozen=True, kw_only=True, eq=False)
class DirectModel:
    """The robot's equation of motion with given parameters: M(q) ddq + h(q, dq) + friction = tau, equation (1).

    Attributes:
        rigid: pinocchio's model with the links' inertias, and its `data`.
        rotor: (n, n) what the rotors add to M.
        viscous, viscous_up, viscous_down: (n, n) friction matrices; the last two for dq > 0 and dq < 0 alone.
        directions: (c, n) directions r that friction with a sign acts along, its speed being r·dq.
        up, down: (c,) Coulomb friction for r·dq > 0 and for r·dq < 0, both positive when they resist.
        shapes: what else acts along the directions, by kind: factors (c,), which resist where they are positive, and the
            speeds (c,) of Stribeck friction.
        offset: (n,) constant torque.
    """

    rigid: Any
    data: Any
    rotor: Array
    viscous: Array
    viscous_up: Array
    viscous_down: Array
    directions: Array
    up: Array
    down: Array
    shapes: dict[Kind, tuple[Array, Array]]
    offset: Array

    def inertia(self, q: Array) -> Array:
        """Inertia matrices (N, n, n) at the positions q (N, n)."""
        M = np.empty((len(q), *self.rotor.shape))
        for k, qk in enumerate(np.ascontiguousarray(q)):
            M[k] = pin.crba(self.rigid, self.data, qk)
        lower = np.tril(np.ones(self.rotor.shape, dtype=bool), -1)
        M[:, lower] = M.transpose(0, 2, 1)[:, lower]  # pinocchio fills the upper triangle
        return M + self.rotor

    def inertia_and_bias(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """Upper triangle of the links' part of M (n, n), without rotors, and h (n,) without friction, at one state."""
        bias = pin.nonLinearEffects(self.rigid, self.data, q, dq)
        return pin.crba(self.rigid, self.data, q), bias

    def of_links(self, q: Array, dq: Array, ddq: Array) -> Array:
        """tau_rigid (n,), the torque of the links alone at one state."""
        return np.asarray(pin.rnea(self.rigid, self.data, q, dq, ddq))

    def gravity(self, q: Array, along: Array | None = None) -> Array:
        """Torques (N, n) that hold the robot at rest at the positions q (N, n), friction aside.

        `along` (3,) is a gravity in m/s² in place of the description's.
        """
        g, rigid = np.tile(self.offset, (len(q), 1)), self.rigid
        if along is not None:
            rigid = rigid.copy()
            rigid.gravity.linear = along
        if rigid.gravity.linear.any():
            for k, qk in enumerate(np.ascontiguousarray(q)):
                g[k] += pin.computeGeneralizedGravity(rigid, self.data, qk)
        return g

    def torque(self, q: Array, dq: Array, ddq: Array, dq_sign: Array | None = None) -> Array:
        """Torque (N, n) along a motion q, dq, ddq (N, n).

        Friction has the signs of `dq_sign` (N, n), where it is given: of a reference without noise.
        """
        rigid = self.torques_of_links(q, dq, ddq)
        u = (dq if dq_sign is None else dq_sign) @ self.directions.T
        sliding = self.up * (u > 0) - self.down * (u < 0)
        if self.shapes:
            sliding = sliding + np.sign(u) * self.shape(u, rigid @ self.directions.T)
        return np.asarray(rigid + (self.without_sliding(dq, ddq) + sliding @ self.directions))

    def torques_of_links(self, q: Array, dq: Array, ddq: Array) -> Array:
        """tau_rigid (N, n) along a motion q, dq, ddq (N, n)."""
        tau, compute, model, data = np.empty(q.shape), pin.rnea, self.rigid, self.data
        for k, state in enumerate(zip(*(np.ascontiguousarray(x) for x in (q, dq, ddq)), strict=True)):
            tau[k] = compute(model, data, *state)
        return tau

    def without_sliding(self, dq: Array, ddq: Array) -> Array:
        """What rotors, offsets and friction without the sign of a speed add (..., n) to the torque of the links."""
        one_sided = np.maximum(dq, 0) @ self.viscous_up.T + np.minimum(dq, 0) @ self.viscous_down.T
        return np.asarray(ddq @ self.rotor.T + dq @ self.viscous.T + one_sided + self.offset)

    def shape(self, u: Array, rigid: Array) -> Array:
        """Size (..., c) of friction beside Coulomb's at speeds u (..., c), the links' torques along them `rigid` (..., c)."""
        load = np.abs(rigid)
        return sum((x * FRICTION[kind].size(u, u_s, load) for kind, (x, u_s) in self.shapes.items()), np.zeros_like(u))

    def steepness(self, u: Array) -> Array:
        """What a unit of speed adds (c,) to shapes that grow with speed, at the speeds u (c,), not zero."""
        slopes = (x * np.maximum(FRICTION[kind].slope(u, u_s), 0.0) for kind, (x, u_s) in self.shapes.items())
        return sum(slopes, np.zeros_like(u))

    def largest_shape(self, u: Array) -> Array:
        """The most (c,) that shapes which resist may have up to the speeds u (c,), load friction apart."""
        found = np.zeros_like(u)
        for kind, (factor, u_s) in self.shapes.items():
            size = FRICTION[kind].size
            found += np.maximum(factor * np.maximum(size(u, u_s, 0.0), size(0.0 * u, u_s, 0.0)), 0.0)
        return found

    @property
    def load_friction(self) -> Array:
        """(n,) of the joints, per torque of their links."""
        factor = self.shapes["load"][0] if "load" in self.shapes else np.zeros(len(self.directions))
        return np.asarray(factor @ self.directions)


def direct_model(dynamics: InverseModel, chi: Array) -> DirectModel:
    """The equation of motion (1) of a robot; pinocchio divides by a link's M: one of exactly zero is taken as 1 mg.

    Load friction goes by the torque of the links of chi (p,), SI: with those of `BaseParameters.standard_parameters`, rotor
    inertias that are regrouped with links' parameters are in it.
    """
    n, rigid = dynamics.robot.n, dynamics.model.copy()
    values = np.zeros((n, len(LINK)))
    rotor, viscous, viscous_up, viscous_down = np.zeros((4, n, n))
    directions, offset = dynamics.coulomb_directions, np.zeros(n)
    up, down = np.zeros((2, len(directions)))
    shapes = dict[Kind, tuple[Array, Array]]()
    for source, value in zip(dynamics.sources, chi, strict=True):
        if not isinstance(source, JointTerm):
            values[source[0], FROM_PINOCCHIO[source[1]]] = value
        elif source.kind == "rotor":
            rotor += value * source.matrix
        elif source.kind == "viscous":
            target = (viscous, viscous_up, viscous_down)[source.side]
            target += value * source.matrix
        elif source.kind == "offset":
            offset += value * source.direction
        elif source.kind == "asymmetric":  # |v| is v forwards, -v backwards
            viscous_up += value * np.diag(source.direction)
            viscous_down -= value * np.diag(source.direction)
        else:
            at = int((directions == source.direction).all(axis=1).argmax())
            if source.kind == "coulomb":
                up[at] += value * (source.side >= 0)
                down[at] += value * (source.side <= 0)
            else:
                none = np.zeros(len(directions)), np.full(len(directions), np.inf)
                factor, speed = shapes.setdefault(source.kind, none)
                factor[at], speed[at] = value, source.speed
    values[values[:, _MASS] == 0.0, _MASS] = 1e-6
    for j in range(n):
        rigid.inertias[j + 1] = pin.Inertia.FromDynamicParameters(values[j])
    return DirectModel(
        rigid=rigid,
        data=rigid.createData(),
        rotor=rotor,
        viscous=viscous,
        viscous_up=viscous_up,
        viscous_down=viscous_down,
        directions=directions,
        up=up,
        down=down,
        shapes={kind: shapes[kind] for kind in SHAPES if kind in shapes and shapes[kind][0].any()},
        offset=offset,
    )


def poses_of(q: Array) -> Array:
    """Some 300 positions (P, n) of a trajectory q (N, n), evenly spaced, at which the inertia matrix M is looked at."""
    return q[:: pose_step(len(q))]


def pose_step(N: int) -> int:
    """From how many of N positions on one is taken for a pose."""
    return max(1, N // _POSES)


def inertias(M: Array) -> Array:
    """J (n,) in kg m² or kg: each joint's largest diagonal entry of the inertia matrices M (P, n, n)."""
    return np.asarray(np.diagonal(M, axis1=1, axis2=2).max(axis=0))


def why_not_positive(M: Array) -> str | None:
    """Why not all inertia matrices M (P, n, n) of a trajectory are positive definite; None if they are."""
    if not np.isfinite(M).all():
        return "the inertia matrix is not finite on the trajectory"
    lowest = float(np.linalg.eigvalsh(M).min())
    return (
        None if lowest > 0 else f"the inertia matrix is not positive on the trajectory (lowest eigenvalue {lowest:.3g})"
    )


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


def torque_without_sliding(
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
