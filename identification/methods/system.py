"""The recordings of a fit, and their stacked system about given parameters."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..data import RecordingFile, Recordings, Signals, check_one_robot
from ..errors import IdentificationError
from ..estimation import Estimate, System, spans_of
from ..regression import (
    ALL_REDUCED,
    HELD,
    LoadFriction,
    Overrides,
    OwnParameters,
    Problem,
    Regression,
    load_columns,
    load_friction,
    make_problem,
    own_parameters,
    recorded_drives,
    refuse_standing_joints,
    regression_again,
    rule_cutoff_hz,
    torque_of_recording,
    with_torque,
)
from ..simulation import ClosedLoops, Instruments, Replica, Simulation
from ..trust import Lag, RecordingData
from .observation import SPAN_S, Say, observation_of, observe_all, regression_at, with_common_rate

SPAN_NUMBERS = 3_000_000  # of its W
SPANS_OF_IV = 80  # of a long recording: the factors of [Z W Y] of six joints take 60 MB, those of 120 spans 84 MB


@dataclass(frozen=True, kw_only=True, eq=False)
class StackedSystem:
    """All recordings of a fit, in the order of their digests, so that sums do not depend on the order given.

    Attributes:
        recordings: in the order of the digests; `overrides`: their settings.
        observations: by recording, with W and Y about `beta`.
        order: places of the recordings in the order given.
        plain: by recording its regression with columns of load friction zero.
        parameters: shared ones, and those of single recordings.
        regression: the stacked system, about `beta`.
        load: load friction in the base parameters; None without.
        beta: values of all parameters; None if columns of load friction are zero.
        left_out: friction terms left out, each with the reason.
        lags: that the torques are corrected by, once estimated.
    """

    recordings: Recordings
    overrides: Overrides
    observations: tuple[RecordingData, ...]
    order: tuple[int, ...]
    plain: tuple[Regression, ...]
    parameters: OwnParameters
    regression: Regression
    load: LoadFriction | None
    beta: Array | None = None
    left_out: dict[str, str] = field(default_factory=dict)
    lags: tuple[Lag, ...] = ()

    @property
    def problem(self) -> Problem:
        """That of the recording given first; all have the same robot, model and base parameters."""
        return self.observations[self.order[0]].problem

    @property
    def parts(self) -> tuple[slice, ...]:
        """The decimated instants of each recording."""
        return tuple(spans_of(self.regression.parts))

    def problems(self) -> list[Problem]:
        """The problems for tasks: without samples if a task can read them itself."""
        found = []
        for source, one in zip(self.recordings.sources, self.observations, strict=True):
            problem = one.problem
            if isinstance(source, RecordingFile) and self.recordings.work.workers != 1:
                problem = problem.without_samples()
            found.append(problem if len(problem.signals.q) else replace(problem, source=source))
        return found

    def lab(self, prior: Array, *, gain_update: bool) -> ClosedLoops:
        """The closed loops of the recordings; gains are set for the inertias of `prior`, values of all parameters."""
        return ClosedLoops(
            simulations=tuple(
                Simulation(
                    problem=problem,
                    prior=self.parameters.base(prior, k),
                    spans=SPANS_OF_IV if one.regression.reduced else 0,
                    gain_update=gain_update,
                )
                for k, (problem, one) in enumerate(zip(self.problems(), self.observations, strict=True))
            ),
            names=tuple(one.problem.signals.recording for one in self.observations),
            parameters=self.parameters,
            work=self.recordings.work,
        )

    def load_places(self, load: LoadFriction | None = None) -> NDArray[np.intp]:
        """Places of the parameters of load friction in the system; of `load`, or of all."""
        load, names = load or self.load, self.problem.base.names
        found = [self.parameters.names.index(names[place]) for place in load.places] if load else []
        return np.array(found, dtype=np.intp)

    def at(self, beta: Array, load: LoadFriction | None = None) -> "StackedSystem":
        """Linearised about beta if there is load friction, else unchanged.

        `load` may be a part of the load friction, if rows are not reduced: columns of the rest are zero.
        """
        load = load or self.load
        if load is None or (load is self.load and self.beta is not None and np.array_equal(beta, self.beta)):
            return self
        run, problems = self.recordings.work.run, self.problems()
        of_each = [self.parameters.base(beta, k) for k in range(len(problems))]
        if self.regression.reduced:
            again = [(problem, ALL_REDUCED, own) for problem, own in zip(problems, of_each, strict=True)]
            each = list(run(regression_again, again))
        else:
            tasks = [
                (problem, one.links, load, own) for problem, one, own in zip(problems, self.plain, of_each, strict=True)
            ]
            found = zip(self.plain, of_each, run(load_columns, tasks), strict=True)
            each = [one.about(own, load, columns) for one, own, columns in found]
        whole = zip(self.observations, each, strict=True)
        return replace(
            self,
            observations=tuple(replace(one, regression=regression) for one, regression in whole),
            regression=self.parameters.stacked(each, drives_of(self.observations) if self.parameters.motors else []),
            beta=beta.copy() if load is self.load else None,
        )

    def without(self, left_out: dict[str, str]) -> "StackedSystem":
        """The same without friction terms that are regrouped with nothing; `left_out` has the reasons."""
        observations = [
            replace(one, problem=one.problem.without_terms(left_out), regression=plain.without(left_out))
            for one, plain in zip(self.observations, self.plain, strict=True)
        ]
        return replace(self._of(observations), left_out=self.left_out | left_out)

    def _of(self, observations: Sequence[RecordingData]) -> "StackedSystem":
        """The same recordings with other observations; columns of load friction are zero."""
        system = stack_recordings(self.recordings, self.overrides, observations, self.order, self.parameters.motors)
        return replace(system, left_out=self.left_out)

    def along(self, z: Instruments) -> System:
        """W and Y about the parameters of a pass; QR factors for long recordings."""
        return self.at(z.beta).regression.system if z.system is None else z.system

    def about(self, z: Instruments) -> "StackedSystem":
        """The same about the parameters of a pass; for long recordings unchanged, `z` has the factors."""
        return self if z.system is not None else self.at(z.beta)

    def simulated(self, replicas: Sequence[Replica]) -> tuple[RecordingData, ...]:
        """The recordings with the robot simulated in them."""
        return tuple(
            replace(one, simulated=found.motion, decimation=found.decimation, reference=found.reference_kind)
            for one, found in zip(self.observations, replicas, strict=True)
        )

    def at_cutoff(self, cutoff_hz: float) -> "StackedSystem":
        """The same recordings with another low-pass."""
        tasks = []
        for problem in self.problems():
            settings = problem.settings
            overrides = replace(self.overrides, cutoff_hz=cutoff_hz, decimation=settings.decimation)
            tasks.append((problem, overrides, len(self.observations)))
        found = zip(self.observations, self.recordings.work.run(regression_at, tasks), strict=True)
        return self._of(
            [
                replace(one, problem=replace(one.problem, settings=settings), regression=regression)
                for one, (settings, regression) in found
            ]
        )

    def with_ramps(self, ramp_rows: float) -> "StackedSystem":
        """The same recordings with other ramps of the weights of samples."""
        if all(one.problem.settings.ramp_rows == ramp_rows for one in self.observations):
            return self
        share, problems = ALL_REDUCED if self.regression.reduced else HELD, self.problems()
        problems = [replace(one, settings=replace(one.settings, ramp_rows=ramp_rows)) for one in problems]
        each = self.recordings.work.run(regression_again, [(problem, share) for problem in problems])
        found = zip(self.observations, problems, each, strict=True)
        overrides = replace(self.overrides, ramp_rows=ramp_rows)
        return replace(self, overrides=overrides)._of(
            [
                replace(one, problem=replace(one.problem, settings=problem.settings), regression=regression)
                for one, problem, regression in found
            ]
        )

    def behind_rule(self) -> "StackedSystem | None":
        """The same recordings with the rule's low-pass; None if all have it or a lower one, or a recording is too short."""
        if all(one.problem.settings.filtered for one in self.observations):
            return None
        signals = [one.problem.signals for one in self.observations]
        with suppress(IdentificationError):
            return self.at_cutoff(min(map(rule_cutoff_hz, signals)))
        return None

    def with_motors(self, motors: tuple[int, ...]) -> "StackedSystem":
        """The same recordings with the gains of these motors as parameters."""
        if motors == self.parameters.motors:
            return self
        found = stack_recordings(self.recordings, self.overrides, self._plain(), self.order, motors)
        return replace(found, left_out=self.left_out, lags=self.lags)

    def with_gains(self, factors: Array) -> "StackedSystem":
        """The same recordings with drive gains times `factors` (n,)."""
        found = list[RecordingData]()
        for one in self._plain():
            problem = one.problem.with_gains(factors)
            found.append(replace(one, problem=problem, regression=with_torque(problem, one.regression)))
        return replace(self._of(found), lags=self.lags)

    def _plain(self) -> list[RecordingData]:
        """The recordings with columns of load friction zero."""
        return [replace(one, regression=plain) for one, plain in zip(self.observations, self.plain, strict=True)]

    def on_span(self) -> "StackedSystem":
        """Unchanged if rows are held; else the beginning of the first recording, with rows, at most three minutes."""
        if not self.regression.reduced:
            return self
        problem = self.problems()[0].with_samples()
        settings, fs = problem.settings, problem.signals.sample_rate_hz
        rows = min(SPAN_NUMBERS // (problem.signals.robot.n * problem.base.b), int(SPAN_S * fs / settings.decimation))
        stop = min(settings.stop, settings.start + rows * settings.decimation)
        one = observation_of(replace(problem, settings=replace(settings, stop=stop)), HELD)
        span = stack_recordings(Recordings(sources=(problem.signals,)), self.overrides, (one,), (0,))
        return replace(span, left_out=self.left_out)

    def corrected(self, lags_s: Sequence[float]) -> "StackedSystem":
        """The same with the torque of each recording corrected by another lag, s."""
        if all(one.problem.settings.torque_lag_s == lag for one, lag in zip(self.observations, lags_s, strict=True)):
            return self
        problems = [problem.corrected(lag_s) for problem, lag_s in zip(self.problems(), lags_s, strict=True)]
        each = self.recordings.work.run(with_torque, list(zip(problems, self.plain, strict=True)))
        found = zip(self.observations, lags_s, each, strict=True)
        return self._of(
            [replace(one, problem=one.problem.corrected(lag_s), regression=plain) for one, lag_s, plain in found]
        )

    def predicted(self, *estimates: Estimate, by_recording: bool = False) -> Array:
        """Decimated torque (rows, n) that an estimate predicts; each of several in as many equal spans of each recording, or
        one recording each.
        """
        tasks = [
            (problem, *(own.values(one) for one in (estimates[k : k + 1] if by_recording else estimates)))
            for k, (problem, own) in enumerate(zip(self.problems(), self.parameters.of, strict=True))
        ]
        return np.concatenate([predicted for _, predicted, _ in self.recordings.work.run(torque_of_recording, tasks)])


def drives_of(observations: Sequence[RecordingData]) -> list[Array]:
    """By recording the torques (n, rows, m) at the joints of each motor, by the gains of its problem, weighted."""
    return [recorded_drives(one.problem) for one in observations]


def stack_recordings(
    recordings: Recordings,
    overrides: Overrides,
    observations: Sequence[RecordingData],
    order: tuple[int, ...],
    motors: tuple[int, ...] = (),
) -> StackedSystem:
    """The stacked system of recordings, columns of load friction zero; the gains of `motors` are parameters."""
    problems, each = [one.problem for one in observations], tuple(one.regression for one in observations)
    parameters = own_parameters(problems, motors)
    return StackedSystem(
        recordings=recordings,
        overrides=overrides,
        observations=tuple(replace(o, parameters=of) for o, of in zip(observations, parameters.of, strict=True)),
        order=order,
        plain=each,
        parameters=parameters,
        regression=parameters.stacked(each, drives_of(observations) if motors else []),
        load=load_friction(problems[0].model, problems[0].base),
    )


def stack_of(given: Signals | Recordings, overrides: Overrides, say: Say) -> StackedSystem:
    """W and Y of one recording or several, filtered and decimated separately, and stacked.

    All have the lowest cut-off and the lowest rate of rows that the rules give.

    Raises `IdentificationError` if the recordings are not of one robot, and as `make_problem`.
    """
    if isinstance(given, Signals):
        given = Recordings(sources=(given,))
    if len(given.sources) == 1:
        (source,) = given.sources
        signals = source if isinstance(source, Signals) else source.load()
        one = observation_of(make_problem(signals, overrides), 1, say)
        return stack_recordings(Recordings(sources=(signals,)), overrides, (one,), (0,))
    say(f"reading {len(given.sources)} recordings")
    found = observe_all(given, [overrides] * len(given.sources), len(given.sources))
    check_one_robot([one.problem.signals for one in found])
    found = with_common_rate(given, found, overrides)
    by_digest = sorted(
        range(len(found)), key=lambda k: (found[k].problem.signals.sha256, found[k].problem.signals.recording)
    )
    found = [found[k] for k in by_digest]
    observed = stack_recordings(
        replace(given, sources=tuple(given.sources[k] for k in by_digest)),
        overrides,
        found,
        tuple(by_digest.index(k) for k in range(len(found))),
    )
    joints = tuple(joint.name for joint in found[0].problem.signals.robot.joints)
    places = ", ".join(one.problem.signals.recording for one in found)
    refuse_standing_joints(observed.regression.share, joints, places, observed.problem.signals.robot.bandwidth_hz)
    return observed
