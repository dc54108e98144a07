"""Results of drive gains and payloads in a fit, apart from the base parameters."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.robot import Payload

from ..arrays import Array
from ..model import LINK

MASS, MOMENTS = LINK.index("M"), [LINK.index(name) for name in ("MX", "MY", "MZ")]
MAX_GAIN_SHARE = 0.1  # half an interval over the gain: with more it is not determined


@dataclass(frozen=True, kw_only=True, eq=False)
class Gains:
    """Identified drive gains.

    Attributes:
        motors: (m,) names; `units`: of the gains, such as N m/A.
        described: (m,) gains of the description, NaN where it has none.
        values, half: (m,) gains, and half-widths of their 95 % intervals.
        cragg_donald: smallest eigenvalue of the Cragg-Donald statistic of the gains.
    """

    motors: tuple[str, ...]
    units: tuple[str, ...]
    described: Array
    values: Array
    half: Array
    cragg_donald: float

    @property
    def determined(self) -> NDArray[np.bool_]:
        """(m,) whether a gain is known to better than 10 %."""
        return np.asarray(self.half < MAX_GAIN_SHARE * np.abs(self.values))


@dataclass(frozen=True, kw_only=True, eq=False)
class EstimatedPayload:
    """What a recording's robot carried, in the frame of the last joint.

    Attributes:
        recording: the first one with it; `payload`: as stated.
        values, half: (10,) XX XY XZ YY YZ ZZ MX MY MZ M of the nearest body of positive density, and half-widths.
        from_prior: (10,) whether a value is not from the recordings.
        near: whether there is such a body; without one the values are what is stated, or a ball's.
    """

    recording: str
    payload: Payload
    values: Array
    half: Array
    from_prior: NDArray[np.bool_]
    near: bool

    @property
    def center_of_mass_m(self) -> tuple[Array, Array]:
        """Centre of mass (3,) and half-widths (3,), which include that of the mass."""
        m, moments = self.values[MASS], self.values[MOMENTS]
        return moments / m, np.hypot(self.half[MOMENTS] / m, moments / m**2 * self.half[MASS])
