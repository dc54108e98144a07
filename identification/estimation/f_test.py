"""The F test: its tail, and how many independent rows correlated ones are worth."""

from scipy.special import fdtrc


def f_tail(F: float, dropped: float, freedom: float) -> float:
    """Probability that an F-distributed value with `dropped` and `freedom` degrees of freedom exceeds F.

    As `scipy.stats.f.sf`, whose import alone takes longer than a fit. A value below 0 by rounding counts as 0.
    """
    return float(fdtrc(dropped, freedom, max(F, 0.0)))


def independent_share(correlation: float) -> float:
    """(1 - c)/(1 + c): r rows whose residual has the correlation c at a lag of one row are worth that share of r.

    A negative correlation counts as none.
    """
    c = max(0.0, correlation)
    return (1.0 - c) / (1.0 + c)
