"""The search for the best reference: sequential quadratic programming on the coefficients of the series (SLSQP).

Kraft, A software package for sequential quadratic programming, DFVLR-FB 88-28 (1988), as scipy has it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from .information import Information
from .limits import Limits
from .series import Motion, Series, motion_of

SAMPLES_PER_PERIOD = 15  # of the highest harmonic
WINDOW = 3  # samples that a search looks at the largest share of
FINER = 10  # times as many samples check what lies between those of the search
ITERATIONS = 50  # of a search
ROUNDS = 10  # that a search among obstacles has these iterations in
TOLERANCE = 1e-6  # of the criterion, and by which a share may be above 1
BISECTIONS = 10


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """What is searched: a series of which a criterion is least within limits.

    Attributes:
        plain: (b,) deviations that the criterion is relative to.
    """

    series: Series
    information: Information
    limits: Limits
    plain: Array

    @property
    def samples(self) -> int:
        """Of a period, in the search."""
        return SAMPLES_PER_PERIOD * self.series.harmonics


def best_series(problem: Problem, start: Array, say: Callable[[float], None]) -> Array:
    """Coefficients x (n, K) of least criterion; limits are kept at the samples of the search, or as nearly as can be.

    Parameters
    ----------
    problem : the criterion and the limits.
    start : (n, K) coefficients to start from.
    say : called with the criterion after each iteration.
    """
    from scipy.optimize import minimize

    basis, limits = problem.series.basis(problem.samples), problem.limits
    # A coefficient of 1 takes its joint to the first limit: all have like effects then.
    peaks = np.array([np.abs(A).max(axis=0) for A in basis])
    unit = 1 / (peaks[:, None] / limits.most[..., None]).max(axis=0)

    def at(z: Array) -> Motion:
        return motion_of(z.reshape(unit.shape) * unit, basis)

    value = np.inf

    def objective(z: Array) -> tuple[float, Array]:
        nonlocal value
        value, gradients = problem.information.criterion(at(z), problem.plain)
        by_x = sum((g.T @ A for g, A in zip(gradients, basis, strict=True)), start=np.zeros(unit.shape))
        return value, (by_x * unit).ravel()

    last: tuple[Array, Array, Array, NDArray[np.intp]] | None = None  # coefficients, used, slopes, samples of the peaks

    def at_last(z: Array) -> tuple[Array, Array, NDArray[np.intp]]:
        nonlocal last
        if last is None or not np.array_equal(last[0], z):
            used, slopes = limits.used_and_slopes(at(z))
            last = z.copy(), used, slopes, _peaks(used)
        return last[1:]

    def slack(z: Array) -> Array:
        used, _, peaks = at_last(z)
        return np.asarray(1 - np.abs(np.take_along_axis(used, peaks, axis=0)).ravel())

    def slack_slopes(z: Array) -> Array:
        used, slopes, peaks = at_last(z)
        signs = np.sign(np.take_along_axis(used, peaks, axis=0)).ravel()
        return np.asarray(-signs[:, None] * limits.jacobian(slopes, basis, peaks) * unit.ravel())

    def from_there(x: Array, iterations: int) -> Array:
        done = minimize(
            objective,
            (x / unit).ravel(),
            jac=True,
            method="SLSQP",
            constraints={"type": "ineq", "fun": slack, "jac": slack_slopes},
            options={"maxiter": iterations, "ftol": TOLERANCE},
            callback=lambda z: say(value),
        )
        return np.asarray(done.x.reshape(unit.shape) * unit)

    if not limits.checks_distance:
        return from_there(start, ITERATIONS)
    # Distances are not convex: after a few iterations back to what keeps all limits, on the way from where they did.
    x = start
    for _ in range(ROUNDS):
        x, _ = shrunk(from_there(x, ITERATIONS // ROUNDS), problem.series, limits, problem.samples, x)
    return x


def shrunk(x: Array, series: Series, limits: Limits, samples: int, towards: Array | None = None) -> tuple[Array, float]:
    """A series moved towards another until it keeps all limits at so many samples of a period.

    Parameters
    ----------
    x : (n, K) its coefficients.
    series, limits, samples : what they are of, what is kept, and at how many samples.
    towards : (n, K) the other; None for rest at its own position at the ends.

    Returns
    -------
    Coefficients x (n, K), and the largest share used of a limit: above 1 where the other leaves one too.
    """
    basis, still = series.basis(samples), x.copy()
    still[:, 1:] = 0.0
    if towards is not None:
        still = towards

    def most(scale: float) -> float:
        return limits.most_used(motion_of(still + scale * (x - still), basis))

    low, high = 0.0, 1.0
    if most(1.0) <= 1.0:
        low = 1.0
    else:
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            low, high = (middle, high) if most(middle) <= 1.0 else (low, middle)
    return still + low * (x - still), most(low)


def _peaks(used: Array) -> NDArray[np.intp]:
    """Samples (N / WINDOW, L) at which each limit is used most, of each window of the samples (N, L)."""
    windows = np.abs(used).reshape(-1, WINDOW, used.shape[1])
    return np.asarray(windows.argmax(axis=1) + WINDOW * np.arange(len(windows))[:, None])
