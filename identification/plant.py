"""The rigid robot as what simulated drives move: effort in, position and speed out."""

import numpy as np
from numpy.typing import NDArray

from .dynamics import DirectModel
from .simulation import Friction

Vector = NDArray[np.float64]

BRAKE = 1e9  # added to the inertia of a joint that is held: it does not move


class RigidBodyPlant:
    """The direct model stepped under given efforts, with white disturbance torque of `disturbance` (n,) rms.

    Satisfies the plant protocol of the simulated drives: quantities at the joints, SI. The same seed gives the same run.
    """

    def __init__(
        self, model: DirectModel, q: Vector, *, speed_scale: Vector, step_s: float, disturbance: Vector, seed: int
    ) -> None:
        """`speed_scale` (n,) is the speed that motion reaches, which sets where friction counts as sticking."""
        self._model, self._step_s = model, step_s
        self._q, self._dq = np.array(q, dtype=float), np.zeros(len(q))
        self._friction = Friction(model, speed_scale[None], self._dq, step_s)
        self._disturbance, self._rng = disturbance, np.random.default_rng(seed)

    def state(self) -> tuple[Vector, Vector]:
        """Position and speed, each (n,)."""
        return self._q.copy(), self._dq.copy()

    def prescribed_effort(self) -> Vector | None:
        """None: it obeys."""
        return None

    def step(self, effort: Vector, held: NDArray[np.bool_], duration_s: float) -> None:
        """Go on for `duration_s` under constant `effort`; brakes hold the joints where `held`."""
        self._dq = np.where(held, 0.0, self._dq)
        if held.all():
            return
        noise = self._disturbance * self._rng.standard_normal(len(effort))
        steps = max(1, round(duration_s / self._step_s))
        for _ in range(steps):
            M, bias = self._model.inertia_and_bias(self._q, self._dq)
            force = self._step_s * (effort + noise - bias)
            after = self._friction.step(M + np.diag(BRAKE * held), force, self._dq)
            if after is None:
                raise ArithmeticError("the inertia matrix of the simulated robot is not positive definite")
            self._q, self._dq = self._q + 0.5 * self._step_s * (self._dq + after), after
