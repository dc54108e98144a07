"""Motions in blocks: the recorded one, that of a simulated robot, or one with another torque.

All have the same interface, so that W and Z are the same columns along two motions. A block filters
any series as equation (6) of Janot2014 does, F[w x]: times the weights w of the samples, then
decimated. Recordings are read-only: delay and gains do not change them, as these are unknowns of
the term `Drives`.

Samples at which a joint is at rest have zero weight. Friction at rest may have any value between
-Fc and Fc, which no model predicts, and the decimation filter F carries it into the rows around. So
torque and regressor of joint j are multiplied by the same weight w_j(t) before both are decimated:

    Y_j := F[w_j Y_j],    W_j := F[w_j W_j],    Z_j := F[w_j Z_j]

Y = W beta at every sample with w > 0 gives F[w Y] = F[w W] beta, whatever the friction at rest is.
The weight w is 0 at rest, 1/2 at L samples away and 1 from 2 L samples on, because an abrupt edge
would fold noise above the low-pass into the band. If the moves of a joint are shorter than the
filter F, nothing is left of them: such a joint has no weights, but only the rows at whose instants
it moves.

Samples that were not measured have zero weight in the same way.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from ..arrays import Array, Bools, Ints
from ..data import Signals
from ..errors import NoFitError
from ..model import BaseParameters, InverseModel, direct_model_of_base
from .filtering import Decimation, nearby
from .motion import BLOCK_SAMPLES, Motion, differentiate, smooth
from .problem import Problem, row_blocks
from .settings import LOW_SPEED_PERCENT, MAX_CUTOFF_SHARE, RAMPS, ROWS, SURROGATE_BANDWIDTH_RATIO

LOW_SPEED_DEVIATIONS = 4.0  # standard deviations of the noise of the speed
# Friction terms that describe lower speeds too, and the share of the usual threshold for them.
SLOW_TERMS, SLIDING_SHARE = frozenset(("root", "load", "stribeck")), 0.25
MIN_SHARE = 0.1  # smallest weight of a row that counts
# Share of the rows in motion, by their weights; with fewer a joint gets the next shorter taper.
MIN_ROWS_LEFT = 1 / 3
DRIVES_A_ROW = 20  # samples of a predicted torque per row: its rate affects the intervals


class SampleWeights:
    """The sample weights of a recording.

    Attributes:
        moves: (N, n) mask of the samples at which a joint moves and was measured.
        ramps: (n,) taper L in rows, or `ROWS`, by joint; shorter than requested if a joint's moves
            are short.
        of_rows: (rows, n) weights of the decimated rows, 0 for those that do not count.
    """

    def __init__(self, problem: Problem, moves: Bools) -> None:
        settings, few = problem.settings, np.ones(moves.shape[1], dtype=bool)
        self._measured, self.moves = problem.measured_samples(), moves
        moving, self.ramps = moves[settings.instants], np.zeros(len(few))
        decimation, used = settings.decimator, settings.used
        blocks = [
            (used[decimation.samples(near, len(used))], inside)
            for near, inside in row_blocks(problem)
        ]
        for ramp in (settings.ramp_rows, *(one for one in RAMPS if one < settings.ramp_rows)):
            self.ramps[few] = ramp
            # The reach of `ROWS` is negative.
            self._reach = [round(ramp * settings.decimation) for ramp in self.ramps]
            off = [
                decimation.filtered(1 - self.between(at.start, at.stop))[:, inside]
                for at, inside in blocks
            ]
            # F has a gain below 1 at frequency 0, but 1 - F[1 - w] is 1 to rounding where all
            # samples have the weight 1.
            share = (1 - np.concatenate(off, axis=1) / decimation.gain).T
            share = np.where(self.ramps == ROWS, moving * share, share)
            self.of_rows = np.where(share > MIN_SHARE, share, 0.0)
            few = (self.of_rows**2).sum(axis=0) < MIN_ROWS_LEFT * moving.sum(axis=0)
            if not few.any():
                break

    def between(self, start: int, stop: int) -> Array:
        """Return w (n, stop - start) of the samples `start` to `stop`."""
        far = 2 * max(0, *self._reach)
        low, high = max(0, start - far), min(len(self.moves), stop + far)
        near, measured = self.moves[low:high], self._measured[low:high].astype(float)
        inside = slice(start - low, stop - low)
        return np.stack(
            [
                (measured if reach < 0 else _ramped(near[:, j], reach))[inside]
                for j, reach in enumerate(self._reach)
            ]
        )


def sample_weights(problem: Problem, given: SampleWeights | None = None) -> SampleWeights:
    """Return the weights of a recording, computed once for its motion and settings.

    `given` weights replace them from then on.
    """
    s, once = problem.settings, problem.motion.once
    span = (s.start, s.stop, s.decimation, s.cutoff_hz, s.low_speed_percent)
    return once(
        ("weights", *span, s.ramp_rows),
        lambda: given or SampleWeights(problem, once(("moves", *span), lambda: _moves(problem))),
    )


def weights_at(problem: Problem, t_s: Array) -> Array:
    """Return w (n, K) at equidistant samples of the recording, at the times `t_s` (K,)."""
    at = np.rint(t_s[[0, 1, -1]] * problem.signals.sample_rate_hz).astype(int)
    return sample_weights(problem).between(int(at[0]), int(at[2]) + 1)[:, :: int(at[1] - at[0])]


def refuse_standing_joints(share: Array, recordings: Sequence[Signals]) -> None:
    """Refuse recordings if a joint has no row that counts, by the weights (rows, n)."""
    robot = recordings[0].robot
    unmeasured = "; ".join(one.unmeasured for one in recordings if one.unmeasured)
    for j, joint in enumerate(robot.joints):
        if not share[:, j].any():
            raise NoFitError(
                f"joint {joint.name} never moves for longer than a period of the filters between "
                "two stops, or never faster than the noise of its speed"
                f"{f'; {unmeasured}' if unmeasured else ''}",
                place=", ".join(one.recording for one in recordings),
                advice="Record longer moves, or in robot.toml give a bandwidth_hz greater than "
                f"{robot.bandwidth_hz:.3g}, or low_speed_percent of [identification]",
            )


def _moves(problem: Problem) -> Bools:
    """Return a mask (N, n) of the joints in motion, at samples that were measured.

    A joint is in motion if no Coulomb direction that acts on it is slow within half a period of the
    cut-off. Slow means less than 4 % of the peak in the time range used, or 1 % if friction has
    terms of slow motion (square-root, load-dependent, Stribeck); or less than 4 standard deviations
    of the noise of the regressor's speed, if that is more.

    Speeds have the low-pass of the fit, or of the rule if the fit has none or a higher one. The
    noise is the difference of both and, for terms of slow motion, the position noise that passes.
    The low-pass smears a speed by half a period of its cut-off, so that a joint that sticks for a
    moment seems to creep.

    A low-pass at the end of the motion smears a reversal over more time than the reversal takes. At
    twice that frequency speeds have little more noise, and rows beside reversals stay.
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
    peak = np.abs(speed[settings.start : settings.stop]).max(axis=0, initial=0.0)
    threshold = 0.01 * (LOW_SPEED_PERCENT if percent is None else percent) * peak
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
    # A reversal between two samples has no slow sample of its own.
    slow[1:] |= speed[1:] * speed[:-1] < 0
    near = [nearby(own, round(0.5 * fs / cutoff_hz)) for own in (slow @ (directions != 0)).T]
    return ~np.stack(near, axis=1) & measured


def _noise_of_speed(problem: Problem, cutoff_hz: float) -> Array:
    """Return the standard deviation (n,) of the noise of a low-passed speed.

    The position is assumed to have white noise, which third differences show.
    """
    thirds = np.abs(np.diff(problem.signals.q[:BLOCK_SAMPLES], 3, axis=0))
    passed = np.sqrt(2 * cutoff_hz**3 / (3 * problem.signals.sample_rate_hz))
    return np.asarray(1.4826 * np.median(thirds, axis=0) / np.sqrt(20) * 2 * np.pi * passed)


def _ramped(moves: Bools, L: int) -> Array:
    """Return w (N,) of a joint: Hann tapers of 2 L samples inside its moves, zero at rest.

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


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionBlock(Motion):
    """A block of a motion, with the margins that the filters of its rows need.

    Attributes:
        problem: recording that it belongs to.
        near: rows that it has samples of.
        inside: its own rows among these.
        decimation: decimation from its samples to the rows.
        stride: step between samples that suffices for links; more than 1 for a low-passed motion.
    """

    problem: Problem
    near: slice
    inside: slice
    decimation: Decimation
    stride: int = 1

    def __getstate__(self) -> dict[str, Any]:
        """Return all that rows need, so that another process needs no recording."""
        return {
            **vars(self),
            **{name: getattr(self, name) for name in ("weights", "share", "known_torque")},
            "problem": self.problem.without_samples,
        }

    @cached_property
    def weights(self) -> Array:
        """Weights (n, N) of the samples: 0 for a joint at rest, 1 in motion."""
        return weights_at(self.problem, self.t_s)

    @cached_property
    def share(self) -> Array:
        """Weights (n, rows) of the rows, 0 for those that do not count."""
        return sample_weights(self.problem).of_rows[self.near][self.inside].T

    @property
    def first(self) -> int:
        """First row of the block."""
        return int(self.near.start + self.inside.start)

    @cached_property
    def W(self) -> Array:
        """Regressor (n, b, rows) F[w IDM]; columns of load-dependent friction are zero."""
        w, N, links = self.weights, len(self.q), self.problem.base.links
        found = np.zeros((len(w), len(links), self.decimation.rows(N)))
        # A short block consists mostly of ends, for which a stride saves nothing.
        few = self.stride > 1 and self.stride * self.decimation.end_samples < N
        if (strided := links & few).any():
            at, end = (N - 1) % self.stride, self.decimation.end_samples
            entries, parts = self._series(
                strided,
                slice(at, None, self.stride),
                slice(at + end + 1),
                slice(N - end - 1, None),
            )
            found[entries] = self.decimation.filtered_strided(*parts)
        entries, parts = self._series(~strided, slice(None))
        found[entries] = self.decimation.filtered(*parts)
        return np.ascontiguousarray(found[..., self.inside])

    def _series(self, of: Bools, *spans: slice) -> tuple[tuple[Ints, Ints], list[Array]]:
        """Return the entries of some columns, and parts of their weighted series (E, N).

        Entries are joints and places (E,).
        """
        model, places, parts = self.problem.model, np.flatnonzero(of), list[Array]()
        columns = self.problem.base.columns[places]
        joints, of_columns = model.entries(columns).T
        for at in spans:
            parts.append(model.series(self.q[at], self.dq[at], self.ddq[at], columns))
            for x, j in zip(parts[-1], joints, strict=True):
                x *= self.weights[j, at]
        return (joints, places[of_columns]), parts

    @cached_property
    def known_torque(self) -> Array:
        """External torque (N, n) of its samples, N m or N; zero for none."""
        signals = self.problem.signals
        if signals.known_torque is None:
            return np.zeros(self.q.shape)
        at = np.rint(self.t_s * signals.sample_rate_hz).astype(np.intp)
        return np.asarray(signals.known_torque[at])

    def weighted(self, x: Array, joints: Sequence[int] | Ints | slice = slice(None)) -> Array:
        """Return F[w x] (k, rows) of series x (k, N), one for each of some joints."""
        return self.filtered(self.weights[joints] * x)

    def filtered(self, x: Array) -> Array:
        """Return the rows F[x] (..., rows) of series x (..., N)."""
        return self.decimation.filtered(x)[..., self.inside]

    def kept(self, x: Array) -> Array:
        """Return the samples (rows, k) of x (N, k) at the instants of the rows."""
        return x[self.decimation.instants(len(x))][self.inside]

    def rate(self, x: Array) -> Array:
        """Return dx/dt (N, k) of x (N, k), per second."""
        return differentiate(x, 1 / float(self.t_s[1] - self.t_s[0]))

    @property
    def torque_stride(self) -> int:
        """Step between samples that suffices for a predicted torque."""
        return self.decimation.factor // DRIVES_A_ROW if self.problem.settings.filtered else 1

    def with_torque_of(self, beta: Array) -> "MotionBlock":
        """Return the motion with the torque of the drives that beta (b,) predicts, equation (1).

        That torque has no noise and no delay.
        """
        tau = predicted_torque(
            self, self.problem.model, self.problem.base, beta, self.torque_stride
        )
        return self.with_torque(tau - self.known_torque)

    def with_torque(self, tau: Array) -> "MotionBlock":
        """Return the motion, and all that was computed from it, with another torque (N, n)."""
        found = object.__new__(MotionBlock)
        vars(found).update(vars(self), tau=tau)
        return found


class Candidate(Protocol):
    """A provider of columns along a motion of a recording, beside the terms."""

    @property
    def sliding(self) -> Array:
        """Largest speeds (c,) along the directions of Coulomb friction."""

    def columns(self, motion: MotionBlock) -> Array:
        """Return the columns (n, k, rows), weighted and decimated."""

    def at_rest(self, motion: MotionBlock) -> Array:
        """Return the torques (n, g, rows) of links at rest, along the measured motion."""


def motion_blocks(problem: Problem) -> Iterator[MotionBlock]:
    """Yield the recorded motion of the time range used, low-passed, in blocks."""
    settings, decimation = problem.settings, problem.settings.decimator
    stride = decimation.stride_behind(settings.cutoff_hz, problem.signals.sample_rate_hz)
    for near, inside in row_blocks(problem):
        at = settings.used[decimation.samples(near, len(settings.used))]
        yield MotionBlock(
            **vars(problem.motion.between(at.start, at.stop, settings.cutoff_hz)),
            problem=problem,
            near=near,
            inside=inside,
            decimation=decimation,
            stride=1 if problem.exact else stride,
        )


def predicted_torque(
    motion: Motion, dynamics: InverseModel, base: BaseParameters, beta: Array, stride: int = 1
) -> Array:
    """Return the torque (..., N, n) of the inverse dynamic model along a motion, N m or N.

        IDM(q, dq, ddq) beta

    It is not decimated.

    Parameters
    ----------
    motion : q, dq, ddq, (N, n) each.
    dynamics, base : the robot and its b base parameters.
    beta : (..., b) their values.
    stride : samples from one to the next at which the torque of links is computed, as in `smooth`.
    """
    models = [direct_model_of_base(dynamics, base, one) for one in beta.reshape(-1, base.b)]
    links, gravity = np.array([one.links for one in models]), dynamics.model.gravity.linear
    rigid = smooth(
        lambda *states: dynamics.torques_of_links(states, links, gravity).swapaxes(0, 1),
        motion,
        stride,
    ).swapaxes(0, 1)
    return np.reshape(
        [
            one.torque(motion.q, motion.dq, motion.ddq, rigid=of_links)
            for one, of_links in zip(models, rigid, strict=True)
        ],
        (*beta.shape[:-1], *motion.q.shape),
    )
