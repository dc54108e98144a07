"""Choice of friction terms by cross-validation: over parts of a recording, or over recordings.

1. Every combination of the tried terms, the same at all joints, is fitted to all rows, and each part, a fifth of one recording
   or one of several, is predicted by the fit of the others. The score of a part is the sum of squared residuals of its moving
   rows, each divided by its joint's s_j of the fit with the usual terms.
2. In the fit of each set the terms whose interval contains 0 go, joint by joint; what is left is a set, too. The level of the
   intervals is such that one in fifty recordings of a robot without such terms shows any.
3. Recommended is the smallest set whose intervals all exclude 0, and whose score is within one standard error (of the paired
   difference over the parts) of the best such set.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import msgspec
import numpy as np
from numpy.typing import NDArray

from acquisition.robot import FrictionTerm, Robot, low_speed_by_method

from ..arrays import Array
from ..data import Recordings, Signals
from ..errors import IdentificationError
from ..estimation import Estimate, are_moving, intervals_of, one_thread, r_factor, relative_error_percent, t_quantile
from ..methods import Fit, StackedSystem, correct_known_lags, identify_ls, solve_with_load_friction, stack_of
from ..model import JointTerm
from ..regression import Overrides
from ..trust import predictions_by_others

FIFTHS = 5  # parts of a single recording
FALSE_TERM_RATE = 0.02  # share of recordings that show a term by chance, without having any
MIN_PARTS = 2  # fewer have no standard error of their mean
BASELINE: tuple[FrictionTerm, ...] = ("viscous", "coulomb", "offset")
CANDIDATES: tuple[FrictionTerm, ...] = ("asymmetric", "root", "load", "stribeck")  # as a description lists them
TermSet = tuple[frozenset[FrictionTerm], ...]  # by joint, the terms added to the usual ones


def described_terms(robot: Robot, terms: TermSet) -> dict[str, tuple[FrictionTerm, ...]]:
    """By joint, the terms of a set as a description lists them: the usual ones as described, and those added.

    Separate friction for each direction contains an offset: it is replaced by common friction and an offset.
    """
    return {
        joint.name: (
            *(term for term in BASELINE if joint.one_sided or term in joint.terms),
            *(term for term in CANDIDATES if term in more),
        )
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


def at_all_joints(robot: Robot, kinds: Collection[FrictionTerm]) -> TermSet:
    """These terms at all joints that can have them: Stribeck friction only if its speed is stated."""
    none = frozenset[FrictionTerm]({"stribeck"})
    return tuple(frozenset(kinds) - (none if j.si("stribeck_speed") is None else frozenset()) for j in robot.joints)


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """The result of a set of terms on recordings.

    Attributes:
        fitted_error_percent: relative torque error of moving rows, fitted to all rows.
        held_out_percents: (k,) the same of each part, predicted by the fit of the others; NaN if no joint moves.
        scores: (k,) of the parts.
        significant_terms: the terms that have a parameter whose interval excludes 0.
    """

    terms: TermSet
    fitted_error_percent: float
    held_out_percents: Array
    scores: Array
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


@dataclass(frozen=True, kw_only=True, eq=False)
class TermChoice:
    """The sets of friction terms tried on recordings, best first, and the recommended one.

    Attributes:
        recordings: in the order given; `overrides`: of their fits.
        held_out: names of the parts held out: recordings, or fifths of one.
        usual: the trial without added terms; `recommended`: the smallest that predicts nearly as well as the best.
        left_out: unidentifiable terms, and recordings that the others cannot predict, one line each.
    """

    recordings: tuple[Signals, ...]
    overrides: Overrides
    held_out: tuple[str, ...]
    trials: tuple[Trial, ...]
    usual: Trial
    recommended: Trial
    left_out: tuple[str, ...]

    @property
    def robot(self) -> Robot:
        """The robot of the first recording."""
        return self.recordings[0].robot

    @property
    def described(self) -> dict[str, tuple[FrictionTerm, ...]]:
        """The recommended terms by joint, as a description lists them under `friction`."""
        return described_terms(self.robot, self.recommended.terms)

    def fits(self) -> list[Fit]:
        """Least squares of the recordings with the usual terms, and with the recommended ones."""
        both = self.usual, self.recommended
        return [identify_ls(_with_terms(self.recordings, trial.terms), self.overrides) for trial in both]


@one_thread
def select_friction(
    signals: Signals | Recordings, overrides: Overrides | None = None, *, say: Callable[[str], None] = lambda text: None
) -> TermChoice:
    """Try sets of friction terms on a recording, or on several of one robot, in this process.

    Raises `IdentificationError`: if recordings are too long or too short, excite too little, are not of one robot, or if
    fewer than two parts can be predicted by the others.
    """
    sources = signals.sources if isinstance(signals, Recordings) else (signals,)
    recordings = tuple(source if isinstance(source, Signals) else source.load() for source in sources)
    robot, given = recordings[0].robot, overrides or Overrides()
    low = robot.identification.low_speed.iv if given.low_speed_percent is None else given.low_speed_percent
    given = replace(given, low_speed_percent=low_speed_by_method(low))  # least squares in the rows of instruments
    whole = stack_of(_with_terms(recordings, at_all_joints(robot, CANDIDATES)), given, say)
    trials = Trials(correct_known_lags(whole))
    able = [term for term in CANDIDATES if any(at_all_joints(robot, [term]))]
    for kinds in (chosen for size in range(len(able) + 1) for chosen in combinations(able, size)):
        say(f"set {len(trials.done) + 1}: {', '.join(kinds)}")
        trials.of(trials.of(at_all_joints(robot, kinds)).significant_terms)
    recommended = smallest_near_best(
        [trial for trial in trials.done.values() if trial.significant_terms == trial.terms]
    )
    left_out = [text for (j, term), text in trials.left_out.items() if term not in recommended.terms[j]]
    return TermChoice(
        recordings=recordings,
        overrides=given,
        held_out=tuple(name for name in trials.names if name not in trials.unpredicted),
        trials=tuple(sorted(trials.done.values(), key=lambda trial: trial.score)),
        usual=trials.of(at_all_joints(robot, ())),
        recommended=recommended,
        left_out=(*left_out, *trials.unpredicted.values()),
    )


def smallest_near_best(trials: Sequence[Trial]) -> Trial:
    """The smallest set within one standard error of the best."""
    trials = sorted(trials, key=lambda trial: trial.score)

    def near(trial: Trial) -> bool:
        more = trial.scores - trials[0].scores
        return bool(more.mean() <= more.std(ddof=1) / np.sqrt(len(more)))

    return min(filter(near, trials), key=lambda trial: trial.count)


def _with_terms(recordings: Sequence[Signals], terms: TermSet) -> Recordings:
    return Recordings(sources=tuple(replace(one, robot=with_terms(one.robot, terms)) for one in recordings))


class Trials:
    """Trials of sets of terms on recordings; each set is tried once.

    Attributes:
        whole: their system with all tried terms; `added`: joint and term of the base parameters of these, by name.
        parts: (T,) the part of each instant, fifths of a single recording or each of several; `names`: of the parts.
        weights: (n,) 1/s_j of the fit with the usual terms.
        unpredicted: messages about the parts whose parameters the others do not determine, by name.
        done: the trials; `left_out`: joints and terms that some of them leave out, each with the reason.
    """

    def __init__(self, whole: StackedSystem) -> None:
        robot, base, self.whole = whole.problem.signals.robot, whole.problem.base, whole
        signals, edges = [one.problem.signals for one in whole.observations], np.cumsum(whole.regression.parts)
        self.names, self._own = [one.recording for one in signals], [one.own for one in whole.parameters.of]
        if whole.regression.reduced:
            expected = "a part of it, or a larger decimation"
            raise IdentificationError("too long", place=", ".join(self.names), expected=expected)
        if len(signals) == 1:
            self.names, self._own = [f"fifth {k + 1}" for k in range(FIFTHS)], [set()] * FIFTHS
            edges = np.linspace(0, edges[-1], FIFTHS + 1)[1:].round()
        self.parts = np.searchsorted(edges, np.arange(edges[-1]), side="right")
        sources = zip(base.names, (whole.problem.model.sources[c] for c in base.columns), strict=True)
        self.added: dict[str, tuple[int, FrictionTerm]] = {
            name: (int("".join(filter(str.isdigit, name))) - 1, term)  # Frm6 is of joint 6
            for name, source in sources
            for term in CANDIDATES
            if isinstance(source, JointTerm) and source.kind == term
        }
        self.done, self.left_out = dict[TermSet, Trial](), dict[tuple[int, FrictionTerm], str]()
        self.weights = self._fit(at_all_joints(robot, ()))[1].weights
        every, _ = self._fit(at_all_joints(robot, CANDIDATES))
        self.unpredicted = {
            name: f"{name} cannot be predicted by the others: {', '.join(lost[:8])} undetermined"
            for name, (_, lost) in zip(self.names, self._predictions(every), strict=True)
            if lost
        }
        if (left := len(self.names) - len(self.unpredicted)) < MIN_PARTS:
            expected = (
                f"at least {MIN_PARTS}: recordings that each move all joints, or one that does so in all its fifths"
            )
            text = "; ".join(self.unpredicted.values())
            raise IdentificationError(text, key="parts held out", value=left, expected=expected)

    def of(self, terms: TermSet) -> Trial:
        """The trial of a set, without terms that are unidentifiable and load friction that does not settle."""
        if terms in self.done:
            return self.done[terms]
        settled, estimate = self._fit(terms)
        rows, found = settled.regression, intervals_of(settled.regression.system, estimate)
        moving = are_moving(rows.speed)

        def errors(beta: Array, among: NDArray[np.bool_]) -> tuple[float, float]:  # score, and error in percent
            rho = rows.tau - rows.predicted(beta)
            percent = relative_error_percent(rows.tau[among], rho[among])
            return float(np.sum((rho * self.weights)[among] ** 2)), float("nan") if percent is None else percent

        predictions = enumerate(zip(self.names, self._predictions(settled), strict=True))
        held = [
            errors(beta, moving & (self.parts == k)[:, None])
            for k, (name, (beta, _)) in predictions
            if name not in self.unpredicted
        ]
        least = t_quantile(1 - FALSE_TERM_RATE / 2 / max(1, len(self.added)), found.freedom) * found.sigma
        # The interval of load friction must lie above 0: no friction decreases with load.
        values = zip(estimate.names, estimate.beta, least, strict=True)
        beyond = [name for name, x, limit in values if (x if name.startswith("mu") else abs(x)) > limit]

        def terms_of(names: Collection[str]) -> TermSet:
            added = [self.added[name] for name in names if name in self.added]
            return tuple(frozenset(term for i, term in added if i == j) for j in range(len(terms)))

        trial = Trial(
            terms=terms_of(estimate.names),
            significant_terms=terms_of(beyond),
            fitted_error_percent=errors(estimate.beta, moving)[1],
            held_out_percents=np.array([percent for _, percent in held]),
            scores=np.array([score for score, _ in held]),
        )
        return self.done.setdefault(trial.terms, trial)

    def _fit(self, terms: TermSet) -> tuple[StackedSystem, Estimate]:
        others = {name: "" for name, (j, term) in self.added.items() if term not in terms[j]}
        settled, estimate = solve_with_load_friction(self.whole.without(others) if others else self.whole)
        self.left_out |= {self.added[name]: text for name, text in settled.left_out.items() if text}
        return settled, estimate

    def _predictions(self, settled: StackedSystem) -> list[tuple[Array, list[str]]]:
        """By part the parameters (b,) by the others, and the names of those that they do not determine."""
        rows, names = np.column_stack(settled.regression.system.weighted(self.weights)), settled.regression.system.names
        by_joint = rows.reshape(len(self.weights), -1, rows.shape[1])
        each = [r_factor(by_joint[:, self.parts == k].reshape(-1, rows.shape[1])) for k in range(len(self.names))]
        found = predictions_by_others([np.c_[R[:, :-1], R] for R in each], names, self._own)
        return [(np.zeros(len(names)) if beta is None else beta, lost) for beta, lost in found]
