"""The equations of a fit: the rows of all its recordings, in the columns of its unknowns x,
about given values of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from .. import regression
from ..arrays import Array
from ..data import RecordingFile, Recordings, Signals, check_one_robot
from ..estimation import Estimate, System, combined, stacked, stacked_columns
from ..regression import HELD, REDUCED, Overrides, Problem, Rows, Settings, Term, Unknowns
from ..simulation import COARSE, FINE, Simulated, SimulatedRecording, simulate
from ..trust import Lag
from .observation import (
    SPAN_S,
    Observed,
    Replayed,
    Say,
    observation_of,
    observe_all,
    rows_at,
    with_common_rate,
)

# by recording
Robots = Sequence[Callable[[float], SimulatedRecording]]
SPANS_OF_IV = 80  # of a long recording: the factors of [C Z W Y] of six joints take 80 MB
SPAN_NUMBERS = 1_500_000  # of the W of the beginning of a long recording


@dataclass(frozen=True, kw_only=True, eq=False)
class Equations:
    """The recordings of a fit, in the order of their digests, so that sums do not
    depend on the order given.

    Attributes:
        recordings: in the order of the digests; `overrides`: their settings.
        problems: the recordings with their settings; `rows`: of each, columns
            of load friction zero.
        replays: the described control law of each against its recorded effort.
        order: places of the recordings in the order given.
        unknowns: x.
        load: load friction in the base parameters; None without.
        left_out: friction terms left out, each with the reason.
        lags: that the torques are corrected by, once estimated.
    """

    recordings: Recordings
    overrides: Overrides
    problems: tuple[Problem, ...]
    rows: tuple[Rows, ...]
    replays: tuple[Replayed, ...]
    order: tuple[int, ...]
    unknowns: Unknowns
    load: regression.LoadFriction | None
    left_out: dict[str, str] = field(default_factory=dict)
    lags: tuple[Lag, ...] = ()
    _about: dict[bytes, Rows] = field(default_factory=dict)

    @property
    def problem(self) -> Problem:
        """That of the recording given first; all have the same robot, model and base parameters."""
        return self.problems[self.order[0]]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of x."""
        return self.unknowns.names

    @property
    def reduced(self) -> bool:
        """Whether rows are QR factors; all of them, or none."""
        return self.rows[0].reduced

    def tasks(self) -> list[Problem]:
        """The problems for tasks: without samples if a task can read them itself."""
        found = []
        for source, problem in zip(self.recordings.sources, self.problems, strict=True):
            if isinstance(source, RecordingFile) and self.recordings.work.workers != 1:
                problem = problem.without_samples()
            found.append(problem if len(problem.signals.q) else replace(problem, source=source))
        return found

    def with_sources(self) -> list[Problem]:
        """The problems, those without samples with where to read them."""
        return [
            own if len(own.signals.q) else task
            for own, task in zip(self.problems, self.tasks(), strict=True)
        ]

    def load_places(self) -> NDArray[np.intp]:
        """Places of the parameters of load friction in x."""
        places = self.load.places if self.load else ()
        return np.array(
            [self.names.index(self.problem.base.names[place]) for place in places], dtype=np.intp
        )

    def about(self, x: Array | None = None) -> Rows:
        """[J Y] of all recordings about x, columns of all unknowns; without x columns of
        load friction are zero.
        """
        if self.load is None or x is None:
            x = np.zeros(0)
        if (key := x.tobytes()) not in self._about:
            self._about.clear()
            self._about[key] = self.stacked(self.rows_about(x))
        return self._about[key]

    def rows_about(self, x: Array, further: Sequence[Term] = ()) -> list[Rows]:
        """The rows of each recording about x, of long ones with `further` columns."""
        if not further and (self.load is None or not len(x)):
            return list(self.rows)
        run = self.recordings.work.run
        tasks = [
            (problem, REDUCED, self.unknowns.beta(x, k)) for k, problem in enumerate(self.tasks())
        ]
        if self.reduced:
            more = further or (None,) * len(tasks)
            each = [(*task, terms) for task, terms in zip(tasks, more, strict=True)]
            return list(run(regression.rows_again, each))
        assert self.load is not None
        columns = run(
            regression.load_columns, [(problem, self.load, beta) for problem, _, beta in tasks]
        )
        found = zip(self.rows, tasks, columns, strict=True)
        return [rows.about(beta, self.load, column) for rows, (*_, beta), column in found]

    def stacked(self, each: Sequence[Rows]) -> Rows:
        """The rows of the recordings, stacked joint by joint, in the columns of x."""
        systems, Z = list[System](), list[Array]()
        for k, rows in enumerate(each):
            WE = np.c_[rows.system.W, rows.E] if rows.E.size else rows.system.W
            J, Y = self.unknowns.columns(k, WE), rows.system.Y
            if not self.unknowns.plain:
                Y = (
                    Y
                    - rows.system.W @ self.unknowns.arms[k].known
                    - rows.E[:, self.unknowns.motors].sum(axis=1)
                )
            systems.append(replace(rows.system, W=J, Y=Y, names=self.names))
            Z.append(self.unknowns.columns(k, rows.Z) if rows.Z.size else rows.Z)
        n = self.problem.signals.robot.n
        return Rows(
            system=stacked(systems),
            E=each[0].E[:0],
            C=stacked_columns([rows.C for rows in each], n),
            Z=stacked_columns(Z, n),
            **{
                name: np.concatenate([getattr(rows, name) for rows in each])
                for name in ("share", "tau", "speed")
            },
        )

    def along(self, x: Array, z: Sequence[Simulated]) -> Rows:
        """[Z J Y] about x with the instruments of each recording."""
        if self.reduced:
            return self.stacked(self.rows_with([one.Z for one in z]))
        Z = stacked_columns([np.asarray(one.Z) for one in z], self.problem.signals.robot.n)
        return replace(self.about(x), Z=Z)

    def rows_with(self, factors: Sequence[Rows | Array]) -> list[Rows]:
        """The rows of each recording with given factors and its measurements, or its own."""
        return [
            replace(x, share=own.share, tau=own.tau, speed=own.speed)
            for own, x in zip(self.rows, factors, strict=bool(factors))
            if isinstance(x, Rows)
        ] or list(self.rows)

    def without(self, left_out: dict[str, str]) -> "Equations":
        """The same without friction terms that are regrouped with nothing;
        `left_out` has the reasons.
        """
        problems = [problem.without_terms(left_out) for problem in self.problems]
        found = self._of(problems, [rows.without(left_out) for rows in self.rows])
        return replace(found, left_out=self.left_out | left_out)

    def _of(
        self,
        problems: Sequence[Problem],
        rows: Sequence[Rows],
        motors: tuple[int, ...] | None = None,
    ) -> "Equations":
        """The same recordings with other settings and rows, or other motors
        whose gains are unknown.
        """
        observed = list(zip(problems, rows, self.replays, strict=True))
        motors = self.unknowns.motors if motors is None else motors
        found = equations_of(self.recordings, self.overrides, observed, self.order, motors)
        return replace(found, left_out=self.left_out, lags=self.lags)

    def at_cutoff(self, cutoff_hz: float) -> "Equations":
        """The same recordings with another low-pass."""
        overrides, most = (
            replace(self.overrides, cutoff_hz=cutoff_hz),
            regression.most_numbers(len(self.problems)),
        )
        tasks = [
            (one, replace(overrides, decimation=one.settings.decimation), most)
            for one in self.tasks()
        ]
        settings, rows = zip(*self.recordings.work.run(rows_at, tasks), strict=True)
        return self._of(self._with_settings(settings), rows)

    def with_ramps(self, ramp_rows: float) -> "Equations":
        """The same recordings with other ramps of the weights of samples."""
        if all(problem.settings.ramp_rows == ramp_rows for problem in self.problems):
            return self
        most, settings = REDUCED if self.reduced else HELD, [one.settings for one in self.problems]
        found = replace(self, overrides=replace(self.overrides, ramp_rows=ramp_rows))
        found = replace(
            found,
            problems=self._with_settings([replace(one, ramp_rows=ramp_rows) for one in settings]),
        )
        rows = list(
            self.recordings.work.run(
                regression.rows_again, [(problem, most) for problem in found.tasks()]
            )
        )
        return found._of(found.problems, rows)

    def _with_settings(self, settings: Sequence[Settings]) -> tuple[Problem, ...]:
        return tuple(
            replace(one, settings=own) for one, own in zip(self.problems, settings, strict=True)
        )

    def behind_rule(self) -> "Equations | None":
        """The same with the rule's low-pass; None if all have it or a lower one.

        Raises `NoFitError` if one is too short.
        """
        if all(problem.settings.filtered for problem in self.problems):
            return None
        return self.at_cutoff(
            min(regression.rule_cutoff_hz(problem.signals) for problem in self.problems)
        )

    def with_motors(self, motors: tuple[int, ...]) -> "Equations":
        """The same recordings with the gains of these motors as unknowns."""
        return (
            self if motors == self.unknowns.motors else self._of(self.problems, self.rows, motors)
        )

    def with_gains(self, factors: Array) -> "Equations":
        """The same recordings with drive gains times `factors` (n,)."""
        return self._with_torques([problem.with_gains(factors) for problem in self.problems])

    def corrected(self, lags_s: Sequence[float]) -> "Equations":
        """The same with the torque of each recording corrected by another lag, s."""
        pairs = list(zip(self.problems, lags_s, strict=True))
        if all(problem.settings.torque_lag_s == lag_s for problem, lag_s in pairs):
            return self
        return self._with_torques([problem.corrected(lag_s) for problem, lag_s in pairs])

    def _with_torques(self, problems: Sequence[Problem]) -> "Equations":
        tasks = zip(replace(self, problems=tuple(problems)).tasks(), self.rows, strict=True)
        return self._of(
            problems, list(self.recordings.work.run(regression.with_torque, list(tasks)))
        )

    def beginning(self) -> "Equations":
        """Unchanged if rows are held; else the beginnings of the recordings, with rows, together
        at most three minutes.
        """
        if not self.reduced:
            return self
        observed, count = list[Observed](), len(self.problems)
        for problem in self.tasks():
            whole = problem.with_samples()
            rows = SPAN_NUMBERS / (whole.signals.robot.n * whole.base.b) / count
            most = min(
                rows * whole.settings.decimation, SPAN_S * whole.signals.sample_rate_hz / count
            )
            stop = min(whole.settings.stop, whole.settings.start + int(most))
            observed.append(observation_of(whole.until(stop), HELD))
        problems, held, replays = zip(*observed, strict=True)
        recordings = Recordings(sources=tuple(problem.signals for problem in problems))
        return replace(self, recordings=recordings, replays=replays)._of(problems, held)

    def combined(self, system: System, estimate: Estimate) -> Estimate:
        """An estimate from these rows, combined with the stated centres of mass."""
        for payload in self.unknowns.payloads:
            estimate = combined(system, estimate, payload.stated)
        return estimate

    def predicted(self, *estimates: Estimate, by_recording: bool = False) -> Array:
        """Decimated torque (rows, n) of an estimate; of several, each in equal spans of a
        recording, or in one recording.
        """
        tasks = [
            (
                problem,
                *(arm.values(one) for one in (estimates[k : k + 1] if by_recording else estimates)),
            )
            for k, (problem, arm) in enumerate(zip(self.tasks(), self.unknowns.arms, strict=True))
        ]
        return np.concatenate(
            [
                predicted
                for _, predicted, _ in self.recordings.work.run(
                    regression.torque_of_recording, tasks
                )
            ]
        )


def equations_of(
    recordings: Recordings,
    overrides: Overrides,
    observed: Sequence[Observed],
    order: tuple[int, ...],
    motors: tuple[int, ...] = (),
) -> Equations:
    """The equations of recordings; the gains of `motors` are unknown."""
    problems, rows, replays = zip(*observed, strict=True)
    return Equations(
        recordings=recordings,
        overrides=overrides,
        problems=problems,
        rows=rows,
        replays=replays,
        order=order,
        unknowns=regression.make_unknowns(
            problems, motors, ("Fv", "Fc") if overrides.gains else ()
        ),
        load=regression.load_friction(problems[0].model, problems[0].base),
    )


def read_equations(given: Signals | Recordings, overrides: Overrides, say: Say) -> Equations:
    """The equations of one recording or several, each filtered and decimated separately: with the
    lowest cut-off and rate of rows that the rules give. Raises `BadInputError` if the recordings
    are not of one robot, and as `make_problem`.
    """
    if isinstance(given, Signals):
        given = Recordings(sources=(given,))
    if len(given.sources) == 1:
        (source,) = given.sources
        signals = source if isinstance(source, Signals) else source.load()
        one = observation_of(regression.make_problem(signals, overrides), None, say)
        return equations_of(Recordings(sources=(signals,)), overrides, (one,), (0,))
    say(f"reading {len(given.sources)} recordings")
    found = observe_all(
        given, [overrides] * len(given.sources), regression.most_numbers(len(given.sources))
    )
    check_one_robot([problem.signals for problem, _, _ in found])
    found = with_common_rate(given, found, overrides)
    each = [problem.signals for problem, _, _ in found]
    by_digest = sorted(range(len(found)), key=lambda k: (each[k].sha256, each[k].recording))
    equations = equations_of(
        replace(given, sources=tuple(given.sources[k] for k in by_digest)),
        overrides,
        [found[k] for k in by_digest],
        tuple(by_digest.index(k) for k in range(len(found))),
    )
    joints = tuple(joint.name for joint in each[0].robot.joints)
    places = ", ".join(each[k].recording for k in by_digest)
    bandwidth_hz = equations.problem.signals.robot.bandwidth_hz
    regression.refuse_standing_joints(equations.about().share, joints, places, bandwidth_hz)
    return equations


def robots_in(equations: Equations, prior: Array, *, gain_update: bool = True) -> Robots:
    """What prepares each recording; gains are set for the inertias of `prior`, values of x."""
    each = [
        partial(
            SimulatedRecording,
            problem,
            equations.unknowns.beta(prior, k),
            spans=min(SPANS_OF_IV, len(rows.tau) // 2) if rows.reduced else 0,
            gain_update=gain_update,
        )
        for k, (problem, rows) in enumerate(zip(equations.tasks(), equations.rows, strict=True))
    ]
    # Once in this process; each task of a worker prepares its own.
    return [cache(one) for one in each] if equations.recordings.work.workers == 1 else each


def simulate_all(
    equations: Equations,
    robots: Robots,
    x: Array,
    asked: tuple[Array, Array | None] | None = None,
    *,
    coarse: bool = False,
    further: Sequence[Term] = (),
) -> tuple[Simulated, ...]:
    """By recording, `simulate` with what is asked, values of x and their covariance; Z of x."""
    of, rate, none = equations.unknowns, COARSE if coarse else FINE, [None] * len(robots)
    each = zip(robots, of.simulated(*asked) if asked else none, further or none, strict=True)
    tasks = [
        (robot, rate, of.beta(x, k), own, more, partial(of.columns, k))
        for k, (robot, own, more) in enumerate(each)
    ]
    return tuple(equations.recordings.work.run(simulate, tasks))
