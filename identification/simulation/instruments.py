"""Instruments: the columns along the motion simulated with an estimate, one task
per recorded experiment.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from .. import regression
from ..arrays import Array
from ..data import Work
from ..estimation import SpanFactors, one_thread, stacked_columns
from ..model import why_not_positive
from ..regression import Motion, Problem, Rows, Term, Unknowns
from . import motion as motions
from .experiment import EARLY_RATE_PER_BANDWIDTH, RATE_PER_BANDWIDTH, Experiment
from .motion import MotionBlocks, NotSimulatedError, Replica, TrackingDeviation

InstrumentKind = Literal["simulated", "consistent", "reference"]
WORST_FIRST: tuple[InstrumentKind, ...] = ("reference", "consistent", "simulated")


@dataclass(frozen=True, kw_only=True, eq=False)
class Instruments:
    """Instruments of a recording, or of several stacked; single values are those
    of the worst recording.

    Attributes:
        x: values about which the columns are: (b,) base parameters of one recording, or
            all unknowns of several.
        Z: (r, b + n) instruments of base parameters and drives, or (r, p) of all unknowns;
            empty for long recordings.
        rows: of long recordings [C Z W E Y] of each about x, as QR factors by span; else none.
        kind, reason: as in `methods.Pass`.
        gains: factors on the controllers' gains, n for each recording.
        tracking_percent: error of the simulated position, None if nothing was simulated.
        replicas: the robot simulated in each recording.
    """

    x: Array
    Z: Array
    rows: tuple[Rows, ...]
    kind: InstrumentKind
    reason: str | None
    gains: Array
    tracking_percent: float | None
    replicas: tuple[Replica, ...]

    def without_rows(self) -> "Instruments":
        """The same without arrays of a recording's length."""
        replicas = tuple(replace(one, motion=None, q=one.q[:0]) for one in self.replicas)
        return replace(self, Z=self.Z[:0].copy(), rows=(), replicas=replicas)


def simulate_instruments(
    e: Experiment,
    x: Array,
    robot: Array,
    covariance: Array | None,
    payload: Array | float = 0.0,
    further: Term | None = None,
) -> Instruments:
    """Instruments about the base parameters `x` (b,), along the closed loop of the physically
    consistent robot nearest to parameters `robot` (b,) of this covariance (b, b); without a
    covariance that robot itself is simulated. `payload` (b,) is the part of `robot` that a payload
    adds, which stays as it is.

    The nearest parameters follow the estimate smoothly. The estimate itself moves a light wrist
    wildly long before its inertia matrix stops being positive, and the iteration then has no fixed
    point. If the simulated robot leaves its reference, instruments are computed along the motion
    that the reference predicts.
    """
    near = robot if covariance is None else motions.nearest(e, robot, covariance, payload)
    model, gains, reason = motions.with_gains_for(e, near)
    kind: InstrumentKind = "simulated"
    try:
        found = _along(
            e, motions.simulated_blocks(e, model, gains, reason), x, simulated=True, further=further
        )
        if (
            covariance is not None
            and (reason := why_not_positive(e.model(robot).inertia(e.poses))) is not None
        ):
            kind = "consistent"
        elif covariance is not None and near is robot:
            reason = "no physically consistent robot is near: that of the estimate itself"
    except NotSimulatedError as why:
        kind, reason = "reference", str(why)
        found = _along(e, motions.reference_blocks(e, x), x, simulated=False, further=further)
    return replace(found, kind=kind, reason=reason, gains=gains)


def _along(
    e: Experiment, blocks: MotionBlocks, x: Array, *, simulated: bool, further: Term | None = None
) -> Instruments:
    """Instruments about x (b,) along a motion, of kind `reference`."""
    problem, n, T = e.problem, e.problem.signals.robot.n, e.blocks[0].rows
    share, width = (
        regression.sample_weights(problem).of_rows,
        problem.base.b + n * problem.needs_drives,
    )
    factors = SpanFactors(T, n, e.spans) if e.spans else None
    error, parts, series = TrackingDeviation(e), list[Array](), list[tuple[Array, ...]]()
    for at, motion in blocks:
        inside, q = error.add(at, motion)
        own = (
            motion.t_s[inside],
            q,
            *(path[inside] for path in (motion.q, motion.dq, motion.ddq, motion.tau)),
        )
        # A long recording keeps only the instants of the rows.
        series.append(tuple(map(e.decimation.kept, own)) if e.spans else own)
        columns = [regression.columns_of_arm(problem, motion, e.decimation, beta=x)[0]]
        if problem.needs_drives:
            torque = regression.predicted_torque(motion, problem.model, problem.base, x)
            columns.append(regression.torque_of_drives(problem, motion.t_s, torque, e.decimation))
        Z, rows = np.concatenate(columns, axis=1)[..., at.inside], slice(at.first, at.last)
        if factors is None:
            parts.append(Z)
            continue
        Z = np.concatenate([Z, regression.columns_of_block(problem, at, x)], axis=1)
        if further is not None:
            Z = np.concatenate(
                [further.columns(problem, motion, e.decimation)[..., at.inside], Z], axis=1
            )
        factors.add(at.first, Z, share[rows])
    held = (
        np.concatenate(parts, axis=-1).transpose(0, 2, 1).reshape(-1, width)
        if parts
        else np.zeros((0, width))
    )
    t_s, measured, *moved = (np.concatenate(each) for each in zip(*series, strict=True))
    replica = Replica(
        motion=Motion(t_s=t_s, q=moved[0], dq=moved[1], ddq=moved[2], tau=moved[3]),
        q=measured,
        decimation=replace(e.decimation, factor=1) if e.spans else e.decimation,
        tracking_percent=error.percent if simulated else None,
        direct=error.by_joint if simulated else (),
        reference_kind=e.reference_kind,
        controller=e.controller,
        J_known=e.J_known,
        bandwidth_hz=e.bandwidth_hz,
    )
    return Instruments(
        x=x,
        Z=held,
        rows=(regression.rows_of_factors(problem, factors, width),) if factors else (),
        kind="reference",
        reason=None,
        gains=np.ones(n),
        tracking_percent=replica.tracking_percent,
        replicas=(replica,),
    )


def max_or_none(figures: Sequence[float | None]) -> float | None:
    """The largest value; None if any is None."""
    known = [x for x in figures if x is not None]
    return max(known) if len(known) == len(figures) else None


def join_reasons(reasons: Sequence[str | None], names: Sequence[str]) -> str | None:
    """The reasons in one line, led by the recordings' names if there are several recordings."""
    if len(reasons) == 1:
        return reasons[0]
    return (
        "; ".join(
            f"{name}: {why}" for name, why in zip(names, reasons, strict=True) if why is not None
        )
        or None
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulation:
    """The closed loop of a recording, with gains set for the inertias of `prior` (b,);
    `spans` as of `Experiment`.
    """

    problem: Problem
    prior: Array
    spans: int
    gain_update: bool = True
    _experiments: dict[float, Experiment] = field(default_factory=dict)

    def at(self, rate_per_bandwidth: float) -> Experiment:
        """The experiment with this many steps and samples per period of the
        bandwidth, prepared once.
        """
        if rate_per_bandwidth not in self._experiments:
            self._experiments[rate_per_bandwidth] = Experiment(
                self.problem.with_samples(),
                self.prior,
                rate_per_bandwidth=rate_per_bandwidth,
                gain_update=self.gain_update,
                spans=self.spans,
            )
        return self._experiments[rate_per_bandwidth]

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_experiments": {}}  # each process prepares its own

    @one_thread
    def instruments(self, rate_per_bandwidth: float, *given: Any) -> Instruments:
        """See `simulate_instruments`."""
        return simulate_instruments(self.at(rate_per_bandwidth), *given)

    @one_thread
    def along_reference(self, x: Array, further: Term | None = None) -> Instruments:
        """Instruments along the motion that the reference predicts, without a simulation,
        coarsely, about x (b,).
        """
        e = self.at(EARLY_RATE_PER_BANDWIDTH)
        return _along(e, motions.reference_blocks(e, x), x, simulated=False, further=further)


@dataclass(frozen=True, kw_only=True, eq=False)
class ClosedLoops:
    """The recordings of a fit, their `names`, the `unknowns`, all in the order of the rows,
    and where the tasks run.
    """

    simulations: tuple[Simulation, ...]
    names: tuple[str, ...]
    unknowns: Unknowns
    work: Work

    def instruments(
        self,
        x: Array,
        covariance: Array | None,
        *,
        robot: Array | None = None,
        coarse: bool = False,
        further: Sequence[Term] = (),
    ) -> Instruments:
        """Instruments of all recordings about x, as `simulate_instruments`; `robot` is
        simulated in place of x.
        """
        rate = EARLY_RATE_PER_BANDWIDTH if coarse else RATE_PER_BANDWIDTH
        asked = self.unknowns.simulated(x if robot is None else robot, covariance)
        tasks = [
            (one, rate, self.unknowns.beta(x, k), *own, further[k] if further else None)
            for k, (one, own) in enumerate(zip(self.simulations, asked, strict=True))
        ]
        return self._stacked(list(self.work.run(Simulation.instruments, tasks)), x)

    def along_reference(self, x: Array, further: Sequence[Term] = ()) -> Instruments:
        """Instruments of all recordings along the motions that their references predict about x."""
        each = enumerate(self.simulations)
        tasks = [
            (one, self.unknowns.beta(x, k), further[k] if further else None) for k, one in each
        ]
        return self._stacked(list(self.work.run(Simulation.along_reference, tasks)), x)

    def _stacked(self, each: Sequence[Instruments], x: Array) -> Instruments:
        """Instruments of all recordings, in the columns of x; rows of long ones stay apart."""
        Z = stacked_columns(
            [self.unknowns.columns(k, one.Z) for k, one in enumerate(each)], len(each[0].gains)
        )
        return Instruments(
            x=x,
            Z=Z,
            rows=tuple(rows for one in each for rows in one.rows),
            kind=min((one.kind for one in each), key=WORST_FIRST.index),
            reason=join_reasons([one.reason for one in each], self.names),
            gains=np.concatenate([one.gains for one in each]),
            tracking_percent=max_or_none([one.tracking_percent for one in each]),
            replicas=tuple(replica for one in each for replica in one.replicas),
        )
