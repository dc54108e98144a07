"""The simulated robot: the direct dynamic model of any base estimate in closed loop with the robot's own controller."""

import numpy as np

from ..arrays import Array
from ..model import DirectModel
from .control_law import Control, ControlLaw, Reference
from .disturbances import Disturbances
from .friction import Friction

_LOOK_EVERY = 64  # steps between looks at whether the simulation still follows


class ClosedLoop:
    """A robot in closed loop, simulated span by span: its motion and the controller's memory go on from one to the next.

    The smooth part of the model is stepped explicitly; viscous and Coulomb friction implicitly, Coulomb friction with its
    stick phases, so that light joints do not chatter: within a step it is found which directions stick (a semi-smooth
    Newton iteration).
    """

    def __init__(
        self,
        model: DirectModel,
        loop: ControlLaw,
        start: tuple[Array, Array],
        *,
        fastest: Array,
        substeps: int = 1,
        cell: Disturbances | None = None,
    ) -> None:
        """`start` is position and speed, (n,) each; `fastest` (c,) speeds that the directions of Coulomb friction reach.

        A controller period has `substeps` steps; `cell` is what disturbs the loop, as the references have it.
        """
        self._q, self._v = (x.copy() for x in start)
        self._h, self._substeps, self._period_s = loop.period_s / substeps, substeps, loop.period_s
        self._control = Control(model, loop, self._q, self._v)
        plant, stribeck = (model, 0.0) if cell is None else (cell.on_plant(model), cell.stribeck)
        self._friction = Friction(plant, fastest, self._v, self._h, stribeck=stribeck)
        self._instants = 0

    @np.errstate(over="ignore", invalid="ignore")  # a loop that is not stable is told by where it goes
    def follow(self, reference: Reference, bound: Array) -> tuple[Array, str | None]:
        """Follow the next span of a reference given once per controller period.

        Returns q, dq, ddq, tau (4, N, n), `substeps` rows to a period, each of one instant, tau held from there on: the true
        motion and the torque that the controller gives, without noise of encoders and disturbing torque. And the reason why
        it ended early, if it did: where the position leaves the reference by more than `bound` (n,), or the inertia matrix is
        not positive. The state is never clipped.
        """
        h, substeps, q_ref, cell = self._h, self._substeps, reference.q, reference.disturbances
        N, n = q_ref.shape
        out = np.empty((4, N * substeps, n))
        q_out, dq_out, ddq_out, tau_out = out
        q, v, control, friction = self._q, self._v, self._control, self._friction
        control.take(reference)
        look_every, half, reason = max(1, _LOOK_EVERY // substeps), 0.5 * h, None
        rows, known = 0, reference.known_torque
        for k in range(N):
            if cell is None:
                acting = tau = control.torque(k, q, v)
            else:
                tau = control.torque(k, cell.seen(k, q), v)
                acting = tau + cell.torque[k]
            if known is not None:
                acting = acting + known[k]
            for row in range(rows, rows + substeps):
                after = friction.step(q, v, acting)
                if after is None:
                    reason = "the inertia matrix is not positive definite"
                    break
                q_out[row], dq_out[row], tau_out[row] = q, v, tau
                q, v = q + half * (v + after), after
                rows = row + 1
            if reason is None and k % look_every == 0 and not (np.abs(q - q_ref[k]) < bound).all():
                reason = self._lost(q, q_ref[k], bound, k)
            if reason is not None:
                break
        far = np.flatnonzero(~(np.abs(q_out[:rows:substeps] - q_ref[: -(-rows // substeps)]) < bound).all(axis=1))
        if reason is None and far.size:
            k = int(far[0])
            reason, rows = self._lost(q_out[k * substeps], q_ref[k], bound, k), k * substeps
        self._q, self._v, self._instants = q, v, self._instants + N
        ddq_out[:rows] = np.diff(dq_out[:rows], axis=0, append=v[None]) / h
        return out[:, :rows], reason

    def _lost(self, q: Array, q_ref: Array, bound: Array, k: int) -> str:
        j, t_s = int(np.argmin(np.abs(q - q_ref) < bound)), (self._instants + k) * self._period_s
        return f"the simulated robot leaves its reference at joint {j + 1}, {t_s:.3f} s"
