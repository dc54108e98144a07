"""Which friction terms a robot needs: those that predict parts of a recording that were not fitted.

1. Sets for all joints: every choice of the tried terms.
2. Joint by joint, from the best of these sets: terms whose interval contains 0 go; terms absent from it whose interval
   excludes 0 in the fit with all of them come, where the score falls with them; then, the least sure first, a term goes where
   the score does not rise without it. Intervals are of a level at which, of all terms tried, one in twenty recordings of a
   robot without any has one outside.
3. Recommended is the smallest set whose terms all have an interval that excludes 0, and whose score is within one standard
   error, of the paired difference over the parts, of the best of these sets.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from acquisition.robot import FrictionTerm, Robot

from ..data import Signals
from ..errors import IdentificationError
from ..estimation import one_thread
from ..methods import Fit, identify_ls
from ..passes import Linearised, alike, leave_out_untold
from ..regression import Overrides, Problem, make_problem, regression_of_recording
from .sets import TRIED, TermSet, described_terms, everywhere, tried_terms, with_terms
from .trials import Trial, Trials

LEVEL = 0.05  # share of recordings without any of the tried terms that show one by chance


@dataclass(frozen=True, kw_only=True, eq=False)
class TermChoice:
    """The sets of friction terms tried on a recording, best first, and which is recommended.

    Attributes:
        robot: of the recording.
        problem: the identification with all terms that are tried.
        trials: of all sets; `usual` of that without any.
        recommended: the smallest set that predicts about as well as the best.
        left_out: what of all terms the recording cannot tell, one line each.
    """

    robot: Robot
    problem: Problem
    trials: tuple[Trial, ...]
    usual: Trial
    recommended: Trial
    left_out: tuple[str, ...]

    @property
    def described(self) -> dict[str, tuple[FrictionTerm, ...]]:
        """The recommended terms by joint, as the list `friction` of a description has them."""
        lists = described_terms(self.robot, self.recommended.terms)
        return {joint.name: terms for joint, terms in zip(self.robot.joints, lists, strict=True)}


def _silent(text: str) -> None:
    pass


@one_thread
def choose_terms(signals: Signals, overrides: Overrides, *, say: Callable[[str], None] = _silent) -> TermChoice:
    """Try sets of friction terms on a recording.

    Parameters
    ----------
    signals : the recording.
    overrides : settings in place of those of the description.
    say : called with a line of text for each step.

    Returns
    -------
    The sets with their errors, and the recommended one.

    Raises
    ------
    IdentificationError : where the recording is too long or too short, or excites too little.
    """
    robot = signals.robot
    everything = tuple(tried_terms(joint) for joint in robot.joints)
    problem = make_problem(replace(signals, robot=with_terms(robot, everything)), overrides)
    plain = regression_of_recording(problem, say)
    if plain.reduced:
        raise IdentificationError("too long", place=signals.recording, expected="a part of it, or a larger --decimate")
    trials = Trials(_told(Linearised.of_one(problem, plain)))
    usual = trials.of(everywhere(robot.joints, frozenset()))
    level = 1 - LEVEL / max(1, sum(len(names) for names in trials.parameters.values()))
    for terms in _for_all_joints(robot):
        say(f"set {len(trials.done) + 1}: {', '.join(terms)}")
        trials.of(everywhere(robot.joints, terms))
    _joint_by_joint(trials, trials.of(everything), level, say)
    found = sorted(trials.done, key=lambda trial: trial.score)
    return TermChoice(
        robot=robot,
        problem=trials.problem,
        trials=tuple(found),
        usual=usual,
        recommended=recommended(found, level),
        left_out=tuple(trials.left_out.values()),
    )


def fits_with(signals: Signals, choice: TermChoice, overrides: Overrides) -> tuple[Fit, Fit]:
    """Least squares of the recording with the usual terms, and with the recommended ones."""
    before, after = (
        identify_ls(replace(signals, robot=with_terms(signals.robot, trial.terms)), overrides)
        for trial in (choice.usual, choice.recommended)
    )
    return before, after


def recommended(trials: Iterable[Trial], level: float) -> Trial:
    """The smallest set within one standard error of the best, of those whose terms all exclude 0 at a level."""
    able = sorted((trial for trial in trials if trial.significant(level)), key=lambda trial: trial.score)
    best = able[0]

    def near(trial: Trial) -> bool:
        more = trial.scores - best.scores
        return bool(more.mean() <= more.std(ddof=1) / np.sqrt(len(more)))

    return min((trial for trial in able if near(trial)), key=lambda trial: (trial.count, trial.score))


def _told(linearised: Linearised) -> Linearised:
    """W and Y without the terms that the recording cannot tell with all others at hand."""
    linearised = leave_out_untold(linearised)
    while load := linearised.load:
        beta, names = Trials(linearised).links_of_usual(), linearised.parameters.names
        among = [names[place] for place in linearised.load_places(load)]
        untold = alike(linearised.problem, linearised.at(beta).system, among)
        if not untold:
            break
        linearised = linearised.without(untold)
    return linearised


def _for_all_joints(robot: Robot) -> Iterator[frozenset[FrictionTerm]]:
    """Every choice of the terms that some joint may have, small ones first."""
    able = [term for term in TRIED if any(term in tried_terms(joint) for joint in robot.joints)]
    for size in range(1, len(able) + 1):
        yield from (frozenset(chosen) for chosen in combinations(able, size))


def _joint_by_joint(trials: Trials, everything: Trial, level: float, say: Callable[[str], None]) -> None:
    """Try sets that differ between joints; `trials` has them all in the end."""
    best = min(trials.done, key=lambda trial: trial.score)
    now = trials.of(_kept(trials, best, level))
    for j, term in _places(everything.terms):
        if term not in now.terms[j] and _sure(trials, everything, j, term, level):
            say(f"set {len(trials.done) + 1}: {term} at joint {j + 1}")
            wider = trials.of(_changed(now.terms, j, now.terms[j] | {term}))
            if wider.score < now.score and wider.significant(level):
                now = wider
    while True:
        pruned = trials.of(_kept(trials, now, level))
        now = pruned if pruned.score <= now.score or not now.significant(level) else now
        going = sorted(_places(now.terms), key=lambda place: _size(trials, now, *place))
        for j, term in going:
            say(f"set {len(trials.done) + 1}: without {term} at joint {j + 1}")
            narrower = trials.of(_changed(now.terms, j, now.terms[j] - {term}))
            if narrower.score <= now.score:
                now = narrower
                break
        else:
            return


def _places(terms: TermSet) -> list[tuple[int, FrictionTerm]]:
    return [(j, term) for j, more in enumerate(terms) for term in TRIED if term in more]


def _changed(terms: TermSet, j: int, more: frozenset[FrictionTerm]) -> TermSet:
    return (*terms[:j], more, *terms[j + 1 :])


def _kept(trials: Trials, trial: Trial, level: float) -> TermSet:
    """The set without the terms whose intervals contain 0."""
    return tuple(
        frozenset(term for term in more if _sure(trials, trial, j, term, level)) for j, more in enumerate(trial.terms)
    )


def _sure(trials: Trials, trial: Trial, j: int, term: FrictionTerm, level: float) -> bool:
    """Whether the interval of a parameter of the term excludes 0."""
    return any(trial.excludes_zero(name, level) for name in trials.parameters[j, term])


def _size(trials: Trials, trial: Trial, j: int, term: FrictionTerm) -> float:
    """The term's value in deviations, the larger where it has two parameters."""
    return max(abs(trial.t[name]) for name in trials.parameters[j, term])
