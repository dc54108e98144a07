"""Recordings of a simulated robot whose parameters are known: what a fit of them must give back.

The robot has the values of the description's `[parameters]` and tracks a random exciting reference under its own
controller, or under a PD of the stated bandwidth where none is described. The cell has the imperfections that are asked for.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from acquisition.files import atomic_write, let_go, room
from acquisition.recording import OPTIONAL, Header, RecordingWriter, sample_dtype
from acquisition.robot import FourierReference, Robot, fourier_reference

from ..arrays import Array
from ..data import Signals
from ..errors import IdentificationError
from ..model import DirectModel, InverseModel, base_parameters, direct_model, inertias, poses_of, truth
from ..regression import differentiate
from ..simulation import ClosedLoop, ControlLaw, Reference, recorded_loop, surrogate_loop
from .noise import LONG, SPAN, Noise

PERIOD_S = 10.0  # of the reference, about: one period as long as a long recording would be slow, and excite little
LEAST_SAMPLES, MOST_SAMPLES = 100, 10_000_000  # of a simulated recording
SUBSTEPS = 2  # of the plant per controller period; with more, motion and torque change by less than 0.1 %


def periodic_reference(robot: Robot, *, duration_s: float, seed: int, period_s: float = PERIOD_S) -> FourierReference:
    """A random exciting reference that is at rest at the end of `duration_s`: whole periods, each of about `period_s`."""
    periods = max(1, round(duration_s / period_s))
    return fourier_reference(robot, period_s=duration_s / periods, seed=seed)


def random_reference(
    robot: Robot, *, duration_s: float, sample_rate_hz: float, seed: int, period_s: float = PERIOD_S
) -> Array:
    """A random exciting reference, a Fourier series within the limits of the robot.

    Parameters
    ----------
    duration_s, sample_rate_hz : length and rate, which together give 100 to 10 000 000 samples.
    seed : the same one gives the same reference.
    period_s : about the period; a whole number of periods makes up the length. A shorter recording has one.

    Returns
    -------
    (N, n) joint positions, rad or m, at rest at both ends.

    Raises
    ------
    IdentificationError : for another number of samples.
    """
    samples = duration_s * sample_rate_hz
    if not LEAST_SAMPLES <= samples <= MOST_SAMPLES:
        raise IdentificationError(
            f"{duration_s:g} s at {sample_rate_hz:g} Hz: {samples:g} samples; expected {LEAST_SAMPLES} to {MOST_SAMPLES}"
        )
    reference = periodic_reference(robot, duration_s=duration_s, seed=seed, period_s=period_s)
    q = room((round(samples) + 1, robot.n), LONG)
    for first in range(0, len(q), SPAN):
        q[first : first + SPAN] = reference.at(np.arange(first, min(first + SPAN, len(q))) / sample_rate_hz)[0]
        let_go(q)
    return q


def closed_loop(robot: Robot, q_ref: Array, sample_rate_hz: float, *, noise: Noise, seed: int) -> Signals:
    """Signals of the simulated robot tracking a reference.

    The controller acts on what the encoders give, noise and counts included.

    Parameters
    ----------
    robot : described with `[parameters]`.
    q_ref : (N, n) reference positions, rad or m.
    sample_rate_hz : rate of reference, recording and controller.
    noise, seed : imperfections of the cell.

    Raises
    ------
    IdentificationError : where the description has no values or another rate, or the robot does not follow.
    """
    dynamics = InverseModel(robot)
    base = base_parameters(dynamics)
    model = direct_model(dynamics, base.standard_parameters(truth(dynamics, base)))
    loop = _loop(robot, model, q_ref, sample_rate_hz, noise)
    if abs(loop.period_s * sample_rate_hz - 1) > 1e-9:
        raise IdentificationError(
            f"robot {robot.name}: controller.sample_rate_hz = {1 / loop.period_s:g}: expected {sample_rate_hz:g}, the "
            "rate of the simulated recording"
        )
    # Span by span: a long recording, with the steps of the plant and its derivatives, is too much to be held in memory.
    N, squares, fastest = len(q_ref), [], np.zeros(len(model.directions))
    for first in range(0, N, SPAN):
        span = _span(q_ref, first, sample_rate_hz)
        squares.append(model.torque(span.q[::10], span.dq[::10], span.ddq[::10]) ** 2)
        fastest = np.maximum(fastest, np.abs(span.dq @ model.directions.T).max(axis=0, initial=0.0))
    cell = noise.disturbances(np.sqrt(np.mean(np.concatenate(squares), axis=0)), N, seed)
    bound = np.full(robot.n, 10 * np.ptp(q_ref, axis=0).max())
    start = (q_ref[0].copy(), _span(q_ref[:3], 0, sample_rate_hz).dq[0])
    follower = ClosedLoop(model, loop, start, fastest=fastest, substeps=SUBSTEPS, cell=cell)
    q, tau = room(q_ref.shape, LONG), room(q_ref.shape, LONG)
    for first in range(0, N, SPAN):
        here = slice(first, first + SPAN)
        part = replace(cell, position=cell.position[here], torque=cell.torque[here])
        done, reason = follower.follow(replace(_span(q_ref, first, sample_rate_hz), disturbances=part), bound)
        if reason:
            raise IdentificationError(f"robot {robot.name}: cannot be simulated: {reason}")
        q[here], tau[here] = part.seen(done[0, ::SUBSTEPS]), done[3, ::SUBSTEPS]
        for x in (q, tau, q_ref, cell.position, cell.torque):
            let_go(x)
    return Signals(
        t_s=np.arange(N) / sample_rate_hz,
        q=q,
        q_ref=q_ref,
        effort=noise.on_effort(tau, seed),
        sample_rate_hz=sample_rate_hz,
        track=None,
        robot=robot,
        recording="simulated",
        sha256="",
        effort_timing="mean" if noise.recorded == "mean" else "command",
    )


def _span(q_ref: Array, first: int, sample_rate_hz: float) -> Reference:
    """`SPAN` instants of a reference with its derivatives, which take two samples on each side."""
    low = max(0, first - 2)
    dq = differentiate(q_ref[low : first + SPAN + 2], sample_rate_hz)
    ddq, rows = differentiate(dq, sample_rate_hz), slice(first - low, first - low + SPAN)
    return Reference(q_ref[first : first + SPAN], dq[rows], ddq[rows])


def _loop(robot: Robot, model: DirectModel, q_ref: Array, sample_rate_hz: float, noise: Noise) -> ControlLaw:
    """The described control law, or a PD; a PD that sees noise has to tell the speed from it."""
    loop = recorded_loop(robot)
    if loop is None:
        J = inertias(model, poses_of(q_ref))
        loop = surrogate_loop(robot.bandwidth_hz, J, sample_rate_hz)
        if noise.position or noise.encoder_step:
            loop = replace(loop, velocity_estimate="backward_difference")
    return loop.with_integral(2 * np.pi * noise.integral_hz) if noise.integral_hz else loop


def write_signals(
    path: Path, signals: Signals, *, source: str, noise: Noise | None = None, notes: Mapping[str, str] | None = None
) -> None:
    """Write simulated signals as a recording.

    Parameters
    ----------
    path : of the recording; it is written whole or not at all.
    signals : with the robot's description.
    source : where they come from, as `info` shows it.
    noise : imperfections that they were simulated with, which the metadata then name.
    notes : more keys of the recording's metadata.
    """
    provenance, cell = "simulated joint torque", {}
    if noise is not None:
        provenance, cell = f"{provenance}, {noise.effort_text}", {"cell": noise.text}
    optional = {name: getattr(signals, name) for name in OPTIONAL if getattr(signals, name) is not None}
    layout = sample_dtype(signals.robot.n, reference=signals.q_ref is not None, optional=optional)
    with (
        atomic_write(path) as partial,
        RecordingWriter(
            partial,
            Header(
                robot=signals.robot,
                source=source,
                sample_rate_hz=signals.sample_rate_hz,
                effort_provenance=provenance,
                effort_timing=signals.effort_timing,
                notes={"simulated": "true", **cell, **(notes or {})},
            ),
        ) as writer,
    ):
        for first in range(0, len(signals.q), SPAN):
            here = slice(first, first + SPAN)
            samples = np.empty(len(signals.q[here]), layout)
            samples["stamp_ns"] = np.round(signals.t_s[here] * 1e9).astype(np.int64)
            samples["position"], samples["effort"] = signals.q[here], signals.effort[here]
            if signals.q_ref is not None:
                samples["reference"] = signals.q_ref[here]
            for name, values in optional.items():
                samples[name] = values[here]
            writer.samples(samples)
            for x in (signals.q, signals.effort, signals.q_ref):
                if x is not None:
                    let_go(x)
