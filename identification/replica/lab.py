"""All recordings of a fit laid out for simulation, each pass one task for each of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import Array
from ..regression import OwnParameters
from ..work import Work
from .bench import Bench, Replica, instruments_at, replica
from .experiment import EARLY_RATE_PER_BANDWIDTH, RATE_PER_BANDWIDTH
from .instruments import InstrumentKind, Instruments

WORST_FIRST: tuple[InstrumentKind, ...] = ("reference", "consistent", "simulated")


@dataclass(frozen=True, kw_only=True, eq=False)
class PassInstruments:
    """Instruments of all recordings, of these `names`, along the robot simulated with parameters near to `beta` (b,)."""

    beta: Array
    each: tuple[Instruments, ...]
    names: tuple[str, ...]
    parameters: OwnParameters

    @cached_property
    def Z(self) -> Array:
        """Instruments (r, b), rows as those of W: joint by joint, recording by recording."""
        if len(self.each) == 1:
            return self.each[0].Z
        n, b = self.each[0].gains.size, len(self.beta)
        wide = [self.parameters.columns(one.Z, k) for k, one in enumerate(self.each)]
        return np.concatenate([Z.reshape(n, -1, b) for Z in wide], axis=1).reshape(-1, b)

    @property
    def kind(self) -> InstrumentKind:
        """The worst of the recordings."""
        return min((one.kind for one in self.each), key=WORST_FIRST.index)

    @property
    def reason(self) -> str | None:
        """Why it is that, None where there is nothing to say."""
        return told([one.reason for one in self.each], self.names)

    @property
    def load_unknown(self) -> bool:
        """Whether the parameters, of a regular start, have nothing of the links' torque that load friction goes by."""
        return any(one.load_unknown for one in self.each)

    @property
    def gains(self) -> Array:
        """Factors on the controllers' gains, n for each recording."""
        return np.concatenate([one.gains for one in self.each])

    @property
    def tracking_percent(self) -> float | None:
        """Simulated against measured position, of the recording that is worst; None where one was not simulated."""
        return worst([one.tracking_percent for one in self.each])


def worst(figures: Sequence[float | None]) -> float | None:
    """The largest, None where one of them is."""
    known = [x for x in figures if x is not None]
    return max(known) if len(known) == len(figures) else None


def told(reasons: Sequence[str | None], names: Sequence[str]) -> str | None:
    """Reasons of recordings in one line, with the recordings' names where they are several."""
    if len(reasons) == 1:
        return reasons[0]
    return "; ".join(f"{name}: {why}" for name, why in zip(names, reasons, strict=True) if why is not None) or None


@dataclass(frozen=True, kw_only=True, eq=False)
class Lab:
    """The recordings of a fit, laid out for simulation in the order of the rows, and where the tasks run.

    `names` are the recordings'; `parameters` those that they share and those of each, in whose order values stand.
    """

    benches: tuple[Bench, ...]
    names: tuple[str, ...]
    parameters: OwnParameters
    work: Work

    def instruments(self, beta: Array, covariance: Array | None, *, coarse: bool = False) -> PassInstruments:
        """Instruments along the robot simulated with the consistent parameters nearest to beta (b,), C its covariance."""
        rate = EARLY_RATE_PER_BANDWIDTH if coarse else RATE_PER_BANDWIDTH
        each = tuple(self.work.run(instruments_at, self._tasks(rate, beta, covariance)))
        return PassInstruments(beta=beta, each=each, names=self.names, parameters=self.parameters)

    def replicas(self, beta: Array, covariance: Array) -> tuple[Replica, ...]:
        """The robot simulated with beta (b,) in each experiment, or with the nearest consistent parameters."""
        return tuple(self.work.run(replica, self._tasks(RATE_PER_BANDWIDTH, beta, covariance)))

    def plain_replicas(self, beta: Array) -> tuple[Replica, ...]:
        """The robot simulated with beta (b,) itself in each experiment."""
        return tuple(self.work.run(replica, self._tasks(RATE_PER_BANDWIDTH, beta, None)))

    def _tasks(self, rate: float, beta: Array, covariance: Array | None) -> list[tuple[object, ...]]:
        """A task for each recording, with the values and the covariance of its own base parameters."""
        tasks: list[tuple[object, ...]] = []
        for k, bench in enumerate(self.benches):
            at = self.parameters.places(k)
            tasks.append((bench, rate, beta[at], None if covariance is None else covariance[np.ix_(at, at)]))
        return tasks
