"""The instants of a recorded experiment that is simulated: of its rows, of the instruments, of the controller, of the steps."""

import math
from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..errors import IdentificationError
from ..regression import Problem
from .control_law import ControlLaw

LEAST_INSTANTS = 30  # of the controller, for a simulation to say anything
MOST_STEPS = 2e7  # to simulate: what is slower than real time by far is a mistake in the description


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Instruments have `N` samples: every `stride`-th of the recording, from its sample `first` on.

    The controller has `instants`, `period_s` apart, from the same sample on, each with `substeps` simulated steps.
    """

    sample_rate_hz: float
    first: int
    stride: int
    N: int
    period_s: float
    instants: int
    substeps: int

    @property
    def spacing_s(self) -> float:
        """Between two samples of the instruments."""
        return self.stride / self.sample_rate_hz

    def t_s(self, at: slice) -> Array:
        """Seconds of the recording of samples of the instruments."""
        return np.asarray((self.first + self.stride * np.arange(at.start, at.stop)) / self.sample_rate_hz)

    def of_recording(self, at: slice) -> slice:
        """The recording's samples from the first to the last one of the instruments."""
        return slice(self.first + self.stride * at.start, self.first + self.stride * (at.stop - 1) + 1)

    def places(self, first: int, last: int) -> Array:
        """Controller's instants, counted in samples of the recording."""
        return np.asarray(self.first + self.period_s * self.sample_rate_hz * np.arange(first, last))

    def around(self, at: slice) -> tuple[int, int]:
        """The controller's instants, first and past the last, that samples of the instruments lie between."""
        ratio = self.spacing_s / self.period_s
        first, last = math.floor(at.start * ratio + 1e-6), math.ceil((at.stop - 1) * ratio - 1e-6) + 1
        return min(first, self.instants - 1), self.instants if at.stop == self.N else min(last, self.instants)

    def sampled(self, x: Array, first: int, at: slice, substeps: int) -> Array:
        """x (rows, c), `substeps` rows to an instant from row `first` on, at samples of the instruments."""
        places = np.arange(at.start, at.stop) * (self.spacing_s * substeps / self.period_s) - first
        picks = np.rint(places).astype(np.intp)  # beyond the last row that one stands
        if np.abs(places - picks).max() < 1e-6:
            return x[np.minimum(picks, len(x) - 1)]
        return np.stack([np.interp(places, np.arange(len(x)), column) for column in x.T], axis=1)


def make_layout(problem: Problem, loop: ControlLaw | None, step_hz: float) -> Layout:
    """Instruments as coarse as `step_hz` allows at instants of the rows; refuses controllers of other recordings."""
    signals, settings = problem.signals, problem.settings
    robot, fs, bandwidth_hz = signals.robot, signals.sample_rate_hz, signals.robot.bandwidth_hz
    m, used = _stride(fs, settings.decimation, step_hz), settings.stop - settings.start
    N = -(-used // m)
    span_s = (N - 1) * m / fs
    period_s = loop.period_s if loop else m / fs
    substeps = max(1, math.ceil(period_s * step_hz - 1e-9))
    if loop is None:  # a continuous law: it acts at every step
        period_s, substeps = period_s / substeps, 1
    steps, instants = span_s / period_s * substeps, math.floor(span_s / period_s + 1e-6) + 1
    what = ""
    if steps > MOST_STEPS:
        what = f"{steps:.2g} steps to simulate with bandwidth_hz = {bandwidth_hz:g}"
        expected = f"at most {MOST_STEPS:.2g} steps"
    elif instants < LEAST_INSTANTS:
        what = f"{instants} instants in the {used / fs:.3g} s of {signals.recording}"
        expected = f"at least {LEAST_INSTANTS} instants"
    if what:
        raise IdentificationError(
            what,
            place=f"robot {robot.name}",
            key="controller.sample_rate_hz",
            value=1 / period_s,
            shown=f"{1 / period_s:g}",
            expected=expected,
        )
    return Layout(
        sample_rate_hz=fs,
        first=(settings.stop - 1 - settings.start) % m + settings.start,
        stride=m,
        N=N,
        period_s=period_s,
        instants=instants,
        substeps=substeps,
    )


def _stride(fs: float, decimation: int, step_hz: float) -> int:
    """The largest divisor of the decimation that leaves a rate of `step_hz`."""
    divisors = [m for m in range(1, decimation + 1) if decimation % m == 0]
    return max((m for m in divisors if fs / m >= step_hz), default=1)
