"""Selection of friction terms by cross-validation.

The parts of the cross-validation are those of a recording or of a pair, or whole recordings. The
selected set is the smallest that predicts the parts nearly as well as the best, among the sets
whose terms all have intervals that exclude 0 (identification/docs/howto/friction.md). The score of
a part is the sum of squared residuals of its weighted rows, each divided by its joint's s_j of the
fit with the usual terms.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import msgspec
import numpy as np

from acquisition.errors import Location
from acquisition.robot import FrictionTerm, Robot, low_speed_by_method

from .. import estimation, methods, results, trust
from ..arrays import Array, Bools
from ..data import Recordings, Signals
from ..model import JointTerm
from ..regression import Overrides, Rows

FIFTHS = 5  # parts of a single recording
FALSE_TERM_RATE = 0.02  # share of recordings without added terms that show one as a false positive
MIN_PARTS = 2  # a single part gives no standard error of the mean score
BASELINE: tuple[FrictionTerm, ...] = ("viscous", "coulomb", "offset")
# In the order in which a description lists them.
CANDIDATES: tuple[FrictionTerm, ...] = ("asymmetric", "root", "load", "stribeck")
TermSet = tuple[frozenset[FrictionTerm], ...]  # terms added to the usual ones, by joint


def with_terms(robot: Robot, terms: TermSet) -> Robot:
    """Return the robot with the terms of a set beside the usual ones.

    Friction given by direction becomes common friction with an offset.

    Parameters
    ----------
    robot : the robot.
    terms : added terms, by joint.
    """
    return replace(
        robot,
        joints=tuple(
            msgspec.structs.replace(
                joint,
                friction=(
                    *(term for term in BASELINE if joint.one_sided or term in joint.terms),
                    *(term for term in CANDIDATES if term in more),
                ),
                viscous=None,
                coulomb=None,
                offset=None,
            )
            for joint, more in zip(robot.joints, terms, strict=True)
        ),
    )


def described_terms(robot: Robot, terms: TermSet) -> dict[str, tuple[FrictionTerm, ...]]:
    """Return the usual terms and those of a set, by joint, as the key `friction` lists them."""
    return {joint.name: joint.terms for joint in with_terms(robot, terms).joints}


def at_all_joints(robot: Robot, kinds: Collection[FrictionTerm]) -> TermSet:
    """Return a set with these terms at all joints that can have them.

    A joint can have Stribeck friction only if its Stribeck speed is given.
    """
    return tuple(
        frozenset(kind for kind in kinds if kind != "stribeck" or has)
        for has in (joint.si("stribeck_speed") is not None for joint in robot.joints)
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """The result of a set of friction terms on recordings.

    Attributes:
        terms: the set.
        significant_terms: the terms that have a parameter whose interval excludes 0.
        fitted_error_percent: relative torque error of a fit to all rows, percent; None without
            torque.
        held_out_percents: relative torque errors of the parts, each predicted by the fit of the
            others, shape (k,), percent; NaN if no joint moves.
        scores: sums of squared weighted residuals of the parts, shape (k,).
    """

    terms: TermSet
    significant_terms: TermSet
    fitted_error_percent: float | None
    held_out_percents: Array
    scores: Array

    @property
    def added_terms(self) -> int:
        """Number of terms added to the usual ones."""
        return sum(map(len, self.terms))

    @property
    def score(self) -> float:
        """Sum of the scores of all parts."""
        return float(self.scores.sum())

    @property
    def held_out_error_percent(self) -> float:
        """Mean held-out torque error of the parts, percent."""
        return float(np.nanmean(self.held_out_percents))


@dataclass(frozen=True, kw_only=True, eq=False)
class TermChoice:
    """Sets of friction terms tried on recordings, best first, and the selected one.

    Attributes:
        recordings: the recordings in the order given.
        overrides: settings of their fits.
        held_out: names of the parts held out: recordings, or fifths of one.
        trials: the trials, best first.
        usual: the trial without added terms.
        recommended: the trial of the smallest set that predicts nearly as well as the best.
        left_out: unidentifiable terms, and parts that the others cannot predict, one line each.
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
        """Robot of the first recording."""
        return self.recordings[0].robot

    @property
    def described(self) -> dict[str, tuple[FrictionTerm, ...]]:
        """Selected terms, by joint, as `friction` of a description lists them."""
        return described_terms(self.robot, self.recommended.terms)

    def fits(self) -> list[results.Evidence]:
        """Fit the recordings by least squares, with the usual and with the selected terms."""
        return [
            results.identify_ls(_with_terms(self.recordings, trial.terms), self.overrides)
            for trial in (self.usual, self.recommended)
        ]


@estimation.one_thread
def select_friction(
    signals: Signals | Recordings,
    overrides: Overrides | None = None,
    *,
    say: Callable[[str], None] = lambda text: None,
) -> TermChoice:
    """Select friction terms by cross-validation: over recordings, or over fifths of a single one.

    Parameters
    ----------
    signals : the recording, or several recordings of one robot.
    overrides : settings that replace those of the description.
    say : called with a line of text for each step.

    Returns
    -------
    The sets of terms that were tried, best first, and the selected one.

    Raises
    ------
    NoFitError : the recordings are too short or excite too little.
    BadInputError : the recordings are not of one robot, or fewer than two parts can be predicted by
        the others.
    """
    recordings = tuple(
        source if isinstance(source, Signals) else source.load()
        for source in (signals.sources if isinstance(signals, Recordings) else (signals,))
    )
    given = overrides or Overrides()
    # The drive gains of one fit, with the terms of the description, are used for all sets, because
    # scores can be compared only on one scale of the torque.
    if given.gains:
        gain = results.identify(Recordings(sources=recordings), given, say=say).problem.robot.gain
        recordings = tuple(
            one.with_gains_of(replace(one.robot, identified_gain=gain)) for one in recordings
        )
        given = replace(given, gains=None)
    robot = recordings[0].robot
    low = given.low_speed_percent
    # Least squares takes the low-speed limit of instrumental variables here, because the selected
    # terms are for fits by either method.
    given = replace(
        given,
        low_speed_percent=low_speed_by_method(
            robot.identification.low_speed.iv if low is None else low
        ),
    )
    whole = methods.read_model(
        _with_terms(recordings, at_all_joints(robot, CANDIDATES)), given, say
    )
    trials = Trials(*methods.with_best_ramps(whole, instruments=False))
    for kinds in (
        chosen for size in range(len(CANDIDATES) + 1) for chosen in combinations(CANDIDATES, size)
    ):
        say(f"set {len(trials.done) + 1}: {', '.join(kinds)}")
        trials.of(trials.of(at_all_joints(robot, kinds)).significant_terms)
    recommended = smallest_near_best(
        [one for one in trials.done.values() if one.significant_terms == one.terms]
    )
    return TermChoice(
        recordings=recordings,
        overrides=trials.whole.overrides,
        held_out=tuple(name for name in trials.names if name not in trials.unpredicted),
        trials=tuple(sorted(trials.done.values(), key=lambda trial: trial.score)),
        usual=trials.of(at_all_joints(robot, ())),
        recommended=recommended,
        left_out=(
            *(
                text
                for (j, term), text in trials.left_out.items()
                if term not in recommended.terms[j]
            ),
            *trials.unpredicted.values(),
        ),
    )


def smallest_near_best(trials: Sequence[Trial]) -> Trial:
    """Return the trial with the fewest terms within one standard error of the best score.

    Parameters
    ----------
    trials : trials on the same parts.
    """
    best = min(trials, key=lambda trial: trial.score)
    near = [
        trial
        for trial in trials
        if (x := trial.scores - best.scores).mean() <= x.std(ddof=1) / np.sqrt(len(x))
    ]
    return min(near, key=lambda trial: (trial.added_terms, trial.score))


def _with_terms(recordings: Sequence[Signals], terms: TermSet) -> Recordings:
    return Recordings(
        sources=tuple(replace(one, robot=with_terms(one.robot, terms)) for one in recordings)
    )


class Trials:
    """Trials of sets of terms on recordings; each set is tried once.

    Attributes:
        whole: the model of all recordings with all terms that are tried.
        added: joint and term of the base parameters of these terms, by name.
        parts: masks of the time blocks of the parts, shape (K,) each. A part is a fifth of a single
            recording, or of each of several recordings that differ in payload, because only all of
            these together determine the parameters; else it is a recording.
        names: names of the parts.
        weights: weights 1/s_j of the fit with the usual terms, shape (n,).
        unpredicted: messages about the parts that the others cannot predict, by name.
        done: the trials, by set.
        left_out: reasons why terms were left out, by joint and term.
    """

    def __init__(self, whole: methods.Model, rows: Rows) -> None:
        robot, model, base = whole.problem.signals.robot, whole.problem.model, whole.problem.base
        self._rows, counts = rows, [len(of) - 1 for of in rows.system.spans]
        self.whole, self._own = whole, [arm.own for arm in whole.unknowns.arms]
        self.names = [problem.signals.recording for problem in whole.problems]
        self.by_recording = len(self.names) > 1 and not whole.unknowns.payloads
        part_of = np.repeat(np.arange(len(counts)), counts)
        if not self.by_recording:
            part_of = np.concatenate([np.arange(K) * FIFTHS // K for K in counts])
            self.names, self._own = [f"fifth {k + 1}" for k in range(FIFTHS)], [set()] * FIFTHS
        self.parts = tuple(part_of == k for k in range(len(self.names)))
        self.added = {
            name: (source.joint, term)
            for name, source in zip(
                base.names, (model.sources[c] for c in base.columns), strict=True
            )
            for term in CANDIDATES
            if isinstance(source, JointTerm) and source.kind == term
        }
        self.done, self.left_out = dict[TermSet, Trial](), dict[tuple[int, FrictionTerm], str]()
        self.weights = self._fit(at_all_joints(robot, ()))[1].estimate.weights
        _, _, last = self._fit(at_all_joints(robot, CANDIDATES))
        self.unpredicted = {
            name: f"{name} cannot be predicted by the others, which do not determine "
            f"{', '.join(lost[:8])}"
            for name, (_, lost) in zip(self.names, self._predictions(last), strict=True)
            if lost
        }
        left = len(self.names) - len(self.unpredicted)
        Location("").require(
            left >= MIN_PARTS,
            "parts held out",
            left,
            f"at least {MIN_PARTS}",
            text="; ".join(self.unpredicted.values()),
            advice="Use recordings that each move all joints; of a single one, every fifth has to",
        )

    def of(self, terms: TermSet) -> Trial:
        """Return the trial of a set.

        Unidentifiable terms are left out, and so is load-dependent friction that does not converge.
        """
        if terms in self.done:
            return self.done[terms]
        model, settled, rows = self._fit(terms)
        estimate = settled.estimate
        betas = [beta for beta, _ in self._predictions(rows)]
        tau, (fitted, by_others), counts, _, instants = model.torques(
            settled.x,
            [estimate],
            [replace(estimate, names=rows.system.names, beta=beta) for beta in betas],
            by_recording=self.by_recording,
            judged=True,
        )
        at = estimation.spans_at(rows.system.spans, instants)

        def percent(predicted: Array, part: Bools) -> float | None:
            among = counts & part[at][:, None]
            return estimation.relative_error_percent(tau[among], (tau - predicted)[among])

        J, Y = rows.system.weighted(self.weights)
        held = [
            (np.sum((Y - J @ beta)[part[rows.system.span]] ** 2), percent(by_others, part))
            for name, part, beta in zip(self.names, self.parts, betas, strict=True)
            if name not in self.unpredicted
        ]
        scores, percents = np.array(held, dtype=float).T
        trial = Trial(
            terms=self._terms(estimate.names),
            significant_terms=self._terms(self._significant(rows.system, estimate)),
            fitted_error_percent=percent(fitted, np.ones_like(self.parts[0])),
            held_out_percents=percents,
            scores=scores,
        )
        return self.done.setdefault(trial.terms, trial)

    def _significant(
        self, system: estimation.System, estimate: estimation.Estimate
    ) -> Sequence[str]:
        """Return the names of the parameters whose interval excludes 0.

        The intervals are so wide that false positives are rare.
        """
        found = estimation.intervals_of(system, estimate)
        level = 1 - FALSE_TERM_RATE / 2 / max(1, len(self.added))
        least = estimation.t_quantile(level, found.freedom) * found.sigma
        # Friction does not decrease with load, so the interval of mu must lie above 0.
        return [
            x
            for x, beta, most in zip(estimate.names, estimate.beta, least, strict=True)
            if (beta if x[:2] == "mu" else abs(beta)) > most
        ]

    def _terms(self, names: Sequence[str]) -> TermSet:
        """Return the terms that have these parameters."""
        added = [self.added[name] for name in names if name in self.added]
        return tuple(
            frozenset(term for i, term in added if i == j) for j in range(len(self.weights))
        )

    def _fit(self, terms: TermSet) -> tuple[methods.Model, methods.Pass, Rows]:
        others = {name: "" for name, (j, term) in self.added.items() if term not in terms[j]}
        model, settled = methods.least_squares(
            self.whole.without(others), self._rows.without(others)
        )
        assert settled.rows is not None
        self.left_out |= {self.added[name]: text for name, text in model.left_out.items() if text}
        return model, settled, settled.rows

    def _predictions(self, settled: Rows) -> list[tuple[Array, list[str]]]:
        """Return, for each part, the parameters by the other parts.

        Returns
        -------
        Parameters, shape (b,), and the names of the parameters that the other parts do not
        determine.
        """
        system = settled.system
        rows = np.column_stack(system.weighted(self.weights))
        each = [estimation.r_factor(rows[part[system.span]]) for part in self.parts]
        return [
            (np.zeros(len(system.names)) if lost else beta, lost)
            for beta, lost in trust.predictions_by_others(
                [np.c_[R[:, :-1], R] for R in each], system.names, self._own
            )
        ]
