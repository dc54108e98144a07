"""The rows of a recording, equations (5) and (6): regressor of the model and torques,
weighted and decimated alike.

Rows are stacked by joint. The columns are asked of any motion in the same way: W and Y along the
measured motion, Z along that of the simulated robot. A long recording has QR factors of the rows of
each span of time, with the same products of columns: whatever is a sum of its columns, such as W P,
may be taken afterwards.
"""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import SPANS, SpanFactors, Spans, System, one_thread
from ..model import BaseParameters, InverseModel, direct_model
from .filtering import Decimation
from .load import LoadFriction, load_friction
from .motion import Motion, smooth
from .problem import MotionBlock, Problem, motion_blocks, motion_of_block, row_blocks
from .weights import refuse_standing_joints, sample_weights, weighted, weights_at

_MAX_NUMBERS = 4_000_000  # of W in rows; above, its spans are reduced to their QR factors
_MAX_NUMBERS_OF_ALL = 16_000_000  # the same of all recordings of a fit
REDUCED, HELD = 0.0, math.inf  # most numbers of a recording: always reduced, or never
MAX_BLOCKS_KEPT = 8  # whose torque by the last parameters is kept


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows:
    """The rows of a recording, and the measurements at their instants.

    Attributes:
        system: weighted W and Y.
        E: (r, n) weighted torque at the joints of each motor by its described gain; (r, 0)
            where no gain needs it.
        C: (r, k) columns of terms that are not in the model; (r, 0) until they are asked for.
        Z: (r, b + n) instruments in the rows of a long recording, those of E last; (r, 0) else.
        share: (T, n) weights of the decimated samples, 0 for those that do not count.
        tau: (T, n) decimated torques, not weighted; never reduced.
        speed: (T, n) joint speeds at the same instants.
    """

    system: System
    E: Array
    C: Array
    Z: Array
    share: Array
    tau: Array
    speed: Array

    @property
    def reduced(self) -> bool:
        """Whether rows are QR factors of spans rather than samples."""
        return self.system.spans[0].count < self.system.spans[0].instants

    @property
    def parts(self) -> tuple[int, ...]:
        """Numbers of decimated samples of the recordings, in sequence."""
        return tuple(spans.instants for spans in self.system.spans)

    @property
    def counts(self) -> NDArray[np.bool_]:
        """(T, n) whether a decimated sample counts."""
        return self.share > 0

    def residual(self, x: Array, weights: Array) -> Array:
        """Residual Y - J x (T, n), times `weights` (n,), for rows that are not reduced; 0
        where rows do not count.
        """
        J, Y = self.system.weighted(weights)
        return np.asarray((Y - J @ x).reshape(len(weights), -1).T)

    def about(self, beta: Array, load: LoadFriction, columns: Array) -> "Rows":
        """The same about beta (b,), by the columns (2, k, T) of load friction; for
        rows that are not reduced.
        """
        n, W, Y = self.tau.shape[1], self.system.W.copy(), self.system.Y.copy()
        load.linearise(
            W.reshape(n, -1, len(beta)).transpose(0, 2, 1), Y.reshape(n, -1), columns, beta
        )
        return replace(self, system=replace(self.system, W=W, Y=Y))

    def without(self, names: Collection[str]) -> "Rows":
        """The same without the columns of parameters."""
        stay = np.flatnonzero([name not in names for name in self.system.names])
        return replace(self, system=self.system.with_columns(stay))


def most_numbers(recordings: int) -> float:
    """Numbers of W that each of several recordings may hold in rows."""
    return min(_MAX_NUMBERS, _MAX_NUMBERS_OF_ALL // recordings)


class Term(Protocol):
    """What is asked for its columns along a motion of a recording."""

    def columns(self, problem: Problem, motion: Motion, decimation: Decimation) -> Array:
        """(n, k, rows), weighted and decimated."""


def rows_of_recording(
    problem: Problem,
    say: Callable[[str], None] = lambda text: None,
    *,
    most: float | None = None,
    beta: Array | None = None,
    further: Term | None = None,
) -> Rows:
    """The rows of a recording, by blocks: the undecimated W is never whole in memory.

    Columns of load friction are zero, or W and Y are linearised about the parameters `beta` (b,),
    as in `load`. Rows of more than `most` numbers are reduced; those of several recordings have a
    share each, and may leave a joint standing. `further` columns are C.
    """
    blocks, of_rows = list[tuple[Array, ...]](), sample_weights(problem).of_rows
    if most is None:  # else another recording may move the joint
        s, names = problem.signals, tuple(joint.name for joint in problem.signals.robot.joints)
        refuse_standing_joints(of_rows, names, s.recording, s.robot.bandwidth_hz, s.unmeasured)
        most = most_numbers(1)
    (T, n), b = of_rows.shape, problem.base.b
    factors = SpanFactors(T, n, min(SPANS, -(-T // 2))) if T * n * b > most else None
    for at in row_blocks(problem):
        motion = motion_of_block(problem, at)
        columns = columns_of_block(problem, motion, beta)
        if further is not None:
            more = further.columns(problem, motion, problem.settings.decimator)[..., at.inside]
            columns = np.concatenate([more, columns], axis=1)
        tau = problem.settings.decimator.filtered(motion.tau.T)[:, at.inside]
        speed = problem.settings.decimator.kept(motion.dq)[at.inside].T
        if factors:
            factors.add(at.first, columns, of_rows[at.first : at.last])
        blocks.append((tau, speed) if factors else (tau, speed, columns))
        say(f"regressor: {at.last / T:.0%}")
    tau, speed, *held = (np.concatenate(x, axis=-1) for x in zip(*blocks, strict=True))
    if factors:
        rows = rows_of_factors(problem, factors)
    else:
        followed = {
            "joint_of_row": np.repeat(np.arange(n), T),
            "share": of_rows.T.reshape(-1),
            "rows": (of_rows**2).sum(axis=0),
            "spans": (Spans(instants=T, count=T),),
        }
        rows = _split(problem, held[0].transpose(0, 2, 1).reshape(n * T, -1), followed)
    return replace(rows, share=of_rows, tau=tau.T, speed=np.ascontiguousarray(speed.T))


def rows_of_factors(problem: Problem, factors: SpanFactors, instruments: int = 0) -> Rows:
    """Rows [C Z W E Y] of a long recording with so many columns of instruments, without the
    measurements at its instants.
    """
    return _split(problem, *factors.rows(), instruments)


def _split(problem: Problem, rows: Array, followed: dict[str, Any], instruments: int = 0) -> Rows:
    b, m = problem.base.b, problem.signals.robot.n * problem.needs_drives
    k = rows.shape[1] - instruments - b - m - 1
    edges = np.cumsum([k, instruments, b, m])
    C, Z, W, E, Y = (np.ascontiguousarray(part) for part in np.split(rows, edges, axis=1))
    system, none = System(W=W, Y=Y[:, 0], names=problem.base.names, **followed), np.zeros((0, 0))
    return Rows(system=system, E=E, C=C, Z=Z, share=none, tau=none, speed=none)


@one_thread
def rows_again(
    problem: Problem, most: float, beta: Array | None = None, further: Term | None = None
) -> Rows:
    """`rows_of_recording` as a task."""
    return rows_of_recording(problem.with_samples(), most=most, beta=beta, further=further)


@one_thread
def torque_of_recording(problem: Problem, *betas: Array) -> tuple[Array, Array, Array]:
    """Torque measured and predicted, and joint speed, each (T, n), decimated;
    without W, and no weights.

    Each of `betas`, (b,) each, predicts one of as many equal spans of the rows.
    """
    problem = problem.with_samples()
    parts, settings, decimation = (
        list[tuple[Array, ...]](),
        problem.settings,
        problem.settings.decimator,
    )
    rows, fs = decimation.rows(settings.stop - settings.start), problem.signals.sample_rate_hz
    edges = settings.stop - settings.decimation * (
        rows - np.linspace(0, rows, len(betas) + 1).round().astype(int)
    )
    for motion, inside in motion_blocks(problem):
        cuts = [
            0,
            *np.clip(edges[1:-1] - round(motion.t_s[0] * fs), 0, len(motion.q)),
            len(motion.q),
        ]
        pieces = [
            torque_of_model(problem, motion.part(slice(first, last)), beta)
            for beta, (first, last) in zip(betas, pairwise(cuts), strict=True)
            if first < last
        ]
        measured, modelled = (
            decimation.filtered(tau.T)[:, inside].T for tau in (motion.tau, np.concatenate(pieces))
        )
        parts.append((measured, modelled, decimation.kept(motion.dq)[inside]))
    tau, tau_predicted, speed = ([part[i] for part in parts] for i in range(3))
    return np.concatenate(tau), np.concatenate(tau_predicted), np.concatenate(speed)


@one_thread
def with_torque(problem: Problem, rows: Rows) -> Rows:
    """The rows of a recording, columns of load friction zero, with the torque of `problem`,
    of another lag or gains.
    """
    problem = problem.with_samples()
    if rows.reduced:
        return rows_of_recording(problem, most=REDUCED)
    settings, n = problem.settings, problem.signals.robot.n
    t_s = np.arange(settings.start, settings.stop) / problem.signals.sample_rate_hz
    # Contiguous in time by joint: sums round otherwise along a column of a file than along
    # one of another process.
    torque = np.ascontiguousarray(problem.signals.torque[settings.start : settings.stop].T).T
    Y, tau = (
        weighted(problem, t_s, torque, settings.decimator),
        settings.decimator.filtered(torque.T),
    )
    E = rows.E
    if problem.needs_drives:
        E = torque_of_drives(problem, t_s, torque, settings.decimator).transpose(0, 2, 1)
    return replace(
        rows,
        tau=tau.T,
        E=E.reshape(n * len(rows.tau), -1),
        system=replace(rows.system, Y=Y.reshape(-1)),
    )


def torque_of_drives(problem: Problem, t_s: Array, torque: Array, decimation: Decimation) -> Array:
    """Torques (n, n, rows) at the joints of each motor, weighted and decimated, of the `torque` (K,
    n) at joints, which has the known one, at samples of the recording at `t_s` (K,).
    """
    R, known = problem.signals.robot.R, problem.signals.known_torque
    if known is not None:
        at = np.rint(t_s * problem.signals.sample_rate_hz).astype(np.intp)
        torque = torque - known[at]
    of_motors, w = np.linalg.solve(R.T, torque.T), weights_at(problem, t_s)
    found = np.zeros((len(R), len(R), decimation.rows(len(t_s))))
    for m, j in np.argwhere(R):
        found[j, m] = decimation.filtered(R[m, j] * w[j] * of_motors[m])
    return found


@one_thread
def predicted_drives(problem: Problem, beta: Array) -> Array:
    """`torque_of_drives` (r, n) that beta (b,) predicts along the measured motion; for
    rows that are not reduced.
    """
    problem, parts = problem.with_samples(), list[Array]()
    for motion, inside in motion_blocks(problem):
        torque = torque_of_model(problem, motion, beta)
        parts.append(
            torque_of_drives(problem, motion.t_s, torque, problem.settings.decimator)[..., inside]
        )
    E = np.concatenate(parts, axis=2)
    return np.ascontiguousarray(E.transpose(0, 2, 1)).reshape(-1, E.shape[1])


def torque_of_model(problem: Problem, motion: Motion, beta: Array) -> Array:
    """`predicted_torque` (N, n) along a block of the recorded motion; that of the
    last parameters is kept.
    """
    kept, key = problem.motion.torques, (motion.t_s[0], len(motion.t_s), problem.settings.cutoff_hz)
    if (found := kept.get(key)) is None or found[0] != beta.tobytes():
        if len(kept) > MAX_BLOCKS_KEPT:
            kept.clear()
        kept[key] = beta.tobytes(), predicted_torque(motion, problem.model, problem.base, beta)
    return kept[key][1]


def predicted_torque(
    motion: Motion, dynamics: InverseModel, base: BaseParameters, beta: Array, stride: int = 1
) -> Array:
    """Torque (N, n) of the inverse dynamic model along a motion, undecimated: IDM(q, dq, ddq)
    beta; links' as `smooth`.
    """
    model = direct_model(dynamics, base.standard_parameters(beta))
    rigid = smooth(model.torques_of_links, motion, stride)
    return model.torque(motion.q, motion.dq, motion.ddq, rigid=rigid)


@one_thread
def load_columns(problem: Problem, load: LoadFriction, beta: Array) -> Array:
    """`LoadFriction.columns` (2, k, rows) of a recording."""
    problem, parts = problem.with_samples(), list[Array]()
    for motion, inside in motion_blocks(problem):
        w, x = weights_at(problem, motion.t_s), (motion.q, motion.dq, motion.ddq)
        parts.append(load.columns(*x, w, beta, problem.settings.decimator)[..., inside])
    return np.concatenate(parts, axis=-1)


def _decimated(
    motion: Motion,
    w: Array,
    dynamics: InverseModel,
    base: BaseParameters,
    decimation: Decimation,
    stride: int,
) -> Array:
    """Regressor (n, b, rows) with weights w (n, N), link columns at every `stride`-th sample."""
    N, W = (
        len(motion.q),
        np.zeros((len(dynamics.robot.joints), len(base.names), decimation.rows(len(motion.q)))),
    )
    strided = stride > 1 and stride * decimation.end_samples < N  # else most of it is the ends
    links = base.links & strided
    if links.any():
        at, end = (N - 1) % stride, decimation.end_samples
        spans = (slice(at, None, stride), slice(0, at + end + 1), slice(N - end - 1, None))
        entries, parts = _series(motion, dynamics, base, np.flatnonzero(links), spans)
        parts = [part * w[entries[:, 0], span] for part, span in zip(parts, spans, strict=True)]
        W[entries[:, 0], entries[:, 1]] = decimation.filtered_strided(*parts)
    entries, (series,) = _series(motion, dynamics, base, np.flatnonzero(~links), (slice(None),))
    for x, j in zip(series, entries[:, 0], strict=True):
        x *= w[j]
    W[entries[:, 0], entries[:, 1]] = decimation.filtered(series)
    return W


def _series(
    motion: Motion,
    dynamics: InverseModel,
    base: BaseParameters,
    places: NDArray[np.intp],
    spans: Sequence[slice],
) -> tuple[NDArray[np.intp], list[Array]]:
    """Entries (E, 2), joint and place in `base`, and their series (E, N) in spans of a motion."""
    columns = base.columns[places]
    entries = dynamics.entries(columns)
    entries[:, 1] = places[entries[:, 1]]
    return entries, [
        dynamics.series(motion.q[at], motion.dq[at], motion.ddq[at], columns) for at in spans
    ]


def columns_of_block(problem: Problem, motion: MotionBlock, beta: Array | None = None) -> Array:
    """Return [W E Y] (n, b + m + 1, rows) along a block of any motion, weighted and decimated.

    Along the measured motion these are the rows; along that of the simulated robot, with the
    torque of its drives, the first b + m are the instruments Z.

    Columns of load friction are zero; with parameters `beta` (b,) W and Y are linearised
    about them, as in `load`.
    """
    w, decimation = weights_at(problem, motion.t_s), motion.decimation
    load = load_friction(problem.model, problem.base)
    W = _decimated(motion, w, problem.model, problem.base, decimation, motion.stride)
    Y = decimation.filtered(w * motion.tau.T)
    if load and beta is not None:
        columns = load.columns(motion.q, motion.dq, motion.ddq, w, beta, decimation)
        load.linearise(W, Y, columns, beta)
    drives = problem.needs_drives
    E = [torque_of_drives(problem, motion.t_s, motion.tau, decimation)] if drives else []
    return np.concatenate([W, *E, Y[:, None]], axis=1)[..., motion.at.inside]
