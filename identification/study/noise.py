"""What a real cell has and a description does not: noise that the controller sees, friction, delay of the torque."""

from collections.abc import Iterator

import numpy as np

from acquisition.files import let_go, room

from ..arrays import Array
from ..options import CellOptions
from ..simulation import Disturbances

SPAN, LONG = 50_000, 2**24  # samples made at a time; bytes of an array that is held in memory
AR = 0.98  # correlation of coloured noise from sample to sample
_POSITION, _EFFORT, _COLOURED, _DISTURBANCE = range(
    4
)  # streams of random numbers: one kind of noise does not change another


class Noise(CellOptions):
    """Imperfections of a simulated cell, with which the controller acts on counts and on the encoder's noise.

    Coloured noise and disturbances are AR(0.98) from sample to sample. `recorded` as the mean of the control periods before and
    after its instant, as a drive's own filter shows it; or as the command of the `tick`, which is held after it.
    """

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
        position, torque = np.zeros(shape), np.zeros(shape)
        if self.position:
            position = room(shape, LONG)
            for here, noise in noise_parts(_rng(seed, _POSITION), shape):
                position[here] = self.position * noise
                let_go(position)
        if pushed.any():
            torque = room(shape, LONG)
            for here, noise in noise_parts(_rng(seed, _DISTURBANCE), shape, AR):
                torque[here] = pushed * noise
                let_go(torque)
        return Disturbances(
            position=position,
            count=self.encoder_step,
            torque=torque,
            asymmetry=0.01 * self.asymmetry_percent,
            stribeck=0.01 * self.stribeck_percent,
        )

    def on_effort(self, held: Array, seed: int) -> Array:
        """Torques as they are recorded (N, n), of those that the controller gives and holds from sample to sample."""
        N, late = len(held), min(self.lag_samples, len(held))
        tau, squares = room(held.shape, LONG), np.zeros(held.shape[1])
        for first in range(0, N, SPAN):
            at = np.maximum(np.arange(first, min(first + SPAN, N)) - late, 0)
            part = held[at]
            if self.recorded == "mean":
                part = np.where(at[:, None] > 0, 0.5 * (part + held[np.maximum(at - 1, 0)]), part)
            tau[first : first + len(part)] = part
            squares += np.sum(part**2, axis=0)
            let_go(held)
        level = 0.01 * np.sqrt(squares / max(N, 1))
        for percent, stream, ar in ((self.effort_percent, _EFFORT, 0.0), (self.coloured_percent, _COLOURED, AR)):
            if percent:
                for here, noise in noise_parts(_rng(seed, stream), tau.shape, ar):
                    tau[here] += percent * level * noise
                    let_go(tau)
        return tau


def noise_parts(rng: np.random.Generator, shape: tuple[int, ...], ar: float = 0.0) -> Iterator[tuple[slice, Array]]:
    """Noise of deviation 1, AR(`ar`) along the first axis from the first sample on, `SPAN` samples at a time."""
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


def _rng(seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng([seed, stream])
