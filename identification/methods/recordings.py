"""The recordings of a fit, and the system that all of them make together."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..data import RecordingFile, Recordings, Signals, check_one_robot
from ..errors import IdentificationError
from ..estimation import Estimate, System, slices
from ..regression import (
    ALL_REDUCED,
    HELD,
    Linearised,
    Overrides,
    OwnParameters,
    Place,
    Problem,
    Regression,
    make_problem,
    own_parameters,
    refuse_slow_joints,
    rule_cutoff_hz,
    settled_least_squares,
    without_terms,
)
from ..simulation import Instruments, Lab, Simulation
from ..trust import RecordingData
from .observation import SPAN_S, Say, observation_of, observe, predict, regression_at, retimed_at

SPAN_NUMBERS = 3_000_000  # of its W


@dataclass(frozen=True, kw_only=True, eq=False)
class Observed:
    """All recordings of a fit, in the order of their digests: sums over them do not depend on the order they are given in.

    Attributes:
        recordings: as they were given, in the order of the digests; `overrides` the settings they were observed with.
        observations: one by one.
        order: places of the recordings as the user gave them.
        linearised: W and Y about any parameters.
        regression: the system that they make together, about the parameters of `at`; columns of load friction are zero before.
    """

    recordings: Recordings
    overrides: Overrides
    observations: tuple[RecordingData, ...]
    order: tuple[int, ...]
    linearised: Linearised
    regression: Regression

    @property
    def problem(self) -> Problem:
        """That of the recording given first: robot, model and base parameters are those of all."""
        return self.observations[self.order[0]].problem

    @property
    def parameters(self) -> OwnParameters:
        """Those that the recordings share, and those of each."""
        return self.linearised.parameters

    @property
    def parts(self) -> tuple[slice, ...]:
        """The decimated instants of each recording."""
        return tuple(slices(self.regression.parts))

    def places(self) -> list[Place]:
        """Where tasks find the recordings, without the terms that are left out."""
        return _places(self.recordings, self.overrides, self.observations, tuple(self.linearised.left_out))

    def lab(self, prior: Array, *, gain_update: bool) -> Lab:
        """The recordings laid out for simulation, gains being those for the inertias of `prior`, values of all parameters."""
        return Lab(
            simulations=tuple(
                Simulation(
                    place=place,
                    prior=prior[self.parameters.places(k)],
                    slip_noise=one.regression.slip_noise,
                    long=one.regression.reduced,
                    gain_update=gain_update,
                )
                for k, (place, one) in enumerate(zip(self.places(), self.observations, strict=True))
            ),
            names=tuple(one.problem.signals.recording for one in self.observations),
            parameters=self.parameters,
            work=self.recordings.work,
        )

    @property
    def load_places(self) -> NDArray[np.intp]:
        """Where the parameters of load friction are among those of the system."""
        return self.linearised.load_places()

    def at(self, beta: Array) -> "Observed":
        """The same with W and Y about values of all parameters, by which load friction goes; the same without any."""
        if not self.linearised.load:
            return self
        whole, each = self.linearised.at(beta), self.linearised.each_at(beta)
        observations = (replace(one, regression=own) for one, own in zip(self.observations, each, strict=True))
        return replace(self, observations=tuple(observations), regression=whole)

    def about(self, z: Instruments) -> "Observed":
        """The same with W and Y about the parameters of a pass; of long recordings its factors have them."""
        return self if z.system is not None else self.at(z.beta)

    def along(self, z: Instruments) -> tuple[System, Array]:
        """W, Y and Z with the rows that count in a pass, about its parameters; of long recordings QR factors."""
        if z.system is not None:
            return z.system, z.Z
        return self.about(z).regression.system.with_rows(z.used), z.Z

    def settled(self, method: Literal["ols", "wls"] = "wls") -> tuple["Observed", Estimate]:
        """Least squares of all parameters, and the same without the friction terms that are not told, W and Y about them.

        Raises `IdentificationError` as of the estimators.
        """
        found = settled_least_squares(self.linearised, method)
        told = found.linearised
        observations = (
            replace(one, problem=without_terms(one.problem, told.left_out), regression=own, parameters=names)
            for one, own, names in zip(self.observations, told.each, told.parameters.of, strict=True)
        )
        observed = replace(self, observations=tuple(observations), linearised=told, regression=told.plain)
        return observed.at(found.about), found.full

    def at_cutoff(self, cutoff_hz: float) -> "Observed":
        """The same recordings behind another low-pass; columns of load friction are zero."""
        tasks = [
            (place, replace(place.overrides, cutoff_hz=cutoff_hz), len(self.observations)) for place in self.places()
        ]
        observations = (
            replace(one, problem=replace(one.problem, settings=settings), regression=regression)
            for one, (settings, regression) in zip(
                self.observations, self.recordings.work.run(regression_at, tasks), strict=True
            )
        )
        left_out = tuple(self.linearised.left_out)
        return _observed(self.recordings, self.overrides, tuple(observations), self.order, left_out)

    @property
    def method(self) -> tuple[Literal["iv", "wls"], str]:
        """The method by default, and why: instruments where every recording has its reference."""
        without = [one.problem.signals for one in self.observations if one.problem.signals.q_ref is None]
        if not without:
            return "iv", "reference recorded"
        where = f" in {without[0].recording}" if len(self.observations) > 1 else ""
        return "wls", f"no reference{where}"

    def behind_rule(self) -> "Observed | None":
        """The same recordings behind the rule's low-pass; None where all are behind it, or behind a lower one.

        None too where a recording is too short for it.
        """
        if all(one.problem.settings.filtered for one in self.observations):
            return None
        signals = [one.problem.signals for one in self.observations]
        with suppress(IdentificationError):
            return self.at_cutoff(min(rule_cutoff_hz(s.robot.bandwidth_hz, s.sample_rate_hz) for s in signals))
        return None

    def on_span(self) -> "Observed":
        """The recordings as they are where rows are held; else the beginning of the first, with rows, three minutes at most."""
        if not self.regression.reduced:
            return self
        problem = self.places()[0].problem()
        settings, fs = problem.settings, problem.signals.sample_rate_hz
        rows = min(SPAN_NUMBERS // (problem.signals.robot.n * problem.base.b), int(SPAN_S * fs / settings.decimation))
        stop = min(settings.stop, settings.start + rows * settings.decimation)
        one = observation_of(replace(problem, settings=replace(settings, stop=stop)), HELD)
        left_out = tuple(self.linearised.left_out)
        return _observed(Recordings(sources=(problem.signals,)), self.overrides, (one,), (0,), left_out)

    def corrected(self, lags_s: Sequence[float]) -> "Observed":
        """The same with the torque of each recording corrected by another lag, s; columns of load friction are zero."""
        if all(one.problem.settings.torque_lag_s == lag for one, lag in zip(self.observations, lags_s, strict=True)):
            return self
        tasks = list(zip(self.places(), self.linearised.each, lags_s, strict=True))
        observations = (
            replace(one, problem=one.problem.corrected(lag_s), regression=regression)
            for one, lag_s, regression in zip(
                self.observations, lags_s, self.recordings.work.run(retimed_at, tasks), strict=True
            )
        )
        left_out = tuple(self.linearised.left_out)
        return _observed(self.recordings, self.overrides, tuple(observations), self.order, left_out)

    def predicted(self, estimate: Estimate) -> Array:
        """Decimated torque (rows, n) that an estimate predicts."""
        observed = self.regression
        if observed.reduced:
            beta = estimate.among(self.problem.base.names)
            return np.concatenate(list(self.recordings.work.run(predict, [(place, beta) for place in self.places()])))
        return observed.predicted(estimate.among(observed.system.names))


def _observed(
    recordings: Recordings,
    overrides: Overrides,
    observations: tuple[RecordingData, ...],
    order: tuple[int, ...],
    left_out: tuple[str, ...] = (),
) -> Observed:
    """The recordings and the system that they make together, columns of load friction zero; `left_out` are terms that the
    observations are without.
    """
    linearised = Linearised(
        problem=observations[order[0]].problem,
        each=tuple(one.regression for one in observations),
        places=tuple(_places(recordings, overrides, observations, left_out)),
        parameters=own_parameters([one.problem for one in observations]),
        work=recordings.work,
    )
    named = zip(observations, linearised.parameters.of, strict=True)
    return Observed(
        recordings=recordings,
        overrides=overrides,
        observations=tuple(replace(one, parameters=names) for one, names in named),
        order=order,
        linearised=linearised,
        regression=linearised.plain,
    )


def _places(
    recordings: Recordings, overrides: Overrides, observations: Sequence[RecordingData], left_out: tuple[str, ...]
) -> list[Place]:
    """Where tasks find recordings: the problem where it is at hand and need not be sent, or the file.

    A file is observed with the options, and with the cut-off and decimation that are common to all.
    """
    found = []
    for source, problem in zip(recordings.sources, (one.problem for one in observations), strict=True):
        without_samples, settings = not len(problem.signals.q), problem.settings
        in_file = isinstance(source, RecordingFile) and recordings.work.remote
        common = replace(overrides, cutoff_hz=settings.cutoff_hz or 0.0, decimation=settings.decimation)
        at_hand = None if in_file or without_samples else problem
        lag_s = settings.torque_lag_s
        found.append(Place(source=source, overrides=common, at_hand=at_hand, lag_s=lag_s, left_out=left_out))
    return found


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
        one = observation_of(make_problem(signals, overrides), 1, say)
        return _observed(Recordings(sources=(signals,)), overrides, (one,), (0,))
    say(f"reading {len(given.sources)} recordings")
    found = _observe(given, [overrides] * len(given.sources), len(given.sources))
    check_one_robot([one.problem.signals for one in found])
    found = _alike(given, found, overrides)
    by_digest = sorted(
        range(len(found)), key=lambda k: (found[k].problem.signals.sha256, found[k].problem.signals.recording)
    )
    found = [found[k] for k in by_digest]
    observed = _observed(
        replace(given, sources=tuple(given.sources[k] for k in by_digest)),
        overrides,
        tuple(found),
        tuple(by_digest.index(k) for k in range(len(found))),
    )
    joints = tuple(joint.name for joint in found[0].problem.signals.robot.joints)
    refuse_slow_joints(observed.regression.fast, joints, ", ".join(one.problem.signals.recording for one in found))
    return observed


def _observe(given: Recordings, overrides: Sequence[Overrides], share: int) -> list[RecordingData]:
    tasks = zip(given.sources, overrides, [share] * len(given.sources), strict=True)
    return list(given.work.run(observe, list(tasks)))


def _alike(given: Recordings, found: list[RecordingData], overrides: Overrides) -> list[RecordingData]:
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
        for (k, _), one in zip(again, _observe(some, [o for _, o in again], share), strict=True):
            found[k] = one
    return found
