"""W and Y, equations (5) and (6): the model's regressor and the torques, decimated alike, stacked joint by joint."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..data import Signals
from ..model import BaseParameters, InverseModel
from .filtering import Decimation, Motion, decimation_reach, motion_between
from .low_speed import measured_fast_rows
from .settings import Settings

_SERIES_BLOCK = 8_000_000  # numbers of a block's regressor: 64 MB
_NUMBERS_IN_MEMORY = 8_000_000  # numbers of W kept as they are; beyond, joints are reduced to their QR factors
_FILTERED = 1_000_000  # numbers of the series filtered at a time: their copies take no more memory than they must


@dataclass(frozen=True, kw_only=True, eq=False)
class Regression:
    """The over-determined system Y = W beta + rho, rows stacked joint by joint.

    Attributes:
        W: (r, b) regressor of the base parameters.
        Y: (r,) torques.
        joint_of_row: (r,) joint index of each row, ascending.
        fast: (rows, n) whether a decimated sample counts for least squares (`low_speed`).
        tau: (rows, n) decimated torques; never reduced.
        speed: (rows, n) joint speeds at the same instants.

    A long recording is held reduced: per joint the b + 1 rows of the QR factor of those rows of [W Y] that count for least
    squares, which have the same normal equations.
        base: the base parameters.
    """

    W: Array
    Y: Array
    joint_of_row: NDArray[np.intp]
    fast: NDArray[np.bool_]
    tau: Array
    speed: Array
    base: BaseParameters

    def __post_init__(self) -> None:
        r, b = self.W.shape
        if self.Y.shape != (r,) or self.joint_of_row.shape != (r,) or b != self.base.b:
            raise ValueError(f"shapes do not agree: W {self.W.shape}, Y {self.Y.shape}, {self.base.b} parameters")

    @property
    def reduced(self) -> bool:
        """Whether rows are QR factors rather than samples."""
        return self.tau.size != len(self.Y)

    @property
    def counted(self) -> tuple[Array, Array, NDArray[np.intp], NDArray[np.intp]]:
        """W, Y, joint_of_row for least squares, zero in rows that do not count, and how many samples (n,) do per joint."""
        rows = self.fast.sum(axis=0)
        if self.reduced or self.fast.all():
            return self.W, self.Y, self.joint_of_row, rows
        used = self.used
        return self.W * used[:, None], self.Y * used, self.joint_of_row, rows

    @property
    def used(self) -> Array:
        """1 for rows (r,) that count for least squares, 0 for others."""
        return np.ones(len(self.Y)) if self.reduced else self.fast.T.reshape(-1).astype(float)


def regression_of_motion(motion: Motion, dynamics: InverseModel, base: BaseParameters) -> Regression:
    """W and Y of a motion held in memory, every sample of it, not decimated."""
    every = np.ones(motion.q.shape, dtype=bool)
    return _stacked([_block(motion, slice(None), dynamics, base, Decimation(), every)], base)


def regression_of_recording(
    signals: Signals,
    plan: Settings,
    dynamics: InverseModel,
    base: BaseParameters,
    say: Callable[[str], None] = lambda text: None,
) -> Regression:
    """W and Y of a recording, block by block, so that the whole undecimated W is never held."""
    blocks: list[_Block] = []
    reduced: Regression | None = None
    fast, done_rows = measured_fast_rows(signals, plan, dynamics), 0
    for motion, inside, done in motion_blocks(signals, plan, len(dynamics.entries(base.columns))):
        here = slice(done_rows, done_rows + inside.stop - inside.start)
        done_rows = here.stop
        blocks.append(_block(motion, inside, dynamics, base, plan.decimator, fast[here]))
        say(f"regressor: {done:.0%}")
        if sum(block.W.size for block in blocks) > _NUMBERS_IN_MEMORY:
            reduced = _reduce(_stacked(blocks, base), reduced)
            blocks = []
    if not blocks and reduced is not None:
        return reduced
    last = _stacked(blocks, base)
    return last if reduced is None else _reduce(last, reduced)


def torque_of_recording(
    signals: Signals, plan: Settings, dynamics: InverseModel, base: BaseParameters, beta: Array
) -> tuple[Array, Array, Array]:
    """Torque measured and predicted with `beta`, and joint speed, each (rows, n), decimated; W is not needed."""
    parts: list[tuple[Array, ...]] = []
    for motion, inside, _ in motion_blocks(signals, plan, len(dynamics.entries(base.columns))):
        predicted = predicted_torque(motion, dynamics, base, beta)
        measured, modelled = (plan.decimator.filtered(tau.T)[:, inside].T for tau in (motion.tau, predicted))
        parts.append((measured, modelled, plan.decimator.kept(motion.dq)[inside]))
    tau, tau_predicted, speed = ([part[i] for part in parts] for i in range(3))
    return np.concatenate(tau), np.concatenate(tau_predicted), np.concatenate(speed)


def predicted_torque(motion: Motion, dynamics: InverseModel, base: BaseParameters, beta: Array) -> Array:
    """Torque (N, n) of the inverse dynamic model along a motion, undecimated: IDM(q, dq, ddq) beta."""
    entries = dynamics.entries(base.columns)
    tau: Array = np.zeros_like(motion.q)
    step = max(1, _SERIES_BLOCK // (4 * len(entries)))
    for k in range(0, len(tau), step):
        part = slice(k, k + step)
        series = dynamics.series(motion.q[part], motion.dq[part], motion.ddq[part], base.columns)
        for j in range(motion.q.shape[1]):
            mine = entries[:, 0] == j
            tau[part, j] = beta[entries[mine, 1]] @ series[mine]
    return tau


def decimated_regressor(motion: Motion, dynamics: InverseModel, base: BaseParameters, decimation: Decimation) -> Array:
    """Regressor (n, b, rows) of the base parameters along a motion, every column decimated."""
    entries = dynamics.entries(base.columns)
    series = dynamics.series(motion.q, motion.dq, motion.ddq, base.columns)
    W = np.zeros((motion.q.shape[1], base.b, decimation.rows(len(motion.q))))
    size = max(1, _FILTERED // series.shape[1])
    for k in range(0, len(entries), size):
        group = slice(k, k + size)
        W[entries[group, 0], entries[group, 1]] = decimation.filtered(series[group])
    return W


def motion_blocks(signals: Signals, plan: Settings, series: int) -> Iterator[tuple[Motion, slice, float]]:
    """Cut the plan's span into blocks: each block's motion, which of its decimated rows count, and the share done.

    A block reaches beyond the rows that count as far as the decimation filter does, so blocks give what one pass
    would. Blocks are counted from the end, where decimation keeps its last sample.
    """
    n_d, start, stop = plan.decimation, plan.start, plan.stop
    margin = -(-decimation_reach(n_d) // n_d)  # in decimated rows
    rows = -(-(stop - start) // n_d)
    size = max(4 * margin, _SERIES_BLOCK // (series * n_d), 1)
    for first in range(0, rows, size):
        last = min(rows, first + size)
        if rows - last < margin:
            last = rows  # no block shorter than the filter's reach
        low, high = max(0, first - margin), min(rows, last + margin)
        motion = motion_between(
            signals.q,
            signals.effort,
            cutoff_hz=plan.cutoff_hz,
            sample_rate_hz=signals.sample_rate_hz,
            start=start if low == 0 else stop - (rows - low) * n_d,
            stop=stop - (rows - high) * n_d,
        )
        yield motion, slice(first - low, last - low), last / rows
        if last == rows:
            return


@dataclass(frozen=True, kw_only=True, eq=False)
class _Block:
    """The decimated rows of a block: W (n, b, rows), Y (n, rows), speed and fast (rows, n)."""

    W: Array
    Y: Array
    speed: Array
    fast: NDArray[np.bool_]


def _block(
    motion: Motion,
    inside: slice,
    dynamics: InverseModel,
    base: BaseParameters,
    decimation: Decimation,
    fast: NDArray[np.bool_],
) -> _Block:
    return _Block(
        W=decimated_regressor(motion, dynamics, base, decimation)[..., inside],
        Y=decimation.filtered(motion.tau.T)[:, inside],
        speed=decimation.kept(motion.dq)[inside],
        fast=fast,
    )


def _stacked(blocks: list[_Block], base: BaseParameters) -> Regression:
    """Blocks as one system, rows joint by joint."""
    W, Y = (np.concatenate([getattr(block, name) for block in blocks], axis=-1) for name in ("W", "Y"))
    n, rows = Y.shape
    return Regression(
        W=np.ascontiguousarray(W.transpose(0, 2, 1)).reshape(n * rows, base.b),
        Y=Y.reshape(-1),
        joint_of_row=np.repeat(np.arange(n), rows),
        fast=np.concatenate([block.fast for block in blocks]),
        tau=Y.T,
        speed=np.concatenate([block.speed for block in blocks]),
        base=base,
    )


def _reduce(new: Regression, before: Regression | None) -> Regression:
    """Per joint the QR factor of the rows so far that count: b + 1 rows with the same normal equations."""
    n = new.tau.shape[1]
    factors = []
    for j in range(n):
        parts = [np.c_[r.W, r.Y][(r.joint_of_row == j) & (r.used > 0)] for r in (before, new) if r is not None]
        factors.append(np.linalg.qr(np.concatenate(parts), mode="r"))
    stack = np.concatenate(factors)
    return Regression(
        W=np.ascontiguousarray(stack[:, :-1]),
        Y=np.ascontiguousarray(stack[:, -1]),
        joint_of_row=np.repeat(np.arange(n), [len(f) for f in factors]),
        fast=new.fast if before is None else np.concatenate([before.fast, new.fast]),
        tau=new.tau if before is None else np.concatenate([before.tau, new.tau]),
        speed=new.speed if before is None else np.concatenate([before.speed, new.speed]),
        base=new.base,
    )
