"""The search for the best reference: sequential quadratic programming on the coefficients of the series (SLSQP).

Kraft, A software package for sequential quadratic programming, DFVLR-FB 88-28 (1988), as scipy has it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from acquisition.trajectory import FourierReference, fourier_reference

from ..arrays import Array
from ..errors import IdentificationError
from .information import Information
from .limits import Limits
from .series import Motion, Series, motion_of

SAMPLES_PER_PERIOD = 15  # of the highest harmonic
WINDOW = 3  # samples that a search looks at the largest share of
FINER = 10  # times as many samples check what lies between those of the search
STARTS = 3  # from random references of other seeds
FIRST_SEED = 20  # of these: those before are of plain references
START_SHARE = 0.9  # of the limits, which a search starts within
POSES = 200  # of which the one with most room is started from
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


def best_of_searches(problem: Problem, seed: int, place: str, say: Callable[[str], None]) -> tuple[Array, Array]:
    """Coefficients (n, K) of the best of several searches that keeps the limits between samples too, and deviations (b,).

    Parameters
    ----------
    problem : the criterion and the limits.
    seed : of the random references that they start from.
    place : the name of the description in errors.
    say : called with a line of text as a search goes on.

    Raises
    ------
    IdentificationError : where no search keeps the limits.
    """
    best: tuple[float, Array, Array] | None = None
    worst = ""
    basis = problem.series.basis(problem.samples)
    for i in range(STARTS):
        text = f"search {i + 1} of {STARTS}"
        say(text)
        try:
            start = _start(problem, STARTS * seed + i)
            x = best_series(problem, start, partial(_tell, say, text))
            x, most = shrunk(x, problem.series, problem.limits, FINER * problem.samples)
            if most > 1 + TOLERANCE:
                used = np.abs(problem.limits.used(motion_of(x, basis))).max(axis=0)
                worst = f"{problem.limits.names[int(used.argmax())]} is left by {100 * (most - 1):.3g} %"
                continue
            sigma = problem.information.sigma(motion_of(x, basis))
        except IdentificationError as error:  # it strayed to where nothing is excited
            worst = str(error)
            continue
        f = float(np.mean((sigma / problem.plain) ** 2))
        if best is None or f < best[0]:
            best = f, x, sigma
    if best is None:
        raise IdentificationError(
            f"no reference keeps the limits: {worst}",
            place=place,
            expected="wider limits, another --seed or --harmonics",
        )
    return best[1], best[2]


def random_within(limits: Limits, series: Series, seed: int) -> FourierReference:
    """A random reference that uses the same share of all limits, torque too; distances of links are not looked at."""
    robot, limits = limits.robot, replace(limits, obstacles=None)
    found = fourier_reference(
        robot, period_s=series.period_s, seed=seed, harmonics=series.harmonics, share=limits.share
    )
    x, _ = shrunk(series.coefficients(found), series, limits, SAMPLES_PER_PERIOD * series.harmonics)
    return series.reference(x)


def _start(problem: Problem, seed: int) -> Array:
    """Coefficients (n, K) of a random reference within a share of the limits, its links as far apart as may be."""
    limits, series = problem.limits, problem.series
    x = START_SHARE * series.coefficients(random_within(limits, series, FIRST_SEED + seed))
    x[:, 0] /= START_SHARE
    if limits.checks_distance:
        x[:, 0] = _roomiest(limits, seed)
        x, _ = shrunk(x, series, limits, problem.samples)
    return x


def _roomiest(limits: Limits, seed: int) -> Array:
    """Of random poses (n,) about the middle of the ranges that may be used, the one whose links are farthest apart."""
    poses = limits.middle + np.random.default_rng(seed).uniform(-0.5, 0.5, (POSES, limits.robot.n)) * limits.most[0]
    still = np.zeros(poses.shape)
    used = np.abs(limits.used((poses, still, still)))
    return np.asarray(poses[int(used.max(axis=1).argmin())])


def _tell(say: Callable[[str], None], text: str, criterion: float) -> None:
    say(f"{text}: deviations {math.exp(criterion / 2):.2f} times those of the plain reference")


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
