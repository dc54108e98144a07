"""What acts on a real loop besides its reference, and which neither its controller nor a description knows of."""

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..model import DirectModel


@dataclass(frozen=True, kw_only=True, eq=False)
class Disturbances:
    """Noise of the encoders, torque on the joints, friction that is not described; at the controller's N instants.

    Attributes:
        position: (N, n) noise of the encoders, rad or m at the joints; the controller acts on it.
        count: step of the encoders, rad or m, 0 for none.
        torque: (N, n) that acts on the joints, each held to the next instant.
        asymmetry: viscous and Coulomb friction is (1 + asymmetry) of the described one for dq > 0, (1 - asymmetry) for dq < 0.
        stribeck: Coulomb friction at rest is (1 + stribeck) of the described one, which it falls to with speed.
    """

    position: Array
    count: float
    torque: Array
    asymmetry: float = 0.0
    stribeck: float = 0.0

    def seen(self, k: int, q: Array) -> Array:
        """Position (n,) that the encoders give at the instant k, where it is q (n,)."""
        return self._counted(q + self.position[k])

    def recorded(self, q: Array) -> Array:
        """Positions (N, n) that the encoders gave along q (N, n)."""
        return self._counted(q + self.position)

    def _counted(self, q: Array) -> Array:
        return np.asarray(np.rint(q / self.count) * self.count) if self.count else q

    def on_plant(self, model: DirectModel) -> DirectModel:
        """The robot with the friction that it has."""
        more, less = 1.0 + self.asymmetry, 1.0 - self.asymmetry
        return replace(
            model,
            up=more * model.up,
            down=less * model.down,
            viscous_up=more * model.viscous_up + self.asymmetry * model.viscous,
            viscous_down=less * model.viscous_down - self.asymmetry * model.viscous,
        )
