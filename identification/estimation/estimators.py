"""Least squares and instrumental variables on any W, Y, Z by QR; essential parameters.

    rho = Y - W beta,     s² = |rho|²/(r - 1),     C = s² (W'W)⁻¹
    sigma_i = sqrt(C_ii),     %sigma_i = 100 sigma_i/|beta_i|

Symbols are those of Janot2014 and Gautier1997. The divisor r - 1, not r - b, is that of the
authors' scripts and published standard deviations; it makes sigma smaller by b/2r (0.06 % on the
EMPS, 1.3 % on the TX40).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar, cast

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from ..arrays import Array, Ints
from ..errors import NoFitError
from ..report import FTest
from .diagnostics import f_test
from .system import RANK_TOLERANCE, System, orthonormal, r_factor, refuse_rank_deficiency

F = TypeVar("F", bound=Callable[..., Any])

MIN_COLUMN_NORM = 1e-9  # of a column's norm over all joints; less at one joint is rounding
F_TEST_LEVEL = 0.01  # a drop with a smaller p-value is rejected


def one_thread(function: F) -> F:
    """Restrict linear algebra within `function` to one thread.

    The matrices are small: on a busy machine more threads make a fit several times slower.
    """
    return cast(F, threadpool_limits.wrap(limits=1)(function))


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """An estimate with its covariance and factors.

    Attributes:
        names: (b,) estimated parameters.
        beta: (b,) their values.
        covariance: (b, b) classical covariance C, which assumes white residuals.
        weights: (n,) 1/s_j of the rows of joint j, 1/(N m) or 1/N; ones without weighting.
        residual_norm: |Y - W beta| of the weighted rows.
        condition_number: condition number of W.
        condition_number_scaled: condition number of the weighted W with columns of norm one; with
            instruments that of Z'W.
        rows: r, the effective number of decimated samples of all joints, the sum of the squares of
            their weights.
        Q: (r, b) orthonormal columns that span the weighted W, or Z.
        bread: (b, b) factor of beta - beta_true = bread Q' rho, with weighted rho (r,).
        stated: (b, s) changes by one standard error of each of the s given values that the estimate
            is combined with (`confidence.combined`).
    """

    names: tuple[str, ...]
    beta: Array
    covariance: Array
    weights: Array
    residual_norm: float
    condition_number: float
    condition_number_scaled: float
    rows: float
    Q: Array
    bread: Array
    stated: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @cached_property
    def sigma(self) -> Array:
        """Classical standard errors (b,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def sigma_percent(self) -> Array:
        """Classical standard errors (b,) in percent of the values; infinite for a value of zero."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(100.0 * self.sigma / np.abs(self.beta))

    def without_rows(self) -> "Estimate":
        """Return a copy without Q, which is as large as W."""
        return replace(self, Q=self.Q[:0].copy())

    def part(self, indices: Ints) -> "Estimate":
        """Return the estimate of some of the parameters; the others stay estimated."""
        return replace(
            self,
            names=tuple(self.names[i] for i in indices),
            beta=self.beta[indices],
            covariance=self.covariance[np.ix_(indices, indices)],
            bread=self.bread[indices],
            stated=self.stated[indices] if self.stated.size else self.stated,
        )

    def values_of(self, names: tuple[str, ...]) -> Array:
        """Return the values of `names`, zero for those that are not estimated."""
        found = dict(zip(self.names, self.beta, strict=True))
        return np.array([found.get(name, 0.0) for name in names])


def ordinary_least_squares(system: System) -> Estimate:
    """Solve the rows by least squares without weights.

        min |Y - W beta|²,     equation (B) with S = 1

    Parameters
    ----------
    system : rows W (r, b) and Y (r,), Y in N m or N.

    Returns
    -------
    The estimate with its covariance s² (W'W)⁻¹, and `weights` (n,) of ones.

    Raises
    ------
    NoFitError : as `weighted_least_squares`.
    """
    return _estimated(system, np.ones(len(system.rows)))


def weighted_least_squares(system: System, weights: Array | None = None) -> Estimate:
    """Solve the rows by least squares, with the rows of joint j divided by s_j.

        min |S (Y - W beta)|²,     S = 1/s_j in rows of joint j                          (B)

    Parameters
    ----------
    system : rows W (r, b) and Y (r,), Y in N m or N.
    weights : (n,) 1/s_j, 1/(N m) or 1/N, if they are known. By default s_j is the residual standard
        deviation of the joint's own least squares.

    Returns
    -------
    The estimate with its covariance s² (W'S²W)⁻¹, and `weights` (n,) 1/s_j, 1/(N m) or 1/N.

    Raises
    ------
    NoFitError : there are no more rows than parameters, or W is rank deficient; the text names the
        parameters that are not excited or not distinguishable.
    """
    return _estimated(system, joint_weights(system) if weights is None else weights)


def joint_weights(system: System) -> Array:
    """Compute the weight (n,) of each joint's rows from its own least squares, 1/(N m) or 1/N.

        1/s_j,     s_j² = |Y_j - W_j beta_j|² / (r_j - b_j)                              (B)

    beta_j is the solution of the r_j rows of joint j alone, b_j the rank of its columns.
    """
    rows, W, Y = system.rows, system.W, system.Y
    s, least = np.empty(len(rows)), MIN_COLUMN_NORM * np.linalg.norm(W, axis=0)
    for j in range(len(rows)):
        W_j, Y_j = W[system.joint_of_row == j], Y[system.joint_of_row == j]
        W_j = W_j[:, np.linalg.norm(W_j, axis=0) > least]
        # The R factor has the same residual norm as the rows, but only as many rows as columns.
        R = r_factor(np.c_[W_j / _norms(W_j), Y_j])
        b_j, _, rank, _ = np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=RANK_TOLERANCE)
        rho = R[:, -1] - R[:, :-1] @ b_j
        # An exact model leaves only rounding, which must not set the weights.
        rounding = 1e-12 * np.sqrt(Y_j @ Y_j / rows[j])
        s[j] = max(np.sqrt(rho @ rho / max(1, rows[j] - rank)), rounding)
    return _reciprocal(s)


def weights_of(system: System, rho: Array) -> Array:
    """Return 1/s_j (n,), 1/(N m) or 1/N, of residuals rho (r,), with s_j² = |rho_j|² / r_j."""
    squares = np.bincount(system.joint_of_row, rho**2, minlength=len(system.rows))
    return _reciprocal(np.sqrt(squares / np.maximum(1, system.rows)))


def _reciprocal(s: Array) -> Array:
    """Return 1/s_j (n,), limited: a joint at rest without torque must not outweigh all others."""
    s = np.maximum(s, 1e-6 * s.max())
    return np.asarray(1.0 / np.where(s > 0, s, 1.0))


def essential_parameters(
    system: System, full: Estimate, *, correlation: float, ratio: float = 30.0
) -> FTest:
    """Find the essential parameters: drop the one with the largest %sigma, and solve again.

    This ends when max %sigma < ratio · min %sigma (Gautier2013), or when the F test rejects a drop
    at 1 %. The F test is corrected for the correlation of the residual.

    Parameters
    ----------
    system : rows of all base parameters.
    full : their estimate, whose weights are used.
    correlation : autocorrelation of the residual at one row, -1 to 1.
    ratio : largest ratio of two %sigma that is kept.

    Returns
    -------
    The names of the kept parameters, and the F test against `full`, whose figures are NaN if none
    was dropped.
    """
    # Columns are dropped from the R factor, so that each drop costs b³ operations, not r b².
    R, r, b = r_factor(np.column_stack(system.weighted(full.weights))), full.rows, len(full.beta)

    kept, nan = np.arange(b), math.nan
    tested = FTest(names=(), F=nan, p_value=nan, F_effective=nan, p_effective=nan)
    beta, bread, norm, _ = _solve(orthonormal(R[:, kept]), R[:, kept], R[:, -1])
    while len(kept) > 1:
        with np.errstate(divide="ignore", invalid="ignore"):
            percent = np.sqrt(np.diag(_covariance(bread, norm, r))) / np.abs(beta)
        if percent.max() < ratio * percent.min():
            break
        fewer = np.delete(kept, percent.argmax())
        beta, bread, norm, _ = _solve(orthonormal(R[:, fewer]), R[:, fewer], R[:, -1])
        if full.residual_norm > 0:
            F = (
                (norm**2 - full.residual_norm**2)
                / (b - len(fewer))
                / (full.residual_norm**2 / (r - b))
            )
            outcome = f_test((), F, b - len(fewer), r, b, correlation)
            if (outcome.p_effective or 0.0) < F_TEST_LEVEL:
                break
            tested = outcome
        kept = fewer
    return msgspec.structs.replace(tested, names=tuple(system.names[k] for k in kept))


def instrumental_variables(system: System, Z: Array, weights: Array) -> Estimate:
    """Solve the rows by instrumental variables, section 3 of Janot2014.

        beta = (Z'W)⁻¹ Z'Y,     covariance s² (Z'W)⁻¹ Z'Z (W'Z)⁻¹                        (D)

    W, Y and Z are weighted. The QR factors of Z = Q R solve it, (Q'W) beta = Q'Y; R cancels in the
    covariance.

    Parameters
    ----------
    system : rows W (r, b) and Y (r,), Y in N m or N.
    Z : (r, b) instruments, not weighted, in the units of W.
    weights : (n,) 1/s_j of the rows of joint j, 1/(N m) or 1/N.

    Returns
    -------
    The estimate; its `Q` (r, b) spans the weighted Z.

    Raises
    ------
    NoFitError : Q'W is singular, or as `weighted_least_squares`, of Z in place of W.
    """
    return _estimated(system, weights, Z)


def _estimated(system: System, weights: Array, Z: Array | None = None) -> Estimate:
    """Solve by least squares, or by instrumental variables if there are instruments Z (r, b).

    Z is not weighted.
    """
    r, b = float(system.rows.sum()), len(system.names)
    if r <= b:
        raise NoFitError(
            key="decimated rows",
            value=round(r),
            expected=f"more than {b}, the number of parameters",
            advice="Record a longer motion",
        )
    W, Y = system.weighted(weights)
    spanning = W if Z is None else Z * weights[system.joint_of_row][:, None]
    singular, Q = refuse_rank_deficiency(spanning, system.names), orthonormal(spanning)
    del spanning
    beta, bread, residual_norm, condition = _solve(Q, W, Y)
    if Z is None:
        condition = float(singular[0] / singular[-1])
    elif not condition < 1 / RANK_TOLERANCE:
        raise NoFitError(
            "instruments and regressor are too weakly correlated",
            key="cond(ZᵀW)",
            value=condition,
            shown=f"{condition:.2g}",
        )
    return Estimate(
        names=system.names,
        beta=beta,
        covariance=_covariance(bread, residual_norm, r),
        weights=weights,
        residual_norm=residual_norm,
        condition_number=float(np.linalg.cond(r_factor(system.W))),
        condition_number_scaled=condition,
        rows=r,
        Q=Q,
        bread=bread,
    )


def _solve(Q: Array, W: Array, Y: Array) -> tuple[Array, Array, float, float]:
    """Solve (Q'W) beta = Q'Y.

    Returns beta (b,), bread (b, b) of beta - beta_true = bread Q' rho, |Y - W beta|, and cond(Q'W)
    with columns of norm one.
    """
    d = _norms(W)
    A = Q.T @ W / d  # upper triangular if Q spans W
    q, R = np.linalg.qr(A)
    bread, beta = np.linalg.solve(R, q.T) / d[:, None], np.linalg.solve(R, q.T @ (Q.T @ Y)) / d
    return beta, bread, float(np.linalg.norm(Y - W @ beta)), float(np.linalg.cond(A))


def _covariance(bread: Array, residual_norm: float, rows: float) -> Array:
    """Return C (b, b) = s² bread bread' of `rows` samples."""
    return np.asarray(residual_norm**2 / (rows - 1) * (bread @ bread.T))


def _norms(W: Array) -> Array:
    norms = np.linalg.norm(W, axis=0)
    return np.asarray(np.where(norms > 0, norms, 1.0))
