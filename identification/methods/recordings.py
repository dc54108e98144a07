"""The recordings of a fit, and the system that all of them make together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..data import RecordingFile, Recordings, Signals, check_one_robot
from ..errors import IdentificationError
from ..estimation import Estimate, ordinary_least_squares, slices, weighted_least_squares
from ..passes import LinearisedRecording, settled_least_squares, untold_terms, without
from ..regression import (
    Overrides,
    OwnParameters,
    Problem,
    Regression,
    make_problem,
    own_parameters,
    refuse_slow_joints,
    stacked,
)
from ..replica import Bench, Lab, Place
from ..trust import Part
from .observation import Observation, Say, observation_of, observe, predict, regression_at

ALL_REDUCED = 10**9  # so many share the memory for rows that all are reduced


@dataclass(frozen=True, kw_only=True, eq=False)
class Observed:
    """All recordings of a fit, in the order of their digests: sums over them do not depend on the order they are given in.

    Attributes:
        recordings: as they were given, in the order of the digests; `overrides` the settings they were observed with.
        observations: one by one.
        regression: the system that they make together.
        order: places of the recordings as the user gave them.
        parameters: those that the recordings share, and those of each.
        linearised: W and Y about any parameters, of one recording; None of several, and before least squares has settled.
        left_out: friction terms of the description that several recordings cannot tell.
    """

    recordings: Recordings
    overrides: Overrides
    observations: tuple[Observation, ...]
    regression: Regression
    order: tuple[int, ...]
    parameters: OwnParameters
    linearised: LinearisedRecording | None = None
    left_out: tuple[str, ...] = ()

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
            settings = self.settings_of(one)
            found.append(Place(source=source, overrides=settings, at_hand=at_hand, left_out=self.left_out))
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

    @property
    def load_places(self) -> NDArray[np.intp]:
        """Where the parameters of load friction are among those of the system."""
        return np.array([], dtype=np.intp) if self.linearised is None else self.linearised.load.places

    def at(self, beta: Array) -> "Observed":
        """The same with W and Y about values of all parameters, by which load friction goes; the same without any."""
        if self.linearised is None or not self.linearised.load:
            return self
        return replace(self, regression=self.linearised.at(beta))

    def settled(self, method: Literal["ols", "wls"] = "wls") -> tuple["Observed", Estimate]:
        """Least squares of all parameters, and the same without the friction terms that are not told, W and Y about them.

        Raises `IdentificationError` as of the estimators.
        """
        if len(self.observations) == 1:
            (one,) = self.observations
            found = settled_least_squares(one.problem, one.regression, method)
            observed = self._of([(found.problem, found.recording.plain)], found.observed)
            return replace(observed, linearised=found.recording), found.full
        observed, solve = self, weighted_least_squares if method == "wls" else ordinary_least_squares
        if untold := untold_terms(self.problem, self.regression.system):
            each = [without(one.problem, one.regression, untold) for one in self.observations]
            observed = self._of(each, without(self.problem, self.regression, untold)[1])
            observed = replace(observed, left_out=tuple(untold))
        return observed, solve(observed.regression.system)

    def _of(self, each: Sequence[tuple[Problem, Regression]], regression: Regression) -> "Observed":
        """The same recordings as other problems and regressions, and the system that they make together."""
        return replace(
            self,
            observations=tuple(
                replace(one, problem=problem, regression=own)
                for one, (problem, own) in zip(self.observations, each, strict=True)
            ),
            regression=regression,
            parameters=own_parameters([problem for problem, _ in each]),
            linearised=None,
        )

    def at_cutoff(self, cutoff_hz: float) -> "Observed":
        """The same recordings behind another low-pass."""
        tasks = [
            (place, replace(place.overrides, cutoff_hz=cutoff_hz), len(self.observations)) for place in self.places()
        ]
        each = list(self.recordings.work.run(regression_at, tasks))
        return self._of(
            [
                (replace(one.problem, settings=settings), own)
                for one, (settings, own) in zip(self.observations, each, strict=True)
            ],
            stacked([self.parameters.widened(own, k) for k, (_, own) in enumerate(each)]),
        )

    def settings_of(self, observation: Observation) -> Overrides:
        """What a recording was observed with: the options, and the cut-off and decimation that are common to all."""
        settings = observation.problem.settings
        return replace(self.overrides, cutoff_hz=settings.cutoff_hz or 0.0, decimation=settings.decimation)

    def predicted(self, estimate: Estimate) -> Array:
        """Decimated torque (rows, n) that an estimate predicts."""
        observed = self.regression
        if observed.reduced:
            beta = estimate.among(self.problem.base.names)
            return np.concatenate(list(self.recordings.work.run(predict, [(place, beta) for place in self.places()])))
        return observed.predicted(estimate.among(observed.system.names))


def observe_all(given: Signals | Recordings, overrides: Overrides, say: Say) -> Observed:
    """W and Y of one recording or several, filtered and decimated one by one, and stacked.

    Cut-off and decimation are common, the lowest cut-off and the lowest rate of rows that the rules give.

    Raises `IdentificationError` where the recordings are not of one robot, or several with load friction, or as
    `make_problem`.
    """
    if isinstance(given, Signals):
        given = Recordings(sources=(given,))
    if len(given.sources) == 1:
        (source,) = given.sources
        signals = source if isinstance(source, Signals) else source.load()
        one = observation_of(make_problem(signals, overrides), 1, say)
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
    _refuse_load(found[0].problem.signals)
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


def _refuse_load(signals: Signals) -> None:
    """Refuse load friction of several recordings: its W and Y are about an estimate, and these are made of one recording."""
    for joint in signals.robot.joints:
        if "load" in joint.terms:
            raise IdentificationError(
                "load friction is fitted of one recording",
                place=f"robot {signals.robot.name}",
                key=f"joint {joint.name}: friction",
                value="load",
                expected="its list without load where several recordings are fitted together, or one recording",
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
