"""Recordings of a simulated robot whose parameters are known, those of `[parameters]`.

It tracks a random exciting reference with the described controller, or else with a PD
of the stated bandwidth.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from acquisition.files import atomic_write
from acquisition.recording import OPTIONAL, Header, RecordingWriter, sample_dtype
from acquisition.robot import FourierReference, Payload, Robot, fourier_reference

from .. import model as dynamics
from ..arrays import Array
from ..data import Signals
from ..errors import BadInputError, NoFitError
from ..options import CellOptions
from ..regression import differentiate
from ..simulation import ClosedLoop, Encoder, Reference, recorded_loop, surrogate_loop

PERIOD_S = 10.0  # of the reference, about; a very long period would be slow and excite little
MIN_SAMPLES, MAX_SAMPLES = 100, 1_000_000  # of a simulated recording
# of the plant per controller period; with more, motion and torque change by less than 0.1 %
SUBSTEPS = 2
AR = 0.98  # autocorrelation of coloured noise at lag 1
# Separate random streams: one kind of noise does not change another.
_POSITION, _EFFORT, _COLOURED = range(3)


class Noise(CellOptions):
    """Noise of a simulated cell; the controller sees encoder counts and noise,
    coloured noise is AR(0.98).

    The torque is recorded as the mean of the control periods before and after its instant,
    like a drive's filter.
    """

    @property
    def text(self) -> str:
        """The fields that are not zero."""
        return (
            ", ".join(f"{name} {value:g}" for name, value in vars(self).items() if value)
            or "no noise"
        )

    def on_effort(self, held: Array, seed: int) -> Array:
        """Recorded torques (N, n) from the controller's torques, which are held
        from sample to sample.
        """
        from scipy.signal import lfilter

        at = np.maximum(np.arange(len(held)) - self.lag_samples, 0)
        tau = 0.5 * (held[at] + held[np.maximum(at - 1, 0)])
        level = 0.01 * np.sqrt(np.mean(tau**2, axis=0))
        white, slow = (
            np.random.default_rng([seed, k]).standard_normal(tau.shape)
            for k in (_EFFORT, _COLOURED)
        )
        slow[1:] *= np.sqrt(1 - AR**2)
        slow = lfilter([1], [1, -AR], slow, axis=0)
        return np.asarray(
            tau + level * (self.effort_percent * white + self.coloured_percent * slow)
        )


def study_truth(robot: Robot) -> tuple[dynamics.BaseParameters, Array]:
    """The base parameters of the robot and their true values (b,) in a study."""
    idm = dynamics.InverseModel(robot)
    base = dynamics.base_parameters(idm)
    return base, dynamics.described_parameters(idm, base)


def true_model(robot: Robot, payload: Payload | None = None) -> dynamics.DirectModel:
    """The direct model with the values of the description, and a payload."""
    idm = dynamics.InverseModel(robot)
    base, chi = dynamics.base_parameters(idm), dynamics.known_parameters(idm)
    if payload is not None:
        chi = dynamics.add_payload(idm, chi, payload)
    return dynamics.direct_model(idm, base.standard_parameters(base.K @ chi))


def periodic_reference(
    robot: Robot, *, duration_s: float, seed: int, period_s: float = PERIOD_S
) -> FourierReference:
    """A random exciting reference of whole periods, each of about `period_s`, at
    rest after `duration_s`.
    """
    periods = max(1, round(duration_s / period_s))
    return fourier_reference(robot, period_s=duration_s / periods, seed=seed)


def random_reference(
    robot: Robot, *, duration_s: float, sample_rate_hz: float, seed: int, period_s: float = PERIOD_S
) -> Array:
    """A random exciting reference (N, n), rad or m: a Fourier series within the limits of the
    robot, at rest at both ends.

    The same seed gives the same reference. The length is a whole number of periods of
    about `period_s`, one if it is shorter. Raises `BadInputError` for fewer than 100 or
    more than 1 000 000 samples.
    """
    samples = duration_s * sample_rate_hz
    if not MIN_SAMPLES <= samples <= MAX_SAMPLES:
        found = f"{duration_s:g} s at {sample_rate_hz:g} Hz: {samples:g} samples"
        raise BadInputError(f"{found}; expected {MIN_SAMPLES} to {MAX_SAMPLES}")
    t_s = np.arange(round(samples) + 1) / sample_rate_hz
    return periodic_reference(robot, duration_s=duration_s, seed=seed, period_s=period_s).at(t_s)[0]


def closed_loop(
    robot: Robot,
    q_ref: Array,
    sample_rate_hz: float,
    *,
    noise: Noise,
    seed: int,
    payload: Payload | None = None,
) -> Signals:
    """Signals of the robot of `[parameters]`, simulated with a payload along the reference
    q_ref (N, n), rad or m.

    `sample_rate_hz` is that of reference, recording and controller, which sees the noise of the
    encoder. Raises `BadInputError` if the description has no values or another rate, or the
    robot does not follow.
    """
    model, loop = true_model(robot, payload), recorded_loop(robot)
    if loop is None:
        inertias = dynamics.inertias(model.inertia(dynamics.poses_of(q_ref)))
        loop = surrogate_loop(robot.bandwidth_hz, inertias, sample_rate_hz)
        if noise.position or noise.encoder_step:  # the PD estimates the speed
            loop = replace(loop, velocity_estimate="backward_difference")
    if abs(loop.period_s * sample_rate_hz - 1) > 1e-9:
        found, expected = (
            f"{1 / loop.period_s:g}",
            f"{sample_rate_hz:g}, the rate of the simulated recording",
        )
        raise BadInputError(
            f"robot {robot.name}: controller.sample_rate_hz = {found}: expected {expected}"
        )
    dq = differentiate(q_ref, sample_rate_hz)
    fastest = np.abs(dq @ model.directions.T).max(axis=0, initial=0.0)
    white = np.random.default_rng([seed, _POSITION]).standard_normal(q_ref.shape)
    encoder = Encoder(noise=noise.position * white, step=noise.encoder_step)
    reference = Reference(q_ref, dq, differentiate(dq, sample_rate_hz), encoder=encoder)
    follower = ClosedLoop(model, loop, (q_ref[0], dq[0]), fastest=fastest, substeps=SUBSTEPS)
    done, reason = follower.follow(reference, np.full(robot.n, 10 * np.ptp(q_ref, axis=0).max()))
    if reason:
        raise NoFitError(f"robot {robot.name}: cannot be simulated: {reason}")
    return Signals(
        t_s=np.arange(len(q_ref)) / sample_rate_hz,
        q=encoder.seen(done[0, ::SUBSTEPS]),
        q_ref=q_ref,
        effort=noise.on_effort(done[3, ::SUBSTEPS], seed),
        sample_rate_hz=sample_rate_hz,
        robot=robot,
        recording="simulated",
        payload=payload,
        effort_timing="mean",
    )


def write_signals(path: Path, signals: Signals, *, source: str, noise: Noise | None = None) -> None:
    """Write simulated signals of a `source` as a recording, whole or not at all; `noise`: of the
    simulation, for metadata.
    """
    provenance, notes = "simulated joint torque", {"simulated": "true"}
    if noise is not None:
        provenance, notes["cell"] = (
            f"{provenance}, the mean of the control periods before and after",
            noise.text,
        )
    given = {"position": signals.q, "effort": signals.effort, "reference": signals.q_ref}
    given |= {name: getattr(signals, name) for name in OPTIONAL}
    columns = {name: values for name, values in given.items() if values is not None}
    layout = sample_dtype(signals.robot.n, reference="reference" in columns, optional=columns)
    samples = np.empty(len(signals.q), layout)
    samples["stamp_ns"] = np.round(signals.t_s * 1e9)
    for name, values in columns.items():
        samples[name] = values
    header = Header(
        robot=signals.robot,
        source=source,
        sample_rate_hz=signals.sample_rate_hz,
        effort_provenance=provenance,
        effort_timing=signals.effort_timing,
        payload=signals.payload,
        notes=notes,
    )
    with atomic_write(path) as partial, RecordingWriter(partial, header) as writer:
        writer.samples(samples)
