"""The rows of a recording, equations (5) and (6): regressor of the model and torques,
weighted and decimated alike.

Rows are stacked by joint. The columns are asked of any motion in the same way: W and Y along the
measured motion, Z along that of the simulated robot. Where a span of time has more rows than
columns it has their QR factor, with the same products of columns: whatever is a sum of its columns,
such as W P, may be taken afterwards.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import System, one_thread
from ..model import BaseParameters, InverseModel, direct_model
from .filtering import Decimation
from .lag_rows import LagCollector
from .load import load_friction
from .motion import Motion, differentiate, smooth
from .problem import MotionBlock, Problem, motion_blocks, motion_of_block, row_blocks
from .spans import SpanRows
from .states import fast_for_lag
from .weights import sample_weights, weights_at

MAX_BLOCKS_KEPT = 8  # whose torque by the last parameters is kept


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows:
    """The rows of a recording, and the measurements at its decimated instants.

    Attributes:
        system: weighted W and Y.
        E: (r, n) weighted torque at the joints of each motor by its described gain; (r, 0)
            where no gain needs it.
        C: (r, k) columns of terms that are not in the model; (r, 0) until they are asked for;
            `fast`: (r,) which rows of them show a lag.
        Z: (r, b + n + 1) instruments: of W, of E, and of the lag; (r, 0) for none.
        share: (T, n) weights of the decimated samples, 0 for those that do not count.
        tau: (T, n) decimated torques, not weighted.
        speed: (T, n) joint speeds.
        torque_lag_s, gains: of the torques, as of `Problem`.
        late: those of the lag along a simulated motion, and their instruments (r, b + 1).
    """

    system: System
    E: Array
    C: Array
    fast: NDArray[np.bool_]
    Z: Array
    share: Array
    tau: Array
    speed: Array
    torque_lag_s: float
    gains: Array | None = None
    late: tuple[System, Array] | None = None

    @property
    def parts(self) -> tuple[int, ...]:
        """Numbers of decimated samples of the recordings, in sequence."""
        return tuple(spans.instants for spans in self.system.spans)

    @property
    def counts(self) -> NDArray[np.bool_]:
        """(T, n) whether a decimated sample counts."""
        return self.share > 0

    def without(self, names: Collection[str]) -> "Rows":
        """The same without the columns of parameters."""
        stay = np.flatnonzero([name not in names for name in self.system.names])
        return replace(self, system=self.system.with_columns(stay))


class Term(Protocol):
    """What is asked for its columns along a motion of a recording."""

    @property
    def sliding(self) -> Array:
        """(c,) largest speeds along the directions of Coulomb friction."""

    def columns(self, problem: Problem, motion: Motion, decimation: Decimation) -> Array:
        """(n, k, rows), weighted and decimated."""


@one_thread
def rows_of_recording(
    problem: Problem,
    beta: Array | None = None,
    further: Term | None = None,
    along: Iterable[MotionBlock] | None = None,
    before: Array | None = None,
) -> Rows:
    """The rows [C Z W E Y] of a recording, block by block: W is never whole in memory.

    Columns of load friction are zero, or W and Y are linearised about the parameters `beta` (b,),
    as in `load`. `further` columns are C, and Z the columns `along` another motion, given by block.
    The rows of the lag along it are whitened by the residuals of the parameters `before` (b,).
    """
    problem = problem.with_samples()
    settings, share, blocks = problem.settings, sample_weights(problem).of_rows, row_blocks(problem)
    collected, parts, (k, m) = SpanRows(*share.shape), list[tuple[Array, ...]](), (0, 0)
    lag = None
    if before is not None:
        tau, predicted, speed = torque_of_recording(problem, before)
        lag = LagCollector(problem, share, share * (tau - predicted), speed)
    b, about = problem.base.b, np.zeros(problem.base.b) if beta is None else beta
    motions: Iterable[MotionBlock | None] = along or [None] * len(blocks)
    for at, z in zip(blocks, motions, strict=True):
        motion = motion_of_block(problem, at)
        A = columns_of_block(problem, motion, beta)
        Z, C, fast = A[:, :0], A[:, :0], None
        if z is not None:
            Z = instruments_of_block(problem, z, about)
            if lag is not None:
                W, L, r = A[:, :b], Z[:, -1:], A[:, -1:] - about @ A[:, None, :b]
                lag.add(np.concatenate([Z[:, :b], L, W, L, r], axis=1), z)
        if further is not None:
            other = motion if z is None else z
            C = further.columns(problem, other, other.decimation)[..., at.inside]
            fast = fast_for_lag(problem, other, other.decimation, further.sliding)[:, at.inside]
        k, m = C.shape[1], Z.shape[1]
        A = np.concatenate([C, Z, A], axis=1)
        collected.add(at.first, A, share[at.first : at.last], fast)
        tau, speed = motion.filtered(motion.tau.T).T, settings.decimator.kept(motion.dq)[at.inside]
        parts.append((tau, speed))
    tau, speed = (np.concatenate(x) for x in zip(*parts, strict=True))
    rows, fast_rows, followed = collected.rows()
    edges = np.cumsum([k, m, problem.base.b, problem.signals.robot.n * problem.needs_drives])
    C, Z, W, E, Y = (np.ascontiguousarray(part) for part in np.split(rows, edges, axis=1))
    return Rows(
        system=System(W=W, Y=Y[:, 0], names=problem.base.names, **followed),
        E=E,
        C=C,
        fast=fast_rows,
        Z=Z,
        share=share,
        tau=tau,
        speed=speed,
        torque_lag_s=settings.torque_lag_s,
        gains=problem.gains,
        late=None if lag is None else lag.rows(problem.base.names),
    )


@one_thread
def rows_by_measured_motion(problem: Problem, beta: Array, further: Term | None = None) -> Rows:
    """The rows about beta (b,) with instruments of the measured motion: those of the drives are
    the torques that beta predicts, as the recorded ones are noisy.
    """
    problem = problem.with_samples()
    return rows_of_recording(problem, beta, further, (x for x, _ in motion_blocks(problem)))


def instruments_of_block(problem: Problem, z: MotionBlock, beta: Array) -> Array:
    """The columns [W E L] (n, b + m + 1, rows) about beta (b,) along a block of a motion, E of the
    torque that beta predicts: L, of the lag, is minus the rate of the motion's torque.
    """
    x = z
    if problem.needs_drives:
        x = replace(z, tau=predicted_torque(z, problem.model, problem.base, beta))
    found, rate = columns_of_block(problem, x, beta), differentiate(z.tau, 1 / z.step_s)
    found[:, -1] = -z.filtered(weights_at(problem, z.t_s) * rate.T)  # in place of Y
    return found


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
    # as spans of time end
    edges = settings.stop - settings.decimation * (
        rows + -np.arange(len(betas) + 1) * rows // len(betas)
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
