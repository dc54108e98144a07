"""What a set of friction terms is worth on recordings: its fit, and how well parts held out are predicted.

All sets share W: its columns are those of all terms at all joints. A part is predicted by the fit of the others; load
friction goes by the links' torque of that fit. The score of a part is the sum of squared residuals of moving rows, each
divided by its joint's s_j of the fit with the usual terms.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import (
    Estimate,
    System,
    are_moving,
    intervals,
    lag_one,
    ordinary_least_squares,
    relative_error_percent,
    t_quantile,
    weighted_least_squares,
)
from ..methods import StackedSystem, load_passes
from ..regression import Regression, base_name
from .parts import Mask, Part
from .sets import TermSet, parameters_of


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """A set of terms on recordings.

    Attributes:
        terms: by joint, beside the usual ones.
        fitted_error_percent: relative torque error of moving rows, of the fit of all of them.
        held_out_percents: (k,) the same of each part by the fit of the others; NaN where nothing moves.
        scores: (k,) by part.
        lag_one: of the fit's weighted residual; None where it is zero.
        condition_number_scaled: of its weighted W, columns of norm one.
        t: by added parameter, its value in deviations; `freedom` those of their Student's t.
        names_of_terms: the parameters of each added term.
    """

    terms: TermSet
    fitted_error_percent: float
    held_out_percents: Array
    scores: Array
    lag_one: float | None
    condition_number_scaled: float
    t: dict[str, float]
    freedom: int
    names_of_terms: tuple[tuple[str, ...], ...]

    @property
    def count(self) -> int:
        """Number of terms beside the usual ones."""
        return sum(map(len, self.terms))

    @property
    def score(self) -> float:
        """Of all parts together."""
        return float(self.scores.sum())

    @property
    def held_out_error_percent(self) -> float:
        """Mean of the parts'."""
        return float(np.nanmean(self.held_out_percents))

    def significant(self, level: float) -> bool:
        """Whether each added term has a parameter whose interval of that `level` (0.95, say) excludes 0."""
        return all(any(self.excludes_zero(name, level) for name in names) for names in self.names_of_terms)

    def excludes_zero(self, name: str, level: float) -> bool:
        """Whether the interval of a parameter does; that of load friction must lie above, no friction falls with the load."""
        t = self.t[name] if name.startswith("mu") else abs(self.t[name])
        return t > t_quantile(0.5 + level / 2, self.freedom)


class Trials:
    """Trials of sets of terms; each set is tried once."""

    def __init__(self, whole: StackedSystem, parts: Sequence[Part]) -> None:
        """`whole` is of the robot with all terms that are tried; `parts` are held out in turn."""
        self.whole, self.plain, self.parts = whole, whole.regression, parts
        self.parameters = parameters_of(whole.problem.model, whole.problem.base)
        self._names = whole.parameters.names
        self._usual = usual_columns(whole)
        self._weights = usual_estimate(whole).weights
        self._moving = are_moving(self.plain.speed)
        self._starts: dict[int, Array] = {}  # the last solution of each part: where the next set's passes start
        self._done: dict[TermSet, Trial] = {}
        self.left_out = dict(whole.left_out)

    @property
    def done(self) -> Sequence[Trial]:
        """All sets tried."""
        return tuple(self._done.values())

    def of(self, terms: TermSet) -> Trial:
        """The trial of a set, less the load friction that does not settle with it, and less what cannot be told."""
        terms = tuple(frozenset(term for term in more if (j, term) in self.parameters) for j, more in enumerate(terms))
        if terms not in self._done:
            everything = np.ones(len(self.plain.tau), dtype=bool)
            observed, estimate, unsettled = self._fit(self._columns(terms), everything, -1)
            if unsettled:
                self.left_out |= unsettled
                fewer = (more - {"load"} if f"mu{j + 1}" in unsettled else more for j, more in enumerate(terms))
                found = self.of(tuple(fewer))
                self._done[found.terms] = found
                return found
            self._done[terms] = self._judged(terms, observed, estimate)
        return self._done[terms]

    def held_out_percents(self, terms: TermSet, parts: Sequence[Part]) -> Array:
        """Relative error, percent, of the moving rows of each part by the fit of the other rows."""
        return np.array([self._held_out(terms, part, -2 - k)[1] for k, part in enumerate(parts)])

    def _judged(self, terms: TermSet, observed: Regression, estimate: Estimate) -> Trial:
        held = [self._held_out(terms, part, k) for k, part in enumerate(self.parts)]
        rho = self._residual(observed, estimate)
        error = relative_error_percent(self.plain.tau[self._moving], rho[self._moving])
        weighted = rho * self._weights * self.plain.fast
        W, _ = observed.system.with_columns(self._columns(terms)).weighted(self._weights)
        Q = W @ estimate.bread  # W bread has orthonormal columns: bread breadᵀ = (WᵀW)⁻¹
        found = intervals(replace(estimate, Q=Q), weighted.T.reshape(-1), self.plain.tau.shape[1], self.plain.parts)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.nan_to_num(estimate.beta / found.sigma, nan=0.0)
        usual = {self._names[i] for i in np.flatnonzero(self._usual)}
        return Trial(
            terms=terms,
            fitted_error_percent=float("nan") if error is None else error,
            held_out_percents=np.array([percent for _, percent in held]),
            scores=np.array([score for score, _ in held]),
            lag_one=lag_one(weighted),
            condition_number_scaled=estimate.condition_number_scaled,
            t={name: float(x) for name, x in zip(estimate.names, t, strict=True) if name not in usual},
            freedom=found.freedom,
            names_of_terms=tuple(self.parameters[j, term] for j, more in enumerate(terms) for term in more),
        )

    def _held_out(self, terms: TermSet, part: Part, start: int) -> tuple[float, float]:
        """Score and relative error in percent of the rows of a part, by the fit of the others."""
        columns = self._columns(terms)
        observed, estimate, _ = self._fit(columns[~part.own[columns]], ~part.rows, start)
        moving = self._moving & part.rows[:, None]
        rho = self._residual(observed, estimate)
        if part.own.any():
            rho = self._less_own(observed, rho, part)
        percent = relative_error_percent(self.plain.tau[moving], rho[moving])
        score = float(((rho * self._weights)[moving] ** 2).sum())
        return score, float("nan") if percent is None else percent

    def _residual(self, observed: Regression, estimate: Estimate) -> Array:
        """(T, n) of all rows."""
        return np.asarray(observed.tau - observed.predicted(estimate.among(self._names)))

    def _less_own(self, observed: Regression, rho: Array, part: Part) -> Array:
        """Residuals (T, n) less what a part's own parameters, fitted to those of its rows, say of them."""
        counts = (self.plain.fast & part.rows[:, None]).T.reshape(-1).astype(float)
        system = replace(observed.system, Y=rho.T.reshape(-1)).with_rows(counts).with_columns(np.flatnonzero(part.own))
        own = np.linalg.lstsq(*system.weighted(self._weights))[0]
        return np.asarray((system.Y - system.W @ own).reshape(rho.shape[1], -1).T)

    def _columns(self, terms: TermSet) -> NDArray[np.intp]:
        names = {name for j, more in enumerate(terms) for term in more for name in self.parameters[j, term]}
        return np.flatnonzero(self._usual | np.isin(self._names, list(names)))

    def _fit(self, columns: NDArray[np.intp], rows: Mask, start: int) -> tuple[Regression, Estimate, dict[str, str]]:
        """Least squares of some parameters in the rows (T,), and which load friction did not settle."""
        used, whole = (self.plain.fast & rows[:, None]).T.reshape(-1).astype(float), self.whole
        settling = [whole.problem.base.names.index(base_name(self._names[i])) for i in columns]
        load = whole.load and whole.load.of(settling)

        def solve(observed: Regression, kept: NDArray[np.intp] = columns) -> Estimate:
            return ordinary_least_squares(_factor(observed.system.with_rows(used).with_columns(kept), self._weights))

        beta = self._starts.get(start)
        if beta is None:
            beta = solve(self.plain, np.setdiff1d(columns, whole.load_places(load))).among(self._names)
        without_others = np.where(np.isin(np.arange(len(beta)), columns), beta, 0.0)
        observed, estimate, unsettled = load_passes(whole, solve, without_others, load)
        self._starts[start] = estimate.among(self._names)
        return observed.regression, estimate, unsettled


def usual_columns(whole: StackedSystem) -> Mask:
    """(b,) which parameters are of the usual terms, not of those that are tried."""
    tried = parameters_of(whole.problem.model, whole.problem.base).values()
    return ~np.isin(whole.parameters.names, [name for names in tried for name in names])


def usual_estimate(whole: StackedSystem) -> Estimate:
    """Weighted least squares of the usual terms."""
    return weighted_least_squares(whole.regression.system.with_columns(np.flatnonzero(usual_columns(whole))))


def _factor(system: System, weights: Array) -> System:
    """The QR factor of the weighted rows, which has the same least squares: as many rows as columns, and one."""
    W, Y = system.weighted(weights)
    counted = int(system.rows.sum())
    if counted <= W.shape[1]:
        expected = f"more than {W.shape[1]} parameters"
        raise IdentificationError(key="rows outside a part", value=counted, expected=expected)
    R = np.asarray(np.linalg.qr(np.c_[W, Y], mode="r"))
    zeros = np.zeros(len(R), dtype=np.intp)
    return System(
        W=R[:, :-1], Y=R[:, -1], joint_of_row=zeros, names=system.names, used=np.ones(len(R)), rows=np.array([counted])
    )
