"""The robot's direct dynamic model, and the derivatives of its torques by the motion.

    M(q) ddq + N(q, dq) = tau,     equation (1)

Derivatives: Carpentier, Mansard, Analytical Derivatives of Rigid Body Dynamics Algorithms, RSS
2018.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import eigenpy
import numpy as np
import pinocchio as pin

from acquisition.robot import FRICTION

from ..arrays import Array
from .inverse import FROM_PINOCCHIO, LINK, InverseModel, link_columns
from .joint_terms import SHAPES, SIZES, JointTerm, Kind
from .parameters import BaseParameters

_POSES = 300  # positions of a trajectory at which M is checked
# Samples per joint; up to this number pinocchio is faster, above it arrays of all samples are.
_ONE_BY_ONE = 150
# Mass that is added to each link for gradients, over the sum of masses and first moments: large
# enough that no sum of masses is zero.
_DUMMY = 2.0
_MOMENTS = [FROM_PINOCCHIO[LINK.index(name)] for name in ("M", "MX", "MY", "MZ")]


@dataclass(frozen=True, kw_only=True, eq=False)
class DirectModel:
    """The robot's equation of motion with given parameters, equation (1).

        M(q) ddq + h(q, dq) + friction = tau

    Attributes:
        inverse: inverse dynamic model.
        links: (n, 10) the links' parameters in the order of `LINK`.
        rigid: pinocchio's model with the links' inertias.
        data: pinocchio's data of it.
        rotor: (n, n) rotor part of M.
        viscous: (n, n) viscous friction.
        viscous_up, viscous_down: (n, n) viscous friction for dq > 0 and dq < 0 only.
        directions: (c, n) directions r of friction with a sign, with the speed u = r·dq.
        up, down: (c,) Coulomb friction for u > 0 and for u < 0, positive if it resists.
        shapes: further friction along the directions, by kind: factors (c,), positive if they
            resist, and the speeds (c,) of Stribeck friction.
        offset: (n,) constant torque.
    """

    inverse: InverseModel
    links: Array
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
        """Return inertia matrices M (N, n, n) at the positions q (N, n)."""
        M = np.empty((len(q), *self.rotor.shape))
        for k, qk in enumerate(np.ascontiguousarray(q)):
            M[k] = pin.crba(self.rigid, self.data, qk)
        return symmetric(M) + self.rotor

    def inertia_and_bias(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """Return the upper triangle of M (n, n) without rotors, and h (n,), at one state."""
        bias = pin.nonLinearEffects(self.rigid, self.data, q, dq)
        return pin.crba(self.rigid, self.data, q), bias

    def lone_bias(self) -> Callable[[float], float]:
        """Return h of a lone joint as a function of its position: a + b cos q + c sin q."""
        ahead, up, behind = (
            self.inertia_and_bias(q, np.zeros(1))[1].item()
            for q in np.array([[0.0], [0.5 * np.pi], [np.pi]])
        )
        a, b = 0.5 * (ahead + behind), 0.5 * (ahead - behind)
        c, cos, sin = up - a, math.cos, math.sin

        def bias(q: float) -> float:
            q = q if abs(q) < math.inf else math.nan  # math.cos raises an error at infinity
            return a + b * cos(q) + c * sin(q)

        return bias if b or c else lambda q: a

    def gravity(self, q: Array, along: Array | None = None) -> Array:
        """Return torques (N, n) that hold the robot at rest at the positions q (N, n).

        Friction is not included. `along` (3,), m/s², replaces the description's gravity.
        """
        along = self.rigid.gravity.linear if along is None else along
        still = np.zeros(q.shape)
        return self.offset + (
            self.torques_of_links(q, still, still, along) if along.any() else still
        )

    def torque(
        self,
        q: Array,
        dq: Array,
        ddq: Array,
        dq_sign: Array | None = None,
        rigid: Array | None = None,
    ) -> Array:
        """Return the torque (N, n) along a motion q, dq, ddq (N, n), N m or N.

        `rigid` (N, n) is the torque of the links, if it is known. `dq_sign` (N, n), such as the
        speed of a reference without noise, replaces dq in the signs of friction.
        """
        rigid = self.torques_of_links(q, dq, ddq) if rigid is None else rigid
        u = (dq if dq_sign is None else dq_sign) @ self.directions.T
        sliding = self.up * (u > 0) - self.down * (u < 0)
        if self.shapes:
            sliding = sliding + np.sign(u) * self.shape(np.abs(u), rigid @ self.directions.T)
        return np.asarray(rigid + (self.without_sliding(dq, ddq) + sliding @ self.directions))

    def torques_of_links(
        self, q: Array, dq: Array, ddq: Array, gravity: Array | None = None
    ) -> Array:
        """Return tau_rigid (N, n), the torque of the links, along a motion q, dq, ddq (N, n).

        `gravity` (3,), m/s², replaces the description's.
        """
        rigid = self.rigid
        if len(q) > _ONE_BY_ONE * q.shape[1]:
            gravity = rigid.gravity.linear if gravity is None else gravity
            (tau,) = self.inverse.torques_of_links((q, dq, ddq), self.links[None], gravity)
            return np.asarray(tau)
        if gravity is not None:
            rigid = rigid.copy()
            rigid.gravity.linear = gravity
        states = zip(*(np.ascontiguousarray(x) for x in (q, dq, ddq)), strict=True)
        return np.array([pin.rnea(rigid, self.data, *state) for state in states]).reshape(q.shape)

    def without_sliding(self, dq: Array, ddq: Array) -> Array:
        """Return the torque (..., n) of rotors, offsets and friction without a sign."""
        one_sided = np.maximum(dq, 0) @ self.viscous_up.T + np.minimum(dq, 0) @ self.viscous_down.T
        return np.asarray(ddq @ self.rotor.T + dq @ self.viscous.T + one_sided + self.offset)

    def shape(self, u: Array, rigid: Array) -> Array:
        """Return further friction (..., c) at absolute speeds u (..., c).

        `rigid` (..., c) are the links' torques along the directions.
        """
        load = np.abs(rigid)
        return sum(
            (x * SIZES[kind](u, u_s, load) for kind, (x, u_s) in self.shapes.items()),
            np.zeros_like(u),
        )

    def steepness(self, u: Array) -> Array:
        """Return slopes (c,) of the shapes that grow with speed, at speeds u (c,) above zero."""
        return sum(
            (
                x * np.maximum(FRICTION[kind].slope(u, u_s), 0.0)
                for kind, (x, u_s) in self.shapes.items()
            ),
            np.zeros_like(u),
        )

    def largest_shape(self, u: Array) -> Array:
        """Return the maximum (c,) of the resisting shapes up to the speeds u (c,).

        Load-dependent friction is not included.
        """
        return sum(
            (
                np.maximum(
                    x * np.maximum(SIZES[kind](u, u_s, 0.0), SIZES[kind](0.0 * u, u_s, 0.0)), 0.0
                )
                for kind, (x, u_s) in self.shapes.items()
            ),
            np.zeros_like(u),
        )

    @property
    def load_friction(self) -> Array:
        """Load-dependent friction of the joints per torque of the links, (n,)."""
        factor = self.shapes["load"][0] if "load" in self.shapes else np.zeros(len(self.directions))
        return np.asarray(factor @ self.directions)


def direct_model_of_base(dynamics: InverseModel, base: BaseParameters, beta: Array) -> DirectModel:
    """Return the equation of motion (1) of a robot with base parameters beta (b,)."""
    return direct_model(dynamics, base.standard_parameters(beta))


def direct_model(dynamics: InverseModel, chi: Array) -> DirectModel:
    """Return the equation of motion (1) of a robot with standard parameters chi (p,), SI.

    Load-dependent friction depends on the torque of chi's links. With
    `BaseParameters.standard_parameters` these include the rotor inertias that are regrouped into
    links' parameters.
    """
    assert len(chi) == dynamics.p
    n, rigid = dynamics.robot.n, dynamics.model.copy()
    links = chi[link_columns(dynamics)]
    links[links[:, -1] == 0.0, -1] = 1e-6  # pinocchio divides by the masses
    for j, parameters in enumerate(links[:, np.argsort(FROM_PINOCCHIO)], 1):
        rigid.inertias[j] = pin.Inertia.FromDynamicParameters(parameters)
    rotor, viscous = np.zeros((n, n)), np.zeros((3, n, n))  # in both directions, up, down
    directions, offset = dynamics.coulomb_directions, np.zeros(n)
    up, down = np.zeros((2, len(directions)))
    shapes = dict[Kind, tuple[Array, Array]]()
    for source, value in zip(dynamics.terms.values(), chi[[*dynamics.terms]], strict=True):
        if source.kind == "rotor":
            rotor += value * source.matrix
        elif source.kind == "viscous":
            viscous[source.side] += value * source.matrix
        elif source.kind == "offset":
            offset += value * source.direction
        # |v| is v for one direction of motion and -v for the other.
        elif source.kind == "asymmetric":
            viscous[1] += value * np.diag(source.direction)
            viscous[-1] -= value * np.diag(source.direction)
        else:
            at = int((directions == source.direction).all(axis=1).argmax())
            if source.kind == "coulomb":
                up[at] += value * (source.side >= 0)
                down[at] += value * (source.side <= 0)
            else:
                factor, speed = shapes.setdefault(
                    source.kind, (np.zeros(len(directions)), np.full(len(directions), np.inf))
                )
                factor[at], speed[at] = value, source.speed
    return DirectModel(
        inverse=dynamics,
        links=links,
        rigid=rigid,
        data=rigid.createData(),
        rotor=rotor,
        viscous=viscous[0],
        viscous_up=viscous[1],
        viscous_down=viscous[-1],
        directions=directions,
        up=up,
        down=down,
        shapes={kind: shapes[kind] for kind in SHAPES if kind in shapes and shapes[kind][0].any()},
        offset=offset,
    )


def symmetric(M: Array) -> Array:
    """Return full matrices (..., n, n) from the upper triangles that pinocchio fills."""
    return np.triu(M) + np.triu(M, 1).swapaxes(-1, -2)


def cholesky_solver(n: int) -> Callable[[Array, Array], Any]:
    """Return a function that solves A x = b for x (n,) from the upper triangle of A (n, n).

    Its result is None if A is not positive definite.
    """
    factors = eigenpy.LLT(n)

    def solve(A: Array, b: Array) -> Any:
        factors.compute(A.T)  # Eigen reads the lower triangle
        return None if factors.info() else factors.solve(b).ravel()  # for a lone joint it is (1, 1)

    return solve


def poses_of(q: Array) -> Array:
    """Return about 300 evenly spaced positions (P, n) of a trajectory q (N, n).

    The inertia matrix M is checked at these.
    """
    return np.array(q[:: max(1, len(q) // _POSES)])


def inertias(M: Array) -> Array:
    """Return J (n,), the largest diagonal entries of inertia matrices M (P, n, n), kg m² or kg."""
    return np.asarray(np.diagonal(M, axis1=1, axis2=2).max(axis=0))


def why_not_positive(M: Array) -> str | None:
    """Return why inertia matrices M (P, n, n) are not all positive definite; None if they are."""
    if not np.isfinite(M).all():
        return "the inertia matrix is not finite on the trajectory"
    lowest = float(np.linalg.eigvalsh(M).min())
    text = f"the inertia matrix is not positive on the trajectory (lowest eigenvalue {lowest:.3g})"
    return None if lowest > 0 else text


def regressor_gradient(
    model: InverseModel, base: BaseParameters, motion: tuple[Array, Array, Array], G: Array
) -> tuple[Array, Array, Array]:
    """Return gradients (N, n) of sum(G * W) by q, dq and ddq.

    Parameters
    ----------
    model, base : the robot and its b base parameters.
    motion : q, dq, ddq, (N, n) each.
    G : (N, n, b) constant weights of the regressor W (N, n, b), such as d criterion / d W in the
        search for exciting references.

    Notes
    -----
    A row of W times any parameters is a torque. Row j of sample k times G[k, j] is the torque at
    joint j of a robot that has the numbers G[k, j] as its parameters. So

        d/dq sum(G * W) = sum_j d/dq tau_j(q, dq, ddq; G[k, j])

    and each term is row j of the derivatives of RNEA, for n robots per sample. Rows of other joints
    are not used, as each robot belongs to one row. Terms of motors and friction have slopes of
    their own.

    Pinocchio divides by the mass of a link, which G may make zero. The torque is linear in the
    parameters, so each link gets a dummy mass, large enough that no sum of masses is zero. The
    derivatives of the robot that consists of the dummies alone, n + 1 in all, are subtracted.
    """
    q, dq, ddq = (np.ascontiguousarray(x) for x in motion)
    links, out = _split(model, base, dq, G)
    dummy = (_DUMMY * np.abs(links[..., _MOMENTS]).sum(axis=(2, 3)))[..., None]  # (N, n, 1)
    dummy[dummy == 0] = 1.0
    links[..., _MOMENTS[0]] += dummy  # the masses
    slopes = _slopes_of_robots(model, (q, dq, ddq), links)
    for j in range(model.robot.n):
        out += slopes[j, :, :, j] - dummy[:, j] * slopes[-1, :, :, j]
    return out[0], out[1], out[2]


def _split(model: InverseModel, base: BaseParameters, dq: Array, G: Array) -> tuple[Array, Array]:
    """Split G (N, n, b) into parameters of links, and gradients of motors and friction.

    The parameters are (N, n, n, 10) by row, in pinocchio's order; the gradients are (3, N, n).
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
    """Return derivatives (n + 1, 3, N, n, n) of the torques by q, dq and ddq.

    They are those of n robots with the parameters `links` (N, n, n, 10), and of one whose links
    only have the mass 1.
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
    """Return tau_rigid (N, n), and its derivatives (3, N, n, n) by q, dq, ddq (last axis)."""
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
    """Return the torque (N, n) without friction that has a sign, and its derivatives.

    Parameters
    ----------
    model : equation of motion.
    motion : q, dq, ddq, (N, n) each.
    of_links : torque of the links and its derivatives, as returned by `torque_of_links`.

    Returns
    -------
    The torque (N, n), N m or N, and its derivatives (3, N, n, n) by q, dq, ddq (last axis).
    """
    _, dq, ddq = motion
    slopes, up, down = of_links[1].copy(), model.viscous_up, model.viscous_down
    slopes[2] += model.rotor
    slopes[1] += model.viscous + (dq > 0)[:, None] * up + (dq < 0)[:, None] * down
    return of_links[0] + model.without_sliding(dq, ddq), slopes
