"""Recordings of a simulated robot whose parameters are known: what a fit of them must give back.

The robot follows its reference exactly; its torques are those of its inverse dynamic model with the values of the
description's `[parameters]`. Encoder and torque sensor add the noise that is asked for.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.blocks import sample_dtype
from acquisition.recording import RecordingWriter
from acquisition.reference import fourier_reference
from acquisition.robot import Robot
from acquisition.whole_file import whole_file

from . import IdentificationError
from .base_parameters import BaseParameters
from .dynamics import Dynamics
from .filtering import Motion

Vector = NDArray[np.float64]

_BLOCK = 2000  # samples per message


@dataclass(frozen=True, kw_only=True)
class Noise:
    """What the sensors add: encoder step and white noise of each joint, rad or m; torque noise in % of its rms."""

    encoder_step: float = 0.0
    position: float = 0.0
    effort_percent: float = 0.0


def known_parameters(dynamics: Dynamics) -> Vector:
    """Standard parameters chi (p,) from the description's `[parameters]`, zero where it is silent.

    Raises `IdentificationError` for a name that the robot does not have, or a description without values.
    """
    values, names = dynamics.robot.parameters, dynamics.names
    if not values:
        raise IdentificationError(f"robot {dynamics.robot.name}: no [parameters] to simulate with")
    for name, value in values.items():
        if name not in names:
            raise IdentificationError(
                f"robot {dynamics.robot.name}: parameters.{name} = {value:g}: not a standard parameter of this robot; "
                f"expected names such as {', '.join(names[:3])} ... {names[-1]}"
            )
    return np.array([values.get(name, 0.0) for name in names])


def truth(dynamics: Dynamics, base: BaseParameters) -> Vector:
    """Base parameters (b,) of the description's `[parameters]`: K chi."""
    return np.asarray(base.K @ known_parameters(dynamics))


def exact_motion(dynamics: Dynamics, *, duration_s: float, sample_rate_hz: float, seed: int) -> Motion:
    """Motion along a random exciting reference, with the torques of the inverse dynamic model; no noise."""
    t_s = np.arange(round(duration_s * sample_rate_hz) + 1) / sample_rate_hz
    q, dq, ddq = fourier_reference(dynamics.robot, period_s=duration_s, seed=seed).at(t_s)
    tau = dynamics.regressor(q, dq, ddq) @ known_parameters(dynamics)
    return Motion(t_s=t_s, q=q, dq=dq, ddq=ddq, tau=tau)


def write_synthetic(
    path: Path, robot: Robot, *, duration_s: float, sample_rate_hz: float, seed: int, noise: Noise
) -> None:
    """Write the recording of a simulated robot; the same arguments give the same samples."""
    dynamics = Dynamics(robot)
    motion = exact_motion(dynamics, duration_s=duration_s, sample_rate_hz=sample_rate_hz, seed=seed)
    rng = np.random.default_rng(seed)
    q = motion.q + noise.position * rng.standard_normal(motion.q.shape)
    if noise.encoder_step:
        q = np.round(q / noise.encoder_step) * noise.encoder_step
    rms = np.sqrt(np.mean(motion.tau**2, axis=0))
    tau = motion.tau + 0.01 * noise.effort_percent * rms * rng.standard_normal(motion.tau.shape)
    samples = np.empty(len(q), sample_dtype(robot.n, reference=True))
    samples["stamp_ns"] = np.round(motion.t_s * 1e9).astype(np.int64)
    samples["position"], samples["effort"], samples["reference"] = q, tau, motion.q
    with (
        whole_file(path) as partial,
        RecordingWriter(
            partial,
            robot,
            source=f"simulated: the inverse dynamic model with [parameters] along a Fourier reference, seed {seed}",
            sample_rate_hz=sample_rate_hz,
            effort_provenance="simulated joint torque",
            notes={"simulated": "true"},
        ) as writer,
    ):
        for k in range(0, len(samples), _BLOCK):
            writer.samples(samples[k : k + _BLOCK])
