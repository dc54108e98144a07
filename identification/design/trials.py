"""Trials of sets of friction terms on recordings: the fit of each, and the error of predicting parts held out.

All sets share W, which has columns of all terms at all joints. A part is a fifth of one recording, or one of several; the fit
of the others predicts it (load friction with the links' torque of that fit). The score of a part is the sum of squared
residuals of moving rows, each divided by its joint's s_j of the fit with the usual terms.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import msgspec
import numpy as np
from numpy.typing import NDArray

from acquisition.robot import FrictionTerm, Joint, Robot

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import (
    Estimate,
    System,
    are_moving,
    autocorrelation,
    intervals,
    ordinary_least_squares,
    relative_error_percent,
    t_quantile,
    undetermined_parameters,
    weighted_least_squares,
)
from ..methods import StackedSystem, load_passes
from ..model import BaseParameters, InverseModel, JointTerm
from ..regression import Regression, base_name

FIFTHS = 5  # parts of a single recording
FALSE_TERM_RATE = 0.05  # share of recordings that show a term by chance, without having any
MIN_PARTS = 2  # fewer have no standard error of their mean
BASELINE: tuple[FrictionTerm, ...] = ("viscous", "coulomb", "offset")
CANDIDATES: tuple[FrictionTerm, ...] = (
    "asymmetric",
    "root",
    "load",
    "stribeck",
)  # in the order of a description's list
TermSet = tuple[frozenset[FrictionTerm], ...]  # by joint, the terms added to the usual ones
Mask = NDArray[np.bool_]


def baseline_terms(joint: Joint) -> tuple[FrictionTerm, ...]:
    """The terms of a joint in every set: viscous, coulomb and offset, as described.

    Separate friction for each direction contains an offset: it is replaced by common friction and an offset.
    """
    described = ("viscous", "coulomb", "offset") if joint.one_sided else joint.terms
    return tuple(term for term in BASELINE if term in described)


def candidate_terms(joint: Joint) -> frozenset[FrictionTerm]:
    """Terms that are tried; Stribeck friction only if its speed is stated."""
    return frozenset(term for term in CANDIDATES if term != "stribeck" or joint.si("stribeck_speed") is not None)


def described_terms(robot: Robot, terms: TermSet) -> dict[str, tuple[FrictionTerm, ...]]:
    """By joint, the terms of a set as a description lists them."""
    return {
        joint.name: (*baseline_terms(joint), *(term for term in CANDIDATES if term in more))
        for joint, more in zip(robot.joints, terms, strict=True)
    }


def with_terms(robot: Robot, terms: TermSet) -> Robot:
    """The robot with these friction terms instead of the described ones."""
    lists = described_terms(robot, terms)
    joints = (
        msgspec.structs.replace(joint, friction=lists[joint.name], viscous=None, coulomb=None, offset=None)
        for joint in robot.joints
    )
    return replace(robot, joints=tuple(joints))


def parameters_of(model: InverseModel, base: BaseParameters) -> dict[tuple[int, FrictionTerm], tuple[str, ...]]:
    """Base parameters by joint and tried term: two if a motor turns with several joints."""
    names: dict[tuple[int, FrictionTerm], tuple[str, ...]] = {}
    for name, column in zip(base.names, base.columns, strict=True):
        source = model.sources[column]
        for term in CANDIDATES:
            if isinstance(source, JointTerm) and source.kind == term:
                key = int("".join(filter(str.isdigit, name))) - 1, term
                names[key] = (*names.get(key, ()), name)
    return names


def for_all_joints(joints: Sequence[Joint], kinds: frozenset[FrictionTerm]) -> TermSet:
    """These terms at all joints that can have them."""
    return tuple(kinds & candidate_terms(joint) for joint in joints)


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Rows that are held out together.

    Attributes:
        rows: (T,) whether an instant is in the part.
        own: (b,) whether only this part has a parameter, such as Off1@A: it is then fitted to this part.
    """

    name: str
    rows: Mask
    own: Mask


def parts_of(observed: StackedSystem, names: Sequence[str]) -> tuple[Part, ...]:
    """Fifths of a single recording, or each of several; `names` of the recordings in the order of their rows."""
    parameters, lengths = observed.parameters, observed.regression.parts
    instants, edges = np.arange(sum(lengths)), np.cumsum([0, *lengths])
    owned = [[name in of.own for name in parameters.names] for of in parameters.of]
    if len(lengths) == 1:
        edges = np.linspace(0, len(instants), FIFTHS + 1).round().astype(int)
        names, owned = [f"fifth {k + 1}" for k in range(FIFTHS)], [[False] * len(parameters.names)] * FIFTHS
    spans = [(begin <= instants) & (instants < end) for begin, end in pairwise(edges)]
    return tuple(
        Part(name=name, rows=rows, own=np.array(own)) for name, rows, own in zip(names, spans, owned, strict=True)
    )


def predictable_parts(parts: Sequence[Part], observed: Regression) -> tuple[tuple[Part, ...], dict[str, str]]:
    """The parts whose parameters the others determine; messages about the remaining parts, by name.

    `observed` has all tried terms. Raises `IdentificationError`: if fewer than two parts are left.
    """
    predicted, refused = [], dict[str, str]()
    for part in parts:
        counts = (observed.fast & ~part.rows[:, None]).T.reshape(-1)
        names = tuple(name for name, own in zip(observed.system.names, part.own, strict=True) if not own)
        if lost := undetermined_parameters(observed.system.W[counts][:, ~part.own], names):
            refused[part.name] = f"{part.name} cannot be predicted by the others: {', '.join(lost[:8])} undetermined"
        else:
            predicted.append(part)
    if len(predicted) < MIN_PARTS:
        text = "; ".join(refused.values())
        expected = "recordings that each move all joints, or a single recording, whose fifths are then held out"
        if len(observed.parts) == 1:
            expected = "motion of all joints in all fifths of the recording"
        raise IdentificationError(
            text, key="parts held out", value=len(predicted), expected=f"at least {MIN_PARTS}: {expected}"
        )
    return tuple(predicted), refused


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """The result of a set of terms on recordings.

    Attributes:
        fitted_error_percent: relative torque error of moving rows, fitted to all rows.
        held_out_percents: (k,) the same of each part, predicted by the fit of the others; NaN if no joint moves.
        scores: (k,) of the parts.
        lag_one: autocorrelation of the weighted residual; None if that is zero.
        condition_number_scaled: of the weighted W with columns of norm one.
        t: value over standard deviation, by added parameter; `freedom`: degrees of freedom of Student's t.
        significant_terms: the terms that have a parameter whose interval excludes 0.
    """

    terms: TermSet
    fitted_error_percent: float
    held_out_percents: Array
    scores: Array
    lag_one: float | None
    condition_number_scaled: float
    t: dict[str, float]
    freedom: int
    significant_terms: TermSet

    @property
    def count(self) -> int:
        """Number of terms added to the usual ones."""
        return sum(map(len, self.terms))

    @property
    def score(self) -> float:
        """Sum over the parts."""
        return float(self.scores.sum())

    @property
    def held_out_error_percent(self) -> float:
        """Mean over the parts."""
        return float(np.nanmean(self.held_out_percents))


class Trials:
    """Trials of sets of terms; each set is tried once."""

    def __init__(self, whole: StackedSystem, parts: Sequence[Part]) -> None:
        """`whole` has all tried terms; `parts` are held out in turn."""
        self.whole, self.regression, self.parts = whole, whole.regression, parts
        self.parameters = parameters_of(whole.problem.model, whole.problem.base)
        self._names = whole.parameters.names
        baseline = baseline_estimate(whole)
        self._baseline, self._weights = baseline.names, baseline.weights
        self._moving = are_moving(self.regression.speed)
        self._starts: dict[int, Array] = {}  # the last solution of each part, where the next set's passes start
        self._done: dict[TermSet, Trial] = {}
        self.left_out = dict(whole.left_out)

    @property
    def done(self) -> Sequence[Trial]:
        """All sets tried."""
        return tuple(self._done.values())

    def of(self, terms: TermSet) -> Trial:
        """The trial of a set, without terms that are unidentifiable and load friction that does not settle."""
        terms = tuple(frozenset(term for term in more if (j, term) in self.parameters) for j, more in enumerate(terms))
        if terms not in self._done:
            everything = np.ones(len(self.regression.tau), dtype=bool)
            observed, estimate, unsettled = self._fit(self._columns(terms), everything, -1)
            if unsettled:
                self.left_out |= unsettled
                fewer = (more - {"load"} if f"mu{j + 1}" in unsettled else more for j, more in enumerate(terms))
                trial = self.of(tuple(fewer))
                self._done[trial.terms] = trial
                return trial
            self._done[terms] = self._trial(terms, observed, estimate)
        return self._done[terms]

    def _trial(self, terms: TermSet, observed: Regression, estimate: Estimate) -> Trial:
        held = [self._held_out(terms, part, k) for k, part in enumerate(self.parts)]
        rho = self._residual(observed, estimate)
        error = relative_error_percent(self.regression.tau[self._moving], rho[self._moving])
        weighted = rho * self._weights * self.regression.fast
        W, _ = observed.system.with_columns(self._columns(terms)).weighted(self._weights)
        Q = W @ estimate.bread  # W bread has orthonormal columns: bread breadᵀ = (WᵀW)⁻¹
        fitted = intervals(
            replace(estimate, Q=Q), weighted.T.reshape(-1), self.regression.tau.shape[1], self.regression.parts
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.nan_to_num(estimate.beta / fitted.sigma, nan=0.0)
        t = {name: float(x) for name, x in zip(estimate.names, values, strict=True) if name not in self._baseline}
        level = 1 - FALSE_TERM_RATE / max(1, sum(len(names) for names in self.parameters.values()))
        limit = t_quantile(0.5 + level / 2, fitted.freedom)
        # The interval of load friction must lie above 0: no friction decreases with load.
        beyond = {name for name, x in t.items() if (x if name.startswith("mu") else abs(x)) > limit}
        return Trial(
            terms=terms,
            fitted_error_percent=float("nan") if error is None else error,
            held_out_percents=np.array([percent for _, percent in held]),
            scores=np.array([score for score, _ in held]),
            lag_one=autocorrelation(weighted),
            condition_number_scaled=estimate.condition_number_scaled,
            t=t,
            freedom=fitted.freedom,
            significant_terms=tuple(
                frozenset(term for term in more if beyond.intersection(self.parameters[j, term]))
                for j, more in enumerate(terms)
            ),
        )

    def _held_out(self, terms: TermSet, part: Part, start: int) -> tuple[float, float]:
        """Score, and relative error in percent, of a part predicted by the fit of the others."""
        columns = self._columns(terms)
        observed, estimate, _ = self._fit(columns[~part.own[columns]], ~part.rows, start)
        moving = self._moving & part.rows[:, None]
        rho = self._residual(observed, estimate)
        if part.own.any():
            rho = self._less_own(observed, rho, part)
        percent = relative_error_percent(self.regression.tau[moving], rho[moving])
        score = float(((rho * self._weights)[moving] ** 2).sum())
        return score, float("nan") if percent is None else percent

    def _residual(self, observed: Regression, estimate: Estimate) -> Array:
        """(T, n) of all rows."""
        return np.asarray(observed.tau - observed.predicted(estimate.values_of(self._names)))

    def _less_own(self, observed: Regression, rho: Array, part: Part) -> Array:
        """Residuals (T, n) after fitting a part's own parameters to those in its rows."""
        counts = (self.regression.fast & part.rows[:, None]).T.reshape(-1).astype(float)
        system = replace(observed.system, Y=rho.T.reshape(-1)).with_rows(counts).with_columns(np.flatnonzero(part.own))
        own = np.linalg.lstsq(*system.weighted(self._weights))[0]
        return np.asarray((system.Y - system.W @ own).reshape(rho.shape[1], -1).T)

    def _columns(self, terms: TermSet) -> NDArray[np.intp]:
        added = [name for j, more in enumerate(terms) for term in more for name in self.parameters[j, term]]
        return np.flatnonzero(np.isin(self._names, [*self._baseline, *added]))

    def _fit(self, columns: NDArray[np.intp], rows: Mask, start: int) -> tuple[Regression, Estimate, dict[str, str]]:
        """Least squares of some parameters in the rows (T,), and messages about load friction that did not settle."""
        used, whole = (self.regression.fast & rows[:, None]).T.reshape(-1).astype(float), self.whole
        settling = [whole.problem.base.names.index(base_name(self._names[i])) for i in columns]
        load = whole.load and whole.load.of(settling)

        def solve(observed: Regression, some: NDArray[np.intp] = columns) -> Estimate:
            return ordinary_least_squares(_factor(observed.system.with_rows(used).with_columns(some), self._weights))

        beta = self._starts.get(start)
        if beta is None:
            beta = solve(self.regression, np.setdiff1d(columns, whole.load_places(load))).values_of(self._names)
        without_others = np.where(np.isin(np.arange(len(beta)), columns), beta, 0.0)
        observed, estimate, unsettled = load_passes(whole, solve, without_others, load)
        self._starts[start] = estimate.values_of(self._names)
        return observed.regression, estimate, unsettled


def baseline_estimate(whole: StackedSystem) -> Estimate:
    """Weighted least squares with the usual terms only."""
    candidates = parameters_of(whole.problem.model, whole.problem.base).values()
    baseline = ~np.isin(whole.parameters.names, [name for names in candidates for name in names])
    return weighted_least_squares(whole.regression.system.with_columns(np.flatnonzero(baseline)))


def _factor(system: System, weights: Array) -> System:
    """The QR factor of the weighted rows, with the same least-squares solution."""
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
