"""Tails and quantiles of the distributions that tests and intervals need, and what correlated rows are worth.

They stand here because the import of a library's takes longer than a fit.
"""

import math
from collections.abc import Callable

_MOST_TERMS = 500  # of the continued fraction: some ten are needed, and sqrt(degrees of freedom) where these are many


def f_tail(F: float, dropped: float, freedom: float) -> float:
    """Probability that an F-distributed value with `dropped` and `freedom` degrees of freedom exceeds F.

    A value below 0 by rounding counts as 0.
    """
    return _incomplete_beta(freedom / 2, dropped / 2, freedom / (freedom + dropped * max(F, 0.0)))


def t_quantile(p: float, freedom: float) -> float:
    """Value that one with Student's t distribution of `freedom` degrees of freedom stays below with probability p > 1/2."""
    return _root(lambda t: f_tail(t * t, 1.0, freedom) - 2.0 * (1.0 - p))


def chi_squared_quantile(tail: float, freedom: int) -> float:
    """Value that a chi-squared one of `freedom` degrees of freedom exceeds with the probability `tail`."""
    return _root(lambda x: _chi_squared_tail(x, freedom) - tail)


def independent_share(correlation: float) -> float:
    """(1 - c)/(1 + c): r rows whose residual has the correlation c at a lag of one row are worth that share of r.

    A negative correlation counts as none.
    """
    c = max(0.0, correlation)
    return (1.0 - c) / (1.0 + c)


def _chi_squared_tail(x: float, freedom: int) -> float:
    """The sum that repeated integration by parts gives for whole degrees of freedom, from that of 1 or 2 on."""
    odd, half = freedom % 2, 0.5 * x
    tail = math.erfc(math.sqrt(half)) if odd else 0.0
    powers = (k + 0.5 * odd for k in range(freedom // 2))
    return tail + sum(
        math.exp(k * math.log(half) - half - math.lgamma(k + 1)) if half else float(k == 0) for k in powers
    )


def _incomplete_beta(a: float, b: float, x: float) -> float:
    """The regularised incomplete beta function I_x(a, b), by its continued fraction (Abramowitz and Stegun 26.5.8, Lentz)."""
    if x <= 0.0 or x >= 1.0:
        return float(x >= 1.0)
    if x > (a + 1.0) / (a + b + 2.0):  # where the fraction of the other tail converges faster
        return 1.0 - _incomplete_beta(b, a, 1.0 - x)
    front = math.exp(math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x))
    C, D = 1.0, 1.0 / (1.0 - (a + b) * x / (a + 1.0))
    fraction = D
    for m in range(1, _MOST_TERMS):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        for term in (even, odd):
            C, D = 1.0 + term / C, 1.0 / (1.0 + term * D)
            fraction *= C * D
        if abs(C * D - 1.0) < 1e-15:
            break
    return front * fraction / a


def _root(falling: Callable[[float], float]) -> float:
    """Where a function of x > 0 that falls becomes negative, by bisection down to rounding."""
    low, high = 0.0, 1.0
    while falling(high) > 0.0:
        low, high = high, 2.0 * high
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if falling(middle) > 0.0 else (low, middle)
    return high
