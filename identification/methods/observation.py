"""What one recording brings to a fit, and the tasks that find it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..data import RecordingFile, Signals
from ..estimation import one_thread
from ..model import SHAPES
from ..passes import RowStates, row_states
from ..regression import (
    NOTHING,
    KnownLag,
    Overrides,
    Problem,
    Regression,
    Settings,
    make_problem,
    make_settings,
    regression_of_recording,
    retimed,
    torque_of_recording,
)
from ..replica import Place
from ..trust import Part, TrustLine, poses_of, replay_line

Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation:
    """A recording as a fit sees it.

    Attributes:
        problem: recording, settings and model; without samples where rows are reduced and recordings are several.
        regression: its W and Y.
        poses: (P, n) positions at which M is looked at.
        replay: its described control law against the recorded effort; `replay_lag` what that tells of the torque's lag.
        t_s: (rows,) instants of its decimated rows, s.
        states: some rows and the motion at them; None where friction has the usual terms alone.
    """

    problem: Problem
    regression: Regression
    poses: Array
    replay: TrustLine
    replay_lag: KnownLag | None
    t_s: Array
    states: RowStates | None

    def part(self, parameters: tuple[str, ...]) -> Part:
        """What it brings to the evidence before anything is simulated; its base parameters have these names."""
        return Part(
            problem=self.problem,
            parameters=parameters,
            slip_noise=self.regression.slip_noise,
            poses=self.poses,
            replay=self.replay,
            replay_lag=self.replay_lag,
            states=self.states,
        )

    @property
    def known_lag(self) -> KnownLag:
        """What is known of its torque's lag without an estimate."""
        known, replayed = self.problem.settings.known_lag, self.replay_lag
        if known.stated or replayed is None:
            return known
        return replayed if known.source == NOTHING else known.with_other(replayed)


@one_thread
def observe(source: Signals | RecordingFile, overrides: Overrides, share: int) -> Observation | None:
    """W and Y of a recording and what else is known without an estimate; None where the file is not found here.

    `share` is the number of recordings of the fit.
    """
    if isinstance(source, RecordingFile):
        if not source.found:
            return None
        source = source.load()
    return observation_of(make_problem(source, overrides), share)


def observation_of(problem: Problem, share: int, say: Say = lambda text: None) -> Observation:
    """The observation of a recording that is at hand; `share` as of `observe`."""
    settings, signals = problem.settings, problem.signals
    regression = regression_of_recording(problem, say, share=share)
    # Decimation keeps the last sample and every n_d-th before it.
    kept = settings.stop - 1 - settings.decimation * np.arange(len(regression.tau))[::-1]
    poses, (replay, replay_lag) = poses_of(signals.q[settings.start : settings.stop]), replay_line(problem)
    shaped = any(term in SHAPES for joint in signals.robot.joints for term in joint.terms)
    shaped |= any(joint.one_sided for joint in signals.robot.joints)
    states = row_states(problem) if shaped else None
    if share > 1 and regression.reduced:
        problem = problem.without_samples()
    return Observation(
        problem=problem,
        regression=regression,
        poses=np.array(poses),
        replay=replay,
        replay_lag=replay_lag,
        t_s=signals.t_s[kept],
        states=states,
    )


@one_thread
def regression_at(place: Place, overrides: Overrides, share: int) -> tuple[Settings, Regression]:
    """Settings, and W and Y of a recording with them, of other overrides."""
    problem = place.problem()
    settings = make_settings(problem.signals, overrides, problem.motion)
    return settings, regression_of_recording(replace(problem, settings=settings), share=share)


@one_thread
def retimed_at(place: Place, regression: Regression, lag_s: float) -> Regression:
    """The regression of a recording with its torque corrected by another lag."""
    return retimed(regression, place.problem().corrected(lag_s))


@one_thread
def predict(place: Place, beta: Array) -> Array:
    """Decimated torque (rows, n) that beta (b,) predicts for a recording."""
    return torque_of_recording(place.problem(), beta)[1]
