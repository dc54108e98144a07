"""What a real cell has and a description does not: noise that the controller sees, friction, delay of the torque."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..arrays import Array
from ..simulation import Disturbances

AR = 0.98  # correlation of coloured noise from sample to sample
_POSITION, _EFFORT, _COLOURED, _DISTURBANCE = range(
    4
)  # streams of random numbers: one kind of noise does not change another


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Imperfections of a simulated cell, none by default. Percent are of each joint's rms torque, where not said otherwise.

    Attributes:
        encoder_step: of each joint, rad or m; the controller acts on counts.
        position: white noise of each joint's encoder, rad or m rms; the controller acts on it.
        effort_percent: white noise of the recorded torque.
        coloured_percent: noise of the recorded torque, AR(0.98) from sample to sample.
        disturbance_percent: AR(0.98) torque that acts on the joints.
        recorded: torque recorded as the mean of the control periods before and after its instant, as a drive's own filter shows
            it; or as the command of the `tick`, which is held after it.
        lag_samples: by which the recorded torque is late.
        stribeck_percent: by which Coulomb friction is larger at rest, in percent of itself.
        asymmetry_percent: by which friction is larger for dq > 0 and smaller for dq < 0, in percent of itself.
        integral_hz: rate of an integral that the control law has and the description does not; 0 for none.
    """

    encoder_step: float = 0.0
    position: float = 0.0
    effort_percent: float = 0.0
    coloured_percent: float = 0.0
    disturbance_percent: float = 0.0
    recorded: Literal["mean", "tick"] = "mean"
    lag_samples: int = 0
    stribeck_percent: float = 0.0
    asymmetry_percent: float = 0.0
    integral_hz: float = 0.0

    @property
    def effort_text(self) -> str:
        """How the torque is recorded, in words."""
        if self.recorded == "tick":
            return "the command of its tick, held after it"
        return "the mean of the control periods before and after"

    @property
    def text(self) -> str:
        """The fields that are not zero."""
        present = (f"{name} {value:g}" for name, value in vars(self).items() if name != "recorded" and value)
        return ", ".join(present) or "no imperfections"

    @property
    def modelled(self) -> bool:
        """Whether all of it is noise: nothing that a description could say and does not, but how the torque is recorded."""
        return not (self.lag_samples or self.stribeck_percent or self.asymmetry_percent or self.integral_hz)

    def disturbances(self, rms: Array, samples: int, seed: int) -> Disturbances:
        """What acts on a loop of so many samples; `rms` (n,) are the torques along its reference."""
        shape = (samples, len(rms))
        pushed = 0.01 * self.disturbance_percent * rms
        return Disturbances(
            position=self.position * _rng(seed, _POSITION).standard_normal(shape) if self.position else np.zeros(shape),
            count=self.encoder_step,
            torque=pushed * coloured(_rng(seed, _DISTURBANCE), shape) if pushed.any() else np.zeros(shape),
            asymmetry=0.01 * self.asymmetry_percent,
            stribeck=0.01 * self.stribeck_percent,
        )

    def on_effort(self, held: Array, seed: int) -> Array:
        """Torques as they are recorded (N, n), of those that the controller gives and holds from sample to sample."""
        tau = held.copy()
        if self.recorded == "mean":
            tau[1:] = 0.5 * (held[1:] + held[:-1])
        late = min(self.lag_samples, len(tau))
        tau[late:], tau[:late] = tau[: len(tau) - late].copy(), tau[0].copy()
        level = 0.01 * np.sqrt(np.mean(tau**2, axis=0))
        if self.effort_percent:
            tau += self.effort_percent * level * _rng(seed, _EFFORT).standard_normal(tau.shape)
        if self.coloured_percent:
            tau += self.coloured_percent * level * coloured(_rng(seed, _COLOURED), tau.shape)
        return tau


def coloured(rng: np.random.Generator, shape: tuple[int, int]) -> Array:
    """AR(0.98) of deviation 1 along the first axis, from the first sample on."""
    x = rng.standard_normal(shape)
    x[1:] *= np.sqrt(1 - AR**2)
    for k in range(1, len(x)):
        x[k] += AR * x[k - 1]
    return x


def _rng(seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng([seed, stream])
