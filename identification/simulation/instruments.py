"""Instruments: the regressor along the motion simulated with an estimate, one task per recorded experiment."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from ..arrays import Array
from ..data import Work
from ..estimation import SpanFactors, System, one_thread, stacked
from ..model import why_not_positive
from ..regression import (
    OwnParameters,
    Problem,
    columns_of_drives,
    decimated_regressor,
    predicted_torque,
    rows_of_block,
    sample_weights,
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
        drives: (n, rows, m) torques at the joints of each motor that beta predicts; None where no gains are identified.
        kind, reason: as in `methods.Pass`.
        gains: factors on the controllers' gains, n for each recording.
        tracking_percent: error of the simulated position, None if nothing was simulated.
        load_unknown: beta, a regular start, has no link torques; load friction is left out.
    """

    beta: Array
    Z: Array
    system: System | None = None
    kind: InstrumentKind
    reason: str | None
    gains: Array
    tracking_percent: float | None
    load_unknown: bool
    drives: Array | None = None

    def without_rows(self) -> "Instruments":
        """The same without arrays of a recording's length."""
        return replace(self, Z=self.Z[:0].copy(), system=None, drives=None)


def simulate_instruments(e: Experiment, beta: Array, covariance: Array | None) -> Instruments:
    """Instruments along the closed loop simulated with the physically consistent parameters nearest to `beta` (b,).

    The nearest parameters follow the estimate smoothly. The estimate itself moves a light wrist wildly long before its inertia
    matrix stops being positive, and the iteration then has no fixed point. If the simulated robot leaves its reference,
    instruments are computed along the reference.

    Parameters
    ----------
    e : the recorded experiment.
    beta, covariance : of the estimate, (b,) and (b, b); without a covariance beta itself is simulated.
    """
    near = beta if covariance is None else nearest(e, beta, covariance)
    model, gains, reason = with_gains_for(e, near)
    kind: InstrumentKind = "simulated"
    tracking_percent = None
    try:
        found, tracking_percent = _along(e, simulated_blocks(e, model, gains, reason), near, beta)
        if covariance is not None and (reason := why_not_positive(e.model(beta).inertia(e.poses))) is not None:
            kind = "consistent"
    except NotSimulatedError as why:
        kind, reason = "reference", str(why)
        found, _ = _along(e, reference_blocks(e), near, beta)
    Z, drives, system = found
    return Instruments(
        beta=beta,
        Z=Z,
        system=system,
        kind=kind,
        reason=reason,
        gains=gains,
        tracking_percent=tracking_percent,
        load_unknown=covariance is None,
        drives=drives,
    )


def reference_instruments(e: Experiment, beta: Array) -> Instruments:
    """Instruments along the reference, without a simulation, about beta (b,)."""
    (Z, drives, system), _ = _along(e, reference_blocks(e), beta, beta)
    gains = np.ones(len(e.held))
    return Instruments(
        beta=beta,
        Z=Z,
        system=system,
        kind="reference",
        reason=None,
        gains=gains,
        tracking_percent=None,
        load_unknown=True,
        drives=drives,
    )


def stack_instruments(
    each: Sequence[Instruments], beta: Array, parameters: OwnParameters, names: Sequence[str]
) -> Instruments:
    """Instruments of several recordings, in the columns of all parameters beta (b,)."""
    if len(each) == 1 and parameters.plain:
        return replace(each[0], beta=beta)
    n = len(each[0].gains)
    of_all = [parameters.columns(one.Z, k, one.drives) for k, one in enumerate(each)]
    wide = [Z.reshape(n, -1, len(beta)) for Z in of_all]
    systems = [one.system for one in each if one.system is not None]
    return Instruments(
        beta=beta,
        Z=np.concatenate(wide, axis=1).reshape(-1, len(beta)),
        system=stacked(systems) if systems else None,
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
    e: Experiment, blocks: MotionBlocks, near: Array, beta: Array
) -> tuple[tuple[Array, Array | None, System | None], float]:
    """Z about `near` along a motion, the drives' torques by beta, a long recording's system; and the tracking error."""
    problem, base = e.problem, e.problem.base
    n, rows = problem.signals.robot.n, e.blocks[0].rows
    share = sample_weights(problem).of_rows
    factors = SpanFactors(rows, n, 2 * base.b + 1, e.spans) if e.spans else None
    error, parts, drives = TrackingError(e), list[Array](), list[Array]()
    for at, motion in blocks:
        error.add(at, motion)
        own = decimated_regressor(problem, motion, e.decimation, beta=near)[..., at.inside]
        if factors is not None:
            W, Y = rows_of_block(problem, at, beta)
            factors.add(at.first, np.concatenate([own, W, Y[:, None]], axis=1), share[at.first : at.last])
            continue
        parts.append(own)
        if problem.gains is not None:
            torque = predicted_torque(motion, problem.model, base, beta)
            drives.append(columns_of_drives(problem, motion.t_s, torque, e.decimation)[:, at.inside])
    if factors is not None:
        system, Z = factors.system(base.names)
        assert Z is not None
        return (Z, None, system), error.percent
    Z = np.ascontiguousarray(np.concatenate(parts, axis=-1).transpose(0, 2, 1)).reshape(-1, base.b)
    return (Z, np.concatenate(drives, axis=1) if drives else None, None), error.percent


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulation:
    """The closed loop of a recording, with gains set for the inertias of `prior` (b,).

    `payload` (b,) is the part of the simulated parameters that a payload adds, which stays as it is; `spans` as of
    `Experiment`.
    """

    problem: Problem
    prior: Array
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
                rate_per_bandwidth=rate_per_bandwidth,
                gain_update=self.gain_update,
                spans=self.spans,
            )
        return self._experiments[rate_per_bandwidth].carrying(self.payload)

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_experiments": {}}  # each process prepares its own

    @one_thread
    def instruments(self, beta: Array, covariance: Array | None, rate_per_bandwidth: float) -> Instruments:
        """See `simulate_instruments`."""
        return simulate_instruments(self.at(rate_per_bandwidth), beta, covariance)

    @one_thread
    def along_reference(self, beta: Array) -> Instruments:
        """See `reference_instruments`."""
        return reference_instruments(self.at(EARLY_RATE_PER_BANDWIDTH), beta)

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

    def instruments(self, beta: Array, covariance: Array | None, *, coarse: bool = False) -> Instruments:
        """Instruments of all recordings for beta (b,) and its covariance, as `simulate_instruments`."""
        rate = EARLY_RATE_PER_BANDWIDTH if coarse else RATE_PER_BANDWIDTH
        each = tuple(self.work.run(Simulation.instruments, [(*own, rate) for own in self._own(beta, covariance)]))
        return stack_instruments(each, beta, self.parameters, self.names)

    def along_reference(self, beta: Array) -> Instruments:
        """Instruments of all recordings along their references, coarsely, about beta (b,)."""
        tasks = [(one, x) for one, x, _ in self._own(beta, None)]
        return stack_instruments(
            tuple(self.work.run(Simulation.along_reference, tasks)), beta, self.parameters, self.names
        )

    def replicas(self, beta: Array, covariance: Array | None) -> tuple[Replica, ...]:
        """The robot simulated with beta (b,) in each recording, as `simulate_replica`."""
        return tuple(self.work.run(Simulation.replica, self._own(beta, covariance)))

    def _own(self, beta: Array, covariance: Array | None) -> list[tuple[Simulation, Array, Array | None]]:
        """By recording: its simulation, its base parameters and their covariance."""
        own = zip(self.simulations, self.parameters.simulated(beta, covariance), strict=True)
        return [(replace(one, payload=carried), x, C) for one, (x, C, carried) in own]
