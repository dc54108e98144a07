"""The model of a fit: its recordings, each with its equation of motion, and their unknowns x.

Reading a recording is a task of its own: its settings and its control law, at a rate of rows that
is common to all recordings.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np

from ..arrays import Array, Bools, Ints
from ..control import FoundLaw, lag_without_fit, law_of
from ..data import HERE, RecordingFile, Recordings, Signals, Work, check_one_robot
from ..estimation import Estimate, System, combined, one_thread
from ..regression import (
    Candidate,
    Equation,
    Lag,
    Overrides,
    Problem,
    Rows,
    Unknowns,
    equation_of,
    make_problem,
    make_unknowns,
    rows_of_recording,
    stacked_rows,
    torque_of_recording,
    with_common_band,
)
from ..simulation import Simulated, SimulatedRecording, simulate
from ..trust import Candidates

# Numbers of positions that several recordings may hold in memory: 64 MB, and a few times as much
# with all other signals.
MAX_HELD = 8_000_000

ProgressCallback = Callable[[str], None]
# Functions that prepare each recording, at a rate per period of the bandwidth.
Robots = Sequence[Callable[[float], SimulatedRecording]]
# Values of x (p,) to simulate, and their covariance (f, f), which is None for a regular start.
Asked = tuple[Array, Array | None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """The recordings of a fit, with their unknowns; read-only.

    They are in the order of their digests, so that sums do not depend on the given order.

    Attributes:
        problems: recordings with their settings.
        laws: control law estimated from each recording.
        overrides: settings that replace those of the description.
        work: workers of the tasks.
        order: places of the recordings in the given order.
        unknowns: names and places of x.
        lags: delay of each group of recordings, by prior knowledge.
        left_out: friction terms that are left out, each with the reason.
    """

    problems: tuple[Problem, ...]
    laws: tuple[FoundLaw | None, ...]
    overrides: Overrides
    work: Work
    order: tuple[int, ...]
    unknowns: Unknowns
    lags: tuple[Lag, ...]
    left_out: dict[str, str] = field(default_factory=dict)

    @property
    def problem(self) -> Problem:
        """Recording given first; all have the same robot, model and base parameters."""
        return self.problems[self.order[0]]

    @property
    def recordings(self) -> tuple[str, ...]:
        """Names of the recordings."""
        return tuple(problem.signals.recording for problem in self.problems)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free unknowns, which come first in x."""
        return self.unknowns.names

    @cached_property
    def equations(self) -> tuple[Equation, ...]:
        """Equation of motion of each recording."""
        work = self.work if len(self.problems) == 1 else HERE
        return tuple(
            equation_of(one, self.unknowns, k, work) for k, one in enumerate(self.problems)
        )

    @cached_property
    def load(self) -> Ints:
        """Places of the parameters of load-dependent friction in x."""
        base = self.problem.base.names
        return np.array(
            [self.names.index(base[i]) for term in self.equations[0].load for i in term.places],
            dtype=np.intp,
        )

    @property
    def exogenous(self) -> bool:
        """True if all references are recorded; else instruments contain the noise of positions."""
        return all(problem.signals.q_ref is not None for problem in self.problems)

    def start(self) -> Array:
        """Return x (p,) of given drive gains and delays; all other values are zero."""
        return self.unknowns.start([lag.value_s for lag in self.lags])

    def x_of(self, estimate: Estimate, x: Array) -> Array:
        """Return x (p,) with the values of an estimate.

        Free unknowns that it lacks are set to zero, drive gains stay.
        """
        found = x.copy()
        found[: len(self.names) - len(self.unknowns.motors)] = 0.0
        found[[self.names.index(name) for name in estimate.names]] = estimate.beta
        return found

    def concluded(self, x: Array) -> tuple[Problem, ...]:
        """Return the problems with the delays and drive gains of x (p,)."""
        kappa = self.equations[0].drives.factors(x) if self.unknowns.motors else None
        return tuple(
            replace(problem, settings=replace(problem.settings, lag=lag), gains=kappa)
            for problem, equation in zip(self.problems, self.equations, strict=True)
            for known in [problem.settings.lag]
            for lag in [replace(known, value_s=float(x[equation.drives.lag]), prior=known)]
        )

    def run(self, task: Callable[..., Any], each: Sequence[Sequence[Any]]) -> list[Any]:
        """Run a task for each recording, several on the workers of the fit; return the results."""
        tasks = [(one, *given) for one, given in zip(self.equations, each, strict=True)]
        return _run(self.work, task, tasks)

    def candidates(
        self, x: Array, measured: tuple[Array, Array], *, simulated: bool = False
    ) -> tuple[Candidates, ...]:
        """Return by recording the terms that are not in the model, linearised at x (p,).

        Parameters
        ----------
        x : (p,) values.
        measured : speed and `most`, (rows, n) each, of the measured `Rows` of all recordings.
        simulated : True along a simulated motion, False along the measured one.
        """
        speed, most = measured
        sliding = np.abs(speed @ self.problem.model.coulomb_directions.T)
        ends = np.cumsum([len(one.settings.instants) for one in self.problems])
        return tuple(
            Candidates(
                problem=one.apart.problem,
                beta=one.arm.beta(x),
                peak=np.abs(speed).max(axis=0),
                most=most.max(axis=0),
                speed=part,
                alone=len(ends) == 1,
                sliding=sliding.max(axis=0),
                simulated=simulated and self.exogenous,
            )
            for one, part in zip(self.equations, np.split(speed, ends[:-1]), strict=True)
        )

    def rows(self, x: Array, further: Sequence[Candidate] = ()) -> Rows:
        """Return [C Z J r] of all recordings about x (p,), along the measured motion."""
        return stacked_rows(
            self.run(
                rows_of_recording,
                [(x, *further[k : k + 1]) for k in range(len(self.problems))],
            )
        )

    def combined(self, system: System, estimate: Estimate) -> Estimate:
        """Return an estimate from these rows, combined with the given centres of mass."""
        for payload in self.unknowns.payloads:
            estimate = combined(system, estimate, payload.stated)
        return estimate

    def torques(
        self,
        x: Array,
        *sets: Sequence[Estimate],
        by_recording: bool = False,
        judged: bool = False,
    ) -> tuple[Array, Array, Bools, list[Array], list[Ints]]:
        """Return the decimated torque as measured by x, and as predicted by sets of estimates.

        Parameters
        ----------
        x : (p,) values, whose delays and drive gains make the measured torque.
        sets : each of one estimate; or of several, which predict equal parts of each recording in
            turn. Without any the prediction is by x.
        by_recording : True if the estimates of a set predict one recording each.
        judged : True for the filters of torque errors.

        Returns
        -------
        The measured torque (rows, n); the prediction (K, rows, n) by K sets, N m or N; a mask
        (rows, n) of the rows that count; by recording their instants, s, and the row of the fit at
        or after each.
        """
        values = [[self.x_of(one, x) for one in estimates] for estimates in sets]
        each = [
            (
                x,
                *(
                    [*map(arm.beta, of[k : k + 1] if by_recording and len(of) > 1 else of)]
                    for of in values
                ),
            )
            for k, arm in enumerate(self.unknowns.arms)
        ]
        tau, predicted, counts, _, t_s, at = zip(
            *self.run(partial(torque_of_recording, judged=judged), each), strict=True
        )
        return (
            np.concatenate(tau),
            np.concatenate(predicted, axis=1),
            np.concatenate(counts),
            list(t_s),
            list(at),
        )

    def predicted(self, x: Array, *estimate: Estimate) -> Array:
        """Return the torque (rows, n) that x, or an estimate, predicts, N m or N."""
        return np.asarray(self.torques(x, *([one] for one in estimate))[1][0])

    @cached_property
    def for_errors(self) -> "Model":
        """Copy with the filters of torque errors."""
        return replace(self, problems=tuple(one.for_errors for one in self.problems))

    def robots(self, x: Array, *, gain_update: bool = True) -> Robots:
        """Prepare each recording for simulations, with the drive gains of x (p,).

        The controller gains are assumed to be set for the inertias of x, equation (E).
        """
        each = [
            partial(
                SimulatedRecording,
                replace(one.problem, gains=one.drives.factors(x)),
                law,
                one.arm.beta(x),
                gain_update=gain_update,
            )
            for one, law in zip(self.equations, self.laws, strict=True)
        ]
        # Prepare each robot once if the tasks run in this process, which holds the samples.
        here = 1 in (self.work.workers, len(self.problems))
        held = here and all(len(one.signals.q) for one in self.problems)
        return [*map(cache, each)] if held else each

    def with_instruments(
        self,
        robots: Robots,
        x: Array,
        asked: Asked | None,
        measured: tuple[Array, Array] | None = None,
        *,
        of_lag: bool = False,
    ) -> tuple[tuple[Simulated, ...], Rows]:
        """Return the simulated robots, by recording, and [C Z J r] of all recordings.

        Parameters
        ----------
        robots : recordings prepared for simulations.
        x : (p,) values at which the rows are linearised.
        asked : values to simulate and their covariance; None for the motion that the reference
            predicts.
        measured : as in `candidates`, for the columns of terms that are not in the model; None for
            none.
        of_lag : True for rows of the delay, equation (G).
        """
        none = [None] * len(robots)
        own = self.unknowns.simulated(*asked) if asked else none
        further = self.candidates(x, measured, simulated=True) if measured else none
        tasks = [
            (robot, (x, beta), term, of_lag)
            for robot, beta, term in zip(robots, own, further, strict=True)
        ]
        z, each = zip(*self.run(simulate, tasks), strict=True)
        return z, stacked_rows(each)

    def without(self, left_out: dict[str, str]) -> "Model":
        """Return a copy without the given friction terms.

        They must not belong to a regrouped parameter. `left_out` maps each to the reason.
        """
        if not left_out:
            return self
        found = model_of(
            [problem.without_terms(left_out) for problem in self.problems],
            self.laws,
            self.overrides,
            self.work,
            self.order,
        )
        return replace(found, left_out=self.left_out | left_out)


def _run(work: Work, task: Callable[..., Any], each: Sequence[tuple[Any, ...]]) -> list[Any]:
    return (
        [task(*one) for one in each]
        if work.workers == 1 or len(each) < 2
        else list(work.run(task, each))
    )


def model_of(
    problems: Sequence[Problem],
    laws: Sequence[FoundLaw | None],
    overrides: Overrides,
    work: Work,
    order: tuple[int, ...],
) -> Model:
    """Make the model of recordings."""
    names, wanted = [m.name for m in problems[0].signals.robot.motors], overrides.gains or ()
    motors = tuple(map(names.index, names if "all" in wanted else dict.fromkeys(wanted)))
    unknowns = make_unknowns(problems, motors, ("Fv", "Fc") if wanted else ())
    return Model(
        problems=tuple(problems),
        laws=tuple(laws),
        overrides=overrides,
        work=work,
        order=order,
        unknowns=unknowns,
        lags=tuple(
            lag_without_fit([(problems[k], laws[k]) for k in group]) for group in unknowns.groups
        ),
    )


@one_thread
def observe(
    source: Signals | RecordingFile, overrides: Overrides, most: float
) -> tuple[Problem, FoundLaw | None]:
    """Read a recording and estimate its control law.

    The samples are dropped again if there are more than `most` numbers; they are read when needed.
    """
    problem = make_problem(source.load(), overrides)
    law = law_of(problem) if overrides.law is None else overrides.law
    problem = replace(problem, source=source)
    return problem.without_samples if problem.signals.q.size > most else problem, law


def with_common_rate(
    given: Recordings,
    found: Sequence[tuple[Problem, FoundLaw | None]],
    overrides: Overrides,
    most: float,
) -> tuple[list[Problem], list[FoundLaw | None]]:
    """Return recordings and control laws with a common cut-off, row rate and band of errors.

    Only recordings whose cut-off or rate changes are read again.
    """
    settings = [problem.settings for problem, _ in found]
    rates = [problem.signals.sample_rate_hz for problem, _ in found]
    cutoff_hz = min((s.cutoff_hz for s in settings if s.cutoff_hz is not None), default=None)
    row_hz = min(fs / s.decimation for fs, s in zip(rates, settings, strict=True))
    common = [max(1, round(fs / row_hz)) for fs in rates]
    again = [
        k for k, s in enumerate(settings) if (s.cutoff_hz, s.decimation) != (cutoff_hz, common[k])
    ]
    tasks = [
        (
            given.sources[k],
            replace(overrides, cutoff_hz=cutoff_hz or 0.0, decimation=common[k]),
            most,
        )
        for k in again
    ]
    read = dict(zip(again, _run(given.work, observe, tasks), strict=True))
    problems, laws = zip(*(read.get(k, one) for k, one in enumerate(found)), strict=True)
    return with_common_band(problems), list(laws)


def read_model(given: Signals | Recordings, overrides: Overrides, say: ProgressCallback) -> Model:
    """Read the model of one recording or several, each filtered and decimated separately.

    The cut-off and the rate of rows are the lowest that the rules give for a recording.

    Parameters
    ----------
    given : the recording, or several recordings of one robot.
    overrides : settings that replace those of the description.
    say : called with a line of text for each step.

    Raises
    ------
    BadInputError : the recordings are not of one robot, or as in `make_problem`.
    """
    if isinstance(given, Signals):
        given = Recordings(sources=(given,))
    count, most, work = len(given.sources), np.inf, given.work
    if count > 1:
        most = MAX_HELD / count
        say(f"reading {count} recordings")
    each = _run(work, observe, [(source, overrides, most) for source in given.sources])
    check_one_robot([problem.signals for problem, _ in each])
    found, laws = with_common_rate(given, each, overrides, most)
    signals = [problem.signals for problem in found]
    by_digest = sorted(range(count), key=lambda k: (signals[k].sha256, signals[k].recording))
    return model_of(
        [found[k] for k in by_digest],
        [laws[k] for k in by_digest],
        overrides,
        work,
        tuple(by_digest.index(k) for k in range(count)),
    )
