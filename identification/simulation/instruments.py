"""Instruments: the regressor along the robot simulated with an estimate in the recorded experiment."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import Factors, InstrumentBlocks, System
from ..model import direct_model, not_positive
from ..regression import decimated_regressor, fast_rows, lowest_nearby, rows_of_block
from .experiment import Experiment
from .motion import (
    Followed,
    MotionBlock,
    NotSimulatedError,
    SimulatedMotion,
    gains_for,
    nearest,
    reference_blocks,
    simulated_blocks,
)

InstrumentKind = Literal["simulated", "consistent", "reference"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Counting:
    """Which rows count, what they weigh, and what else is wanted.

    Attributes:
        slip_noise: (c,) noise of the speeds of the c directions of Coulomb friction.
        weights: (n,) of the rows of the joints.
        kept: (rows, n) rows that count, from a pass before; None where the simulated speeds tell.
        motion: whether the simulated motion is kept; of a long recording it never is.
    """

    slip_noise: Array
    weights: Array
    kept: NDArray[np.bool_] | None = None
    motion: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class FactoredInstruments:
    """What stands for the rows of a long recording: QR factors of the rows [Z W Y] that count, and their blocks of time.

    `system` has W and Y about the parameters that instruments were asked for, and `Z` (r, b) is in the same rows.
    """

    system: System
    Z: Array
    time_blocks: InstrumentBlocks


@dataclass(frozen=True, kw_only=True, eq=False)
class Instruments:
    """Instruments of a recording.

    Attributes:
        beta: (b,) the parameters asked for, to which those simulated are the nearest.
        Z: (r, b) instruments, rows as those of W; of a long recording there are `factors` in their place.
        fast: (rows, n) which rows count: those at which the simulated robot is fast enough.
        simulated: its motion, where it was wanted; None along the reference.
        reference_kind: that of the experiment.
        kind, reason: as in `methods.Pass`.
        gains: (n,) factors on the controller's gains.
        tracking_percent: simulated against measured position, None where nothing was simulated.
        load_unknown: beta, a regular start, has nothing of the links' torque that load friction goes by.
    """

    beta: Array
    Z: Array | None
    factors: FactoredInstruments | None
    fast: NDArray[np.bool_]
    simulated: SimulatedMotion | None
    reference_kind: Literal["recorded", "surrogate"]
    kind: InstrumentKind
    reason: str | None
    gains: Array
    tracking_percent: float | None
    load_unknown: bool = False


def simulate_instruments(e: Experiment, beta: Array, covariance: Array | None, counting: Counting) -> Instruments:
    """Instruments along the closed loop simulated with the physically consistent parameters nearest to `beta` (b,).

    `covariance` (b, b) is that of beta; None takes beta as it is. Nearest parameters follow the estimate smoothly, whereas the
    estimate itself moves a light wrist wildly long before its inertia matrix is no longer positive: the iteration then has no
    fixed point. Where the robot leaves its reference all the same, instruments are taken along the reference itself.
    """
    near = beta if covariance is None else nearest(e, beta, covariance)
    gains, reason, simulated = gains_for(e, near)[0], None, None
    try:
        rows, followed = _collected(e, simulated_blocks(e, near), near, beta, counting)
        simulated = followed.motion(gains)
        if covariance is not None:
            reason = not_positive(direct_model(e.problem.model, e.problem.base.standard_parameters(beta)), e.poses)
    except NotSimulatedError as why:
        reason = str(why)
        rows, _ = _collected(e, reference_blocks(e), near, beta, counting)
    return Instruments(
        beta=beta,
        Z=rows.Z,
        factors=rows.factors,
        fast=rows.fast,
        simulated=simulated if counting.motion and not e.long else None,
        reference_kind=e.reference_kind,
        kind="reference" if simulated is None else "simulated" if reason is None else "consistent",
        reason=reason,
        gains=gains,
        tracking_percent=None if simulated is None else simulated.tracking_percent,
        load_unknown=covariance is None,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Rows:
    Z: Array | None
    factors: FactoredInstruments | None
    fast: NDArray[np.bool_]


def _collected(
    e: Experiment, blocks: Iterable[MotionBlock], near: Array, beta: Array, counting: Counting
) -> tuple[_Rows, Followed]:
    """Z about the parameters `near` (b,) along a motion, and, of a long recording, its factors with W and Y about `beta`."""
    problem, base, n = e.problem, e.problem.base, e.problem.signals.robot.n
    followed, directions, rows = (
        Followed(e, keep=counting.motion and not e.long),
        problem.model.coulomb_directions,
        e.blocks[0].rows,
    )
    factors, time_blocks = Factors(n, 2 * base.b + 1), InstrumentBlocks.none_yet(rows if e.long else 0, base.names)
    Z, slip, fast = list[Array](), list[Array](), list[NDArray[np.bool_]]()
    percent = problem.settings.low_speed.iv
    for block in blocks:
        at, motion = block.rows, block.motion
        followed.add(block)
        own = decimated_regressor(motion, problem.model, base, e.decimation, beta=near)[..., at.inside]
        slow = _slip(e, motion.dq @ directions.T)[at.inside]
        if not e.long:
            Z.append(own)
            slip.append(slow)
            continue
        if counting.kept is None:  # of the peak that is known beforehand
            counts = fast_rows(slow, counting.slip_noise, directions, percent, peak=e.fastest)
        else:
            counts = counting.kept[at.first : at.last]
        W, Y = rows_of_block(problem, at, beta)
        columns = np.concatenate([own, W, Y[:, None]], axis=1)
        factors.add_block(columns, counts)
        time_blocks.add(at.first, columns, counting.weights, counts)
        fast.append(counts)
    if e.long:
        system, instruments = factors.system(base.names)
        assert instruments is not None
        found = FactoredInstruments(system=system, Z=instruments, time_blocks=time_blocks)
        return _Rows(Z=None, factors=found, fast=np.concatenate(fast)), followed
    stacked = np.ascontiguousarray(np.concatenate(Z, axis=-1).transpose(0, 2, 1)).reshape(-1, base.b)
    if counting.kept is not None:
        return _Rows(Z=stacked, factors=None, fast=counting.kept), followed
    counts = fast_rows(np.concatenate(slip), counting.slip_noise, directions, percent)
    return _Rows(Z=stacked, factors=None, fast=counts), followed


def _slip(e: Experiment, u: Array) -> Array:
    """Lowest speeds (rows, c) within half a period of the cut-off: by that the low-pass blurs reversals in W, not in Z."""
    reach = round(0.5 / (e.layout.spacing_s * e.problem.slip_cutoff_hz))
    return lowest_nearby(np.abs(u), e.decimation.instants(len(u)), reach)
