"""What a fit is about: a recording, the settings, the robot's model and its base parameters."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..data import Signals
from ..model import BaseParameters, InverseModel, base_parameters
from .filtering import decimation_reach
from .motion import FilteredMotion, Motion, sampled_at
from .settings import Overrides, Settings, make_settings, torque_lag_s

_SERIES_BLOCK = (
    12_000_000  # numbers of a block's regressor: 96 MB; a shorter block spends more on what reaches beyond it
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """The data of an identification, made once per fit.

    Attributes:
        signals: the recording, the lag of its torque corrected.
        settings: cut-off, decimation and span, resolved.
        model: inverse dynamic model of the robot, linear in its standard parameters.
        base: its base parameters.
        motion: the recording's motion behind the low-pass.
    """

    signals: Signals
    settings: Settings
    model: InverseModel
    base: BaseParameters
    motion: FilteredMotion

    def without_samples(self) -> "Problem":
        """The same for those who need its settings and model alone."""
        s, arrays = self.signals, ("t_s", "q", "q_ref", "effort", "known_torque", "feedforward")
        none = {name: x[:0] for name in arrays if (x := getattr(s, name)) is not None}
        signals = replace(s, **none, health={}, extras={})
        return replace(self, signals=signals, motion=FilteredMotion(signals))


def make_problem(signals: Signals, overrides: Overrides) -> Problem:
    """Set up the identification of a robot from a recording.

    Raises `IdentificationError` where the settings do not suit the recording, or the robot cannot be modelled.
    """
    lag_s, _ = torque_lag_s(signals, overrides)
    if lag_s:
        at = np.arange(len(signals.effort), dtype=np.float64) + lag_s * signals.sample_rate_hz
        signals = replace(signals, effort=sampled_at(at, signals.effort))
    motion = FilteredMotion(signals)
    settings = make_settings(signals, overrides, motion)
    model = InverseModel(signals.robot)
    return Problem(signals=signals, settings=settings, model=model, base=base_parameters(model), motion=motion)


def motion_blocks(problem: Problem) -> Iterator[tuple[Motion, slice, float]]:
    """Cut the span used into blocks: each block's motion, which of its decimated rows count, and the share done.

    A block reaches beyond the rows that count as far as the decimation filter does, so blocks give what one pass
    would. Blocks are counted from the end, where decimation keeps its last sample.
    """
    settings, series = problem.settings, len(problem.model.entries(problem.base.columns))
    n_d, start, stop = settings.decimation, settings.start, settings.stop
    margin = -(-decimation_reach(n_d) // n_d)  # in decimated rows
    rows = -(-(stop - start) // n_d)
    size = max(4 * margin, _SERIES_BLOCK // (series * n_d), 1)
    for first in range(0, rows, size):
        last = min(rows, first + size)
        if rows - last < margin:
            last = rows  # no block shorter than the filter's reach
        low, high = max(0, first - margin), min(rows, last + margin)
        begin, end = start if low == 0 else stop - (rows - low) * n_d, stop - (rows - high) * n_d
        motion = problem.motion.between(begin, end, settings.cutoff_hz)
        yield motion, slice(first - low, last - low), last / rows
        if last == rows:
            return
