"""The lag of the recorded torque, and what is known of it without a fit."""

from dataclasses import dataclass, field, replace

import numpy as np

from ..arrays import Array
from ..data import Signals
from ..options import Overrides

LAG_REACH = 3.0  # deviations that the lag may differ from the known one
NOTHING, UNKNOWN_LAG_S = "nothing", 0.002  # deviation of an unknown lag


@dataclass(frozen=True, kw_only=True, eq=False)
class Lag:
    """The lag of the torque of a recording, or of several of equal timing, s, positive: late.

    Attributes:
        value_s, sd_s: the lag and its deviation, which the intervals include; half a 95 % interval
            is `reach` deviations. A value stated by the user has no deviation.
        source: where the value comes from.
        period_s: of the samples.
        prior: the lag as known without a fit, if data have been combined with it.
        found: value, deviation and its degrees of freedom by the instruments alone; None where
            they do not determine it.
        by_law_s: the lag where the described control law gives the effort, else None.
        moved: (b,) shift of each parameter by one deviation of the lag.
        recordings: their names.
        order: of the filter that whitens the rows of the lag; 0 without such rows.
    """

    value_s: float
    sd_s: float
    source: str
    period_s: float
    reach: float = 2.0
    prior: "Lag | None" = None
    found: tuple[float, float, int] | None = None
    by_law_s: float | None = None
    moved: Array = field(default_factory=lambda: np.zeros(0))
    recordings: tuple[str, ...] = ()
    order: int = 0

    @property
    def stated(self) -> bool:
        """Whether the user stated it."""
        return self.sd_s == 0.0

    @property
    def half_width_s(self) -> float:
        """Half its 95 % interval."""
        return self.reach * self.sd_s

    @property
    def delay_s(self) -> tuple[float, float] | None:
        """Time from command to torque and half its interval; None without a described law."""
        if self.by_law_s is None or self.found is None:
            return None
        return self.by_law_s - self.found[0], self.reach * self.found[1]

    def with_other(self, other: "Lag") -> "Lag":
        """Both combined, weighted by their variances."""
        own, others = self.sd_s**-2, other.sd_s**-2
        value = (own * self.value_s + others * other.value_s) / (own + others)
        sd, source = (own + others) ** -0.5, f"{self.source} and {other.source}"
        return replace(self, value_s=value, sd_s=sd, source=source)


def known_lag(signals: Signals, overrides: Overrides) -> Lag:
    """Return the lag of a recording's torque as known without a fit: the value at which the lag
    among the unknowns starts, and its deviation.

    A command held for a control period is half that period early: it is recorded at the tick and
    acts, on average, half a period later. Without a described period it is that of the samples.
    `"none"` states a lag of 0.
    """
    own, period_s = signals.robot.identification.torque_lag_s, 1 / signals.sample_rate_hz
    given = own if overrides.torque_lag_s is None else overrides.torque_lag_s
    if given is not None:
        value_s, sd_s, source = 0.0 if given == "none" else given, 0.0, "torque_lag_s"
    elif signals.effort_timing == "unknown":
        value_s, sd_s, source = 0.0, UNKNOWN_LAG_S, NOTHING
    else:
        held_s = 1 / (signals.robot.controller.sample_rate_hz or signals.sample_rate_hz)
        value_s = -0.5 * held_s if signals.effort_timing == "command" else 0.0
        sd_s, source = 0.25 * held_s, f"effort_timing {signals.effort_timing}"
    return Lag(value_s=value_s, sd_s=sd_s, source=source, period_s=period_s)
