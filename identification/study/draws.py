"""What a run of a study draws: noise, start, cut-off, and what the fit is told of the controller."""

from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from acquisition.robot import Robot

from ..options import Controllers, StudyOptions
from .noise import Noise


@dataclass(frozen=True, kw_only=True)
class Study(StudyOptions):
    """What is varied. Each run draws one of each list, seeded by its number.

    `cutoffs` are in multiples of the bandwidth, 0 for none; `starts` factors on each joint's true inertia, all that the start
    knows of the robot (`instruments.regular_start`); `gain_errors` factors on the controller's gains (on the bandwidth of a
    surrogate) as the fit knows them; `controllers` whether the fit is given the described control law, or none. `vary` says
    whether each run has the imperfections of `noise`, or draws `everything`: imperfections of all kinds in some runs, none
    that a description leaves out in others, and any of the controllers.
    """

    noise: Noise = field(default_factory=Noise)


@dataclass(frozen=True, kw_only=True)
class Draw:
    """What one run has; `seed` is that of its reference and noise."""

    cutoff: float
    start: float
    gain_error: float
    seed: int
    controller: Controllers
    noise: Noise

    @property
    def modelled(self) -> bool:
        """Whether the fit is told all but the noise."""
        return self.noise.modelled and (self.gain_error == 1.0 or self.controller == "none")


def draw(study: Study, number: int, bandwidth_hz: float) -> Draw:
    """What run `number` of a study has: the same number gives the same."""
    rng = np.random.default_rng([study.seed, number])
    cutoff, start = float(rng.choice(study.cutoffs)), float(rng.choice(study.starts))
    gain_error, seed = float(rng.choice(study.gain_errors)), int(rng.integers(2**31))
    if study.vary == "everything":
        noise = _any_noise(study.noise, rng, bandwidth_hz)
        controllers: tuple[Controllers, ...] = ("described", "described", "none")
    else:
        noise, controllers = study.noise, study.controllers
    controller = controllers[rng.integers(len(controllers))]
    return Draw(cutoff=cutoff, start=start, gain_error=gain_error, seed=seed, controller=controller, noise=noise)


def _any_noise(noise: Noise, rng: np.random.Generator, bandwidth_hz: float) -> Noise:
    """Noise of any kind, its encoder step about that of `noise`; in half of the runs also what no description has."""

    def some(low: float, high: float) -> float:
        return float(rng.uniform(low, high)) if rng.random() < 0.5 else 0.0

    step = noise.encoder_step * 10 ** rng.uniform(-1.0, 0.3)
    sensors = Noise(
        encoder_step=step,
        position=some(0.0, 2.0) * step,
        effort_percent=some(0.5, 5.0),
        coloured_percent=some(0.5, 3.0),
        disturbance_percent=some(0.5, 3.0),
        recorded="tick" if rng.random() < 0.5 else "mean",
    )
    if rng.random() < 0.5:
        return sensors
    return replace(
        sensors,
        lag_samples=round(some(0.5, 5.5)),
        stribeck_percent=some(10.0, 50.0),
        asymmetry_percent=some(5.0, 30.0),
        integral_hz=some(0.05, 0.3) * bandwidth_hz,
    )


def told_robot(robot: Robot, drawn: Draw) -> Robot:
    """The robot with its controller as the fit is told it: gains off by a factor, or nothing but a bandwidth, off by it."""
    c, factor = robot.controller, drawn.gain_error
    if drawn.controller == "none":
        keys = ("structure", "sample_rate_hz", "position_gain", "velocity_gain", "integral_gain", "velocity_estimate")
        c = msgspec.structs.replace(c, **dict.fromkeys(keys))
    if c.structure is None:
        return replace(robot, controller=msgspec.structs.replace(c, bandwidth_hz=factor * robot.bandwidth_hz))
    scaled = {
        name: tuple(factor * g for g in gains)
        for name in ("position_gain", "velocity_gain")
        if (gains := getattr(c, name)) is not None
        and not (name == "position_gain" and c.structure.startswith("cascade"))
    }
    return replace(robot, controller=msgspec.structs.replace(c, **scaled))
