"""Instruments: the robot simulated with an estimate in the recorded experiment, and the regressor along its motion."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import relative_error_percent
from ..model import direct_model
from ..regression import Decimation, Motion, decimated_regressor, lowest_nearby
from ..simulation import simulate, surrogate_loop
from ..trust import inertias, nearest_consistent, not_positive
from .experiment import LOST, Experiment

InstrumentKind = Literal["simulated", "consistent", "reference"]


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedMotion:
    """The robot simulated with parameters: its motion at the instruments' instants, or None where it could not be simulated.

    `reason` says why not; where there is a motion all the same, it is that of the nearest physically consistent parameters.
    `tracking_percent` is |q_sim - q| in percent of |q - mean|, all joints together; `gains` the factors on the controller.
    """

    motion: Motion | None
    reason: str | None
    gains: Array
    tracking_percent: float | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Instruments:
    """Instruments Z (r, b), rows as those of W.

    `beta` (b,) are the parameters asked for, to which those simulated are the nearest. `kind` and `reason` are as in
    `methods.Pass`.
    `motion` is None along the reference. `load_unknown` says that beta, a regular start, has nothing of the links' torque that
    load friction goes by. `slip` (rows, c) are the speeds of the c directions of Coulomb friction, the lowest
    near the rows' instants. `decimation` and `reference_kind` are those of the experiment.
    """

    beta: Array
    motion: Motion | None
    Z: Array
    slip: Array
    decimation: Decimation
    reference_kind: Literal["recorded", "surrogate"]
    kind: InstrumentKind
    reason: str | None
    gains: Array
    tracking_percent: float | None
    load_unknown: bool = False


def simulate_instruments(e: Experiment, beta: Array, covariance: Array | None) -> Instruments:
    """Instruments along the closed loop simulated with the physically consistent parameters nearest to `beta` (b,).

    `covariance` (b, b) is that of beta; None takes beta as it is. Nearest parameters follow the estimate smoothly, whereas the
    estimate itself moves a light wrist wildly long before its inertia matrix is no longer positive: the iteration then has no
    fixed point. Where the robot leaves its reference all the same, instruments are taken along the reference itself.
    """
    simulated = beta if covariance is None else _nearest(e, beta, covariance)
    s, reason = simulated_motion(e, simulated), None
    if s.motion is not None and covariance is not None:
        reason = not_positive(direct_model(e.problem.model, e.problem.base.standard_parameters(beta)), e.poses)
    motion = s.motion
    if motion is None:
        q, dq, ddq = (_on_grid(e, x, 1) for x in (e.reference.q, e.reference.dq, e.reference.ddq))
        motion = Motion(t_s=e.grid_s, q=q, dq=dq, ddq=ddq, tau=np.zeros_like(q))
    Z = decimated_regressor(motion, e.problem.model, e.problem.base, e.decimation, beta=simulated)  # (n, b, rows)
    return Instruments(
        beta=beta,
        motion=s.motion,
        Z=np.ascontiguousarray(Z.transpose(0, 2, 1)).reshape(-1, e.problem.base.b),
        slip=_slip(e, motion),
        decimation=e.decimation,
        reference_kind=e.reference_kind,
        kind="reference" if s.motion is None else "simulated" if reason is None else "consistent",
        reason=s.reason or reason,
        gains=s.gains,
        tracking_percent=s.tracking_percent,
        load_unknown=covariance is None,
    )


def _slip(e: Experiment, motion: Motion) -> Array:
    """Lowest speeds (rows, c) within half a period of the cut-off: by that the low-pass blurs reversals in W, not in Z."""
    reach = round(0.5 / ((e.grid_s[1] - e.grid_s[0]) * e.problem.slip_cutoff_hz))
    speed = np.abs(motion.dq @ e.problem.model.coulomb_directions.T)
    return lowest_nearby(speed, e.decimation.instants(len(speed)), reach)


def simulated_robot(e: Experiment, beta: Array, covariance: Array) -> SimulatedMotion:
    """The closed loop simulated with `beta` (b,), or else with the nearest consistent parameters; `reason` is that of beta."""
    free = simulated_motion(e, beta)
    if free.reason is None:
        return free
    nearest = simulated_motion(e, _nearest(e, beta, covariance))
    return free if nearest.motion is None else replace(nearest, reason=free.reason)


def _nearest(e: Experiment, beta: Array, covariance: Array) -> Array:
    """Consistent base parameters (b,) nearest to beta; beta itself where none are to be found."""
    try:
        return nearest_consistent(e.problem, beta, covariance).beta
    except IdentificationError:
        return beta


def simulated_motion(e: Experiment, beta: Array) -> SimulatedMotion:
    """The closed loop simulated with `beta` (b,), if M(q, beta) is positive on the trajectory and the loop follows."""
    model = direct_model(e.problem.model, e.problem.base.standard_parameters(beta))
    J, reason = inertias(model, e.poses), not_positive(model, e.poses)
    gains = J / e.J_prior if e.gain_update else np.ones(len(J))
    if reason is not None:
        return SimulatedMotion(motion=None, reason=reason, gains=gains, tracking_percent=None)
    if e.loop is not None and e.loop.computed_torque and not e.J_known:
        gains = np.ones(len(J))  # nothing tells what its saturation was set for
    step_s = e.times_s[1] - e.times_s[0]
    loop = e.loop.scaled(gains) if e.loop else surrogate_loop(e.bandwidth_hz, gains * e.J_prior, 1 / step_s)
    travel = np.ptp(e.reference.q, axis=0)
    bound = np.maximum(LOST * travel, 0.1 * LOST * travel.max())
    done = simulate(model, loop, e.reference, start=e.start, bound=bound, substeps=e.substeps)
    if done.reason is not None:
        return SimulatedMotion(motion=None, reason=done.reason, gains=gains, tracking_percent=None)
    q, dq, ddq, tau = (_on_grid(e, x, e.substeps) for x in (done.q, done.dq, done.ddq, done.tau))
    error = 100 * np.linalg.norm(q - e.q) / np.linalg.norm(e.q - e.q.mean(axis=0))
    motion = Motion(t_s=e.grid_s, q=q, dq=dq, ddq=ddq, tau=tau)
    return SimulatedMotion(motion=motion, reason=None, gains=gains, tracking_percent=float(error))


def joint_tracking_percent(e: Experiment, simulated: Motion) -> list[float | None]:
    """How far each simulated joint is off the measured one, in percent of its variation; None for one that stands."""
    return [relative_error_percent(q - q.mean(), off) for q, off in zip(e.q.T, (simulated.q - e.q).T, strict=True)]


def _on_grid(e: Experiment, x: Array, substeps: int) -> Array:
    """x (K substeps, n) from the controller's first instant on, at the instruments' instants: picked or linear in between."""
    h = (e.times_s[1] - e.times_s[0]) / substeps
    ratio = (e.grid_s[1] - e.grid_s[0]) / h
    step = round(ratio)
    if step >= 1 and abs(ratio - step) < 1e-9 and (len(x) - 1) // step + 1 >= len(e.grid_s):
        return x[::step][: len(e.grid_s)]
    own = e.times_s[0] + h * np.arange(len(x))
    return np.stack([np.interp(e.grid_s, own, column) for column in x.T], axis=1)
