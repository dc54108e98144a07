"""Instruments: the regressor along the motion simulated with an estimate, one task per recorded experiment."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..data import Work
from ..estimation import SpanFactors, System, one_thread, stacked
from ..model import why_not_positive
from ..regression import (
    OwnParameters,
    Problem,
    decimated_regressor,
    lowest_nearby,
    moving_rows_of,
    predicted_drive_torques,
    rows_of_block,
)
from .experiment import EARLY_RATE_PER_BANDWIDTH, RATE_PER_BANDWIDTH, Experiment
from .motion import (
    MotionBlocks,
    NotSimulatedError,
    Replica,
    TrackingError,
    nearest,
    reference_blocks,
    simulate_replica,
    simulated_blocks,
    with_gains_for,
)

InstrumentKind = Literal["simulated", "consistent", "reference"]
WORST_FIRST: tuple[InstrumentKind, ...] = ("reference", "consistent", "simulated")


@dataclass(frozen=True, kw_only=True, eq=False)
class Instruments:
    """Instruments of a recording, or of several stacked; single values are those of the worst recording.

    Attributes:
        beta: (b,) the requested parameters; the nearest consistent ones are simulated.
        Z: (r, b) instruments, rows as those of W; of a long recording as those of `system`.
        system: of a long recording W and Y about beta, as QR factors of the used rows [Z W Y] by span; else None.
        moving_rows: by recording, which rows (rows, n) are used.
        kind, reason: as in `methods.Pass`.
        gains: factors on the controllers' gains, n for each recording.
        tracking_percent: error of the simulated position, None if nothing was simulated.
        load_unknown: beta, a regular start, has no link torques; load friction is left out.
    """

    beta: Array
    Z: Array
    system: System | None = None
    moving_rows: tuple[NDArray[np.bool_], ...]
    kind: InstrumentKind
    reason: str | None
    gains: Array
    tracking_percent: float | None
    load_unknown: bool

    @cached_property
    def used(self) -> Array:
        """1 for used rows (r,), else 0; joint by joint, recording by recording."""
        return np.concatenate(self.moving_rows).T.reshape(-1).astype(float)

    def without_rows(self) -> "Instruments":
        """The same without arrays of a recording's length, except `moving_rows`."""
        return replace(self, Z=self.Z[:0].copy(), system=None)


def simulate_instruments(
    e: Experiment,
    beta: Array,
    covariance: Array | None,
    rows: NDArray[np.bool_] | None = None,
) -> Instruments:
    """Instruments along the closed loop simulated with the physically consistent parameters nearest to `beta` (b,).

    The nearest parameters follow the estimate smoothly. The estimate itself moves a light wrist wildly long before its inertia
    matrix stops being positive, and the iteration then has no fixed point. If the simulated robot leaves its reference,
    instruments are computed along the reference.

    Parameters
    ----------
    e : the recorded experiment.
    beta, covariance : of the estimate, (b,) and (b, b); without a covariance beta itself is simulated.
    rows : (rows, n) used rows of a previous pass; None for those at which the simulated robot is fast enough.
    """
    near = beta if covariance is None else nearest(e, beta, covariance)
    model, gains, reason = with_gains_for(e, near)
    kind: InstrumentKind = "simulated"
    tracking_percent = None
    try:
        found, tracking_percent = _along(e, simulated_blocks(e, model, gains, reason), near, beta, rows)
        if covariance is not None and (reason := why_not_positive(e.model(beta).inertia(e.poses))) is not None:
            kind = "consistent"
    except NotSimulatedError as why:
        kind, reason = "reference", str(why)
        found, _ = _along(e, reference_blocks(e), near, beta, rows)
    Z, moving_rows, system = found
    return Instruments(
        beta=beta,
        Z=Z,
        system=system,
        moving_rows=(moving_rows,),
        kind=kind,
        reason=reason,
        gains=gains,
        tracking_percent=tracking_percent,
        load_unknown=covariance is None,
    )


def stack_instruments(
    each: Sequence[Instruments],
    beta: Array,
    parameters: OwnParameters,
    names: Sequence[str],
    drives: Sequence[Array | None],
) -> Instruments:
    """Instruments of several recordings, in the columns of all parameters beta (b,); `drives` as of `columns`."""
    if len(each) == 1 and parameters.plain:
        return replace(each[0], beta=beta)
    n = each[0].moving_rows[0].shape[1]
    of_all = [parameters.columns(one.Z, k, tau) for k, (one, tau) in enumerate(zip(each, drives, strict=True))]
    wide = [Z.reshape(n, -1, len(beta)) for Z in of_all]
    systems = [one.system for one in each if one.system is not None]
    return Instruments(
        beta=beta,
        Z=np.concatenate(wide, axis=1).reshape(-1, len(beta)),
        system=stacked(systems) if systems else None,
        moving_rows=tuple(rows for one in each for rows in one.moving_rows),
        kind=min((one.kind for one in each), key=WORST_FIRST.index),
        reason=join_reasons([one.reason for one in each], names),
        gains=np.concatenate([one.gains for one in each]),
        tracking_percent=max_or_none([one.tracking_percent for one in each]),
        load_unknown=any(one.load_unknown for one in each),
    )


def max_or_none(figures: Sequence[float | None]) -> float | None:
    """The largest value; None if any is None."""
    known = [x for x in figures if x is not None]
    return max(known) if len(known) == len(figures) else None


def join_reasons(reasons: Sequence[str | None], names: Sequence[str]) -> str | None:
    """The reasons in one line, led by the recordings' names if there are several recordings."""
    if len(reasons) == 1:
        return reasons[0]
    return "; ".join(f"{name}: {why}" for name, why in zip(names, reasons, strict=True) if why is not None) or None


def _along(
    e: Experiment,
    blocks: MotionBlocks,
    near: Array,
    beta: Array,
    rows: NDArray[np.bool_] | None,
) -> tuple[tuple[Array, NDArray[np.bool_], System | None], float]:
    """Z about `near` along a motion, the used rows, a long recording's system; and the tracking error."""
    problem, base = e.problem, e.problem.base
    directions, percent = e.directions, problem.settings.low_speed.iv
    n, rows_of_all = problem.signals.robot.n, e.blocks[0].rows
    factors = SpanFactors(rows_of_all, n, 2 * base.b + 1, e.spans) if e.spans else None
    error, parts, slip, moving = TrackingError(e), list[Array](), list[Array](), list[NDArray[np.bool_]]()
    for at, motion in blocks:
        error.add(at, motion)
        own = decimated_regressor(motion, problem.model, base, e.decimation, beta=near)[..., at.inside]
        speeds = _slip(e, motion.dq @ directions.T)[at.inside]
        if factors is None:
            parts.append(own)
            slip.append(speeds)
            continue
        # The peak of the whole recording is known from its reference.
        if rows is None:
            counts = moving_rows_of(speeds, e.slip_noise, directions, percent, peak=e.fastest)
        else:
            counts = rows[at.first : at.last]
        W, Y = rows_of_block(problem, at, beta)
        factors.add(at.first, np.concatenate([own, W, Y[:, None]], axis=1), counts)
        moving.append(counts)
    if factors is not None:
        system, of_system = factors.system(base.names)
        assert of_system is not None
        return (of_system, np.concatenate(moving), system), error.percent
    Z = np.ascontiguousarray(np.concatenate(parts, axis=-1).transpose(0, 2, 1)).reshape(-1, base.b)
    counts = moving_rows_of(np.concatenate(slip), e.slip_noise, directions, percent) if rows is None else rows
    return (Z, counts, None), error.percent


def _slip(e: Experiment, u: Array) -> Array:
    """Minimum speeds (rows, c) within ± half a cut-off period, because the low-pass smears reversals in W."""
    reach = round(0.5 / (e.spacing_s * e.problem.slip_cutoff_hz))
    return lowest_nearby(np.abs(u), e.decimation.instants(len(u)), reach)


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulation:
    """The closed loop of a recording, with gains set for the inertias of `prior` (b,).

    `payload` (b,) is the part of the simulated parameters that a payload adds, which stays as it is;
    `slip_noise` (c,) is the speed noise along the directions of Coulomb friction; `spans` as of `Experiment`.
    """

    problem: Problem
    prior: Array
    slip_noise: Array
    spans: int
    gain_update: bool = True
    payload: Array | float = 0.0
    _experiments: dict[float, Experiment] = field(default_factory=dict)

    def at(self, rate_per_bandwidth: float) -> Experiment:
        """The experiment with this many steps and samples per period of the bandwidth, prepared once."""
        if rate_per_bandwidth not in self._experiments:
            self._experiments[rate_per_bandwidth] = Experiment(
                self.problem.with_samples(),
                self.prior,
                self.slip_noise,
                rate_per_bandwidth=rate_per_bandwidth,
                gain_update=self.gain_update,
                spans=self.spans,
            )
        return self._experiments[rate_per_bandwidth].carrying(self.payload)

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_experiments": {}}  # each process prepares its own

    @one_thread
    def instruments(
        self,
        beta: Array,
        covariance: Array | None,
        rows: NDArray[np.bool_] | None,
        rate_per_bandwidth: float,
    ) -> Instruments:
        """See `simulate_instruments`."""
        return simulate_instruments(self.at(rate_per_bandwidth), beta, covariance, rows)

    @one_thread
    def replica(self, beta: Array, covariance: Array | None) -> Replica:
        """See `simulate_replica`."""
        return simulate_replica(self.at(RATE_PER_BANDWIDTH), beta, covariance)


@dataclass(frozen=True, kw_only=True, eq=False)
class ClosedLoops:
    """The recordings of a fit in the order of the rows, and where the tasks run.

    `names` are the recordings'; `parameters` gives the order of shared and own parameters.
    """

    simulations: tuple[Simulation, ...]
    names: tuple[str, ...]
    parameters: OwnParameters
    work: Work

    def instruments(
        self,
        beta: Array,
        covariance: Array | None,
        *,
        rows: Sequence[NDArray[np.bool_]] | None = None,
        coarse: bool = False,
    ) -> Instruments:
        """Instruments of all recordings for beta (b,) and its covariance, as `simulate_instruments`.

        `rows` as `Instruments.moving_rows`.
        """
        rate = EARLY_RATE_PER_BANDWIDTH if coarse else RATE_PER_BANDWIDTH
        each_rows: Sequence[NDArray[np.bool_] | None] = rows or [None] * len(self.simulations)
        tasks = [(*own, r, rate) for own, r in zip(self._own(beta, covariance), each_rows, strict=True)]
        each = tuple(self.work.run(Simulation.instruments, tasks))
        drives: list[Array | None] = [None] * len(each)
        if self.parameters.motors:
            drives = [
                predicted_drive_torques(s.problem.with_samples(), one.Z, one.beta)
                for s, one in zip(self.simulations, each, strict=True)
            ]
        return stack_instruments(each, beta, self.parameters, self.names, drives)

    def replicas(self, beta: Array, covariance: Array | None) -> tuple[Replica, ...]:
        """The robot simulated with beta (b,) in each recording, as `simulate_replica`."""
        return tuple(self.work.run(Simulation.replica, self._own(beta, covariance)))

    def _own(self, beta: Array, covariance: Array | None) -> list[tuple[Simulation, Array, Array | None]]:
        """By recording: its simulation, its base parameters and their covariance."""
        own = zip(self.simulations, self.parameters.simulated(beta, covariance), strict=True)
        return [(replace(one, payload=carried), x, C) for one, (x, C, carried) in own]
