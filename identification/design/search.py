"""The search for the best reference by sequential quadratic programming (SLSQP).

Its unknowns are the coefficients of the Fourier series. The algorithm is that of Kraft, A software
package for sequential quadratic programming, DFVLR-FB 88-28 (1988), in scipy.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from acquisition.robot import FourierReference, fourier_reference

from ..arrays import Array, Ints
from ..errors import NoFitError
from ..model import Obstacles
from .information import Information
from .limits import Limits, Motion, Series, motion_of

SAMPLES_PER_PERIOD = 15  # of the highest harmonic
# One constraint per window of samples, on its largest share, is enough and three times faster.
SAMPLES_PER_WINDOW = 3
CHECKS_PER_SAMPLE = 10  # samples that check the result, per sample of the search
# By Bernstein's inequality a sum of harmonics exceeds its largest sample by at most the share
# (pi / samples per period of the highest harmonic)² / 2.
MAX_SHARE = 1 - (math.pi / (CHECKS_PER_SAMPLE * SAMPLES_PER_PERIOD)) ** 2 / 2
STARTS = 3  # searches, each from a random reference of its own seed
FIRST_SEED = 20  # of the starts, because smaller seeds are those of the plain references
# No parameter should become clearly worse than with a plain reference.
MAX_DEVIATION_RATIO = 1 / 0.95
START_SHARE = 0.9  # of the limits, at the start of a search
# Of the position range, at the ends of the period. From its edge, `shrink` would end at rest.
MAX_END_SHARE = 0.99
MARGIN_M = 0.02  # smallest distance of links from each other and from the ground, m
START_POSES = 200  # random poses, of which a search starts at the one with the largest distance
MAX_ITERATIONS = 50  # of a search
# These iterations follow, with limits tightened by how much the motion rises between samples.
POLISHING_ITERATIONS = 10
MIN_TIGHTENED_SHARE = 0.5  # smaller shares are too far from their limit to exceed it
TOLERANCE = 1e-6  # of the criterion, and of shares above 1
BISECTIONS = 10


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchProblem:
    """Minimisation of the criterion of a series within the limits.

    Attributes:
        series: the series.
        information: information of a motion about the parameters.
        limits: limits of the motion.
        plain: standard errors with plain references, shape (b,), to which the criterion is
            relative.
        obstacles: pairs of links that keep a margin, or None. A search starts where they are far
            apart, and its result is moved towards the start until they keep the margin.
        quick: one short search, which shows roughly what to expect of the whole one.
    """

    series: Series
    information: Information
    limits: Limits
    plain: Array
    obstacles: Obstacles | None = None
    quick: bool = False

    @cached_property
    def basis(self) -> Motion:
        """Basis of the series at the samples of the search."""
        return self.series.basis(SAMPLES_PER_PERIOD * self.series.harmonics)

    @cached_property
    def finer(self) -> Motion:
        """Basis of the series at more samples, which check the results of a search."""
        return self.series.basis(CHECKS_PER_SAMPLE * SAMPLES_PER_PERIOD * self.series.harmonics)


def best_of_searches(
    problem: SearchProblem, seed: int, place: str, say: Callable[[str], None]
) -> tuple[Array, Array]:
    """Return the best of several searches.

    Limits hold between the samples too. Searches in which no standard error exceeds
    `MAX_DEVIATION_RATIO` times the plain one come first; then the smallest criterion counts.

    Parameters
    ----------
    problem : the problem.
    seed : seed of the random starts.
    place : name of the description in errors.
    say : called with a line of text at each iteration.

    Returns
    -------
    Coefficients, shape (n, K), and standard errors, shape (b,).

    Raises
    ------
    NoFitError : no search keeps the limits.
    """
    found, worst = list[tuple[bool, float, Array, Array]](), ""
    for i in range(1 if problem.quick else STARTS):
        text = f"search {i + 1} of {STARTS}"
        say(text)
        try:
            x = best_series(
                problem,
                _random_start(problem, STARTS * seed + i),
                partial(_say_criterion, say, text),
            )
            most, name = problem.limits.largest(motion_of(x, problem.finer))
            if most > 1 + TOLERANCE:
                raise NoFitError(f"{name} exceeds its limit by {100 * (most - 1):.3g} %")
            sigma = problem.information.sigma(motion_of(x, problem.basis))
        except NoFitError as error:
            worst = str(error)
        else:
            ratios = sigma / problem.plain
            is_worse = bool(ratios.max() > MAX_DEVIATION_RATIO)
            found.append((is_worse, float(np.mean(ratios**2)), x, sigma))
    if not found:
        raise NoFitError(
            f"no reference keeps the limits: {worst}",
            place=place,
            advice="Widen the limits, or change the seed or the harmonics",
            arguments=("seed", "harmonics"),
        )
    return min(found, key=lambda one: one[:2])[2:]


def random_within(limits: Limits, series: Series, seed: int) -> FourierReference:
    """Return a random reference that uses its share of a limit, torque limits included.

    Distances of links are not checked.

    Parameters
    ----------
    limits : limits of the robot.
    series : the series.
    seed : seed of the random coefficients.
    """
    reference = fourier_reference(
        limits.robot,
        period_s=series.period_s,
        seed=seed,
        harmonics=series.harmonics,
        share=limits.share,
    )
    basis = series.basis(SAMPLES_PER_PERIOD * series.harmonics)
    return series.reference(shrink(series.coefficients(reference), basis, limits))


def _random_start(problem: SearchProblem, seed: int) -> Array:
    """Return the coefficients of a random reference within a share of the limits, shape (n, K)."""
    limits, series = problem.limits, problem.series
    x = START_SHARE * series.coefficients(random_within(limits, series, FIRST_SEED + seed))
    x[:, 0] = np.clip(
        x[:, 0] / START_SHARE,
        *(limits.middle + side * MAX_END_SHARE * limits.maximum[0] for side in (-1, 1)),
    )
    if problem.obstacles is not None:
        x[:, 0] = _roomiest_pose(problem.obstacles, limits, seed)
    return shrink(
        x,
        problem.finer,
        limits,
        share=MAX_SHARE,
        obstacles=problem.obstacles,
    )


def _roomiest_pose(obstacles: Obstacles, limits: Limits, seed: int) -> Array:
    """Return the random pose of rest in which links are farthest apart, shape (n,).

    The poses are near the middle of the usable ranges, and the robot can rest in them.
    """
    offsets = np.random.default_rng(seed).uniform(-0.5, 0.5, (START_POSES, limits.robot.n))
    poses, still = limits.middle + offsets * limits.maximum[0], np.zeros(offsets.shape)
    possible = np.abs(limits.shares((poses, still, still))).max(axis=1) <= 1
    room = np.where(possible, obstacles.distances(poses).min(axis=1), -np.inf)
    best: Array = poses[int(room.argmax())]
    if room.max() < MARGIN_M:
        distance, pair = obstacles.nearest(best[None])
        raise NoFitError(f"{pair} are {distance:.3f} m apart at rest")
    return best


def _say_criterion(say: Callable[[str], None], text: str, criterion: float) -> None:
    say(f"{text}: standard errors {math.exp(criterion / 2):.2f} times those of a plain reference")


def best_series(problem: SearchProblem, start: Array, say: Callable[[float], None]) -> Array:
    """Return the coefficients of the smallest criterion, shape (n, K).

    Limits hold between the samples too, as far as possible. The search ignores distances: its
    result is moved towards `start`, which keeps all limits and distances, until it keeps them too.

    Parameters
    ----------
    problem : the problem.
    start : coefficients at which the search starts, shape (n, K).
    say : called with the criterion after each iteration.
    """
    search = _Search(problem, say)
    kept = partial(
        shrink,
        basis=problem.finer,
        limits=problem.limits,
        share=MAX_SHARE,
        obstacles=problem.obstacles,
    )
    x = search.minimise(start, POLISHING_ITERATIONS if problem.quick else MAX_ITERATIONS)
    search.tighten(x)
    return kept(search.minimise(x, POLISHING_ITERATIONS), towards=kept(x, towards=start))


class _Search:
    """Criterion and limits as functions of scaled coefficients z, shape (n K,).

    The scaling gives all coefficients similar effects.
    """

    def __init__(self, problem: SearchProblem, say: Callable[[float], None]) -> None:
        self._problem, self._say, self._basis = problem, say, problem.basis
        self._value = math.inf
        # Coefficients have different units and effects. In this unit a coefficient of 1 alone takes
        # its joint to its first limit, which gives the search a well-conditioned problem.
        peaks = np.array([np.abs(A).max(axis=0) for A in self._basis])
        self._unit = 1 / (peaks[:, None] / problem.limits.maximum[..., None]).max(axis=0)
        # Factors (L,) of the shares at the samples, greater than 1 after `tighten`.
        self._tight = np.ones(len(problem.limits.names))
        self._last: tuple[Array, Array, Array, Ints] | None = None

    def minimise(self, x: Array, iterations: int) -> Array:
        """Return the coefficients, shape (n, K), after at most so many `iterations` from x."""
        from scipy.optimize import minimize

        done = minimize(
            self._objective,
            (x / self._unit).ravel(),
            jac=True,
            method="SLSQP",
            constraints={"type": "ineq", "fun": self._slack, "jac": self._slack_slopes},
            options={"maxiter": iterations, "ftol": TOLERANCE},
            callback=lambda z: self._say(self._value),
        )
        return np.asarray(done.x.reshape(self._unit.shape) * self._unit)

    def tighten(self, x: Array) -> None:
        """Scale the shares at the samples by how much those of x, (n, K), rise between samples."""
        coarse, fine = (
            np.abs(self._problem.limits.shares(motion_of(x, basis))).max(axis=0)
            for basis in (self._basis, self._problem.finer)
        )
        self._tight = np.maximum(fine, MIN_TIGHTENED_SHARE) / np.maximum(
            coarse, MIN_TIGHTENED_SHARE
        )

    def _motion_at(self, z: Array) -> Motion:
        return motion_of(z.reshape(self._unit.shape) * self._unit, self._basis)

    def _objective(self, z: Array) -> tuple[float, Array]:
        self._value, gradients = self._problem.information.criterion(
            self._motion_at(z), self._problem.plain
        )
        by_x = sum(
            (g.T @ A for g, A in zip(gradients, self._basis, strict=True)),
            start=np.zeros(self._unit.shape),
        )
        return self._value, (by_x * self._unit).ravel()

    def _shares_at(self, z: Array) -> tuple[Array, Array, Ints]:
        """Return the shares, their slopes, and the samples of their peaks.

        The values of the last z are cached, because the slack and its slopes both need them.
        """
        if self._last is None or not np.array_equal(self._last[0], z):
            shares, slopes = self._problem.limits.shares_and_slopes(self._motion_at(z))
            windows = np.abs(shares).reshape(-1, SAMPLES_PER_WINDOW, shares.shape[1])
            peaks = windows.argmax(axis=1) + SAMPLES_PER_WINDOW * np.arange(len(windows))[:, None]
            # Each window constrains only the sample that uses a limit most.
            self._last = z.copy(), shares, slopes, peaks
        return self._last[1:]

    def _slack(self, z: Array) -> Array:
        shares, _, peaks = self._shares_at(z)
        return np.asarray(
            1 - (self._tight * np.abs(np.take_along_axis(shares, peaks, axis=0))).ravel()
        )

    def _slack_slopes(self, z: Array) -> Array:
        shares, slopes, peaks = self._shares_at(z)
        signs = (self._tight * np.sign(np.take_along_axis(shares, peaks, axis=0))).ravel()
        return np.asarray(
            -signs[:, None]
            * self._problem.limits.jacobian(slopes, self._basis, peaks)
            * self._unit.ravel()
        )


def shrink(
    x: Array,
    basis: Motion,
    limits: Limits,
    towards: Array | None = None,
    share: float = 1.0,
    obstacles: Obstacles | None = None,
) -> Array:
    """Move a series towards another one until it keeps a share of all limits.

    Parameters
    ----------
    x : coefficients, shape (n, K).
    basis : basis of the series at the samples at which limits are checked, shape (N, K) each.
    limits : limits of the robot.
    towards : coefficients of the other series, shape (n, K). Default: rest at the end position.
    share : share of the limits to be kept.
    obstacles : pairs of links that keep a margin, or None.

    Returns
    -------
    Coefficients, shape (n, K). They exceed `share` if those of `towards` do.
    """
    still = np.c_[x[:, :1], np.zeros_like(x[:, 1:])] if towards is None else towards

    def largest_share(scale: float) -> float:
        motion = motion_of(still + scale * (x - still), basis)
        used = limits.largest(motion)[0]
        near = (
            used <= share and obstacles is not None and obstacles.nearest(motion[0])[0] < MARGIN_M
        )
        return math.inf if near else used

    low, high = 0.0, 1.0
    if largest_share(1.0) <= share:
        low = 1.0
    else:
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            low, high = (middle, high) if largest_share(middle) <= share else (low, middle)
    return still + low * (x - still)
