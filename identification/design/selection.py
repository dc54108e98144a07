"""Choice of friction terms by cross-validation: over parts of a recording, or over recordings.

1. The same set for all joints: every combination of the tried terms.
2. Joint by joint, from the best of these sets: remove terms whose interval contains 0; add terms whose interval excludes 0 in
   the fit with all terms, if the score falls; then, smallest |t| first, remove a term if the score does not rise. The level of
   the intervals is such that one in twenty recordings of a robot without such terms shows any.
3. Recommended is the smallest set whose intervals all exclude 0, and whose score is within one standard error (of the paired
   difference over the parts) of the best such set.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from acquisition.robot import FrictionTerm, LowSpeed, Robot

from ..data import Recordings, Signals
from ..errors import IdentificationError
from ..estimation import one_thread
from ..methods import (
    Fit,
    StackedSystem,
    correct_known_lags,
    identify_ls,
    leave_out_collinear_terms,
    most_collinear,
    stack_of,
)
from ..regression import Overrides
from .trials import (
    CANDIDATES,
    TermSet,
    Trial,
    Trials,
    baseline_estimate,
    candidate_terms,
    described_terms,
    for_all_joints,
    parts_of,
    predictable_parts,
    with_terms,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class TermChoice:
    """The sets of friction terms tried on recordings, best first, and the recommended one.

    Attributes:
        recordings: in the order given.
        held_out: names of the parts held out: recordings, or fifths of one.
        trials: of all sets; `usual`: of the one without added terms.
        recommended: the smallest set that predicts nearly as well as the best.
        left_out: unidentifiable terms, and recordings that the others cannot predict, one line each.
    """

    recordings: tuple[Signals, ...]
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
    robot = recordings[0].robot
    observed = correct_known_lags(
        stack_of(_with_terms(recordings, frozenset(CANDIDATES)), with_rows_of_iv(robot, overrides or Overrides()), say)
    )
    names = [one.problem.signals.recording for one in observed.observations]
    if observed.regression.reduced:
        raise IdentificationError("too long", place=", ".join(names), expected="a part of it, or a larger --decimate")
    observed = _leave_out_unidentifiable(observed)
    about = observed.at(baseline_estimate(observed).values_of(observed.parameters.names))
    parts, unpredicted = predictable_parts(parts_of(observed, names), about.regression)
    trials = Trials(observed, parts)
    usual = trials.of(for_all_joints(robot.joints, frozenset()))
    for terms in _for_all_joints(robot):
        say(f"set {len(trials.done) + 1}: {', '.join(terms)}")
        trials.of(for_all_joints(robot.joints, terms))
    _joint_by_joint(trials, trials.of(for_all_joints(robot.joints, frozenset(CANDIDATES))), say)
    found = sorted(trials.done, key=lambda trial: trial.score)
    return TermChoice(
        recordings=recordings,
        held_out=tuple(part.name for part in parts),
        trials=tuple(found),
        usual=usual,
        recommended=recommend(found),
        left_out=(*trials.left_out.values(), *unpredicted.values()),
    )


def fits_with(choice: TermChoice, overrides: Overrides) -> tuple[Fit, Fit]:
    """Least squares of the recordings with the usual terms, and with the recommended ones."""
    before, after = (
        identify_ls(_with_terms(choice.recordings, trial.terms), with_rows_of_iv(choice.robot, overrides))
        for trial in (choice.usual, choice.recommended)
    )
    return before, after


def with_rows_of_iv(robot: Robot, overrides: Overrides) -> Overrides:
    """The same, with least squares in the rows of instrumental variables unless rows are chosen."""
    stored = robot.identification.low_speed
    rows = LowSpeed(ls=stored.iv, iv=stored.iv) if overrides.low_speed_percent is None else overrides.low_speed_percent
    return replace(overrides, low_speed_percent=rows)


def _with_terms(recordings: Sequence[Signals], terms: TermSet | frozenset[FrictionTerm]) -> Recordings:
    """The recordings of a robot with a set of terms, or with these terms at all joints."""
    sets = (for_all_joints(one.robot.joints, terms) if isinstance(terms, frozenset) else terms for one in recordings)
    robots = (with_terms(one.robot, own) for one, own in zip(recordings, sets, strict=True))
    return Recordings(sources=tuple(replace(one, robot=robot) for one, robot in zip(recordings, robots, strict=True)))


def recommend(trials: Iterable[Trial]) -> Trial:
    """The smallest set within one standard error of the best, of those whose terms are all significant."""
    able = sorted((trial for trial in trials if trial.significant_terms == trial.terms), key=lambda trial: trial.score)
    best = able[0]

    def near(trial: Trial) -> bool:
        more = trial.scores - best.scores
        return bool(more.mean() <= more.std(ddof=1) / np.sqrt(len(more)))

    return min((trial for trial in able if near(trial)), key=lambda trial: (trial.count, trial.score))


def _leave_out_unidentifiable(observed: StackedSystem) -> StackedSystem:
    """The system without terms that are unidentifiable next to all others."""
    observed = leave_out_collinear_terms(observed)
    while observed.load:
        names = observed.parameters.names
        about = observed.at(baseline_estimate(observed).values_of(names))
        dependent = most_collinear(
            observed.problem, about.regression.system, [names[place] for place in observed.load_places()]
        )
        if not dependent:
            break
        observed = observed.without(dependent)
    return observed


def _for_all_joints(robot: Robot) -> Iterator[frozenset[FrictionTerm]]:
    """Every combination of terms that some joint can have, smallest first."""
    able = [term for term in CANDIDATES if any(term in candidate_terms(joint) for joint in robot.joints)]
    for size in range(1, len(able) + 1):
        yield from (frozenset(chosen) for chosen in combinations(able, size))


def _joint_by_joint(trials: Trials, everything: Trial, say: Callable[[str], None]) -> None:
    """Try sets that differ between joints; `trials` records them."""
    best = min(trials.done, key=lambda trial: trial.score)
    now = trials.of(best.significant_terms)
    for j, term in _places(everything.terms):
        if term not in now.terms[j] and term in everything.significant_terms[j]:
            say(f"set {len(trials.done) + 1}: {term} at joint {j + 1}")
            wider = trials.of(_toggle(now.terms, j, term))
            if wider.score < now.score and wider.significant_terms == wider.terms:
                now = wider
    while True:
        pruned = trials.of(now.significant_terms)
        now = pruned if pruned.score <= now.score or now.significant_terms != now.terms else now
        # The size of a term is its |t|, the larger one if it has two parameters.
        sizes = {at: max(abs(now.t[name]) for name in trials.parameters[at]) for at in _places(now.terms)}
        for j, term in sorted(sizes, key=sizes.__getitem__):
            say(f"set {len(trials.done) + 1}: without {term} at joint {j + 1}")
            narrower = trials.of(_toggle(now.terms, j, term))
            if narrower.score <= now.score:
                now = narrower
                break
        else:
            return


def _places(terms: TermSet) -> list[tuple[int, FrictionTerm]]:
    return [(j, term) for j, more in enumerate(terms) for term in CANDIDATES if term in more]


def _toggle(terms: TermSet, j: int, term: FrictionTerm) -> TermSet:
    """The set with this term added at a joint, or removed."""
    return (*terms[:j], terms[j] ^ {term}, *terms[j + 1 :])
