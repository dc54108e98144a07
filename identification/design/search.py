"""The search for the best reference: sequential quadratic programming on the coefficients of the series (SLSQP).

Kraft, A software package for sequential quadratic programming, DFVLR-FB 88-28 (1988), as scipy has it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from acquisition.robot import FourierReference, fourier_reference

from ..arrays import Array
from ..errors import IdentificationError
from .information import Information
from .limits import FAR_M, MARGIN_M, Limits, Motion, Series, motion_of

SAMPLES_PER_PERIOD = 15  # of the highest harmonic
WINDOW = 3  # samples that a search looks at the largest share of
FINER = 10  # times as many samples check what lies between those of the search
# A sum of harmonics is above its largest sample by (pi / samples of a period of the highest)² / 2 at most (Bernstein).
ALL = 1 - (math.pi / (FINER * SAMPLES_PER_PERIOD)) ** 2 / 2
STARTS = 3  # from random references of other seeds
FIRST_SEED = 20  # of these: those before are of plain references
MAX_DEVIATION_RATIO = 1 / 0.95  # of a deviation over that of the plain reference
START_SHARE = 0.9  # of the limits, which a search starts within
POSES = 200  # of which the one with most room is started from
ITERATIONS = 50  # of a search
POLISHING = 10  # iterations more, with what limits are left by between the samples
LEAST_TIGHTENED = 0.5  # shares below are not looked at between the samples
TOLERANCE = 1e-6  # of the criterion, and by which a share may be above 1
BISECTIONS = 10


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchProblem:
    """What is searched: a series of which a criterion, relative to the deviations `plain` (b,), is least within limits."""

    series: Series
    information: Information
    limits: Limits
    plain: Array

    @property
    def samples(self) -> int:
        """Of a period, in the search."""
        return SAMPLES_PER_PERIOD * self.series.harmonics


def best_of_searches(problem: SearchProblem, seed: int, place: str, say: Callable[[str], None]) -> tuple[Array, Array]:
    """Coefficients (n, K) of the best of several searches that keeps the limits between samples too, and deviations (b,).

    The best has the least criterion; one that makes no deviation larger than
    `MAX_DEVIATION_RATIO` times the plain one goes before others.
    `say` is called with a line of text as a search goes on; an `IdentificationError` where no search keeps the limits.
    """
    best: tuple[tuple[bool, float], Array, Array] | None = None
    worst = ""
    basis, finer = (problem.series.basis(times * problem.samples) for times in (1, FINER))
    for i in range(STARTS):
        text = f"search {i + 1} of {STARTS}"
        say(text)
        try:
            start = _start(problem, STARTS * seed + i)
            x = best_series(problem, start, partial(_say_criterion, say, text))
            fine = motion_of(x, finer)
            most, name = problem.limits.largest(fine)
            if most > 1 + TOLERANCE:
                worst = f"{name} is left by {100 * (most - 1):.3g} %"
                continue
            sigma = problem.information.sigma(motion_of(x, basis))
        except IdentificationError as error:  # it strayed to where nothing is excited
            worst = str(error)
            continue
        ratios = sigma / problem.plain
        found = (bool(ratios.max() > MAX_DEVIATION_RATIO), float(np.mean(ratios**2))), x, sigma
        if best is None or found[0] < best[0]:
            best = found
    if best is None:
        expected = "wider limits, another --seed or --harmonics"
        raise IdentificationError(f"no reference keeps the limits: {worst}", place=place, expected=expected)
    return best[1], best[2]


def random_within(limits: Limits, series: Series, seed: int) -> FourierReference:
    """A random reference that uses the same share of all limits, torque too; distances of links are not looked at."""
    robot, limits = limits.robot, replace(limits, obstacles=None)
    found = fourier_reference(
        robot, period_s=series.period_s, seed=seed, harmonics=series.harmonics, share=limits.share
    )
    x, _ = shrunk(series.coefficients(found), series, limits, SAMPLES_PER_PERIOD * series.harmonics)
    return series.reference(x)


def _start(problem: SearchProblem, seed: int) -> Array:
    """Coefficients (n, K) of a random reference within a share of the limits, its links as far apart as may be."""
    limits, series = problem.limits, problem.series
    x = START_SHARE * series.coefficients(random_within(limits, series, FIRST_SEED + seed))
    x[:, 0] /= START_SHARE
    if limits.obstacles is not None:
        x[:, 0] = _roomiest(limits, seed)
    return shrunk(x, series, limits, FINER * problem.samples, share=ALL)[0]


def _roomiest(limits: Limits, seed: int) -> Array:
    """Of random poses (n,) about the middle of the ranges that may be used, the one whose links are farthest apart."""
    poses = limits.middle + np.random.default_rng(seed).uniform(-0.5, 0.5, (POSES, limits.robot.n)) * limits.most[0]
    still = np.zeros(poses.shape)
    used = np.abs(limits.used((poses, still, still))).max(axis=1)
    return np.asarray(poses[int(np.maximum(used, limits.nearness(poses, FAR_M + MARGIN_M)).argmin())])


def _say_criterion(say: Callable[[str], None], text: str, criterion: float) -> None:
    say(f"{text}: deviations {math.exp(criterion / 2):.2f} times those of the plain reference")


def best_series(problem: SearchProblem, start: Array, say: Callable[[float], None]) -> Array:
    """Coefficients x (n, K) of least criterion; limits are kept between the samples too, or as nearly as can be.

    The search knows nothing of distances: what it finds is moved towards `start`, which keeps all limits, until it keeps
    them. `say` is called with the criterion after each iteration.
    """
    search, limits, between = _Search(problem, say), problem.limits, FINER * problem.samples
    x = search.from_there(start, ITERATIONS)
    search.tighten(x)
    safe, _ = shrunk(x, problem.series, limits, between, start, ALL)
    return shrunk(search.from_there(x, POLISHING), problem.series, limits, between, safe, ALL)[0]


class _Search:
    """The criterion and the limits as functions of the coefficients z (n K,), in units in which all have like effects."""

    def __init__(self, problem: SearchProblem, say: Callable[[float], None]) -> None:
        self._problem, self._say, self._basis = problem, say, problem.series.basis(problem.samples)
        self._value = math.inf
        # A coefficient of 1 takes its joint to the first limit.
        peaks = np.array([np.abs(A).max(axis=0) for A in self._basis])
        self._unit = 1 / (peaks[:, None] / problem.limits.most[..., None]).max(axis=0)
        self._tight = np.ones(len(problem.limits.names))  # (L,) shares at the samples count by so much
        self._last: tuple[Array, Array, Array, NDArray[np.intp]] | None = None

    def from_there(self, x: Array, iterations: int) -> Array:
        """Coefficients (n, K) after some iterations from others."""
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
        """From now on count shares at the samples by what those of a series (n, K) rise between them."""
        finer = self._problem.series.basis(FINER * self._problem.samples)
        coarse, fine = (np.abs(self._problem.limits.used(motion_of(x, b))).max(axis=0) for b in (self._basis, finer))
        self._tight = np.maximum(fine, LEAST_TIGHTENED) / np.maximum(coarse, LEAST_TIGHTENED)

    def _at(self, z: Array) -> Motion:
        return motion_of(z.reshape(self._unit.shape) * self._unit, self._basis)

    def _objective(self, z: Array) -> tuple[float, Array]:
        self._value, gradients = self._problem.information.criterion(self._at(z), self._problem.plain)
        by_x = sum((g.T @ A for g, A in zip(gradients, self._basis, strict=True)), start=np.zeros(self._unit.shape))
        return self._value, (by_x * self._unit).ravel()

    def _at_last(self, z: Array) -> tuple[Array, Array, NDArray[np.intp]]:
        """Shares, their slopes, and the samples of their peaks, of the coefficients looked at last."""
        if self._last is None or not np.array_equal(self._last[0], z):
            used, slopes = self._problem.limits.used_and_slopes(self._at(z))
            self._last = z.copy(), used, slopes, _peaks(used)
        return self._last[1:]

    def _slack(self, z: Array) -> Array:
        used, _, peaks = self._at_last(z)
        return np.asarray(1 - (self._tight * np.abs(np.take_along_axis(used, peaks, axis=0))).ravel())

    def _slack_slopes(self, z: Array) -> Array:
        used, slopes, peaks = self._at_last(z)
        signs = (self._tight * np.sign(np.take_along_axis(used, peaks, axis=0))).ravel()
        J = self._problem.limits.jacobian(slopes, self._basis, peaks)
        return np.asarray(-signs[:, None] * J * self._unit.ravel())


def _peaks(used: Array) -> NDArray[np.intp]:
    """Samples (N / WINDOW, L) at which each limit is used most, of each window of the samples (N, L)."""
    windows = np.abs(used).reshape(-1, WINDOW, used.shape[1])
    return np.asarray(windows.argmax(axis=1) + WINDOW * np.arange(len(windows))[:, None])


def shrunk(
    x: Array, series: Series, limits: Limits, samples: int, towards: Array | None = None, share: float = 1.0
) -> tuple[Array, float]:
    """A series moved towards another until it keeps a share of all limits at so many samples of a period.

    `towards` is by default rest at its own position at the ends. Returns coefficients (n, K), and the largest share used of a
    limit: above `share` where the other leaves it too.
    """
    basis, still = series.basis(samples), x.copy()
    still[:, 1:] = 0.0
    if towards is not None:
        still = towards

    def most(scale: float) -> float:
        return limits.largest(motion_of(still + scale * (x - still), basis))[0]

    low, high = 0.0, 1.0
    if most(1.0) <= share:
        low = 1.0
    else:
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            low, high = (middle, high) if most(middle) <= share else (low, middle)
    return still + low * (x - still), most(low)
