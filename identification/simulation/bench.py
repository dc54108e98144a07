"""Recordings where tasks find them, and laid out for simulation: each read, filtered and laid out once per process."""

from collections import OrderedDict
from dataclasses import dataclass, field, replace
from typing import Literal

from ..arrays import Array
from ..data import RecordingFile, Signals
from ..estimation import one_thread
from ..regression import Overrides, Problem, make_problem
from .experiment import Experiment, make_experiment
from .instruments import Counting, Instruments, simulate_instruments
from .motion import SimulatedMotion, simulated_motion, simulated_robot

NUMBERS_KEPT = (
    8_000_000  # of positions of the recordings that a process keeps at hand: 64 MB, a few times as much in all
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """Where a task finds a recording: its problem `at_hand`, or its file, read by the process that runs the task.

    `lag_s` is the lag of its torque that is corrected, None for the one that is known without a fit; `left_out` are friction
    terms that the fit leaves out of the description.
    """

    source: Signals | RecordingFile
    overrides: Overrides
    at_hand: Problem | None = None
    lag_s: float | None = None
    left_out: tuple[str, ...] = ()

    def problem(self) -> Problem:
        """The problem, as it is at hand in this process."""
        if self.at_hand is not None:
            return self.at_hand
        problem = self._made()
        return replace(problem, base=problem.base.without(self.left_out)) if self.left_out else problem

    def _made(self) -> Problem:
        """The problem with all terms of the description."""
        if isinstance(self.source, Signals):
            return self._corrected(make_problem(self.source, self.overrides))
        key = f"{self.source.key} {self.overrides} {self.lag_s}"
        if key not in _problems:
            _problems[key] = self._corrected(make_problem(self.source.load(), self.overrides))
            while len(_problems) > 1 and sum(p.signals.q.size for p in _problems.values()) > NUMBERS_KEPT:
                _problems.popitem(last=False)
        _problems.move_to_end(key)
        return _problems[key]

    def _corrected(self, problem: Problem) -> Problem:
        return problem if self.lag_s in (None, problem.settings.torque_lag_s) else problem.corrected(self.lag_s)


_problems: OrderedDict[str, Problem] = OrderedDict()  # of this process, those used last at the end


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """A recording laid out for simulation with gains set for the inertias of `prior` (b,).

    `slip_noise` (c,) is that of the speeds of its directions of Coulomb friction; `long` says that rows are QR factors.
    """

    place: Place
    prior: Array
    slip_noise: Array
    long: bool
    gain_update: bool = True
    _laid_out: dict[float, Experiment] = field(default_factory=dict)

    def at(self, rate_per_bandwidth: float) -> Experiment:
        """The experiment with so many steps and samples per period of the bandwidth."""
        if rate_per_bandwidth not in self._laid_out:
            self._laid_out[rate_per_bandwidth] = make_experiment(
                self.place.problem(),
                self.prior,
                gain_update=self.gain_update,
                rate_per_bandwidth=rate_per_bandwidth,
                long=self.long,
            )
        return self._laid_out[rate_per_bandwidth]

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_laid_out": {}}  # laid out anew where it is needed


@dataclass(frozen=True, kw_only=True, eq=False)
class DirectModelError:
    """A joint of the robot simulated with the final estimate against the recording, in percent of its variation.

    Position in percent of |q - mean|, torque in percent of |tau|, both relative norms.
    """

    name: str
    position_error_percent: float | None
    torque_error_percent: float | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Replica:
    """The robot simulated with the final estimate in a recorded experiment, and what the experiment was.

    Attributes:
        simulated: the motion, and what is to be said of it.
        direct: errors of the direct model by joint, empty where nothing could be simulated.
        others as in `Experiment`; `described` says whether the description has the control law.
    """

    simulated: SimulatedMotion
    direct: tuple[DirectModelError, ...]
    reference_kind: Literal["recorded", "surrogate"]
    described: bool
    J_known: bool
    bandwidth_hz: float
    saturated_percent: float | None


@one_thread
def instruments_at(
    bench: Bench, rate_per_bandwidth: float, beta: Array, covariance: Array | None, counting: Counting
) -> Instruments:
    """Instruments of a recording along the robot simulated with parameters near to beta (b,)."""
    return simulate_instruments(bench.at(rate_per_bandwidth), beta, covariance, counting)


@one_thread
def replica(bench: Bench, rate_per_bandwidth: float, beta: Array, covariance: Array | None) -> Replica:
    """The robot simulated with beta (b,); of covariance (b, b); without it with beta itself, or not at all."""
    e = bench.at(rate_per_bandwidth)
    simulated = simulated_motion(e, beta) if covariance is None else simulated_robot(e, beta, covariance)
    return Replica(
        simulated=simulated,
        direct=tuple(
            DirectModelError(name=joint.name, position_error_percent=position, torque_error_percent=torque)
            for joint, position, torque in zip(
                e.problem.signals.robot.joints, simulated.position_percent, simulated.torque_percent, strict=True
            )
        )
        if simulated.motion is not None
        else (),
        reference_kind=e.reference_kind,
        described=e.loop is not None,
        J_known=e.J_known,
        bandwidth_hz=e.bandwidth_hz,
        saturated_percent=e.saturated_percent,
    )
