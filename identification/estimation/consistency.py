"""The physically consistent parameters nearest to an estimate: one smooth convex problem.

    min over chi:  1/2 (K chi - beta)' C⁻¹ (K chi - beta)
                   + gamma sum_j [tr(P0_j⁻¹ P_j) - log det P_j]
                   - gamma_x (sum_i log x_i + sum_k log det X_k)

P_j(chi) is the 4 × 4 pseudo-inertia of link j, positive definite for every rigid body with positive
mass density (Wensing, Kim, Slotine, Linear matrix inequalities for physically consistent inertial
parameter identification, IEEE RA-L 3 (2018)), and P0_j its a priori value. x_i are combinations of
the other parameters that must be positive, X_k matrices of them that must be positive definite,
such as viscous friction of joints that share motors.

Beta, its covariance C and the regrouping matrix K replace the rows of the recording. Damped Newton
steps solve the problem; the Newton decrement certifies the optimum.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array, Ints
from ..errors import NoFitError

# Weight of the a priori pseudo-inertias. On short recordings with generic ones, 0.1 or less is
# worse than none.
GAMMA = 1.0
GAMMA_X = 1e-6  # times gamma: only a barrier, as full weight would bias friction and rotors
MATRIX_WEIGHT = 100.0  # times GAMMA_X, of the log det of a matrix; less is lost in rounding
MAX_DECREMENT = 1e-6  # half the square of the decrement is about the distance to the optimum
MAX_STEPS = 40  # about twenty are usual
MAX_SOFTENING = 1e8  # largest factor of the covariance, for optima out of direct reach
MAX_FACTOR, MIN_FACTOR = 100.0, 1.02  # reduction of that factor in one step
MAX_BOUNDARY_SHARE = 0.95  # of the way to the boundary in one step
MIN_SINGULAR_VALUE = 1e-14  # of the largest singular value
MIN_RELATIVE_DEVIATION = 1e-5  # of a parameter's value; below, the barrier is lost in rounding


@dataclass(frozen=True, kw_only=True, eq=False)
class PhysicalParameters:
    """Conditions of a physically consistent model on standard parameters chi (p,).

    Attributes:
        links: (L, 10) columns of XX XY XZ YY YZ ZZ MX MY MZ M of each link in chi.
        prior: (L, 4, 4) a priori pseudo-inertias P0 of the links, positive definite.
        combinations: (m, p) rows x_i; `combinations @ chi` must be positive.
        start: (p,) parameters that meet all conditions.
        matrices: (s, s, p) each; `matrix @ chi` must be positive definite.
    """

    links: Ints
    prior: Array
    combinations: Array
    start: Array
    matrices: tuple[Array, ...] = ()

    def within(self, K: Array) -> tuple[Ints, "PhysicalParameters"]:
        """Return the columns (k,) of chi that K (b, p) or a link has, and their conditions.

        Further friction terms, which a fit has left out, are zero.
        """
        kept = np.union1d(np.flatnonzero(K.any(axis=0)), self.links)
        # `take` keeps the order in memory, and thereby the last digits of the result.
        return kept, PhysicalParameters(
            links=np.searchsorted(kept, self.links),
            prior=self.prior,
            combinations=self.combinations.take(kept, axis=1),
            start=self.start[kept],
            matrices=tuple(matrix.take(kept, axis=2) for matrix in self.matrices),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Consistent:
    """The nearest physically consistent parameters.

    Attributes:
        chi: (p,) standard parameters.
        beta: (b,) base parameters K chi.
        chi_squared: (beta - estimate)' C⁻¹ (beta - estimate).
        deviations: (b,) change of each parameter, in standard errors.
        decrement: Newton decrement at chi, which certifies the optimum.
    """

    chi: Array
    beta: Array
    chi_squared: float
    deviations: Array
    decrement: float


def consistent_parameters(
    beta: Array,
    covariance: Array,
    K: Array,
    physical: PhysicalParameters,
    *,
    gamma: float = GAMMA,
    gamma_x: float = GAMMA_X,
) -> Consistent:
    """Find the physically consistent parameters nearest to an estimate.

    Parameters
    ----------
    beta : (b,) estimate.
    covariance : (b, b) C = D R D, standard errors D of the intervals, classical correlations R.
    K : (b, p) regrouping matrix, beta = K chi.
    physical : conditions on chi.
    gamma : weight of the a priori pseudo-inertias.
    gamma_x : weight of the barrier of combinations and matrices, relative to gamma.

    Raises
    ------
    NoFitError : the optimum is not reached, e.g. because the estimate is not finite.
    """
    root, (kept, physical) = _inverse_root(beta, covariance), physical.within(K)
    K, p = K.take(kept, axis=1), K.shape[1]

    def softened(softer: float) -> _Objective:
        barrier = gamma * max(gamma_x, min(gamma_x * softer, 1.0))
        return _Objective(beta, root / np.sqrt(softer), K, physical, gamma, barrier)

    chi, decrement = _minimum(softened(1.0), physical.start)
    if not decrement <= MAX_DECREMENT:
        # An estimate far from any physically consistent model leads along the boundary, where steps
        # are short.
        chi, decrement = _along_path(softened, physical.start)
    if not decrement <= MAX_DECREMENT:
        raise NoFitError(
            "the search for physically consistent parameters did not converge",
            key="Newton decrement",
            value=decrement,
            expected=f"at most {MAX_DECREMENT:g}",
        )
    moved, sigma = K @ chi - beta, np.sqrt(np.diag(covariance))
    return Consistent(
        chi=np.asarray(np.bincount(kept, chi, minlength=p), dtype=float),
        beta=K @ chi,
        chi_squared=float(np.sum((root @ moved) ** 2)),
        deviations=np.divide(moved, sigma, out=np.zeros_like(moved), where=sigma > 0),
        decrement=decrement,
    )


def parameter_certainty(
    found: Consistent,
    covariance: Array,
    K: Array,
    physical: PhysicalParameters,
    *,
    gamma: float = GAMMA,
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return standard errors and relative variances of the parameters chi (p,) and beta (b,).

    Standard errors follow Laplace: they are from the inverse Hessian at the optimum, without the
    barrier of friction and rotors. Those of beta include the square of their change from the
    estimate. The relative variance, 0 to 1, is the variance over that of the a priori values alone.
    It is 0 for parameters without a priori values, such as offsets and friction.

    Parameters
    ----------
    found : the optimum.
    covariance, K, physical, gamma : as in `consistent_parameters`.
    """
    whole, (kept, physical) = np.zeros((2, K.shape[1])), physical.within(K)
    b, p = (K := K.take(kept, axis=1)).shape
    links = replace(physical, combinations=np.zeros((0, p)), matrices=())
    root = _inverse_root(found.beta, covariance)
    J = _Objective(found.beta, root, K, links, gamma, 0.0).derivatives(found.chi[kept])[1]
    both, expected = np.concatenate([np.eye(p), K]), J[b:].any(axis=0)
    variance, alone = _variances(J, both), _variances(J[b:, expected], both[:, expected])
    free = both[:, ~expected].any(axis=1)
    share = np.where(free, 0.0, np.minimum(variance / np.where(free, 1.0, alone), 1.0))
    sigma = np.sqrt(variance + np.r_[np.zeros(p), found.deviations**2 * np.diag(covariance)])
    whole[:, kept] = sigma[:p], share[:p]
    return (whole[0], whole[1]), (sigma[p:], share[p:])


def _variances(J: Array, rows: Array) -> Array:
    """Return the diagonal (k,) of rows (J'J)⁻¹ rows'; very large if J is singular."""
    d = np.linalg.norm(J, axis=0)
    values, V = np.linalg.svd(J / d, full_matrices=False)[1:]
    return np.asarray(
        ((rows / d @ V.T / np.maximum(values, MIN_SINGULAR_VALUE * values[0])) ** 2).sum(axis=1)
    )


class _Objective:
    """The function to minimise, infinite unless all P_j, X_k and x_i are positive (definite)."""

    def __init__(
        self,
        beta: Array,
        root: Array,
        K: Array,
        physical: PhysicalParameters,
        gamma: float,
        gamma_x: float,
    ) -> None:
        """Store the problem; `root` (b, b) is a root of C⁻¹, |root r|² = r' C⁻¹ r."""
        self._target, self._A = root @ beta, root @ K
        self._x, self._gamma_x = physical.combinations, gamma_x
        # Each cone is a matrix that is linear in some parameters: their columns (L, c) in chi, the
        # matrices (c, s, s) that they multiply, and the weight of its log det.
        self._cones = [(physical.links, BASIS, gamma)]
        for matrix in physical.matrices:
            columns = np.flatnonzero(matrix.any(axis=(0, 1)))
            self._cones.append(
                (columns[None], np.moveaxis(matrix[..., columns], -1, 0), MATRIX_WEIGHT * gamma_x)
            )
        self._pull = np.zeros(K.shape[1])  # gradient of gamma tr(P0⁻¹ P)
        self._pull[physical.links] = gamma * np.einsum(
            "lab,iba->li", np.linalg.inv(physical.prior), BASIS
        )

    def value(self, chi: Array) -> float:
        """Return the function at chi (p,), infinite outside its domain."""
        x, rho = self._x @ chi, self._A @ chi - self._target
        if (x > 0).all():
            with suppress(np.linalg.LinAlgError):
                log_det = sum(
                    2 * weight * np.log(np.diagonal(L, axis1=1, axis2=2)).sum()
                    for (_, _, weight), L in zip(self._cones, self._roots(chi), strict=True)
                )
                return float(
                    0.5 * rho @ rho + self._pull @ chi - log_det - self._gamma_x * np.log(x).sum()
                )
        return np.inf

    def derivatives(self, chi: Array) -> tuple[Array, Array]:
        """Return the gradient (p,) at chi, and J (r, p) of the Hessian J'J.

        J is returned because the condition number of the Hessian is that of J squared.
        """
        g, parts = self._A.T @ (self._A @ chi - self._target) + self._pull, [self._A]
        for (columns, basis, weight), L in zip(self._cones, self._roots(chi), strict=True):
            back = np.linalg.inv(L)[:, None]
            E = back @ basis @ back.transpose(0, 1, 3, 2)  # (L, c, s, s): L⁻¹ E_i L⁻ᵀ
            J = np.zeros((len(columns), L[0].size, len(chi)))
            traces, flat = np.trace(E, axis1=2, axis2=3), E.reshape(*columns.shape, -1)
            for at, own, trace, entries in zip(columns, J, traces, flat, strict=True):
                g[at] -= weight * trace
                own[:, at] = np.sqrt(weight) * entries.T
            parts.append(J.reshape(-1, len(chi)))
        inverse = self._x / (self._x @ chi)[:, None]
        g -= self._gamma_x * inverse.sum(axis=0)
        at = np.flatnonzero(self._x.any(axis=0))
        # Friction power at hundreds of speeds gives many rows, of which the R factor is enough.
        if len(inverse) > len(at):
            inverse = np.linalg.qr(inverse[:, at], mode="r") @ np.eye(len(chi))[at]
        return g, np.concatenate([*parts, np.sqrt(self._gamma_x) * inverse])

    def reach(self, chi: Array, step: Array) -> float:
        """Return the multiple of a step at which a P_j or X_k becomes singular, or an x_i zero."""
        lowest = float(((self._x @ step) / (self._x @ chi)).min(initial=0.0))
        for (columns, basis, _), L in zip(self._cones, self._roots(chi), strict=True):
            back = np.linalg.inv(L)
            change = back @ np.tensordot(step[columns], basis, axes=1) @ back.transpose(0, 2, 1)
            lowest = min(lowest, float(np.linalg.eigvalsh(change).min()))
        return float(-1.0 / lowest) if lowest < 0 else np.inf

    def _roots(self, chi: Array) -> list[Array]:
        """Return Cholesky factors (L, s, s) of the P_j and X_k.

        Raises `LinAlgError` if one is not positive definite.
        """
        return [
            np.asarray(np.linalg.cholesky(np.tensordot(chi[columns], basis, axes=1)))
            for columns, basis, _ in self._cones
        ]


def _along_path(problem: Callable[[float], _Objective], chi: Array) -> tuple[Array, float]:
    """Minimise for decreasing covariances, each from the optimum before.

    Returns the last optimum and its decrement.
    """
    chi, decrement = _minimum(problem(MAX_SOFTENING), chi)
    softer, factor = MAX_SOFTENING, MAX_FACTOR
    while decrement <= MAX_DECREMENT and softer > 1.0:
        harder = max(1.0, softer / factor)
        found, reached = _minimum(problem(harder), chi)
        if reached <= MAX_DECREMENT:
            chi, decrement, softer, factor = found, reached, harder, min(MAX_FACTOR, factor**1.5)
        elif factor > MIN_FACTOR:  # try a closer problem first
            factor **= 0.5
        else:
            decrement = reached
    return chi, decrement


def _minimum(objective: _Objective, chi: Array) -> tuple[Array, float]:
    """Take Newton steps from chi; return the end, and the Newton decrement there."""
    step, decrement = _newton_step(*objective.derivatives(chi))
    for _ in range(MAX_STEPS):
        going = MAX_DECREMENT < decrement < np.inf
        length = _length(objective, chi, step, decrement) if going else 0.0
        if length == 0.0:
            break
        chi = chi + length * step
        step, decrement = _newton_step(*objective.derivatives(chi))
    return chi, decrement


def _length(objective: _Objective, chi: Array, step: Array, decrement: float) -> float:
    """Return the share of a Newton step that stays inside and decreases the function enough.

    It is 0 if no share decreases the function by more than rounding.
    """
    value, length = objective.value(chi), min(1.0, MAX_BOUNDARY_SHARE * objective.reach(chi, step))
    rounding = 1e-13 * abs(value)
    while length > 1e-10:
        if objective.value(chi + length * step) <= value - 1e-4 * length * decrement**2 + rounding:
            return length
        length *= 0.5
    return 0.0


def _newton_step(g: Array, J: Array) -> tuple[Array, float]:
    """Return the Newton step (p,) and its decrement."""
    d = np.linalg.norm(J, axis=0)
    d = np.where(d > 0, d, 1.0)
    try:
        R = np.asarray(np.linalg.qr(J / d, mode="r"))
        half = np.linalg.solve(R.T, g / d)
        return -np.linalg.solve(R, half) / d, float(np.linalg.norm(half))
    except np.linalg.LinAlgError:
        return np.zeros_like(g), np.inf


def _inverse_root(beta: Array, covariance: Array) -> Array:
    """Return a root (b, b) of C⁻¹, by way of the correlations.

    Standard errors have a lower bound, as the barrier would be lost in rounding beside a smaller
    one.
    """
    sigma = np.sqrt(np.diag(covariance))
    own = np.where(sigma > 0, sigma, 1.0)
    R = covariance / own[:, None] / own
    np.fill_diagonal(R, 1.0 + 1e-12)
    sigma = np.maximum(sigma, MIN_RELATIVE_DEVIATION * np.abs(beta))
    sigma = np.where(sigma > 0, sigma, MIN_RELATIVE_DEVIATION)
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(R)) / sigma)
    except np.linalg.LinAlgError as error:
        raise NoFitError(
            "physically consistent parameters cannot be computed, since the covariance of the "
            "estimates is not positive definite"
        ) from error


def pseudo_inertia(parameters: Array) -> Array:
    """Return pseudo-inertias P (..., 4, 4) of links with parameters (..., 10).

        P = [[tr(I)/2 1 - I, h], [h', M]],     h = [MX MY MZ]'

    The parameters are XX XY XZ YY YZ ZZ MX MY MZ M, in kg m², kg m and kg.
    """
    return np.asarray(np.tensordot(parameters, BASIS, axes=1))


def link_parameters(P: Array) -> Array:
    """Return link parameters (..., 10) of pseudo-inertias P (..., 4, 4).

    It is the inverse of `pseudo_inertia`.
    """
    second, (rows, columns) = P[..., :3, :3], np.triu_indices(3)
    inertia = np.trace(second, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - second
    return np.concatenate([inertia[..., rows, columns], P[..., :3, 3], P[..., 3:, 3]], axis=-1)


def _basis() -> Array:
    basis, (i, j), k = np.zeros((10, 4, 4)), np.triu_indices(3), np.arange(3)
    basis[np.arange(6), i, j] = basis[np.arange(6), j, i] = -1.0
    basis[np.flatnonzero(i == j)] += np.diag([0.5, 0.5, 0.5, 0.0])
    basis[6 + k, k, 3] = basis[6 + k, 3, k] = 1.0
    basis[9, 3, 3] = 1.0
    return basis


BASIS = _basis()  # (10, 4, 4): P is the sum of each parameter times its matrix
