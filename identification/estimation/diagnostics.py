"""Torque errors by joint and state of motion, tests of instruments, whitening, distributions.

The distributions are implemented here because importing a library for them takes longer than a fit.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

from ..arrays import Array, Bools
from ..report import FTest, TorqueResidual
from .system import inverse_factor

MOVING = 0.02  # of a joint's peak speed; a slower joint counts as at rest
_MAX_TERMS = 500  # of the continued fraction, which needs about max(10, sqrt(degrees of freedom))


def torque_errors(
    tau: Array, predicted: Array, counts: Bools, joints: Sequence[tuple[str, str]]
) -> tuple[TorqueResidual, ...]:
    """Return the torque errors of each joint, and of all joints together as the last, named `all`.

    Parameters
    ----------
    tau, predicted : (rows, n) measured and predicted torque, N m or N; A or V if the drive gain is
        not known.
    counts : (rows, n) mask of the rows that count in a fit.
    joints : name and unit of each joint.
    """
    rho, found = tau - predicted, list[TorqueResidual]()
    each = [(*of, tau[:, j], rho[:, j], counts[:, j]) for j, of in enumerate(joints)]
    for name, unit, t, r, of in [*each, ("all", "", tau, rho, counts)]:
        error = relative_error_percent(t[of], r[of])
        found.append(
            TorqueResidual(
                name=name,
                relative_error_percent=error,
                moving_relative_error_percent=error,
                standing_relative_error_percent=relative_error_percent(t[~of], r[~of]),
                moving_rows=int(of.sum()),
                standing_rows=int((~of).sum()),
                autocorrelation=autocorrelation(np.where(of, r, 0.0)),
                residual_rms=float(np.linalg.norm(r[of]) / np.sqrt(max(1, of.sum()))),
                unit=unit,
            )
        )
    return tuple(found)


def are_moving(speed: Array) -> Bools:
    """Return a mask (rows, n) of the joints in motion, from their `speed` (rows, n).

    A joint in motion is faster than 2 % of its peak speed.
    """
    return np.asarray(np.abs(speed) > MOVING * np.abs(speed).max(axis=0))


def autocorrelation(rho: Array) -> float | None:
    """Return the autocorrelation at one row of residuals (rows,) or (rows, n).

    It is None if the residuals are zero.
    """
    r, following = rho[:-1].ravel(), rho[1:].ravel()
    size = np.linalg.norm(r) * np.linalg.norm(following)
    return float(r @ following / size) if size > 0 else None


def relative_error_percent(tau: Array, rho: Array) -> float | None:
    """Return 100 |rho| / |tau| of residual and torque; None if the torque is zero.

    Both have the same unit and shape.
    """
    norm = np.linalg.norm(tau)
    return float(100.0 * np.linalg.norm(rho) / norm) if norm > 0 else None


def relative_residual(W: Array, Y: Array) -> float:
    """Return |rho| / |Y| of the least squares of Y (r,) by columns W (r, b)."""
    W = W / np.maximum(np.linalg.norm(W, axis=0), 1e-300)
    return float(np.linalg.norm(Y - W @ np.linalg.lstsq(W, Y, rcond=1e-9)[0]) / np.linalg.norm(Y))


def first_stage(Q: Array, W: Array, rows: float) -> tuple[float, float]:
    """Test instruments; return their strength and the first-stage F.

    The strength is the smallest canonical correlation of Z and W, 1 for W itself. F is that of the
    least explained direction of W; instruments are weak below 10 (Staiger and Stock).

    Parameters
    ----------
    Q : (r, b) orthonormal columns that span Z.
    W : (r, b) weighted regressor.
    rows : number of used rows.
    """
    b = W.shape[1]
    strength = float(min(1.0, np.linalg.svd(Q.T @ W @ inverse_factor(W)[0], compute_uv=False)[-1]))
    return strength, float(strength**2 / max(1e-300, 1 - strength**2) * (rows - b) / b)


def autoregression(x: Array, order: int) -> Array:
    """Return coefficients (order,) that predict x (T,) from its past, by Yule and Walker.

    They are zero if x is zero.
    """
    r = np.array([x[k:] @ x[: len(x) - k] for k in range(order + 1)])
    if not r[0] > 0:
        return np.zeros(order)
    places = np.abs(np.subtract.outer(np.arange(order), np.arange(order)))
    return np.asarray(np.linalg.solve(r[places] + 1e-9 * r[0] * np.eye(order), r[1:]))


def f_tail(F: float, dropped: float, freedom: float) -> float:
    """Return the probability that a value of the F distribution exceeds F.

    Its degrees of freedom are `dropped` and `freedom`.
    """
    # Rounding may make F negative.
    return _incomplete_beta(freedom / 2, dropped / 2, freedom / (freedom + dropped * max(F, 0.0)))


@cache
def t_quantile(p: float, freedom: float) -> float:
    """Return the quantile p > 1/2 of Student's t distribution with `freedom` degrees of freedom."""
    return _root(lambda t: f_tail(t * t, 1.0, freedom) - 2.0 * (1.0 - p))


def chi_squared_quantile(tail: float, freedom: int) -> float:
    """Return the value that a chi-squared distribution exceeds with the probability `tail`."""
    return _root(lambda x: _chi_squared_tail(x, freedom) - tail)


def f_test(
    names: tuple[str, ...], F: float, dropped: int, rows: float, b: int, correlation: float
) -> FTest:
    """Test F for `dropped` of b parameters, also corrected for correlated residuals.

    Parameters
    ----------
    names : parameters that are kept.
    F : F statistic.
    dropped : number of dropped parameters.
    rows : number of used rows.
    b : number of all parameters.
    correlation : autocorrelation c of the residual at one row. The correction counts the share (1 -
        c)/(1 + c) of the rows as independent, and all of them for a negative c.
    """
    c = max(0.0, correlation)
    share = (1.0 - c) / (1.0 + c)
    return FTest(
        names=names,
        F=F,
        p_value=f_tail(F, dropped, rows - b),
        F_effective=F * share,
        p_effective=f_tail(F * share, dropped, max(1.0, rows * share - b)),
    )


def _chi_squared_tail(x: float, freedom: int) -> float:
    """Return the tail by repeated integration by parts from 1 or 2 degrees of freedom."""
    odd, half = freedom % 2, 0.5 * x
    tail = math.erfc(math.sqrt(half)) if odd else 0.0
    return tail + sum(
        math.exp(k * math.log(half) - half - math.lgamma(k + 1)) if half else float(k == 0)
        for k in (k + 0.5 * odd for k in range(freedom // 2))
    )


def _incomplete_beta(a: float, b: float, x: float) -> float:
    """Return the regularised incomplete beta function I_x(a, b), by its continued fraction.

    Abramowitz and Stegun 26.5.8, evaluated by Lentz's method.
    """
    if x <= 0.0 or x >= 1.0:
        return float(x >= 1.0)
    # The fraction of the other tail converges faster here.
    if x > (a + 1.0) / (a + b + 2.0):
        return 1.0 - _incomplete_beta(b, a, 1.0 - x)
    front = math.exp(
        math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    )
    C, D = 1.0, 1.0 / (1.0 - (a + b) * x / (a + 1.0))
    fraction = D
    for m in range(1, _MAX_TERMS):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        for term in (even, odd):
            C, D = 1.0 + term / C, 1.0 / (1.0 + term * D)
            fraction *= C * D
        if abs(C * D - 1.0) < 1e-15:
            break
    return front * fraction / a


def _root(decreasing: Callable[[float], float]) -> float:
    """Find the zero of a decreasing function of x > 0, by bisection down to rounding."""
    low, high = 0.0, 1.0
    while decreasing(high) > 0.0:
        low, high = high, 2.0 * high
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if decreasing(middle) > 0.0 else (low, middle)
    return high
