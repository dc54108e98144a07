"""Weights of samples: those at which a joint stands weigh nothing.

While a joint stands its friction is anything between -Fc and Fc, which no model says, and the
decimation filter F carries it into the rows around. So torque and regressor of joint j are
multiplied by the same weight w_j(t) before both are decimated,

    Y_j := F[w_j Y_j],    W_j := F[w_j W_j],    Z_j := F[w_j Z_j];

Y = W beta at every sample with w > 0 gives F[w Y] = F[w W] beta, whatever the friction was where w
= 0. w is 0 where a joint stands, 1/2 L samples away and 1 from 2 L samples on: an abrupt edge would
fold noise above the low-pass into the band. Moves that are shorter than the filter leave nothing:
such a joint has no weights, but only the rows at whose instants it moves.

Samples that nobody measured weigh nothing in the same way, also where those of standstill do.
"""

from collections.abc import Sequence

import numpy as np

from ..arrays import Array, Bools
from ..data import Signals
from ..errors import NoFitError
from .filtering import nearby
from .motion import BLOCK_SAMPLES
from .problem import Problem, row_blocks
from .settings import LOW_SPEED_PERCENT, MAX_CUTOFF_SHARE, RAMPS, ROWS, SURROGATE_BANDWIDTH_RATIO

LOW_SPEED_DEVIATIONS = 4.0  # of the noise of the speed
# terms of friction that tell it at lower speeds, and how much lower
SLOW_TERMS, SLIDING_SHARE = frozenset(("root", "load", "stribeck")), 0.25
MIN_SHARE = 0.1  # weight of a row that counts
# of the rows in which a joint moves, by their weights; with fewer it gets the next shorter ramp
MIN_ROWS_LEFT = 1 / 3


class SampleWeights:
    """The weights of a recording.

    Attributes:
        moves: (N, n) which joints move at its samples, and were measured.
        ramps: (n,) L in rows, or `ROWS`, by joint: shorter than asked where a
            joint's moves are short.
        of_rows: (rows, n) weights of the decimated rows, 0 for those that do not count.
    """

    def __init__(self, problem: Problem, moves: Bools) -> None:
        settings, few = problem.settings, np.ones(moves.shape[1], dtype=bool)
        self._measured, self.moves = problem.measured_samples(), moves
        moving, self.ramps = moves[settings.instants], np.zeros(len(few))
        for ramp in (settings.ramp_rows, *(one for one in RAMPS if one < settings.ramp_rows)):
            self.ramps[few] = ramp
            self._set_rows(problem, moving)
            few = (self.of_rows**2).sum(axis=0) < MIN_ROWS_LEFT * moving.sum(axis=0)
            if not few.any():
                break

    def _set_rows(self, problem: Problem, moving: Bools) -> None:
        """1 - F[1 - w] is 1 to rounding where all samples weigh 1; F itself has a gain
        below 1 at frequency 0.
        """
        settings, parts = problem.settings, list[Array]()
        decimation, N = settings.decimator, settings.stop - settings.start
        # negative for `ROWS`
        self._reach = [round(ramp * settings.decimation) for ramp in self.ramps]
        for near, inside in row_blocks(problem):
            samples = decimation.samples(near, N)
            off = 1 - self.between(settings.start + samples.start, settings.start + samples.stop)
            parts.append(1 - decimation.filtered(off)[:, inside] / decimation.gain)
        share = np.concatenate(parts, axis=1).T
        share = np.where(self.ramps == ROWS, moving * share, share)
        self.of_rows = np.where(share > MIN_SHARE, share, 0.0)

    def between(self, start: int, stop: int) -> Array:
        """w (n, stop - start) of the samples `start` to `stop`."""
        far = 2 * max(0, *self._reach)
        low, high = max(0, start - far), min(len(self.moves), stop + far)
        near, inside = self.moves[low:high], slice(start - low, stop - low)
        of_rows = self._measured[low:high].astype(float)
        return np.stack(
            [
                (of_rows if reach < 0 else _ramped(near[:, j], reach))[inside]
                for j, reach in enumerate(self._reach)
            ]
        )


def sample_weights(problem: Problem, given: SampleWeights | None = None) -> SampleWeights:
    """The weights of a recording, made once for its motion and settings; or those `given`, from
    then on.
    """
    s, once = problem.settings, problem.motion.once
    span = (s.start, s.stop, s.decimation, s.cutoff_hz, s.low_speed_percent)
    return once(
        ("weights", *span, s.ramp_rows),
        lambda: given or SampleWeights(problem, once(("moves", *span), lambda: _moves(problem))),
    )


def weights_at(problem: Problem, t_s: Array) -> Array:
    """w (n, K) at equidistant samples of the recording, at `t_s` (K,)."""
    at = np.rint(t_s[[0, 1, -1]] * problem.signals.sample_rate_hz).astype(int)
    return sample_weights(problem).between(int(at[0]), int(at[2]) + 1)[:, :: int(at[1] - at[0])]


def refuse_standing_joints(share: Array, recordings: Sequence[Signals]) -> None:
    """Refuse recordings in none of which a row of a joint counts, by the weights (rows, n)."""
    robot = recordings[0].robot
    unmeasured = "; ".join(one.unmeasured for one in recordings if one.unmeasured)
    for j, joint in enumerate(robot.joints):
        if not share[:, j].any():
            raise NoFitError(
                f"joint {joint.name} never moves for longer than a period of the filters between "
                "two stops, or is never faster than "
                f"the noise of its speed{f'; {unmeasured}' if unmeasured else ''}",
                place=", ".join(one.recording for one in recordings),
                expected=f"longer moves, a bandwidth_hz above {robot.bandwidth_hz:.3g}, or "
                "low_speed_percent of [identification]",
            )


def _moves(problem: Problem) -> Bools:
    """Which joints (N, n) move, in samples that were measured: no Coulomb direction that acts on a
    joint is slow within half a period of the cut-off.

    Slow: below 4 % of the peak in the span, 1 % where friction has terms of slow motion (root,
    load, Stribeck), or 4 deviations of the noise of the regressor's speed if that is more.
    Speeds have the low-pass of the fit, or of the rule if the fit has none or a higher one; the
    noise is the difference and, for terms of slow motion, what passes of that of the position. The
    low-pass smears a speed by half a period of its cut-off, so a joint that sticks for a moment
    seems to creep.

    A low-pass that was put where the motion ends smears a reversal over more than the reversal
    takes: at twice that frequency speeds have little more noise, and rows beside reversals stay.
    """
    settings, fs, N = problem.settings, problem.signals.sample_rate_hz, len(problem.signals.q)
    percent, directions = settings.low_speed_percent, problem.model.coulomb_directions
    cutoff_hz = problem.slip_cutoff_hz
    if problem.signals.motion_hz is not None:
        cutoff_hz = min(SURROGATE_BANDWIDTH_RATIO * cutoff_hz, MAX_CUTOFF_SHARE * fs)
    measured = problem.measured_samples()[:, None]
    if percent == 0:
        return np.broadcast_to(measured, (N, directions.shape[1]))
    speed, noise = (
        np.empty((N, len(directions)), dtype=np.float32),
        np.zeros((2, directions.shape[1])),
    )
    for a in range(0, N, BLOCK_SAMPLES):
        b = min(N, a + BLOCK_SAMPLES)
        dq = problem.motion.between(a, b, cutoff_hz).dq
        speed[a:b] = dq @ directions.T * measured[a:b]
        low, high = max(a, settings.start), min(b, settings.stop)
        if not settings.filtered and low < high:
            off = problem.motion.between(low, high, settings.cutoff_hz).dq - dq[low - a : high - a]
            noise += off.sum(axis=0), (off**2).sum(axis=0)
    threshold = 0.01 * (LOW_SPEED_PERCENT if percent is None else percent)
    threshold = threshold * np.abs(speed[settings.start : settings.stop]).max(axis=0, initial=0.0)
    if percent is None:
        mean, square = noise / (settings.stop - settings.start)
        square, of_low_pass = (
            np.maximum(square - mean**2, 0),
            _noise_of_speed(problem, cutoff_hz) ** 2,
        )
        least = [
            LOW_SPEED_DEVIATIONS * np.sqrt(x) @ np.abs(directions.T)
            for x in (square, square + of_low_pass)
        ]
        threshold = np.where(
            (directions != 0)
            @ [not SLOW_TERMS.isdisjoint(x.terms) for x in problem.signals.robot.joints],
            np.maximum(SLIDING_SHARE * threshold, least[1]),
            np.maximum(threshold, least[0]),
        )
    slow = np.abs(speed) < threshold
    slow[1:] |= speed[1:] * speed[:-1] < 0  # a reversal between two samples
    near = [nearby(own, round(0.5 * fs / cutoff_hz)) for own in (slow @ (directions != 0)).T]
    return ~np.stack(near, axis=1) & measured


def _noise_of_speed(problem: Problem, cutoff_hz: float) -> Array:
    """Deviation (n,) of the noise of the speed behind a low-pass, of white noise of the position,
    which third differences show.
    """
    thirds = np.abs(np.diff(problem.signals.q[:BLOCK_SAMPLES], 3, axis=0))
    passed = np.sqrt(2 * cutoff_hz**3 / (3 * problem.signals.sample_rate_hz))
    return np.asarray(1.4826 * np.median(thirds, axis=0) / np.sqrt(20) * 2 * np.pi * passed)


def _ramped(moves: Bools, L: int) -> Array:
    """w (N,) of a joint: Hann ramps of 2 L samples inside its moves, zero where it stands.

    Beyond the ends nothing changes.
    """
    if L == 0 or moves.all():
        return moves.astype(float)
    inner, window = (
        np.pad(~nearby(~moves, L), L, mode="edge").astype(float),
        np.hanning(2 * L + 3)[1:-1],
    )
    window, steps = window / window.sum(), np.zeros(len(inner) + 2 * L)
    for k in np.flatnonzero(edges := np.diff(inner)):
        steps[k : k + 2 * L + 1] += edges[k] * window
    w = np.cumsum(np.r_[inner[: 2 * L + 1] @ window, steps[2 * L : 2 * L + len(moves) - 1]])
    return np.where(moves, np.clip(w, 0.0, 1.0), 0.0)
