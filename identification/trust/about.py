"""The model of a recording about an estimate, of which terms that it may lack are made."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from acquisition.robot import Robot

from ..arrays import Array, Ints
from ..model import DirectModel, base_prior, direct_model
from ..regression import Problem, row_blocks

MIN_ARM_M = 1e-9  # of a weight about an axis
# of a joint's travel, in which hysteresis turns from one side to the other
TRAVELS = (0.1, 0.2)
FORGOTTEN = 1e-12  # share of z that is left after the way since


@dataclass(frozen=True, kw_only=True, eq=False)
class About:
    """The model of a recording about values of its parameters, of which terms are made.

    Attributes:
        problem: of the recording; `beta`: (b,) its base parameters.
        peak, most: (n,) largest speeds and torques of the joints in all recordings.
        speed: (T, n) measured in the rows of this recording.
        alone: whether there is no other recording.
        simulated: whether the motion is of a simulated robot that follows a recorded reference.
    """

    problem: Problem
    beta: Array
    peak: Array
    most: Array
    speed: Array
    alone: bool
    simulated: bool

    @cached_property
    def weighs(self) -> Ints:
        """(g,) places of the base parameters of links that weigh."""
        idm, columns = self.problem.model, self.problem.base.columns
        q = np.sin(np.outer(np.arange(1, 6), np.arange(1, idm.robot.n + 1)))  # some poses
        still = np.abs(idm.regressor(q, 0 * q, 0 * q)[:, :, columns] * idm.of_links[columns])
        return np.flatnonzero(
            still.max(axis=(0, 1)) > MIN_ARM_M * np.linalg.norm(self.robot.gravity)
        )

    def __getstate__(self) -> dict[str, Any]:
        """Take along to other processes where blocks begin, not the speeds of all rows."""
        return vars(self) | {"wound": self.wound, "speed": self.speed[:0]}

    @cached_property
    def travels(self) -> Array:
        """(k, n) shares of each joint's travel."""
        return np.maximum(np.outer(TRAVELS, np.ptp(self.problem.poses, axis=0)), 1e-9)

    @cached_property
    def wound(self) -> dict[int, Array]:
        """z (k, n) of hysteresis where a block begins, by its first row: that of the row before."""
        row_s = self.problem.settings.decimation / self.problem.signals.sample_rate_hz
        ways = row_s * np.concatenate([0 * self.travels[:1], self.speed])
        z = np.stack([dahl(ways / travel, ways[0]) for travel in self.travels])
        return {near.start: z[:, near.start] for near, _ in row_blocks(self.problem)}

    @cached_property
    def prior(self) -> tuple[dict[str, float], str]:
        """A-priori base parameters of links, by name, and their source."""
        return base_prior(self.problem.model, self.problem.base)

    @property
    def robot(self) -> Robot:
        """Its robot."""
        return self.problem.signals.robot

    @property
    def span_s(self) -> Array:
        """Instants of the first and the last sample used."""
        settings = self.problem.settings
        return np.array([settings.start, settings.stop - 1]) / self.problem.signals.sample_rate_hz

    @cached_property
    def links(self) -> DirectModel:
        """The links, with nothing of parameters that are regrouped."""
        idm, chi = self.problem.model, np.zeros(self.problem.model.p)
        chi[self.problem.base.columns] = self.beta
        return direct_model(idm, np.where(idm.of_links, chi, 0.0))

    def friction(self, name: str) -> Array:
        """(n,) a hundredth of the friction of each joint by this name, Fc or Fv."""
        names = (self.problem.model.names[c] for c in self.problem.base.columns)
        value = dict(zip(names, 0.01 * self.beta, strict=True))
        return np.array([value.get(f"{name}{j + 1}", 0.0) for j in range(len(self.peak))])


def dahl(steps: Array, begin: Array) -> Array:
    """z (N, n) with dz = (dq - |dq| z) / x, from its first value on, by the steps dq / x: each is
    z <- a z + b, put together in twos, fours and so on.
    """
    a, reach = np.exp(-np.abs(steps)), 1
    z = np.asarray(np.sign(steps) * (1 - a))
    z[0] = begin
    while reach < len(z) and a[reach:].max() > FORGOTTEN:
        z[reach:] += a[reach:] * z[:-reach]
        a[reach:] *= a[:-reach].copy()
        reach *= 2
    return z
