"""The recordings of a fit laid out for simulation, each pass one task for each of them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..data import Work
from ..estimation import one_thread
from ..regression import OwnParameters, Problem
from .experiment import EARLY_RATE_PER_BANDWIDTH, RATE_PER_BANDWIDTH, Experiment, make_experiment
from .instruments import Instruments, simulate_instruments, stack_instruments
from .motion import Replica, simulate_replica


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulation:
    """The closed loop of a recording, gains set for the inertias of `prior` (b,); laid out once per process and rate.

    `slip_noise` (c,) is that of the speeds of its directions of Coulomb friction; `long` says that rows are QR factors.
    """

    problem: Problem
    prior: Array
    slip_noise: Array
    long: bool
    gain_update: bool = True
    _laid_out: dict[float, Experiment] = field(default_factory=dict)

    def at(self, rate_per_bandwidth: float) -> Experiment:
        """The experiment with so many steps and samples per period of the bandwidth."""
        if rate_per_bandwidth not in self._laid_out:
            self._laid_out[rate_per_bandwidth] = make_experiment(
                self.problem.with_samples(),
                self.prior,
                self.slip_noise,
                rate_per_bandwidth=rate_per_bandwidth,
                gain_update=self.gain_update,
                long=self.long,
            )
        return self._laid_out[rate_per_bandwidth]

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_laid_out": {}}  # laid out anew where it is needed


@one_thread
def instruments_at(
    simulation: Simulation,
    rate_per_bandwidth: float,
    beta: Array,
    covariance: Array | None,
    weights: Array,
    kept: NDArray[np.bool_] | None,
) -> Instruments:
    """Instruments of a recording, as `simulate_instruments`."""
    return simulate_instruments(simulation.at(rate_per_bandwidth), beta, covariance, weights, kept)


@one_thread
def replica_at(simulation: Simulation, beta: Array, covariance: Array | None) -> Replica:
    """The robot simulated in a recording, as `simulate_replica`."""
    return simulate_replica(simulation.at(RATE_PER_BANDWIDTH), beta, covariance)


@dataclass(frozen=True, kw_only=True, eq=False)
class Lab:
    """The recordings of a fit in the order of the rows, and where the tasks run.

    `names` are the recordings'; `parameters` those that they share and those of each, in whose order values stand.
    """

    simulations: tuple[Simulation, ...]
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
    ) -> Instruments:
        """Instruments along the robot simulated with the consistent parameters nearest to beta (b,), C its covariance.

        Joints have the `weights` (n,); `kept` are the rows that count, as of `Instruments.fast`, or None for those at which
        the simulated robot is fast enough.
        """
        rate = EARLY_RATE_PER_BANDWIDTH if coarse else RATE_PER_BANDWIDTH
        tasks = [
            (simulation, rate, *own, weights, None if kept is None else kept[k])
            for k, (simulation, own) in enumerate(zip(self.simulations, self._own(beta, covariance), strict=True))
        ]
        each = tuple(self.work.run(instruments_at, tasks))
        return stack_instruments(each, beta, self.parameters, self.names)

    def replicas(self, beta: Array, covariance: Array | None) -> tuple[Replica, ...]:
        """The robot simulated with beta (b,) in each experiment, as `simulate_replica`."""
        own = self._own(beta, covariance)
        tasks = [(simulation, *values) for simulation, values in zip(self.simulations, own, strict=True)]
        return tuple(self.work.run(replica_at, tasks))

    def _own(self, beta: Array, covariance: Array | None) -> list[tuple[Array, Array | None]]:
        """By recording, the values and the covariance of its own base parameters."""
        places = [self.parameters.places(k) for k in range(len(self.simulations))]
        return [(beta[at], None if covariance is None else covariance[np.ix_(at, at)]) for at in places]
