"""W and Y, equations (5) and (6): regressor of the model and torques, weighted and decimated alike, stacked by joint."""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import SpanFactors, Spans, System, one_thread
from ..model import BaseParameters, InverseModel, direct_model
from .filtering import Decimation
from .load import LoadFriction, RigidBodyColumns, load_friction
from .motion import Motion, differentiate
from .problem import Problem, RowBlock, motion_blocks, motion_of_block, row_blocks
from .weights import refuse_standing_joints, sample_weights, weighted, weights_at

_MAX_NUMBERS = 4_000_000  # of W in rows; above, its spans are reduced to their QR factors
_MAX_NUMBERS_OF_ALL = 16_000_000  # the same of all recordings of a fit
_MAX_LINK_NUMBERS = 12_000_000  # of all link columns before decimation, 96 MB; above, they are computed again
ALL_REDUCED, HELD = 10**9, 0  # numbers of recordings that share the memory: all are reduced, or none
_FILTERED = 1_000_000  # numbers of the series filtered at a time, to limit memory


@dataclass(frozen=True, kw_only=True, eq=False)
class Regression:
    """The over-determined system of a recording, and the measurements at its rows.

    Attributes:
        system: weighted W and Y.
        share: (rows, n) weights of the decimated samples, 0 for those that do not count.
        tau: (rows, n) decimated torques, not weighted; never reduced.
        speed: (rows, n) joint speeds at the same instants.
        links: link columns for load friction, by block; empty if too large or not needed, and in other processes.
        reduced: whether rows are QR factors rather than samples.

    The system of a long recording is reduced: by joint and span of time the rows, at most b + 1, of the QR factor of the rows
    of [W Y] that count, which have the same normal equations.
    """

    system: System
    share: Array
    tau: Array
    speed: Array
    links: tuple[RigidBodyColumns, ...] = ()
    reduced: bool = False

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "links": ()}  # many times as large as the rows: computed again

    @property
    def parts(self) -> tuple[int, ...]:
        """Numbers of decimated samples of the recordings, in sequence."""
        return tuple(spans.instants for spans in self.system.spans)

    @property
    def counts(self) -> NDArray[np.bool_]:
        """(rows, n) whether a decimated sample counts."""
        return self.share > 0

    def residual(self, beta: Array, weights: Array) -> Array:
        """Residual Y - W beta (rows, n) of beta (b,), times `weights` (n,), for rows that are not reduced; 0 where rows do not
        count.
        """
        W, Y = self.system.weighted(weights)
        return np.asarray((Y - W @ beta).reshape(len(weights), -1).T)

    def about(self, beta: Array, load: LoadFriction, columns: Array) -> "Regression":
        """The same about beta (b,), by the columns (2, k, rows) of load friction; for rows that are not reduced."""
        n, W, Y = self.tau.shape[1], self.system.W.copy(), self.system.Y.copy()
        load.linearise(W.reshape(n, -1, len(beta)).transpose(0, 2, 1), Y.reshape(n, -1), columns, beta)
        return replace(self, system=replace(self.system, W=W, Y=Y), links=())

    def without(self, names: Collection[str]) -> "Regression":
        """The same without the columns of parameters; entries of `links` are renumbered."""
        stay = np.array([name not in names for name in self.system.names])
        place = np.cumsum(stay) - 1
        links = tuple(
            replace(part, entries=np.c_[part.entries[:, 0], place[part.entries[:, 1]]]) for part in self.links
        )
        return replace(self, system=self.system.with_columns(np.flatnonzero(stay)), links=links)


def regression_of_recording(
    problem: Problem, say: Callable[[str], None] = lambda text: None, *, share: int = 1, beta: Array | None = None
) -> Regression:
    """W and Y of a recording, by blocks: the undecimated W is never whole in memory.

    `share` is the number of recordings that share the memory for rows. Columns of load friction are zero, or W and Y are
    linearised about the parameters `beta` (b,), as in `load`.
    """
    blocks, link_blocks, numbers = list[tuple[Array, ...]](), list[RigidBodyColumns](), 0
    of_rows, robot = sample_weights(problem).of_rows, problem.signals.robot
    if share == 1:  # else another recording may move the joint
        names = tuple(joint.name for joint in robot.joints)
        refuse_standing_joints(of_rows, names, problem.signals.recording, robot.bandwidth_hz)
    (rows, n), base = of_rows.shape, problem.base
    b, most = len(base.names), math.inf if share == HELD else min(_MAX_NUMBERS, _MAX_NUMBERS_OF_ALL // share)
    factors = SpanFactors(rows, n, b + 1) if rows * n * b > most else None
    for at in row_blocks(problem):
        (W, Y, tau, speed), links = _block(problem, at, beta)
        if links is not None:
            numbers += links.series.size
            link_blocks = [*link_blocks, links] if numbers <= _MAX_LINK_NUMBERS // max(1, share) else []
        if factors:
            factors.add(at.first, np.concatenate([W, Y[:, None]], axis=1), of_rows[at.first : at.last])
            blocks.append((tau, speed))
        else:
            blocks.append((tau, speed, W, Y))
        say(f"regressor: {at.last / rows:.0%}")
    tau, speed, *held = (np.concatenate(x, axis=-1) for x in zip(*blocks, strict=True))
    if factors:
        system = factors.system(base.names)[0]
    else:
        W, Y = held
        system = System(
            W=np.ascontiguousarray(W.transpose(0, 2, 1)).reshape(n * rows, b),
            Y=Y.reshape(-1),
            joint_of_row=np.repeat(np.arange(n), rows),
            names=base.names,
            share=of_rows.T.reshape(-1),
            rows=(of_rows**2).sum(axis=0),
            spans=(Spans(instants=rows, count=rows),),
        )
    return Regression(
        system=system,
        share=of_rows,
        tau=tau.T,
        speed=np.ascontiguousarray(speed.T),
        links=() if factors else tuple(link_blocks),
        reduced=factors is not None,
    )


@one_thread
def regression_again(problem: Problem, share: int, beta: Array | None = None) -> Regression:
    """W and Y of a recording, about beta (b,) if there is one, as a task; `share` as of `regression_of_recording`."""
    return regression_of_recording(problem.with_samples(), share=share, beta=beta)


def rows_of_block(problem: Problem, block: RowBlock, beta: Array | None = None) -> tuple[Array, Array]:
    """W (n, b, rows) and Y (n, rows) of the rows of a block, about the parameters `beta` (b,) as in `load`."""
    (W, Y, _, _), _ = _block(problem, block, beta)
    return W, Y


@one_thread
def torque_of_recording(problem: Problem, *betas: Array) -> tuple[Array, Array, Array]:
    """Torque measured and predicted, and joint speed, each (rows, n), decimated; without W, and no weights.

    Each of `betas`, (b,) each, predicts one of as many equal spans of the rows.
    """
    problem = problem.with_samples()
    parts, settings, decimation = list[tuple[Array, ...]](), problem.settings, problem.settings.decimator
    rows, fs = decimation.rows(settings.stop - settings.start), problem.signals.sample_rate_hz
    edges = settings.stop - settings.decimation * (rows - np.linspace(0, rows, len(betas) + 1).round().astype(int))
    for motion, inside, _ in motion_blocks(problem):
        cuts = [0, *np.clip(edges[1:-1] - round(motion.t_s[0] * fs), 0, len(motion.q)), len(motion.q)]
        pieces = [
            predicted_torque(motion.part(slice(first, last)), problem.model, problem.base, beta)
            for beta, (first, last) in zip(betas, pairwise(cuts), strict=True)
            if first < last
        ]
        measured, modelled = (decimation.filtered(tau.T)[:, inside].T for tau in (motion.tau, np.concatenate(pieces)))
        parts.append((measured, modelled, decimation.kept(motion.dq)[inside]))
    tau, tau_predicted, speed = ([part[i] for part in parts] for i in range(3))
    return np.concatenate(tau), np.concatenate(tau_predicted), np.concatenate(speed)


@one_thread
def with_torque(problem: Problem, regression: Regression) -> Regression:
    """The regression of a recording, columns of load friction zero, with the torque of `problem`, of another lag or gains."""
    problem = problem.with_samples()
    if regression.reduced:
        return regression_of_recording(problem, share=ALL_REDUCED)
    t_s, torque = _recorded(problem, problem.signals.torque)
    Y = weighted(problem, t_s, torque, problem.settings.decimator)
    tau = problem.settings.decimator.filtered(torque.T)
    return replace(regression, tau=tau.T, system=replace(regression.system, Y=Y.reshape(-1)))


def _recorded(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Times (N,) and values (N, n) of recorded series x in the span used.

    Contiguous in time by joint, since sums round otherwise along a column of the file than along one of another process.
    """
    start, stop = problem.settings.start, problem.settings.stop
    return np.arange(start, stop) / problem.signals.sample_rate_hz, np.ascontiguousarray(x[start:stop].T).T


def columns_of_drives(problem: Problem, t_s: Array, torque: Array, decimation: Decimation) -> Array:
    """Torques (n, rows, m) at the joints of each motor, weighted and decimated, of the `torque` (K, n) at joints, which has the
    known one, at samples of the recording at `t_s` (K,).
    """
    R, known = problem.signals.robot.R, problem.signals.known_torque
    if known is not None:
        at = np.rint(t_s * problem.signals.sample_rate_hz).astype(np.intp)
        torque = torque - known[at]
    of_motors, w = np.linalg.solve(R.T, torque.T), weights_at(problem, t_s)
    found = np.zeros((len(R), decimation.rows(len(t_s)), len(R)))
    for m, j in np.argwhere(R):
        found[j, :, m] = decimation.filtered(R[m, j] * w[j] * of_motors[m])
    return found


def recorded_drives(problem: Problem) -> Array:
    """`columns_of_drives` (n, rows, m) of the recorded torques."""
    return columns_of_drives(problem, *_recorded(problem, problem.signals.torque), problem.settings.decimator)


def predicted_drives(problem: Problem, beta: Array) -> Array:
    """`columns_of_drives` (n, rows, m) of the torques that beta (b,) predicts along the measured motion."""
    parts = list[Array]()
    for motion, inside, _ in motion_blocks(problem):
        torque = predicted_torque(motion, problem.model, problem.base, beta)
        parts.append(columns_of_drives(problem, motion.t_s, torque, problem.settings.decimator)[:, inside])
    return np.concatenate(parts, axis=1)


def torque_rate(problem: Problem, beta: Array) -> Array:
    """Rate of change (n, rows) of the drive torque predicted by beta (b,), per second, weighted and decimated.

    Known torques are left out: drives do not record them. Central differences are taken before decimation, where they are
    accurate.
    """
    parts, known = [], problem.signals.known_torque
    for motion, inside, _ in motion_blocks(problem):
        predicted = predicted_torque(motion, problem.model, problem.base, beta)
        if known is not None:
            first = round(motion.t_s[0] * problem.signals.sample_rate_hz)
            predicted = predicted - known[first : first + len(predicted)]
        rate = differentiate(predicted, problem.signals.sample_rate_hz)
        parts.append(weighted(problem, motion.t_s, rate, problem.settings.decimator)[:, inside])
    return np.concatenate(parts, axis=1)


def predicted_torque(motion: Motion, dynamics: InverseModel, base: BaseParameters, beta: Array) -> Array:
    """Torque (N, n) of the inverse dynamic model along a motion, undecimated: IDM(q, dq, ddq) beta."""
    return direct_model(dynamics, base.standard_parameters(beta)).torque(motion.q, motion.dq, motion.ddq)


def decimated_regressor(
    problem: Problem, motion: Motion, decimation: Decimation, *, beta: Array | None = None
) -> Array:
    """Regressor (n, b, rows) of the base parameters along a motion, every column weighted and decimated.

    Columns of load friction are zero; with parameters `beta` (b,) it is linearised about them, as in `load`.
    """
    load, w = load_friction(problem.model, problem.base), weights_at(problem, motion.t_s)
    W, entries, series = _decimated(motion, w, problem.model, problem.base, decimation)
    if load and beta is not None:
        columns = load.columns(load.series_of_links(entries, series, motion.dq, w, slice(None)), beta, decimation)
        load.linearise(W, None, columns, beta)
    return W


def _decimated(
    motion: Motion, w: Array, dynamics: InverseModel, base: BaseParameters, decimation: Decimation, stride: int = 1
) -> tuple[Array, NDArray[np.intp], Array]:
    """Regressor (n, b, rows) with the weights w (n, N), link columns computed at every `stride`-th sample; and of the columns
    at full rate the entries (E, 2), joint and place in `base`, and series (E, N), not weighted.
    """
    N, W = len(motion.q), np.zeros((len(dynamics.robot.joints), len(base.names), decimation.rows(len(motion.q))))
    strided = stride > 1 and stride * decimation.end_samples < N  # else most of it is the ends
    links = base.links & strided
    if links.any():
        at, end = (N - 1) % stride, decimation.end_samples
        spans = (slice(at, None, stride), slice(0, at + end + 1), slice(N - end - 1, None))
        entries, parts = _series(motion, dynamics, base, np.flatnonzero(links), spans)
        parts = [part * w[entries[:, 0], span] for part, span in zip(parts, spans, strict=True)]
        W[entries[:, 0], entries[:, 1]] = decimation.filtered_strided(*parts)
    entries, (series,) = _series(motion, dynamics, base, np.flatnonzero(~links), (slice(None),))
    size = max(1, _FILTERED // N)
    for k in range(0, len(entries), size):
        group = slice(k, k + size)
        W[entries[group, 0], entries[group, 1]] = decimation.filtered(w[entries[group, 0]] * series[group])
    return W, entries, series


def _series(
    motion: Motion, dynamics: InverseModel, base: BaseParameters, places: NDArray[np.intp], spans: Sequence[slice]
) -> tuple[NDArray[np.intp], list[Array]]:
    """Entries (E, 2), joint and place in `base`, of parameters at `places`; and their series (E, N) in spans of a motion."""
    columns = base.columns[places]
    entries = dynamics.entries(columns)
    entries[:, 1] = places[entries[:, 1]]
    return entries, [dynamics.series(motion.q[at], motion.dq[at], motion.ddq[at], columns) for at in spans]


def _block(
    problem: Problem, at: RowBlock, beta: Array | None
) -> tuple[tuple[Array, Array, Array, Array], RigidBodyColumns | None]:
    """W (n, b, rows), Y and torque tau (n, rows), speed (n, rows) of a block, and its link columns for load friction.

    W and Y are about the parameters `beta` (b,), or columns of load friction are zero.
    """
    motion, inside = motion_of_block(problem, at), at.inside
    decimation, model, base = problem.settings.decimator, problem.model, problem.base
    load, w = load_friction(model, base), weights_at(problem, motion.t_s)
    tau, Y = (decimation.filtered(x)[:, inside] for x in (motion.tau.T, w * motion.tau.T))
    # Beside columns that are not strided, such as those of drives, strided ones are not exact enough.
    full = load is not None or problem.gains is not None
    stride = 1 if full else decimation.stride_behind(problem.settings.cutoff_hz, problem.signals.sample_rate_hz)
    W, entries, series = _decimated(motion, w, model, base, decimation, stride)
    W, links = W[..., inside], None
    if load:
        links = load.series_of_links(entries, series, motion.dq, w, inside)
        if beta is not None:
            load.linearise(W, Y, load.columns(links, beta, decimation), beta)
    return (W, Y, tau, decimation.kept(motion.dq)[inside].T), links
