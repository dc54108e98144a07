"""Instruments of a recording: the columns along the motion of a robot simulated with an estimate.

If the robot cannot be simulated, its motion is the one that the recorded reference predicts, which
needs no control law. The error q - r of a controlled robot is gravity, inertia and friction through
its unknown loop. It is regressed on functions of the reference alone: 1; sin and cos of the joint
angles and of sums of consecutive ones; dr, ddr; friction, tanh(dr / 5 % of its peak); dr^3; each
also some time earlier, to represent the loop's delay. The sum q^ = r + prediction has no noise of
the position, so instruments along it are exogenous by construction. Sticking is not predicted, and
such instruments are less efficient there.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from acquisition.files import allocate, release_pages

from ..arrays import Array, Ints
from ..control import ControllerKind
from ..data import Signals
from ..errors import NoFitError
from ..estimation import one_thread, r_factor
from ..model import nearest_consistent
from ..regression import (
    Candidate,
    Equation,
    FilteredMotion,
    Motion,
    MotionBlock,
    Problem,
    Rows,
    differentiate,
    lowpass_reach,
    rows_of_recording,
    rule_cutoff_hz,
)
from ..report import DirectModelResidual
from .simulated_recording import COARSE, FINE, SimulatedRecording

MAX_SERIES = 4_000_000  # numbers of a position; of a longer one only the rows' motion is kept
InstrumentKind = Literal["simulated", "consistent", "reference"]
# Base parameters (b,) to simulate, their covariance (b, b), and the payload's share (b,) of them.
Asked = tuple[Array, Array | None, Array]
DELAYS_S = (0.0, 0.02, 0.05, 0.1)  # of the terms of the tracking error
SMOOTH = 0.05  # share of the peak speed below which friction changes smoothly
MIN_SINGULAR = 1e-6  # of columns of norm 1
MOST_SAMPLES = 50_000  # of the regression, evenly spaced
DESIGN_SAMPLES = 10_000  # whose columns are in memory at a time
EDGE = 2  # samples to each side that an acceleration needs


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulated:
    """A robot simulated in a recording, and how it follows the recording.

    Attributes:
        recording: name of the recording.
        controller: kind of the control law.
        saturated: as in `SimulatedRecording`.
        kind: `simulated` with the physically consistent parameters nearest to the requested ones;
            `consistent` for the same if the requested ones have an inertia matrix that is not
            positive; `reference` if nothing was simulated, and the motion is that which the
            reference predicts.
        reason: why it is not the requested robot; None if it is.
        gains: (n,) factors on the gains of the control law.
        prior_known: True if the inertias are known that these gains were set for.
        motion: motion; None once dropped, or if nothing was simulated. Of a long recording it has
            the instants of the rows only.
        error: (N, n) simulated minus measured position, rad or m.
        percent: |q_sim - q| in percent of |q - mean|, of all joints that move; None if nothing was
            simulated.
        by_joint: the same by joint, with the error of the torque; empty if nothing was simulated.
    """

    recording: str
    controller: ControllerKind
    saturated: dict[str, float]
    kind: InstrumentKind
    reason: str | None
    gains: Array
    prior_known: bool
    motion: Motion | None = None
    error: Array = field(default_factory=lambda: np.zeros((0, 0)))
    percent: float | None = None
    by_joint: tuple[DirectModelResidual, ...] = ()


@one_thread
def simulate(
    equation: Equation,
    prepared: Callable[[float], SimulatedRecording],
    about: tuple[Array, Asked | None],
    further: Candidate | None = None,
    of_lag: bool = False,
) -> tuple[Simulated, Rows]:
    """Simulate a robot in a recording, and compute the rows of its equation with instruments.

        Z = F[w IDM(q_s, dq_s, ddq_s)]                                                   (D)

    The robot has the physically consistent parameters nearest to the requested ones, or without a
    covariance exactly these. If nothing is requested, or the robot leaves its reference,
    instruments are along the motion that the reference predicts.

    The nearest parameters follow the estimate smoothly. Simulated with the estimate itself, a light
    wrist would move wildly long before its inertia matrix stops being positive, and the iterations
    would not converge.

    Parameters
    ----------
    equation : equation of motion of the recording.
    prepared : function that prepares the recording for simulations, by the number of samples and
        steps per period of the bandwidth.
    about : x (p,) at which the rows are linearised, and the requested parameters; None for none.
    further, of_lag : as in `rows_of_recording`.

    Returns
    -------
    The simulated motion with its errors, and the rows.
    """
    x, asked = about
    robot = prepared(COARSE if asked is None else FINE)
    kind: InstrumentKind = "reference"
    why, gains = None, np.ones(len(robot.held))
    if asked is not None:
        beta, covariance, payload = asked
        why = robot.gains(robot.model_of(beta))[1]
        kind = "simulated" if why is None else "consistent"
        if covariance is not None:
            with suppress(NoFitError):
                own = robot.problem.model, robot.problem.base, beta - payload
                beta = nearest_consistent(*own, covariance).beta + payload
            if why is None and beta is asked[0]:
                why = "no physically consistent model is near, so the estimate itself is simulated"
        path, gains, reason = robot.simulated(beta)
        if reason is not None:
            kind, why = "reference", reason
    motion = predicted_motion(robot.problem) if kind == "reference" else path
    rows = rows_of_recording(equation, x, further, robot.motion(motion), of_lag=of_lag)
    found = Simulated(
        recording=robot.problem.signals.recording,
        controller=robot.loop.kind,
        saturated=robot.saturated,
        kind=kind,
        reason=why,
        gains=gains,
        prior_known=robot.prior_known,
    )
    return (
        found if kind == "reference" else _followed(found, robot, robot.motion(motion), rows.tau),
        rows,
    )


def _followed(
    found: Simulated, robot: SimulatedRecording, along: Iterator[MotionBlock], measured: Array
) -> Simulated:
    """Return a copy with its motion, and its errors against the measurement.

    The norms of position errors are in percent of the measured position about its mean, those of
    torque errors in percent of the torques `measured` (T, n).
    """
    problem, moves, kept = robot.problem, ~robot.held, list[list[Array]]()
    few = problem.signals.q.size > MAX_SERIES  # only the instants of the rows
    for motion in along:
        q = robot.low_passed(problem.motion, motion.near).q
        every = motion.t_s, motion.q, motion.dq, motion.ddq, motion.tau, q
        own = motion.decimation.samples(motion.inside, len(q))  # those that no other block has
        parts = (motion.kept(x) if few else x[own] for x in every)
        kept.append([*parts, motion.filtered((motion.tau + motion.known_torque).T).T])
    t_s, q, dq, ddq, tau, wanted, torque = map(np.concatenate, zip(*kept, strict=True))
    errors, sizes = (q - wanted) * moves, (wanted - wanted.mean(axis=0)) * moves
    percents = [
        [100 * float(a / b) if b > 0 else None for a, b in np.linalg.norm(pair, axis=1).T]
        for pair in ((errors, sizes), (torque - measured, measured))
    ]
    return replace(
        found,
        motion=Motion(t_s=t_s, q=q, dq=dq, ddq=ddq, tau=tau),
        error=q - wanted,
        percent=100 * float(np.linalg.norm(errors) / np.linalg.norm(sizes)),
        by_joint=tuple(
            DirectModelResidual(name=joint.name, position_error_percent=a, torque_error_percent=b)
            for joint, a, b in zip(problem.signals.robot.joints, *percents, strict=True)
        ),
    )


def predicted_motion(problem: Problem) -> FilteredMotion:
    """Return the motion that the reference predicts, or the measured one without a reference.

    It is computed once for the time range of its samples.
    """
    if (r := problem.signals.q_ref) is None:
        return problem.motion
    span = problem.settings.start, problem.settings.stop
    return problem.motion.once(("predicted", *span), lambda: _predicted(problem.signals, r, *span))


def _predicted(signals: Signals, r: Array, start: int, stop: int) -> FilteredMotion:
    """Return the predicted motion q^ (N, n) at all samples of a recording.

    It is fitted to the errors of the samples that a low-pass lets into the time range used.
    """
    (N, n), q, fs = r.shape, signals.q, signals.sample_rate_hz
    reach = lowpass_reach(rule_cutoff_hz(signals), fs)
    within = range(max(0, start - reach), min(N, stop + reach))
    late, every = [round(delay_s * fs) for delay_s in DELAYS_S], -(-len(within) // MOST_SAMPLES)
    used = np.array(within[::every])
    peak = np.abs(differentiate(r[used], fs / every)).max(axis=0)

    def columns(at: Ints) -> Array:  # (K, p) at samples (K,), in order
        low = max(0, at[0] - late[-1] - EDGE)
        now = _terms(r[low : at[-1] + 1 + EDGE], peak, fs)
        return np.concatenate(
            [np.ones((len(at), 1)), *(now[np.maximum(at - d, 0) - low] for d in late)], axis=1
        )

    few = max(1, DESIGN_SAMPLES // every)  # of that many samples the terms are made
    blocks = (used[k : k + few] for k in range(0, len(used), few))
    R = r_factor(np.concatenate([r_factor(np.c_[columns(at), q[at] - r[at]]) for at in blocks]))
    size = np.maximum(np.linalg.norm(R[:, :-n], axis=0), np.finfo(float).tiny)
    effects = np.linalg.lstsq(R[:, :-n] / size, R[:, -n:], rcond=MIN_SINGULAR)[0] / size[:, None]
    found = allocate(r.shape)
    for at in (np.arange(a, min(N, a + DESIGN_SAMPLES)) for a in range(0, N, DESIGN_SAMPLES)):
        found[at] = r[at] + columns(at) @ effects
        for x in (q, r, found):
            release_pages(x)
    return FilteredMotion(signals, found)


def _terms(r: Array, peak: Array, sample_rate_hz: float) -> Array:
    """Return the terms (K, p) of the tracking error along a reference r (K, n).

    `peak` (n,) are the peak speeds of the reference.
    """
    dr, n = differentiate(r, sample_rate_hz), r.shape[1]
    sums = np.stack([r[:, i:j].sum(axis=1) for i in range(n) for j in range(i + 1, n + 1)], axis=1)
    friction = np.tanh(dr / np.maximum(SMOOTH * peak, np.finfo(float).tiny))
    ddr = differentiate(dr, sample_rate_hz)
    return np.concatenate([np.sin(sums), np.cos(sums), dr, ddr, friction, dr**3], axis=1)
