"""From a base estimate to instruments: simulate the closed loop, evaluate the model along it, decimate as W was.

What is simulated needs no more samples than its bandwidth asks for: instruments carry no noise. They are evaluated at 100
times the bandwidth or more, or at the recording's rate where that is less, at instants that the decimated rows of W have
too. The robot is simulated in steps as fine as 100 times the bandwidth, whatever the rate of recording and controller.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..arrays import Array
from ..data import Signals
from ..errors import IdentificationError
from ..model import BaseParameters, DirectModel, InverseModel, direct_model
from ..regression import (
    Decimation,
    Motion,
    Settings,
    decimated_regressor,
    differentiate,
    measured_slip,
    motion_between,
    rule_cutoff_hz,
)
from ..simulation import Loop, has_controller, recorded_loop, simulate, surrogate_loop
from .fit import InstrumentKind
from .plausibility import poses_of

RATE_PER_BANDWIDTH = 100.0  # instrument samples per period of the bandwidth, at least
LEAST_INSTANTS = 30  # of the controller, for a simulation to say anything
MOST_STEPS = 2e7  # to simulate: what is slower than real time by far is a mistake in the description
LOST = 0.5  # of a joint's travel: a simulation, or a reference, this far off does not belong to the recording


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment:
    """What every simulation of a recording shares.

    Attributes:
        reference: `recorded`, or `surrogate`: the measured position low-passed without phase shift.
        q_ref, dq_ref, ddq_ref: (K, n) at the controller's instants.
        start: measured position and speed, filtered, (n,) each, at the first instant.
        q: (N, n) measured position, filtered, at the instruments' instants.
        poses: (P, n) positions at which M is checked.
        loop: the description's control loop, or None where a PD of the stated bandwidth stands in.
        J_prior: (n,) inertias that the loop's gains were set for; `J_known` says that least squares gave them.
        grid_s: (N,) instants of the instruments; `times_s`: (K,) of the controller, each with `substeps` simulated steps. A
            surrogate has its instants at each step.
        decimation: of the instruments, to the rows of W.
        saturated_percent: share of recorded samples at the drives' limit, None where no limit is stated.
        directions: (c, n) directions of Coulomb friction; slip_noise: (c,) noise of their speeds in W.
    """

    dynamics: InverseModel
    base: BaseParameters
    reference: Literal["recorded", "surrogate"]
    q_ref: Array
    dq_ref: Array
    ddq_ref: Array
    start: tuple[Array, Array]
    q: Array
    poses: Array
    loop: Loop | None
    J_prior: Array
    J_known: bool
    bandwidth_hz: float
    grid_s: Array
    times_s: Array
    substeps: int
    decimation: Decimation
    saturated_percent: float | None
    directions: Array
    slip_noise: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedMotion:
    """The robot simulated with an estimate: its motion at the instruments' instants, or None and the `reason`.

    `tracking_percent` is |q_sim - q| in percent of |q - mean|, all joints together; `gains` the factors on the controller.
    """

    motion: Motion | None
    reason: str | None
    gains: Array
    tracking_percent: float | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Instruments:
    """Instruments Z (r, b), rows as those of W.

    `beta` (b,) are the parameters simulated. `kind` says whether they are those asked for, or why not, for the `reason`
    given. `slip` (rows, c) are the speeds of the c directions of Coulomb friction at the rows' instants.
    """

    beta: Array
    Z: Array
    slip: Array
    kind: InstrumentKind
    reason: str | None
    gains: Array
    tracking_percent: float | None


def experiment(
    signals: Signals, plan: Settings, dynamics: InverseModel, base: BaseParameters, beta_ls: Array
) -> Experiment:
    """Lay out the simulation of a recording; `beta_ls` gives the inertias that recorded gains are taken to be set for.

    Raises `IdentificationError` for a controller described in part, or a reference that is not that of the recording.
    """
    robot, fs = signals.robot, signals.sample_rate_hz
    loop = recorded_loop(robot) if has_controller(robot.controller) else None
    if loop is not None and signals.q_ref is None:
        loop = replace(loop, gravity=True)
    bandwidth_hz = robot.controller.bandwidth_hz
    m = _stride(fs, plan.decimation, bandwidth_hz)
    grid = np.arange((plan.stop - 1 - plan.start) % m + plan.start, plan.stop, m)
    period_s = loop.period_s if loop else m / fs
    substeps = max(1, math.ceil(period_s * RATE_PER_BANDWIDTH * bandwidth_hz - 1e-9))
    if loop is None:  # a continuous law: it acts at every step
        period_s, substeps = period_s / substeps, 1
    steps = (grid[-1] - grid[0]) / fs / period_s * substeps
    if steps > MOST_STEPS:
        raise IdentificationError(
            f"robot {robot.name}: controller.sample_rate_hz = {1 / period_s:g}, bandwidth_hz = {bandwidth_hz:g}: {steps:.2g} "
            f"steps to simulate; expected at most {MOST_STEPS:.2g}"
        )
    times_s = grid[0] / fs + period_s * np.arange(int(np.floor((grid[-1] - grid[0]) / fs / period_s + 1e-6)) + 1)
    if len(times_s) < LEAST_INSTANTS:
        raise IdentificationError(
            f"robot {robot.name}: controller.sample_rate_hz = {1 / period_s:g}: {len(times_s)} instants in the "
            f"{(plan.stop - plan.start) / fs:.3g} s of {signals.recording}; expected at least {LEAST_INSTANTS}"
        )
    cutoff_hz = rule_cutoff_hz(bandwidth_hz, fs)
    measured = motion_between(
        signals.q, signals.effort, cutoff_hz=cutoff_hz, sample_rate_hz=fs, start=plan.start, stop=plan.stop
    )
    if signals.q_ref is not None:
        q_ref = np.array(signals.q_ref[plan.start : plan.stop])
        _refuse_foreign_reference(q_ref, signals.q[plan.start : plan.stop], signals)
        dq_ref = differentiate(q_ref, fs)
        reference = (q_ref, dq_ref, differentiate(dq_ref, fs))
    else:
        reference = (measured.q, measured.dq, measured.ddq)
    at = [_at(times_s, plan.start / fs, fs, x) for x in reference]
    q = measured.q[grid - plan.start]
    prior = direct_model(dynamics, base.standard_parameters(beta_ls))
    J_prior = inertias(prior, poses_of(q))
    J_known = bool((J_prior > 0).all())
    if not J_known:  # a PD of the bandwidth takes any; of described gains one knows what inertia they suit
        J_prior = loop.inertias(bandwidth_hz) if loop else np.ones(robot.n)
    return Experiment(
        dynamics=dynamics,
        base=base,
        reference="surrogate" if signals.q_ref is None else "recorded",
        q_ref=at[0],
        dq_ref=at[1],
        ddq_ref=at[2],
        start=(measured.q[grid[0] - plan.start], measured.dq[grid[0] - plan.start]),
        q=q,
        poses=poses_of(q),
        loop=loop,
        J_prior=J_prior,
        J_known=J_known,
        bandwidth_hz=bandwidth_hz,
        grid_s=grid / fs,
        times_s=times_s,
        substeps=substeps,
        decimation=replace(plan.decimator, factor=plan.decimation // m),
        saturated_percent=_saturated_percent(signals, plan),
        directions=prior.directions,
        slip_noise=measured_slip(signals, plan, prior.directions)[1] @ np.abs(prior.directions.T),
    )


def instruments(e: Experiment, beta: Array, good: Array | None, *, gain_update: bool = True) -> Instruments:
    """Instruments along the closed loop simulated with `beta` (b,).

    Where the robot cannot be simulated with it, or leaves its reference, this pass steps back: half, a quarter, an eighth
    of the way from `good`, the parameters simulated last, to `beta`. Where that does not help either, instruments are taken
    along the reference itself. `reason` says why in both cases.
    """
    s, simulated = simulated_motion(e, beta, gain_update=gain_update), beta
    reason = s.reason
    for share in (0.5, 0.25, 0.125) if reason is not None else ():
        if good is None:
            break
        simulated = good + share * (beta - good)
        s = simulated_motion(e, simulated, gain_update=gain_update)
        if s.motion is not None:
            break
    motion = s.motion
    if motion is None:
        q, dq, ddq = (_on_grid(e, x, 1) for x in (e.q_ref, e.dq_ref, e.ddq_ref))
        motion = Motion(t_s=e.grid_s, q=q, dq=dq, ddq=ddq, tau=np.zeros_like(q))
    Z = decimated_regressor(motion, e.dynamics, e.base, e.decimation)  # (n, b, rows)
    return Instruments(
        beta=beta if s.motion is None else simulated,
        Z=np.ascontiguousarray(Z.transpose(0, 2, 1)).reshape(-1, e.base.b),
        slip=e.decimation.kept(motion.dq) @ e.directions.T,
        kind="reference" if s.motion is None else "simulated" if reason is None else "stepped back",
        reason=reason,
        gains=s.gains,
        tracking_percent=s.tracking_percent,
    )


def simulated_motion(e: Experiment, beta: Array, *, gain_update: bool = True) -> SimulatedMotion:
    """The closed loop simulated with `beta` (b,), if M(q, beta) is positive on the trajectory and the loop follows."""
    model = direct_model(e.dynamics, e.base.standard_parameters(beta))
    J, reason = inertias(model, e.poses), not_positive(model, e.poses)
    gains = J / e.J_prior if gain_update else np.ones(len(J))
    if reason is not None:
        return SimulatedMotion(motion=None, reason=reason, gains=gains, tracking_percent=None)
    if e.loop is not None and e.loop.computed_torque and not e.J_known:
        gains = np.ones(len(J))  # nothing tells what its saturation was set for
    step_s = e.times_s[1] - e.times_s[0]
    loop = e.loop.scaled(gains) if e.loop else surrogate_loop(e.bandwidth_hz, gains * e.J_prior, 1 / step_s)
    travel = np.ptp(e.q_ref, axis=0)
    bound = np.maximum(LOST * travel, 0.1 * LOST * travel.max())
    done = simulate(model, loop, e.q_ref, e.dq_ref, e.ddq_ref, start=e.start, bound=bound, substeps=e.substeps)
    if done.reason is not None:
        return SimulatedMotion(motion=None, reason=done.reason, gains=gains, tracking_percent=None)
    q, dq, ddq, tau = (_on_grid(e, x, e.substeps) for x in (done.q, done.dq, done.ddq, done.tau))
    error = 100 * np.linalg.norm(q - e.q) / np.linalg.norm(e.q - e.q.mean(axis=0))
    motion = Motion(t_s=e.grid_s, q=q, dq=dq, ddq=ddq, tau=tau)
    return SimulatedMotion(motion=motion, reason=None, gains=gains, tracking_percent=float(error))


def inertias(model: DirectModel, poses: Array) -> Array:
    """J_j (n,): the largest diagonal entry of M for each joint over the poses (P, n)."""
    M = model.inertia(poses)
    return np.asarray(np.diagonal(M, axis1=1, axis2=2).max(axis=0))


def not_positive(model: DirectModel, poses: Array) -> str | None:
    """None where M is positive definite at all poses (P, n), else a line that says so."""
    M = model.inertia(poses)
    if not np.isfinite(M).all():
        return "the inertia matrix is not finite on the trajectory"
    lowest = float(np.linalg.eigvalsh(M).min())
    return (
        None if lowest > 0 else f"the inertia matrix is not positive on the trajectory (lowest eigenvalue {lowest:.3g})"
    )


def regular_start(dynamics: InverseModel, base: BaseParameters, J: Array | None = None) -> Array:
    """Base parameters (b,) of a robot of which nothing is known but that each motor turns J (n,) at its joint, 1 by default.

    J is in kg m² (or kg). With a coupled wrist the Ia of a joint counts all motors that turn with it: Ia5 = 2 on the TX40.
    A joint without Ia has a link with that inertia about every axis, or that mass.
    """
    chi, robot = np.zeros(dynamics.p), dynamics.robot
    J = np.ones(robot.n) if J is None else J
    place = {name: c for c, name in enumerate(dynamics.names)}
    R = np.abs(robot.R) > 0
    for j, joint in enumerate(robot.joints):
        if joint.rotor_inertia:
            turning = [m for m in range(robot.n) if m != j and R[m, m] and R[m, j] and R[j].sum() == 1]
            shares = [J[m] * (robot.R[m, j] / robot.R[m, m]) ** 2 for m in turning]
            chi[place[f"Ia{j + 1}"]] = J[j] + sum(shares)
        elif joint.type == "revolute":
            for axis in ("XX", "YY", "ZZ"):
                chi[place[f"{axis}{j + 1}"]] = J[j]
        else:
            chi[place[f"M{j + 1}"]] = J[j]
    return np.asarray(base.K @ chi)


def _on_grid(e: Experiment, x: Array, substeps: int) -> Array:
    """x (K substeps, n) from the controller's first instant on, at the instruments' instants: picked or linear in between."""
    h = (e.times_s[1] - e.times_s[0]) / substeps
    ratio = (e.grid_s[1] - e.grid_s[0]) / h
    step = round(ratio)
    if step >= 1 and abs(ratio - step) < 1e-9 and (len(x) - 1) // step + 1 >= len(e.grid_s):
        return x[::step][: len(e.grid_s)]
    own = e.times_s[0] + h * np.arange(len(x))
    return np.stack([np.interp(e.grid_s, own, column) for column in x.T], axis=1)


def _stride(fs: float, decimation: int, bandwidth_hz: float) -> int:
    """The largest divisor of the decimation that leaves 100 samples per period of the bandwidth."""
    divisors = [m for m in range(1, decimation + 1) if decimation % m == 0]
    return max((m for m in divisors if fs / m >= RATE_PER_BANDWIDTH * bandwidth_hz), default=1)


def _at(times_s: Array, start_s: float, fs: float, x: Array) -> Array:
    """x (N, n), sampled at fs from start_s on, at other times (K,): picked, or a cubic spline in between."""
    at = (times_s - start_s) * fs
    picks = np.rint(at).astype(np.intp)
    if np.abs(at - picks).max() < 1e-6 and picks[-1] < len(x):
        return x[picks]
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(np.arange(len(x)), x)(np.clip(at, 0, len(x) - 1)))


def _refuse_foreign_reference(q_ref: Array, q: Array, signals: Signals) -> None:
    """A reference far from the measured position belongs to another recording, or to other units."""
    joints = signals.robot.joints
    for j, joint in enumerate(joints):
        spread = np.std(q[:, j])
        largest = max(np.std(q[:, i]) for i, other in enumerate(joints) if other.type == joint.type)
        error = np.sqrt(np.mean((q_ref[:, j] - q[:, j]) ** 2))
        if error > LOST * max(spread, 0.02 * largest):
            raise IdentificationError(
                f"{signals.recording}: reference of joint {joint.name}: {error:.3g} {joint.position_unit} rms off the "
                f"measured position, which varies by {spread:.3g}; expected the reference of this recording"
            )


def _saturated_percent(signals: Signals, plan: Settings) -> float | None:
    limits = np.array([np.inf if m.saturation is None else m.saturation for m in signals.robot.motors])
    if not np.isfinite(limits).any():
        return None
    effort = signals.robot.motor_effort(signals.effort[plan.start : plan.stop])
    return float(100 * (np.abs(effort) >= 0.995 * limits).any(axis=1).mean())
