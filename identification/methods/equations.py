"""The equations of a fit: the rows of all its recordings, in the columns of its unknowns x,
about given values of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial

import numpy as np
from numpy.typing import NDArray

from .. import regression
from ..arrays import Array
from ..data import RecordingFile, Recordings, Signals, check_one_robot
from ..estimation import Estimate, System, by_joint, combined, stacked
from ..regression import (
    Overrides,
    Problem,
    Rows,
    Settings,
    Term,
    Unknowns,
    rows_of_recording,
    torque_of_recording,
)
from ..simulation import COARSE, FINE, Simulated, SimulatedRecording, simulate
from ..trust import Lag
from .observation import (
    Observed,
    Replayed,
    Say,
    observation_of,
    observe_all,
    settings_at,
    with_common_rate,
)

# by recording, what prepares it at a rate per period of the bandwidth
Robots = Sequence[Callable[[float], SimulatedRecording]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Equations:
    """The recordings of a fit, in the order of their digests, so that sums do not
    depend on the order given.

    Attributes:
        recordings: in the order of the digests; `overrides`: their settings.
        problems: the recordings with their settings.
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
    replays: tuple[Replayed, ...]
    order: tuple[int, ...]
    unknowns: Unknowns
    load: regression.LoadFriction | None
    left_out: dict[str, str] = field(default_factory=dict)
    lags: tuple[Lag, ...] = ()

    @cached_property
    def _made(self) -> dict[bytes, Sequence[Rows]]:
        """The rows about the last values, and those with columns of load friction zero."""
        return {}

    @property
    def problem(self) -> Problem:
        """That of the recording given first; all have the same robot, model and base parameters."""
        return self.problems[self.order[0]]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of x."""
        return self.unknowns.names

    @cached_property
    def _whole(self) -> dict[bytes, Rows]:
        """The rows of all recordings about the last values."""
        return {}

    @property
    def rows(self) -> Sequence[Rows]:
        """Of each recording, columns of load friction zero."""
        return self.rows_about(np.zeros(0))

    @cached_property
    def speed(self) -> Array:
        """(rows, n) joint speeds."""
        return np.concatenate([rows.speed for rows in self.rows])

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
        key = (np.zeros(0) if x is None or self.load is None else x).tobytes()
        if key not in self._whole:
            self._whole.clear()
            self._whole[key] = self.stacked(self.rows_about(np.frombuffer(key)))
        return self._whole[key]

    def rows_about(self, x: Array, further: Sequence[Term] = ()) -> Sequence[Rows]:
        """The rows of each recording about x, with `further` columns; without load friction
        for an empty x.
        """
        if self.load is None and not further:
            x = x[:0]
        if (key := x.tobytes()) in self._made and not further:
            return self._made[key]
        tasks = [
            (problem, self.unknowns.beta(x, k) if len(x) else None, *further[k : k + 1])
            for k, problem in enumerate(self.tasks())
        ]
        found = list(self.recordings.work.run(rows_of_recording, tasks))
        if not further:
            none = self._made.get(b"")
            self._made.clear()
            self._made.update({} if none is None else {b"": none})
            self._made[key] = found
        return found

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
        order = by_joint(systems)
        share, tau, speed = (
            np.concatenate([getattr(rows, name) for rows in each])
            for name in ("share", "tau", "speed")
        )
        return Rows(
            system=stacked(systems),
            E=each[0].E[:0],
            C=np.concatenate([rows.C for rows in each])[order],
            fast=np.concatenate([rows.fast for rows in each])[order],
            Z=np.concatenate(Z)[order],
            share=share,
            tau=tau,
            speed=speed,
            torque_lag_s=each[0].torque_lag_s,
        )

    def along(self, z: Sequence[Simulated]) -> Rows:
        """[Z J Y] with the instruments of simulated robots, about the values that these have."""
        return self.stacked(self.rows_with(z))

    def rows_with(self, z: Sequence[Simulated]) -> Sequence[Rows]:
        """The rows of each recording with instruments, with the torques of these equations: of
        other lags to first order, and of other drive gains.
        """
        found = []
        for rows, problem in zip([x for one in z if (x := one.rows)], self.problems, strict=True):
            late_s = problem.settings.torque_lag_s - rows.torque_lag_s
            Y, E = rows.system.Y - late_s * rows.Z[:, -1], rows.E
            if problem.gains is not None:
                factors = problem.gains / (1.0 if rows.gains is None else rows.gains)
                Y, E = Y + E @ (factors - 1), E * factors
            found.append(replace(rows, system=replace(rows.system, Y=Y), E=E))
        return found

    def without(self, left_out: dict[str, str]) -> "Equations":
        """The same without friction terms that are regrouped with nothing;
        `left_out` has the reasons.
        """
        problems = [problem.without_terms(left_out) for problem in self.problems]
        found = replace(self._of(problems), left_out=self.left_out | left_out)
        found._made[b""] = [rows.without(left_out) for rows in self.rows]
        return found

    def _of(
        self, problems: Sequence[Problem], motors: tuple[int, ...] | None = None
    ) -> "Equations":
        """The same recordings with other settings, or other motors whose gains are unknown."""
        observed = list(zip(problems, self.replays, strict=True))
        motors = self.unknowns.motors if motors is None else motors
        found = equations_of(self.recordings, self.overrides, observed, self.order, motors)
        return replace(found, left_out=self.left_out, lags=self.lags)

    def at_cutoff(self, cutoff_hz: float) -> "Equations":
        """The same recordings with another low-pass."""
        overrides = replace(self.overrides, cutoff_hz=cutoff_hz)
        tasks = [
            (one, replace(overrides, decimation=one.settings.decimation)) for one in self.tasks()
        ]
        settings = list(self.recordings.work.run(settings_at, tasks))
        return self._of(self._with_settings(settings))

    def with_ramps(self, ramp_rows: float) -> "Equations":
        """The same recordings with other ramps of the weights of samples."""
        if all(problem.settings.ramp_rows == ramp_rows for problem in self.problems):
            return self
        settings = [replace(one.settings, ramp_rows=ramp_rows) for one in self.problems]
        found = replace(self, overrides=replace(self.overrides, ramp_rows=ramp_rows))
        return found._of(self._with_settings(settings))

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
        if motors == self.unknowns.motors:
            return self
        found = self._of(self.problems, motors)
        found._made.update(self._made if self.load is None else {})
        return found

    def with_gains(self, factors: Array) -> "Equations":
        """The same recordings with drive gains times `factors` (n,)."""
        return self._of([problem.with_gains(factors) for problem in self.problems])

    def corrected(self, lags_s: Sequence[float], lags: tuple[Lag, ...]) -> "Equations":
        """The same with another lag of the torque of each recording, s; `lags` has them."""
        pairs = zip(self.problems, lags_s, strict=True)
        found = replace(self._of([problem.corrected(lag_s) for problem, lag_s in pairs]), lags=lags)
        if lags_s == [problem.settings.torque_lag_s for problem in self.problems]:
            vars(found).update(_made=self._made, _whole=self._whole)
        if "speed" in vars(self) or b"" in self._made:
            vars(found)["speed"] = self.speed  # of the same motion
        return found

    def combined(self, system: System, estimate: Estimate) -> Estimate:
        """An estimate from these rows, combined with the stated centres of mass."""
        for payload in self.unknowns.payloads:
            estimate = combined(system, estimate, payload.stated)
        return estimate

    def predicted(self, *estimates: Estimate, by_recording: bool = False) -> Array:
        """Decimated torque (rows, n) of an estimate; of several, each in equal spans of a
        recording, or in one recording.
        """
        return self.torques(*estimates, by_recording=by_recording)[1]

    def torques(
        self, *estimates: Estimate, by_recording: bool = False
    ) -> tuple[Array, Array, Array]:
        """Decimated torque, as measured and as `predicted`, and speed, (rows, n) each."""
        tasks = [
            (
                problem,
                *(arm.values(one) for one in (estimates[k : k + 1] if by_recording else estimates)),
            )
            for k, (problem, arm) in enumerate(zip(self.tasks(), self.unknowns.arms, strict=True))
        ]
        each = self.recordings.work.run(torque_of_recording, tasks)
        tau, predicted, speed = (np.concatenate(x) for x in zip(*each, strict=True))
        return tau, predicted, speed


def equations_of(
    recordings: Recordings,
    overrides: Overrides,
    observed: Sequence[Observed],
    order: tuple[int, ...],
    motors: tuple[int, ...] = (),
) -> Equations:
    """The equations of recordings; the gains of `motors` are unknown."""
    problems, replays = zip(*observed, strict=True)
    return Equations(
        recordings=recordings,
        overrides=overrides,
        problems=problems,
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
        one = observation_of(regression.make_problem(signals, overrides))
        return equations_of(Recordings(sources=(signals,)), overrides, (one,), (0,))
    say(f"reading {len(given.sources)} recordings")
    found = observe_all(given, [overrides] * len(given.sources))
    check_one_robot([problem.signals for problem, _ in found])
    found = with_common_rate(given, found, overrides)
    each = [problem.signals for problem, _ in found]
    by_digest = sorted(range(len(found)), key=lambda k: (each[k].sha256, each[k].recording))
    return equations_of(
        replace(given, sources=tuple(given.sources[k] for k in by_digest)),
        overrides,
        [found[k] for k in by_digest],
        tuple(by_digest.index(k) for k in range(len(found))),
    )


def refuse_standing_joints(equations: Equations) -> None:
    """Refuse recordings in none of which a row of a joint counts."""
    signals = [problem.signals for problem in equations.problems]
    regression.refuse_standing_joints(
        equations.about().share,
        tuple(joint.name for joint in signals[0].robot.joints),
        ", ".join(one.recording for one in signals),
        signals[0].robot.bandwidth_hz,
        "; ".join(one.unmeasured for one in signals if one.unmeasured),
    )


def robots_in(equations: Equations, prior: Array, *, gain_update: bool = True) -> Robots:
    """What prepares each recording; gains are set for the inertias of `prior`, values of x."""
    each = [
        partial(
            SimulatedRecording,
            problem,
            equations.unknowns.beta(prior, k),
            gain_update=gain_update,
        )
        for k, problem in enumerate(equations.tasks())
    ]
    # Once in this process; each task of a worker prepares its own.
    return [cache(one) for one in each] if equations.recordings.work.workers == 1 else each


def simulate_all(
    equations: Equations,
    robots: Robots,
    x: Array,
    asked: tuple[Array, Array | None] | None = None,
    *,
    further: Sequence[Term] = (),
    before: Array | None = None,
) -> tuple[Simulated, ...]:
    """By recording, `simulate` with what is asked, values of x and their covariance, or coarsely
    along the motion that the reference predicts; the rows of the lag are whitened by the
    residuals of the values `before`.
    """
    of, rate, none = equations.unknowns, FINE if asked else COARSE, [None] * len(robots)
    own = of.simulated(*asked) if asked else none
    about = [(of.beta(x, k), one) for k, one in enumerate(own)]
    left = none if before is None else [of.beta(before, k) for k in range(len(own))]
    rates = [rate] * len(robots)
    each = zip(robots, rates, equations.tasks(), about, further or none, left, strict=True)
    return tuple(equations.recordings.work.run(simulate, list(each)))
