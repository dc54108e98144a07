"""Confidence intervals that hold for correlated residuals, equation (F).

They use equal-weighted cosines (EWC) and Student's t: Lazarus, Lewis, Stock and Watson, HAR
Inference: Recommendations for Practice, Journal of Business & Economic Statistics 36 (2018). Only
the low-frequency part of the residual affects an estimate, and the cosines of the lowest
frequencies measure it.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress, pairwise

import numpy as np

from ..arrays import Array, Bools, Ints
from ..report import FTest
from .diagnostics import f_tail, t_quantile
from .estimators import Estimate
from .system import System

LEVEL = 0.95
NORMAL_REACH = 1.96  # quantile of a normal distribution at that level
MIN_COSINES = 4
# White residuals would allow more, but then the intervals of an AR(0.98) residual cover 76 %
# instead of 92 % of the true values.
MAX_COSINES = 16
WHITE_COSINES = 48  # of rows that were whitened
MIN_OWN = 1e-9  # of a column's norm, outside the columns of an estimate; less is rounding
MIN_VARIANCE_SHARE = 0.1  # reached by very short recordings


@dataclass(frozen=True, kw_only=True, eq=False)
class Intervals:
    """95 % intervals of the estimated parameters.

    Attributes:
        low, high: (b,) ends of the intervals.
        sigma: (b,) standard errors by equal-weighted cosines.
        freedom: degrees of freedom of Student's t.
        reach: t, the 97.5 % quantile; a half-width is t sigma.
        covariance: (b, b) D R D, with standard errors D = `sigma` and classical correlations R. The
            matrix of the cosines itself has no more than `freedom` independent directions.
    """

    low: Array
    high: Array
    sigma: Array
    freedom: int
    reach: float
    covariance: Array

    def part(self, indices: Ints) -> "Intervals":
        """Return the intervals of some of the parameters."""
        return replace(
            self,
            covariance=self.covariance[np.ix_(indices, indices)],
            **{name: getattr(self, name)[indices] for name in ("low", "high", "sigma")},
        )

    @cached_property
    def half(self) -> Array:
        """Half-widths (b,)."""
        return 0.5 * (self.high - self.low)


def intervals_of(
    system: System, estimate: Estimate, among: Bools | None = None, most: int = MAX_COSINES
) -> Intervals:
    """Compute the 95 % intervals of an estimate from the rows of its system, equation (F).

        beta ± t sigma,     sigma² = (1/B) sum_b L_b²,     L_b = sum_t c_b(t) e(t)

    Parameters
    ----------
    system : the rows W, Y of the estimate, not weighted.
    estimate : with its weights and Q; given values that it is combined with add their standard
        errors.
    among : mask of the time blocks that the rows belong to; all by default.
    most : largest number of cosines of a recording.

    Returns
    -------
    Intervals and `sigma` (b,) in the units of beta. The degrees of freedom are the number B of
    cosines, summed over the recordings, which are independent.
    """
    rho = system.Y - system.W @ estimate.values_of(system.names)
    weighted, Q, bread = rho * estimate.weights[system.joint_of_row], estimate.Q, estimate.bread
    each, freedom = list[Array](), 0
    for B, spans in _by_span(system, among, most):
        # Of each time block its share e(t) of beta - beta_true, and its Q'Q.
        scores = np.array([Q[at].T @ weighted[at] for at in spans]) @ bread.T
        grams, cosine = np.array([Q[at].T @ Q[at] for at in spans]), _family(B, len(spans))
        sums = [np.tensordot(c, grams, axes=1) for c in (cosine, (cosine**2).mean(axis=0))]
        lost, kept, whole = (bread @ x for x in (*sums, grams.sum(axis=0)))
        kept, whole = ((x * bread).sum(axis=-1) for x in (kept, whole))
        share = _share(kept - (lost**2).sum(axis=-1).mean(axis=0), whole)
        each.append(deviations(scores, B) / np.sqrt(share))
        freedom += B
    return intervals_from(
        estimate, np.hypot.reduce([np.hypot.reduce(each), *estimate.stated.T]), freedom
    )


def not_below_white(estimate: Estimate, found: Intervals) -> Array:
    """Return standard errors (b,) that are not smaller than the classical ones.

    Few cosines may be small by coincidence.
    """
    return np.maximum(found.sigma, NORMAL_REACH * estimate.sigma / found.reach)


def essential_names(essential: FTest, estimate: Estimate, found: Intervals) -> tuple[str, ...]:
    """Return the essential parameters whose 95 % interval is narrower than their value."""
    certain = compress(estimate.names, found.half < np.abs(estimate.beta))
    return tuple(name for name in certain if name in essential.names)


def combined(
    system: System, estimate: Estimate, stated: Mapping[str, tuple[float, float]]
) -> Estimate:
    """Combine an estimate x by variances with given values a of some of its parameters.

        x + G (a - A x),    G = C A' (A C A' + S)⁻¹,
        C by equal-weighted cosines, S of the given values

    Parameters
    ----------
    system, estimate : as in `intervals_of`.
    stated : given value and half-width of its 95 % interval, by the name of the parameter.

    Returns
    -------
    The combined estimate. It is the estimate itself if it has no such parameter, or if it differs
    significantly from the given values (`differs`).
    """
    if not (at := [estimate.names.index(name) for name in stated if name in estimate.names]):
        return estimate
    found, names = intervals_of(system, estimate), estimate.names
    value, half = np.array([stated[names[i]] for i in at]).T
    off = value - estimate.beta[at]
    both = found.covariance[np.ix_(at, at)] + np.diag((half / found.reach) ** 2)
    if differs(off, both, found.freedom):
        return estimate
    G, kept = np.linalg.solve(both, found.covariance[at]).T, np.eye(len(names))
    kept[:, at] -= G
    moves, beta = G * (half / found.reach), estimate.beta + G @ off
    W, Y = system.weighted(estimate.weights)
    before = kept @ estimate.stated if estimate.stated.size else np.zeros((len(names), 0))
    return replace(
        estimate,
        beta=beta,
        covariance=kept @ estimate.covariance @ kept.T + moves @ moves.T,
        residual_norm=float(np.linalg.norm(Y - W @ beta)),
        bread=kept @ estimate.bread,
        stated=np.c_[before, moves],
    )


def by_rows_alone(estimate: Estimate, W: Array, Y: Array) -> Estimate:
    """Return the estimate without given values, from its weighted rows W (r, b) and Y (r,)."""
    bread = np.asarray(np.linalg.inv(estimate.Q.T @ W), dtype=float)
    return replace(estimate, beta=bread @ (estimate.Q.T @ Y), bread=bread, stated=np.zeros((0, 0)))


def differs(off: Array, covariance: Array, freedom: int) -> bool:
    """Test whether a difference (s,) with this covariance (s, s) is outside its 95 % region.

    The test is Hotelling's F.
    """
    return (
        f_tail(float(off @ np.linalg.solve(covariance, off)) / len(off), len(off), freedom)
        < 1 - LEVEL
    )


def _by_span(
    system: System, among: Bools | None = None, most: int = MAX_COSINES
) -> Iterator[tuple[int, list[Ints]]]:
    """Yield by recording its number of cosines, and the rows of each of its time blocks.

    The rows are those of all joints together. `among` is a mask of the time blocks that are used,
    `most` the limit of cosines.
    """
    order, last = np.argsort(system.span, kind="stable"), 0
    ends = np.searchsorted(system.span[order], np.arange(sum(map(len, system.spans))))
    for own in system.spans:
        first, last = last, last + len(own) - 1
        spans = np.arange(first, last)
        spans = spans if among is None else spans[among[spans]]
        if (instants := int(np.diff(own)[spans - first].sum())) > 0:
            yield cosines(instants, most), [order[ends[k] : ends[k + 1]] for k in spans]


def intervals_from(estimate: Estimate, sigma: Array, freedom: int) -> Intervals:
    """Return intervals of an estimate from standard errors `sigma` (b,), by Student's t."""
    reach = t_quantile(0.5 + LEVEL / 2, freedom)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(estimate.sigma > 0, sigma / estimate.sigma, 0.0)
    return Intervals(
        low=estimate.beta - reach * sigma,
        high=estimate.beta + reach * sigma,
        sigma=sigma,
        freedom=freedom,
        reach=reach,
        covariance=estimate.covariance * scale[:, None] * scale,
    )


def covariance_of_all(
    names: tuple[str, ...], estimate: Estimate, intervals: Intervals, full: Estimate
) -> Array:
    """Return C = D R D (b, b) of base parameters by their names.

    Parameters
    ----------
    names : (b,) base parameters.
    estimate : estimate of some of them.
    intervals : intervals of the estimate.
    full : least squares of all, whose classical standard errors the others have.
    """
    variances = dict(zip(full.names, np.diag(full.covariance), strict=True))
    covariance = np.diag([variances.get(name, 0.0) for name in names])
    at = [i for i, name in enumerate(estimate.names) if name in names]
    indices = [names.index(estimate.names[i]) for i in at]
    covariance[np.ix_(indices, indices)] = intervals.covariance[np.ix_(at, at)]
    return covariance


def changes_of(system: System, columns: Array, estimate: Estimate) -> Array:
    """Return d beta / d a (b, K) for K values a that the estimate holds: bread Q' C.

    Parameters
    ----------
    system : the rows of the estimate.
    columns : (r, K) torque C per unit of each value, not weighted.
    estimate : with its weights and factors.
    """
    return np.asarray(
        estimate.bread @ (estimate.Q.T @ (columns * estimate.weights[system.joint_of_row][:, None]))
    )


def deviations_of_sums(
    system: System, z: Array, rho: Array, Q: Array, common: Array | None = None
) -> Array:
    """Return standard errors (k,) of the sums z'e of k columns z (r, k) over the rows of a system.

    They are corrected for the noise that the estimate and the column absorb, as in `intervals_of`.

    Parameters
    ----------
    system : the rows.
    z : (r, k) columns.
    rho : (r, k) residual of e after the regression on Q and each column.
    Q : (r, b) orthonormal columns of the estimate.
    common : (r, m) orthonormal directions beside Q that all columns absorb together; None if each
        column absorbs its own.
    """
    # The direction that a column adds to Q; a column that Q spans adds none.
    own, each = z - Q @ (Q.T @ z), []
    size, whole = (np.linalg.norm(x, axis=0) for x in (own, z))
    own = np.divide(own, size, out=np.zeros_like(own), where=size > MIN_OWN * whole)
    for B, spans in _by_span(system):
        order, cuts = np.concatenate(spans), np.cumsum([0, *map(len, spans)])
        of_z, cosine = z[order], _family(B, len(spans))
        scores, squares, by_own = (
            _sums(of_z * x, cuts) for x in (rho[order], of_z, own[order] if common is None else 0.0)
        )
        lost = (cosine @ by_own) ** 2
        for basis in (Q,) if common is None else (Q, common):
            products = [
                of_z[slice(*both)].T @ basis[at]
                for both, at in zip(pairwise(cuts), spans, strict=True)
            ]
            along = np.tensordot(cosine, np.array(products), axes=1)
            lost = lost + (along**2).sum(axis=-1)
        each.append(
            deviations(scores, B)
            / np.sqrt(_share((cosine**2 @ squares - lost).mean(axis=0), squares.sum(axis=0)))
        )
    return np.asarray(np.hypot.reduce(each))


def _sums(x: Array, cuts: Ints) -> Array:
    """Return sums (K, k) of the rows of x (r, k) between the borders `cuts` (K + 1,)."""
    found, full = np.zeros((len(cuts) - 1, x.shape[1])), np.diff(cuts) > 0
    found[full] = np.add.reduceat(x, cuts[:-1][full])
    return found


def deviations(scores: Array, B: int) -> Array:
    """Return standard errors (b,) of the sums of scores (K, b), which are in order of time.

    The B cosines of lowest frequency measure them.
    """
    return np.asarray(np.sqrt(((_family(B, len(scores)) @ scores) ** 2).mean(axis=0)))


def _share(found: Array, whole: Array) -> Array:
    """Return the share (m,) of the variance of sums z'e, e white, that is left in the residuals.

        rho = (I - Q Q')e,     L = a'rho has the variance |a|² - |Q'a|²

    `found` (m,) is the variance that the cosines find, `whole` (m,) the sum of z² over all rows; a
    is a cosine times z, and for an estimate z = Q bread'. The estimate absorbs d directions of the
    noise. Regressors as slow as the cosines absorb more of it than d of r rows: on the TX40 up to a
    third of the standard error, where d/r is a fortieth.
    """
    # A recording that does not excite a parameter has no variance of it.
    share = np.divide(found, whole, out=np.ones_like(found), where=whole > 0)
    return np.asarray(np.maximum(share, MIN_VARIANCE_SHARE))


def _family(B: int, T: int) -> Array:
    """Return c_k(t) = sqrt(2) cos(pi k (t + 1/2)/T), k = 1 to B, shape (B, T)."""
    k, t = np.arange(1, B + 1)[:, None], np.arange(T)
    return np.asarray(np.sqrt(2) * np.cos(np.pi * k * (t + 0.5) / T))


def cosines(T: int, most: int = MAX_COSINES) -> int:
    """Return the number of cosines for T instants, at most `most`.

    They are enough to measure the scatter, and few enough to stay at low frequencies.
    """
    return int(np.clip(np.floor(0.4 * T ** (2 / 3)), MIN_COSINES, most))
