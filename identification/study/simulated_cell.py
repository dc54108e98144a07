"""Recordings of a simulated robot whose parameters are known.

The robot has the description's `[parameters]` and tracks a random exciting reference with the described controller, or with a
PD of the stated bandwidth if none is described. The cell has optional imperfections: noise that the controller sees, friction
and a torque delay that the description lacks.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from acquisition.files import allocate, atomic_write, release_pages
from acquisition.recording import OPTIONAL, Header, RecordingWriter, sample_dtype
from acquisition.robot import FourierReference, Payload, Robot, fourier_reference

from ..arrays import Array
from ..data import Signals
from ..errors import IdentificationError
from ..model import (
    BaseParameters,
    DirectModel,
    InverseModel,
    add_payload,
    base_parameters,
    described_parameters,
    direct_model,
    inertias,
    known_parameters,
    poses_of,
)
from ..options import CellOptions
from ..regression import differentiate
from ..simulation import ClosedLoop, ControlLaw, Disturbances, Reference, recorded_loop, surrogate_loop

PERIOD_S = 10.0  # of the reference, about; a very long period would be slow and excite little
MIN_SAMPLES, MAX_SAMPLES = 100, 10_000_000  # of a simulated recording
SUBSTEPS = 2  # of the plant per controller period; with more, motion and torque change by less than 0.1 %
SPAN, MAX_BYTES_IN_MEMORY = 50_000, 2**24  # samples computed at a time; larger arrays are memory-mapped
AR = 0.98  # autocorrelation of coloured noise at lag 1
RECORDED = {
    "tick": "the command of its tick, held after it",
    "mean": "the mean of the control periods before and after",
}
# Separate random streams: one kind of noise does not change another.
_POSITION, _EFFORT, _COLOURED, _DISTURBANCE = range(4)


class Noise(CellOptions):
    """Imperfections of a simulated cell; the controller sees encoder counts and noise.

    Coloured noise and disturbances are AR(0.98). The torque is `recorded` as the `mean` of the control periods before and after
    its instant, like a drive's filter; or as the command of the `tick`, which is held after it.
    """

    @property
    def text(self) -> str:
        """The fields that are not zero."""
        present = (f"{name} {value:g}" for name, value in vars(self).items() if name != "recorded" and value)
        return ", ".join(present) or "no imperfections"

    @property
    def modelled(self) -> bool:
        """Whether all imperfections are noise: the description lacks nothing except how the torque is recorded."""
        return not (self.lag_samples or self.stribeck_percent or self.asymmetry_percent or self.integral_hz)

    def disturbances(self, rms: Array, samples: int, seed: int) -> Disturbances:
        """Disturbances of a loop of so many samples; `rms` (n,) are torques along its reference."""
        shape = samples, len(rms)

        def series(size: float | Array, stream: int, ar: float) -> Array:
            if not np.any(size):
                return np.zeros(shape)
            x = allocate(shape, MAX_BYTES_IN_MEMORY)
            for here, noise in noise_parts(np.random.default_rng([seed, stream]), shape, ar):
                x[here] = size * noise
                release_pages(x)
            return x

        return Disturbances(
            position=series(self.position, _POSITION, 0.0),
            count=self.encoder_step,
            torque=series(0.01 * self.disturbance_percent * rms, _DISTURBANCE, AR),
            asymmetry=0.01 * self.asymmetry_percent,
            stribeck=0.01 * self.stribeck_percent,
        )

    def on_effort(self, held: Array, seed: int) -> Array:
        """Recorded torques (N, n) from the controller's torques, which are held from sample to sample."""
        N, late = len(held), min(self.lag_samples, len(held))
        tau, squares = allocate(held.shape, MAX_BYTES_IN_MEMORY), np.zeros(held.shape[1])
        for first in range(0, N, SPAN):
            at = np.maximum(np.arange(first, min(first + SPAN, N)) - late, 0)
            part = held[at]
            if self.recorded == "mean":
                part = np.where(at[:, None] > 0, 0.5 * (part + held[np.maximum(at - 1, 0)]), part)
            tau[first : first + len(part)] = part
            squares += np.sum(part**2, axis=0)
            release_pages(held)
        level = 0.01 * np.sqrt(squares / max(N, 1))
        for percent, stream, ar in ((self.effort_percent, _EFFORT, 0.0), (self.coloured_percent, _COLOURED, AR)):
            if percent:
                for here, noise in noise_parts(np.random.default_rng([seed, stream]), tau.shape, ar):
                    tau[here] += percent * level * noise
                    release_pages(tau)
        return tau


def noise_parts(rng: np.random.Generator, shape: tuple[int, ...], ar: float = 0.0) -> Iterator[tuple[slice, Array]]:
    """Stationary AR(`ar`) noise of deviation 1 along the first axis, `SPAN` samples at a time."""
    before = np.zeros(shape[1])
    for first in range(0, shape[0], SPAN):
        here = slice(first, min(first + SPAN, shape[0]))
        noise = rng.standard_normal((here.stop - first, shape[1]))
        if ar:
            noise[first == 0 :] *= np.sqrt(1 - ar**2)
            for row in noise:
                row += ar * before
                before = row
        yield here, noise


def study_truth(robot: Robot) -> tuple[BaseParameters, Array]:
    """The base parameters of the robot and their true values (b,) in a study."""
    idm = InverseModel(robot)
    base = base_parameters(idm)
    return base, described_parameters(idm, base)


def true_model(robot: Robot, payload: Payload | None = None) -> DirectModel:
    """The direct model with the values of the description, and a payload."""
    idm = InverseModel(robot)
    base, chi = base_parameters(idm), known_parameters(idm)
    if payload is not None:
        chi = add_payload(idm, chi, payload)
    return direct_model(idm, base.standard_parameters(base.K @ chi))


def periodic_reference(robot: Robot, *, duration_s: float, seed: int, period_s: float = PERIOD_S) -> FourierReference:
    """A random exciting reference of whole periods, each of about `period_s`, at rest after `duration_s`."""
    periods = max(1, round(duration_s / period_s))
    return fourier_reference(robot, period_s=duration_s / periods, seed=seed)


def random_reference(
    robot: Robot, *, duration_s: float, sample_rate_hz: float, seed: int, period_s: float = PERIOD_S
) -> Array:
    """A random exciting reference, a Fourier series within the limits of the robot.

    Parameters
    ----------
    duration_s, sample_rate_hz : length and rate, for 100 to 10 000 000 samples.
    seed : the same seed gives the same reference.
    period_s : about the period; the length is a whole number of periods. A shorter recording has one.

    Returns
    -------
    (N, n) joint positions, rad or m, at rest at both ends.

    Raises
    ------
    IdentificationError : for another number of samples.
    """
    samples = duration_s * sample_rate_hz
    if not MIN_SAMPLES <= samples <= MAX_SAMPLES:
        raise IdentificationError(
            f"{duration_s:g} s at {sample_rate_hz:g} Hz: {samples:g} samples; expected {MIN_SAMPLES} to {MAX_SAMPLES}"
        )
    reference = periodic_reference(robot, duration_s=duration_s, seed=seed, period_s=period_s)
    q = allocate((round(samples) + 1, robot.n), MAX_BYTES_IN_MEMORY)
    for first in range(0, len(q), SPAN):
        q[first : first + SPAN] = reference.at(np.arange(first, min(first + SPAN, len(q))) / sample_rate_hz)[0]
        release_pages(q)
    return q


def closed_loop(
    robot: Robot, q_ref: Array, sample_rate_hz: float, *, noise: Noise, seed: int, payload: Payload | None = None
) -> Signals:
    """Signals of the simulated robot tracking a reference.

    The controller sees encoder noise and counts.

    Parameters
    ----------
    robot : described with `[parameters]`.
    q_ref : (N, n) reference positions, rad or m.
    sample_rate_hz : rate of reference, recording and controller.
    noise, seed : imperfections of the cell.
    payload : that the robot carries.

    Raises
    ------
    IdentificationError : if the description has no values or another rate, or the robot does not follow.
    """
    model = true_model(robot, payload)
    loop = _loop(robot, model, q_ref, sample_rate_hz, noise)
    if abs(loop.period_s * sample_rate_hz - 1) > 1e-9:
        raise IdentificationError(
            f"robot {robot.name}: controller.sample_rate_hz = {1 / loop.period_s:g}: expected {sample_rate_hz:g}, the "
            "rate of the simulated recording"
        )
    # Span by span: the plant's steps and derivatives of a long recording do not fit in memory.
    N, squares, fastest = len(q_ref), [], np.zeros(len(model.directions))
    for first in range(0, N, SPAN):
        span = _span(q_ref, first, sample_rate_hz)
        squares.append(model.torque(span.q[::10], span.dq[::10], span.ddq[::10]) ** 2)
        fastest = np.maximum(fastest, np.abs(span.dq @ model.directions.T).max(axis=0, initial=0.0))
    cell = noise.disturbances(np.sqrt(np.mean(np.concatenate(squares), axis=0)), N, seed)
    bound = np.full(robot.n, 10 * np.ptp(q_ref, axis=0).max())
    start = (q_ref[0].copy(), _span(q_ref[:3], 0, sample_rate_hz).dq[0])
    follower = ClosedLoop(model, loop, start, fastest=fastest, substeps=SUBSTEPS, cell=cell)
    q, tau = allocate(q_ref.shape, MAX_BYTES_IN_MEMORY), allocate(q_ref.shape, MAX_BYTES_IN_MEMORY)
    for first in range(0, N, SPAN):
        here = slice(first, first + SPAN)
        part = replace(cell, position=cell.position[here], torque=cell.torque[here])
        done, reason = follower.follow(replace(_span(q_ref, first, sample_rate_hz), disturbances=part), bound)
        if reason:
            raise IdentificationError(f"robot {robot.name}: cannot be simulated: {reason}")
        q[here], tau[here] = part.seen(done[0, ::SUBSTEPS]), done[3, ::SUBSTEPS]
        for x in (q, tau, q_ref, cell.position, cell.torque):
            release_pages(x)
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
        payload=payload,
        effort_timing="mean" if noise.recorded == "mean" else "command",
    )


def _span(q_ref: Array, first: int, sample_rate_hz: float) -> Reference:
    """`SPAN` instants of a reference with derivatives, which need two samples on each side."""
    low = max(0, first - 2)
    dq = differentiate(q_ref[low : first + SPAN + 2], sample_rate_hz)
    ddq, rows = differentiate(dq, sample_rate_hz), slice(first - low, first - low + SPAN)
    return Reference(q_ref[first : first + SPAN], dq[rows], ddq[rows])


def _loop(robot: Robot, model: DirectModel, q_ref: Array, sample_rate_hz: float, noise: Noise) -> ControlLaw:
    """The described control law, or a PD; with encoder noise the PD estimates the speed."""
    loop = recorded_loop(robot)
    if loop is None:
        J = inertias(model.inertia(poses_of(q_ref)))
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
    path : of the recording, written whole or not at all.
    signals : with the robot's description.
    source : their origin, shown by `info`.
    noise : imperfections of the simulation, for the metadata.
    notes : additional keys of the metadata.
    """
    provenance, cell = "simulated joint torque", {}
    if noise is not None:
        provenance, cell = f"{provenance}, {RECORDED[noise.recorded]}", {"cell": noise.text}
    given = {"position": signals.q, "effort": signals.effort, "reference": signals.q_ref}
    given |= {name: getattr(signals, name) for name in OPTIONAL}
    columns = {name: values for name, values in given.items() if values is not None}
    layout = sample_dtype(signals.robot.n, reference="reference" in columns, optional=columns)
    header = Header(
        robot=signals.robot,
        source=source,
        sample_rate_hz=signals.sample_rate_hz,
        effort_provenance=provenance,
        effort_timing=signals.effort_timing,
        payload=signals.payload,
        notes={"simulated": "true", **cell, **(notes or {})},
    )
    with atomic_write(path) as partial, RecordingWriter(partial, header) as writer:
        for first in range(0, len(signals.q), SPAN):
            here = slice(first, first + SPAN)
            samples = np.empty(len(signals.q[here]), layout)
            samples["stamp_ns"] = np.round(signals.t_s[here] * 1e9).astype(np.int64)
            for name, values in columns.items():
                samples[name] = values[here]
            writer.samples(samples)
            for values in columns.values():
                release_pages(values)
