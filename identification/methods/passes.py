"""One iteration of the instrumental variable method, or least squares."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import get_args

import numpy as np

from ..arrays import Array
from ..estimation import Estimate, Intervals
from ..regression import Lag, Rows
from ..simulation import InstrumentKind, Simulated


def join_reasons(reasons: Sequence[tuple[str, str | None]]) -> str | None:
    """Join the reasons of recordings in one line, with their names if there are several."""
    return (
        reasons[0][1]
        if len(reasons) == 1
        else "; ".join(f"{name}: {why}" for name, why in reasons if why is not None) or None
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Pass:
    """One iteration of the instrumental variable method, or least squares, its start.

    Only the last one keeps arrays as large as W.

    Attributes:
        x: (p,) values at which the rows are linearised, with the estimated delays.
        rows: [C Z J r] about x; None if they were dropped.
        estimate: estimate of the free unknowns.
        intervals: 95 % intervals of the estimate.
        parameters_settled: True if every parameter converged, that is, changed by less than the
            tolerance.
        lags: estimated delays, with the prior knowledge of each.
        z: simulated robot that the instruments come from, by recording.
        is_consistent: True if the rows have these delays, and the simulated robot these values.
        change_in_sigma: (f,) change of each parameter, in its standard errors; empty for least
            squares.
        change_percent: largest change of the parameters greater than two standard errors.
        residual_change_percent: change of the residual norm over the same rows; None if it is
            within the tolerance.
        number: counted from 1; least squares is 0.
        by_reference: why instruments from the reference replace those of a simulated robot; None if
            they do not.
        tau_predicted: (rows, n) decimated torque of the estimate, N m or N; only of least squares.
    """

    x: Array
    rows: Rows | None
    estimate: Estimate
    intervals: Intervals
    parameters_settled: bool
    lags: tuple[Lag, ...]
    z: tuple[Simulated, ...] = ()
    is_consistent: bool = False
    change_in_sigma: Array = field(default_factory=lambda: np.zeros(0))
    change_percent: float = 0.0
    residual_change_percent: float | None = None
    number: int = 0
    by_reference: str | None = None
    tau_predicted: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def without_rows(self) -> "Pass":
        """Return a copy without arrays as large as W."""
        if self.rows is None:
            return self
        return replace(
            self,
            z=tuple(replace(one, motion=None, error=one.error[:0]) for one in self.z),
            rows=None,
            estimate=self.estimate.without_rows(),
        )

    @property
    def kept(self) -> Rows:
        """Rows, which only the last iteration and least squares keep."""
        assert self.rows is not None
        return self.rows

    @property
    def change_sigma(self) -> float:
        """Largest change of a parameter, in its standard errors."""
        return float(self.change_in_sigma.max())

    @property
    def changed(self) -> str:
        """Name of the parameter that changes most, in its standard errors."""
        return self.estimate.names[int(self.change_in_sigma.argmax())]

    @property
    def kind(self) -> InstrumentKind:
        """Kind of the instruments, as in `Simulated`; of several recordings the least exact one."""
        return max((one.kind for one in self.z), key=get_args(InstrumentKind).index)

    @property
    def reason(self) -> str | None:
        """Reason why the instruments are not those of the requested robot; None if they are."""
        return self.by_reference or join_reasons([(one.recording, one.reason) for one in self.z])

    @property
    def gains(self) -> Array:
        """Gain correction factors of the controllers, equation (E): n per recording."""
        return np.concatenate([one.gains for one in self.z])

    @property
    def tracking_percent(self) -> float | None:
        """Largest error of the simulated position, percent; None if a robot was not simulated."""
        percents = [x for one in self.z if (x := one.percent) is not None]
        return max(percents) if len(percents) == len(self.z) else None

    @property
    def settled(self) -> bool:
        """True if both the parameters and the residual norm converged."""
        return self.residual_change_percent is None and self.parameters_settled

    @property
    def is_last(self) -> bool:
        """True if parameters, residual norm and delays converged, at the simulated robot."""
        return self.settled and self.is_consistent
