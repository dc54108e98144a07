"""The experiment that a recording is of, laid out for simulation: reference, controller, instants.

The instruments have samples as fine as 100 times the bandwidth, or the recording's rate where that is less, at instants that
the decimated rows of W have too. The robot is simulated in steps as fine as 100 times the bandwidth, whatever the rate of
recording and controller.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..data import Signals
from ..errors import IdentificationError
from ..model import direct_model
from ..regression import Decimation, Motion, Problem, differentiate, rule_cutoff_hz, sampled_at
from ..simulation import ControlLaw, Reference, has_controller, recorded_loop
from ..trust import inertias, poses_of

RATE_PER_BANDWIDTH = 100.0  # instrument samples per period of the bandwidth, at least
EARLY_RATE_PER_BANDWIDTH = 25.0  # the same in passes whose estimate is only where the next ones start
LEAST_INSTANTS = 30  # of the controller, for a simulation to say anything
MOST_STEPS = 2e7  # to simulate: what is slower than real time by far is a mistake in the description
LOST = 0.5  # of a joint's travel: a simulation, or a reference, this far off does not belong to the recording


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment:
    """What every simulation of a recording shares.

    Attributes:
        reference: what the controller follows, at its instants; `reference_kind` is `recorded`, or `surrogate`: the
            measured position low-passed without phase shift.
        start: measured position and speed, filtered, (n,) each, at the first instant.
        q: (N, n) measured position, filtered, at the instruments' instants.
        poses: (P, n) positions at which M is checked.
        loop: the description's control loop, or None where a PD of the stated bandwidth stands in.
        J_prior: (n,) inertias that the loop's gains were set for; `J_known` says that least squares gave them.
        grid_s: (N,) instants of the instruments; `times_s`: (K,) of the controller, each with `substeps` simulated steps. A
            surrogate has its instants at each step.
        decimation: of the instruments, to the rows of W.
        saturated_percent: share of recorded samples at the drives' limit, None where no limit is stated.
        gain_update: whether gains follow the inertias of each estimate.
    """

    problem: Problem
    reference: Reference
    reference_kind: Literal["recorded", "surrogate"]
    start: tuple[Array, Array]
    q: Array
    poses: Array
    loop: ControlLaw | None
    J_prior: Array
    J_known: bool
    bandwidth_hz: float
    grid_s: Array
    times_s: Array
    substeps: int
    decimation: Decimation
    saturated_percent: float | None
    gain_update: bool


def make_experiment(
    problem: Problem, beta_ls: Array, *, gain_update: bool = True, rate_per_bandwidth: float = RATE_PER_BANDWIDTH
) -> Experiment:
    """Lay out the simulation of a recording; `beta_ls` gives the inertias that recorded gains are taken to be set for.

    `rate_per_bandwidth` is the number of simulated steps and of instrument samples per period of the bandwidth, at least.

    Raises `IdentificationError` for a controller described in part, or a reference that is not that of the recording.
    """
    signals, settings = problem.signals, problem.settings
    robot, fs = signals.robot, signals.sample_rate_hz
    loop = recorded_loop(robot) if has_controller(robot.controller) else None
    if loop is not None and signals.q_ref is None:
        loop = replace(loop, gravity=True)
    bandwidth_hz = robot.bandwidth_hz
    step_hz = rate_per_bandwidth * bandwidth_hz
    m = _stride(fs, settings.decimation, step_hz)
    grid = np.arange((settings.stop - 1 - settings.start) % m + settings.start, settings.stop, m)
    times_s, substeps = _instants(problem, loop, grid, step_hz)
    measured = problem.motion.between(settings.start, settings.stop, rule_cutoff_hz(bandwidth_hz, fs))
    reference = _reference(problem, measured, loop, times_s * fs - settings.start)
    q = measured.q[grid - settings.start]
    prior = direct_model(problem.model, problem.base.standard_parameters(beta_ls))
    J_prior = inertias(prior, poses_of(q))
    J_known = bool((J_prior > 0).all())
    if not J_known:  # a PD of the bandwidth takes any; of described gains one knows what inertia they suit
        J_prior = loop.inertias(bandwidth_hz) if loop else np.ones(robot.n)
    return Experiment(
        problem=problem,
        reference=reference,
        reference_kind="surrogate" if signals.q_ref is None else "recorded",
        start=(measured.q[grid[0] - settings.start], measured.dq[grid[0] - settings.start]),
        q=q,
        poses=poses_of(q),
        loop=loop,
        J_prior=J_prior,
        J_known=J_known,
        bandwidth_hz=bandwidth_hz,
        grid_s=grid / fs,
        times_s=times_s,
        substeps=substeps,
        decimation=replace(settings.decimator, factor=settings.decimation // m),
        saturated_percent=_saturated_percent(problem),
        gain_update=gain_update,
    )


def _instants(problem: Problem, loop: ControlLaw | None, grid: NDArray[np.intp], step_hz: float) -> tuple[Array, int]:
    """Instants of the controller (K,) in s that span the samples `grid`, and simulated steps to each, at `step_hz` at least."""
    signals, settings = problem.signals, problem.settings
    robot, fs, bandwidth_hz = signals.robot, signals.sample_rate_hz, signals.robot.bandwidth_hz
    period_s = loop.period_s if loop else (grid[1] - grid[0]) / fs
    substeps = max(1, math.ceil(period_s * step_hz - 1e-9))
    if loop is None:  # a continuous law: it acts at every step
        period_s, substeps = period_s / substeps, 1
    steps = (grid[-1] - grid[0]) / fs / period_s * substeps
    if steps > MOST_STEPS:
        raise IdentificationError(
            f"{steps:.2g} steps to simulate with bandwidth_hz = {bandwidth_hz:g}",
            place=f"robot {robot.name}",
            key="controller.sample_rate_hz",
            value=1 / period_s,
            shown=f"{1 / period_s:g}",
            expected=f"at most {MOST_STEPS:.2g} steps",
        )
    times_s = grid[0] / fs + period_s * np.arange(int(np.floor((grid[-1] - grid[0]) / fs / period_s + 1e-6)) + 1)
    if len(times_s) < LEAST_INSTANTS:
        raise IdentificationError(
            f"{len(times_s)} instants in the {(settings.stop - settings.start) / fs:.3g} s of {signals.recording}",
            place=f"robot {robot.name}",
            key="controller.sample_rate_hz",
            value=1 / period_s,
            shown=f"{1 / period_s:g}",
            expected=f"at least {LEAST_INSTANTS} instants",
        )
    return times_s, substeps


def _reference(problem: Problem, measured: Motion, loop: ControlLaw | None, at: Array) -> Reference:
    """What the loop is given at places `at` (K,), counted in samples used: the recorded reference, or the measured motion.

    The measured motion has in it what was fed forward. A surrogate loop's output is torque at the joints.
    """
    signals, used = problem.signals, slice(problem.settings.start, problem.settings.stop)
    known = None if signals.known_torque is None else sampled_at(at, signals.known_torque[used])
    if signals.q_ref is None:
        return Reference(*(sampled_at(at, x) for x in (measured.q, measured.dq, measured.ddq)), known_torque=known)
    q_ref = np.array(signals.q_ref[used])
    _refuse_foreign_reference(q_ref, signals.q[used], signals)
    dq_ref = differentiate(q_ref, signals.sample_rate_hz)
    paths = (sampled_at(at, x) for x in (q_ref, dq_ref, differentiate(dq_ref, signals.sample_rate_hz)))
    ahead = None
    if signals.feedforward is not None:  # held from sample to sample: a cubic would swing beside a step
        ahead = signals.feedforward[used][np.floor(np.clip(at, 0, len(q_ref) - 1) + 1e-6).astype(np.intp)]
        ahead = signals.robot.joint_effort(ahead) if loop is None else ahead
    return Reference(*paths, known_torque=known, feedforward=ahead)


def _stride(fs: float, decimation: int, step_hz: float) -> int:
    """The largest divisor of the decimation that leaves a rate of `step_hz`."""
    divisors = [m for m in range(1, decimation + 1) if decimation % m == 0]
    return max((m for m in divisors if fs / m >= step_hz), default=1)


def _refuse_foreign_reference(q_ref: Array, q: Array, signals: Signals) -> None:
    """A reference far from the measured position belongs to another recording, or to other units."""
    joints = signals.robot.joints
    for j, joint in enumerate(joints):
        spread = np.std(q[:, j])
        largest = max(np.std(q[:, i]) for i, other in enumerate(joints) if other.type == joint.type)
        error = np.sqrt(np.mean((q_ref[:, j] - q[:, j]) ** 2))
        if error > LOST * max(spread, 0.02 * largest):
            raise IdentificationError(
                f"{error:.3g} {joint.position_unit} rms off the measured position, which varies by {spread:.3g}",
                place=f"{signals.recording}: reference of joint {joint.name}",
                expected="the reference of this recording",
            )


def _saturated_percent(problem: Problem) -> float | None:
    signals, settings = problem.signals, problem.settings
    limits = np.array([np.inf if m.saturation is None else m.saturation for m in signals.robot.motors])
    if not np.isfinite(limits).any():
        return None
    effort = signals.robot.motor_effort(signals.effort[settings.start : settings.stop])
    return float(100 * (np.abs(effort) >= 0.995 * limits).any(axis=1).mean())
