"""W and Y, equations (5) and (6): the regressor of the model and the torques, decimated alike, stacked by joint."""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import SpanFactors, Spans, System, one_thread
from ..model import BaseParameters, InverseModel, direct_model, load_parameters
from .filtering import Decimation
from .load import LoadFriction, RigidBodyColumns, load_friction
from .motion import Motion, differentiate
from .problem import Problem, RowBlock, motion_blocks, motion_of_block, row_blocks
from .rows import measured_fast_rows, refuse_slow_joints

_MAX_NUMBERS = 4_000_000  # of W in rows; above, its spans are reduced to their QR factors
_MAX_NUMBERS_OF_ALL = 16_000_000  # the same of all recordings of a fit
_MAX_LINK_NUMBERS = 12_000_000  # of all link columns before decimation, 96 MB; above, they are computed again
ALL_REDUCED, HELD = 10**9, 0  # numbers of recordings that share the memory: all are reduced, or none
_FILTERED = 1_000_000  # numbers of the series filtered at a time, to limit memory


@dataclass(frozen=True, kw_only=True, eq=False)
class Regression:
    """The over-determined system of a recording, and the measurements at its rows.

    Attributes:
        system: W and Y with the rows used by least squares.
        fast: (rows, n) whether a decimated sample is used by least squares (`low_speed`).
        tau: (rows, n) decimated torques; never reduced.
        speed: (rows, n) joint speeds at the same instants.
        slip_noise: (c,) noise of the speeds of the c directions of Coulomb friction.
        links: link columns for load friction, by block; empty if too large or not needed, and in other processes.
        reduced: whether rows are QR factors rather than samples.

    The system of a long recording is reduced: by joint and span of time the rows, at most b + 1, of the QR factor of the rows
    of [W Y] used by least squares, which have the same normal equations.
    """

    system: System
    fast: NDArray[np.bool_]
    tau: Array
    speed: Array
    slip_noise: Array
    links: tuple[RigidBodyColumns, ...] = ()
    reduced: bool = False

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "links": ()}  # many times as large as the rows: computed again

    @property
    def parts(self) -> tuple[int, ...]:
        """Numbers of decimated samples of the recordings, in sequence."""
        return tuple(spans.instants for spans in self.system.spans)

    def predicted(self, beta: Array) -> Array:
        """Torque (rows, n) predicted by beta (b,) for rows that are not reduced: tau less the residual Y - W beta."""
        return np.asarray(self.tau - (self.system.Y - self.system.W @ beta).reshape(self.tau.shape[1], -1).T)

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
    fast, slip_noise = measured_fast_rows(problem)
    if share == 1:  # else another recording may move the joint
        names = tuple(joint.name for joint in problem.signals.robot.joints)
        refuse_slow_joints(fast, names, problem.signals.recording)
    (rows, n), base = fast.shape, problem.base
    b, most = len(base.names), math.inf if share == HELD else min(_MAX_NUMBERS, _MAX_NUMBERS_OF_ALL // share)
    factors = SpanFactors(rows, n, b + 1) if rows * n * b > most else None
    for at in row_blocks(problem):
        (W, Y, tau, speed), links = _block(problem, at, beta)
        if links is not None:
            numbers += links.series.size
            link_blocks = [*link_blocks, links] if numbers <= _MAX_LINK_NUMBERS // max(1, share) else []
        if factors:
            factors.add(at.first, np.concatenate([W, Y[:, None]], axis=1), fast[at.first : at.last])
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
            used=fast.T.reshape(-1).astype(float),
            rows=fast.sum(axis=0),
            spans=(Spans(instants=rows, count=rows),),
        )
    return Regression(
        system=system,
        fast=fast,
        tau=tau.T,
        speed=np.ascontiguousarray(speed.T),
        slip_noise=slip_noise,
        links=() if factors else tuple(link_blocks),
        reduced=factors is not None,
    )


@one_thread
def reduced_regression(problem: Problem, beta: Array) -> Regression:
    """W and Y of a recording about beta (b,), as QR factors."""
    return regression_of_recording(problem.with_samples(), share=ALL_REDUCED, beta=beta)


def rows_of_block(problem: Problem, block: RowBlock, beta: Array | None = None) -> tuple[Array, Array]:
    """W (n, b, rows) and Y (n, rows) of the rows of a block, about the parameters `beta` (b,) as in `load`."""
    (W, Y, _, _), _ = _block(problem, block, beta)
    return W, Y


@one_thread
def torque_of_recording(problem: Problem, beta: Array) -> tuple[Array, Array, Array]:
    """Torque measured and predicted with `beta`, and joint speed, each (rows, n), decimated; without W."""
    problem = problem.with_samples()
    parts: list[tuple[Array, ...]] = []
    decimation = problem.settings.decimator
    for motion, inside, _ in motion_blocks(problem):
        predicted = predicted_torque(motion, problem.model, problem.base, beta)
        measured, modelled = (decimation.filtered(tau.T)[:, inside].T for tau in (motion.tau, predicted))
        parts.append((measured, modelled, decimation.kept(motion.dq)[inside]))
    tau, tau_predicted, speed = ([part[i] for part in parts] for i in range(3))
    return np.concatenate(tau), np.concatenate(tau_predicted), np.concatenate(speed)


@one_thread
def retimed(problem: Problem, regression: Regression, lag_s: float) -> Regression:
    """The regression of a recording with its torque corrected by another lag, s."""
    problem = problem.with_samples().corrected(lag_s)
    if regression.reduced:
        return regression_of_recording(problem, share=ALL_REDUCED)
    settings = problem.settings
    tau = settings.decimator.filtered(problem.signals.torque[settings.start : settings.stop].T).T
    Y = regression.system.Y + (tau - regression.tau).T.reshape(-1)
    return replace(regression, tau=tau, system=replace(regression.system, Y=Y))


def regained(problem: Problem, regression: Regression, factors: Array) -> Regression:
    """The regression of a recording with drive gains times `factors` (n,)."""
    R, known = problem.signals.robot.R, known_torque_rows(problem)
    drives = (np.linalg.solve(R.T, (regression.tau - known).T).T * factors) @ R
    tau = drives + known
    Y = regression.system.Y + (tau - regression.tau).T.reshape(-1)
    return replace(regression, tau=tau, system=replace(regression.system, Y=Y))


def known_torque_rows(problem: Problem) -> Array:
    """Known torques (rows, n) of the span used, decimated as the torques; zeros if there are none."""
    settings, known = problem.settings, problem.signals.known_torque
    if known is None:
        return np.zeros((settings.decimator.rows(settings.stop - settings.start), problem.signals.robot.n))
    # Contiguous, since sums round otherwise along a column of the file than along one that another process sent.
    return np.asarray(settings.decimator.filtered(np.ascontiguousarray(known[settings.start : settings.stop].T)).T)


def predicted_drive_torques(problem: Problem, W: Array, beta: Array) -> Array:
    """Torques (rows, n) of the drives by beta (b,), of rows W (n rows, b) about beta, measured or simulated."""
    load = np.isin(
        problem.base.names, load_parameters(problem.base)
    )  # where W is linearised, the links have load friction
    torque = (W @ np.where(load, 0.0, beta)).reshape(len(problem.signals.robot.joints), -1).T
    return np.asarray(torque - known_torque_rows(problem))


def torque_rate(problem: Problem, beta: Array) -> Array:
    """Rate of change (rows, n) of the drive torque predicted by beta (b,), per second, decimated.

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
        parts.append(problem.settings.decimator.filtered(rate.T)[:, inside].T)
    return np.concatenate(parts)


def predicted_torque(motion: Motion, dynamics: InverseModel, base: BaseParameters, beta: Array) -> Array:
    """Torque (N, n) of the inverse dynamic model along a motion, undecimated: IDM(q, dq, ddq) beta."""
    return direct_model(dynamics, base.standard_parameters(beta)).torque(motion.q, motion.dq, motion.ddq)


def decimated_regressor(
    motion: Motion, dynamics: InverseModel, base: BaseParameters, decimation: Decimation, *, beta: Array | None = None
) -> Array:
    """Regressor (n, b, rows) of the base parameters along a motion, every column decimated.

    Columns of load friction are zero; with parameters `beta` (b,) it is linearised about them, as in `load`.
    """
    load, (W, entries, series) = load_friction(dynamics, base), _decimated(motion, dynamics, base, decimation)
    if load and beta is not None:
        columns = load.columns(load.series_of_links(entries, series, motion.dq, slice(None)), beta, decimation)
        load.linearise(W, None, columns, beta)
    return W


def _decimated(
    motion: Motion, dynamics: InverseModel, base: BaseParameters, decimation: Decimation, stride: int = 1
) -> tuple[Array, NDArray[np.intp], Array]:
    """Regressor (n, b, rows), link columns computed at every `stride`-th sample; and of the columns at full rate the
    entries (E, 2), joint and place in `base`, and series (E, N).
    """
    N, W = len(motion.q), np.zeros((len(dynamics.robot.joints), len(base.names), decimation.rows(len(motion.q))))
    strided = stride > 1 and stride * decimation.end_samples < N  # else most of it is the ends
    links = base.links & strided
    if links.any():
        at, end = (N - 1) % stride, decimation.end_samples
        spans = (slice(at, None, stride), slice(0, at + end + 1), slice(N - end - 1, None))
        entries, parts = _series(motion, dynamics, base, np.flatnonzero(links), spans)
        W[entries[:, 0], entries[:, 1]] = decimation.filtered_strided(*parts)
    entries, (series,) = _series(motion, dynamics, base, np.flatnonzero(~links), (slice(None),))
    size = max(1, _FILTERED // N)
    for k in range(0, len(entries), size):
        group = slice(k, k + size)
        W[entries[group, 0], entries[group, 1]] = decimation.filtered(series[group])
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
    load, tau = load_friction(model, base), decimation.filtered(motion.tau.T)[:, inside]
    stride = 1 if load else decimation.stride_behind(problem.settings.cutoff_hz, problem.signals.sample_rate_hz)
    W, entries, series = _decimated(motion, model, base, decimation, stride)
    W, Y, links = W[..., inside], tau.copy(), None
    if load:
        links = load.series_of_links(entries, series, motion.dq, inside)
        if beta is not None:
            load.linearise(W, Y, load.columns(links, beta, decimation), beta)
    return (W, Y, tau, decimation.kept(motion.dq)[inside].T), links
