"""All recordings of a fit laid out for simulation, each pass one task for each of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..data import Work
from ..estimation import System, combined
from ..regression import OwnParameters
from .bench import Bench, Replica, instruments_at, replica
from .experiment import EARLY_RATE_PER_BANDWIDTH, RATE_PER_BANDWIDTH
from .instruments import Counting, InstrumentKind, Instruments

WORST_FIRST: tuple[InstrumentKind, ...] = ("reference", "consistent", "simulated")


@dataclass(frozen=True, kw_only=True, eq=False)
class PassInstruments:
    """Instruments of all recordings, of these `names`, along the robot simulated with parameters near to `beta` (b,)."""

    beta: Array
    each: tuple[Instruments, ...]
    names: tuple[str, ...]
    parameters: OwnParameters

    @cached_property
    def Z(self) -> Array | None:
        """Instruments (r, b), rows as those of W: joint by joint, recording by recording; None of long recordings."""
        found = [one.Z for one in self.each]
        n, b = self.each[0].gains.size, len(self.beta)
        wide = [self.parameters.columns(Z, k) for k, Z in enumerate(found) if Z is not None]
        if len(wide) < len(found):
            return None
        return wide[0] if len(wide) == 1 else np.concatenate([Z.reshape(n, -1, b) for Z in wide], axis=1).reshape(-1, b)

    @cached_property
    def factors(self) -> tuple[System, Array] | None:
        """W, Y and Z of all long recordings; None of others, whose rows are held."""
        found = [(one.factors.system, one.factors.Z) for one in self.each if one.factors is not None]
        if not found:
            return None
        system, Z = found[0] if len(found) == 1 else combined(found)
        assert Z is not None
        return system, Z

    @property
    def used(self) -> Array:
        """Rows (r,) that count: 1 and 0, joint by joint, recording by recording."""
        return np.concatenate(self.fast).T.reshape(-1).astype(float)

    @property
    def fast(self) -> tuple[NDArray[np.bool_], ...]:
        """By recording which rows (rows, n) count."""
        return tuple(one.fast for one in self.each)

    def without_rows(self) -> "PassInstruments":
        """The same without Z, and what else is as long as a recording but which rows count."""
        each = (replace(one, Z=None, factors=None, simulated=None) for one in self.each)
        return replace(self, each=tuple(each))

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

    def instruments(
        self,
        beta: Array,
        covariance: Array | None,
        weights: Array,
        *,
        kept: Sequence[NDArray[np.bool_]] | None = None,
        coarse: bool = False,
        motion: bool = False,
    ) -> PassInstruments:
        """Instruments along the robot simulated with the consistent parameters nearest to beta (b,), C its covariance.

        Joints have the `weights` (n,); `kept` are the rows that count, as of `PassInstruments.fast`, or None for those at which
        the simulated robot is fast enough. The motion itself is kept where it is asked for: it need not be sent otherwise.
        """
        rate = EARLY_RATE_PER_BANDWIDTH if coarse else RATE_PER_BANDWIDTH
        rows: Sequence[NDArray[np.bool_] | None] = kept or [None] * len(self.benches)
        tasks = [
            (*task, Counting(slip_noise=bench.slip_noise, weights=weights, kept=own, motion=motion))
            for task, bench, own in zip(self._tasks(rate, beta, covariance), self.benches, rows, strict=True)
        ]
        each = tuple(self.work.run(instruments_at, tasks))
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
