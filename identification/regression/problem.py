"""What a fit is about: a recording, the settings, the robot's model and its base parameters."""

from dataclasses import dataclass, replace

import numpy as np

from ..data import Signals
from ..model import BaseParameters, InverseModel, base_parameters
from .motion import FilteredMotion, sampled_at
from .settings import Overrides, Settings, make_settings, torque_lag_s


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
