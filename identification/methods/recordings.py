"""What each recording brings to a fit, found by tasks of their own, and the system that all of them make together."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..data import RecordingFile, Recordings, Signals, check_one_robot
from ..estimation import Estimate, one_thread, slices
from ..regression import (
    Overrides,
    OwnParameters,
    Problem,
    Regression,
    make_problem,
    make_settings,
    own_parameters,
    refuse_slow_joints,
    regression_of_recording,
    stacked,
    torque_of_recording,
)
from ..replica import Bench, Lab, Place
from ..trust import Part, TrustLine, poses_of, replay_line

ALL_REDUCED = 10**9  # so many share the memory for rows that all are reduced
Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation:
    """A recording as a fit sees it.

    Attributes:
        problem: recording, settings and model; without samples where rows are reduced and recordings are several.
        regression: its W and Y.
        poses: (P, n) positions at which M is looked at.
        replay: its described control law against the recorded effort.
        t_s: (rows,) instants of its decimated rows, s.
    """

    problem: Problem
    regression: Regression
    poses: Array
    replay: TrustLine
    t_s: Array

    def part(self, parameters: tuple[str, ...]) -> Part:
        """What it brings to the evidence before anything is simulated; its base parameters have these names."""
        return Part(
            problem=self.problem,
            parameters=parameters,
            slip_noise=self.regression.slip_noise,
            poses=self.poses,
            replay=self.replay,
        )


@one_thread
def observe(source: Signals | RecordingFile, overrides: Overrides, share: int) -> Observation | None:
    """W and Y of a recording and what else is known without an estimate; None where the file is not found here.

    `share` is the number of recordings of the fit.
    """
    if isinstance(source, RecordingFile):
        if not source.found:
            return None
        source = source.load()
    return _observation(make_problem(source, overrides), share)


def _observation(problem: Problem, share: int, say: Say = lambda text: None) -> Observation:
    settings, signals = problem.settings, problem.signals
    regression = regression_of_recording(problem, say, share=share)
    # Decimation keeps the last sample and every n_d-th before it.
    kept = settings.stop - 1 - settings.decimation * np.arange(len(regression.tau))[::-1]
    poses, replay = poses_of(signals.q[settings.start : settings.stop]), replay_line(problem)
    t_s = signals.t_s[kept]
    if share > 1 and regression.reduced:
        problem = problem.without_samples()
    return Observation(problem=problem, regression=regression, poses=np.array(poses), replay=replay, t_s=t_s)


@one_thread
def regression_at(place: Place, overrides: Overrides, share: int) -> Regression:
    """W and Y of a recording with other settings."""
    problem = place.problem()
    settings = make_settings(problem.signals, overrides, problem.motion)
    return regression_of_recording(replace(problem, settings=settings), share=share)


@one_thread
def predict(place: Place, beta: Array) -> Array:
    """Decimated torque (rows, n) that beta (b,) predicts for a recording."""
    return torque_of_recording(place.problem(), beta)[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class Observed:
    """All recordings of a fit, in the order of their digests: sums over them do not depend on the order they are given in.

    Attributes:
        recordings: as they were given, in the order of the digests; `overrides` the settings they were observed with.
        observations: one by one.
        regression: the system that they make together.
        order: places of the recordings as the user gave them.
        parameters: those that the recordings share, and those of each.
    """

    recordings: Recordings
    overrides: Overrides
    observations: tuple[Observation, ...]
    regression: Regression
    order: tuple[int, ...]
    parameters: OwnParameters

    @property
    def problem(self) -> Problem:
        """That of the recording given first: robot, model and base parameters are those of all."""
        return self.observations[self.order[0]].problem

    @property
    def parts(self) -> tuple[slice, ...]:
        """The decimated instants of each recording."""
        return tuple(slices(self.regression.parts))

    @property
    def evidence(self) -> tuple[Part, ...]:
        """What the recordings bring to the evidence before anything is simulated."""
        return tuple(one.part(names) for one, names in zip(self.observations, self.parameters.of, strict=True))

    def places(self) -> list[Place]:
        """Where tasks find the recordings: the problem where it is at hand and need not be sent, or the file."""
        found = []
        for source, one in zip(self.recordings.sources, self.observations, strict=True):
            without_samples = not len(one.problem.signals.q)
            in_file = isinstance(source, RecordingFile) and self.recordings.work.remote
            at_hand = None if in_file or without_samples else one.problem
            found.append(Place(source=source, overrides=self.settings_of(one), at_hand=at_hand))
        return found

    def lab(self, prior: Array, *, gain_update: bool) -> Lab:
        """The recordings laid out for simulation, gains being those for the inertias of `prior`, values of all parameters."""
        return Lab(
            benches=tuple(
                Bench(place=place, prior=prior[self.parameters.places(k)], gain_update=gain_update)
                for k, place in enumerate(self.places())
            ),
            names=tuple(one.problem.signals.recording for one in self.observations),
            parameters=self.parameters,
            work=self.recordings.work,
        )

    def at_cutoff(self, cutoff_hz: float) -> Regression:
        """The same recordings behind another low-pass."""
        tasks = [
            (place, replace(place.overrides, cutoff_hz=cutoff_hz), len(self.observations)) for place in self.places()
        ]
        each = self.recordings.work.run(regression_at, tasks)
        return stacked([self.parameters.widened(one, k) for k, one in enumerate(each)])

    def settings_of(self, observation: Observation) -> Overrides:
        """What a recording was observed with: the options, and the cut-off and decimation that are common to all."""
        settings = observation.problem.settings
        return replace(self.overrides, cutoff_hz=settings.cutoff_hz or 0.0, decimation=settings.decimation)

    def predicted(self, estimate: Estimate) -> Array:
        """Decimated torque (rows, n) that an estimate predicts."""
        observed, system = self.regression, self.regression.system
        if observed.reduced:
            beta = estimate.among(self.problem.base.names)
            return np.concatenate(list(self.recordings.work.run(predict, [(place, beta) for place in self.places()])))
        columns = system.W[:, [system.names.index(name) for name in estimate.names]]
        return np.asarray((columns @ estimate.beta).reshape(observed.tau.shape[1], -1).T)


def observe_all(given: Signals | Recordings, overrides: Overrides, say: Say) -> Observed:
    """W and Y of one recording or several, filtered and decimated one by one, and stacked.

    Cut-off and decimation are common, the lowest cut-off and the lowest rate of rows that the rules give.

    Raises `IdentificationError` where the recordings are not of one robot, or as `make_problem`.
    """
    if isinstance(given, Signals):
        given = Recordings(sources=(given,))
    if len(given.sources) == 1:
        (source,) = given.sources
        signals = source if isinstance(source, Signals) else source.load()
        one = _observation(make_problem(signals, overrides), 1, say)
        return Observed(
            recordings=Recordings(sources=(signals,)),
            overrides=overrides,
            observations=(one,),
            regression=one.regression,
            order=(0,),
            parameters=own_parameters([one.problem]),
        )
    say(f"reading {len(given.sources)} recordings")
    given, found = _observe(given, [overrides] * len(given.sources), len(given.sources))
    check_one_robot([one.problem.signals for one in found])
    found = _alike(given, found, overrides)
    by_digest = sorted(
        range(len(found)), key=lambda k: (found[k].problem.signals.sha256, found[k].problem.signals.recording)
    )
    found = [found[k] for k in by_digest]
    parameters = own_parameters([one.problem for one in found])
    regression = stacked([parameters.widened(one.regression, k) for k, one in enumerate(found)])
    joints = tuple(joint.name for joint in found[0].problem.signals.robot.joints)
    refuse_slow_joints(regression.fast, joints, ", ".join(one.problem.signals.recording for one in found))
    return Observed(
        recordings=replace(given, sources=tuple(given.sources[k] for k in by_digest)),
        overrides=overrides,
        observations=tuple(found),
        regression=regression,
        order=tuple(by_digest.index(k) for k in range(len(found))),
        parameters=parameters,
    )


def _observe(given: Recordings, overrides: Sequence[Overrides], share: int) -> tuple[Recordings, list[Observation]]:
    """Observations of recordings; those whose files the workers do not find are sent to them."""
    sources, found = list(given.sources), []
    for k, one in enumerate(
        given.work.run(observe, list(zip(sources, overrides, [share] * len(sources), strict=True)))
    ):
        if one is None:
            source = sources[k]
            assert isinstance(source, RecordingFile)
            sources[k] = source.with_content()
            (one,) = given.work.run(observe, [(sources[k], overrides[k], share)])
        found.append(one)
    return replace(given, sources=tuple(sources)), found


def _alike(given: Recordings, found: list[Observation], overrides: Overrides) -> list[Observation]:
    """The same with common cut-off and rate of rows, and all of them reduced or none; only others are observed again."""
    settings = [one.problem.settings for one in found]
    rates = [one.problem.signals.sample_rate_hz for one in found]
    cutoff_hz = min((s.cutoff_hz for s in settings if s.cutoff_hz is not None), default=None)
    row_hz = min(fs / s.decimation for fs, s in zip(rates, settings, strict=True))
    share = ALL_REDUCED if any(one.regression.reduced for one in found) else len(found)
    again = []
    for k, (fs, s) in enumerate(zip(rates, settings, strict=True)):
        decimation = max(1, round(fs / row_hz))
        reduced = found[k].regression.reduced or share != ALL_REDUCED
        if (s.cutoff_hz, s.decimation) != (cutoff_hz, decimation) or not reduced:
            again.append((k, replace(overrides, cutoff_hz=cutoff_hz or 0.0, decimation=decimation)))
    if again:
        some = replace(given, sources=tuple(given.sources[k] for k, _ in again))
        for (k, _), one in zip(again, _observe(some, [o for _, o in again], share)[1], strict=True):
            found[k] = one
    return found
