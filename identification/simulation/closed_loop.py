"""The simulated robot: the direct dynamic model of any base estimate in closed loop with the robot's own controller."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..model import DirectModel
from .control_law import Control, ControlLaw, Reference
from .friction import Friction

_LOOK_EVERY = 64  # steps between looks at whether the simulation still follows


@dataclass(frozen=True, eq=False)
class Simulated:
    """A simulated motion: q, dq, ddq, tau (N, n), each row of one instant, tau held from there on.

    That is the true motion, and the torque that the controller gives: noise of encoders and disturbing torque are not in them.
    There are `substeps` rows to each controller period. `reason` says why it ended early, if it did.
    """

    q: Array
    dq: Array
    ddq: Array
    tau: Array
    reason: str | None


@np.errstate(over="ignore", invalid="ignore")  # a loop that is not stable is told by where it goes
def simulate(
    model: DirectModel,
    loop: ControlLaw,
    reference: Reference,
    *,
    start: tuple[Array, Array],
    bound: Array,
    substeps: int = 1,
) -> Simulated:
    """Follow a reference given once per controller period, from the `start` position and speed, (n,) each.

    The smooth part of the model is stepped explicitly; viscous and Coulomb friction implicitly, Coulomb friction with its
    stick phases, so that light joints do not chatter: within a step it is found which directions stick (a semi-smooth
    Newton iteration). Stops with a `reason` where the position leaves the reference by more than `bound` (n,) or the
    inertia matrix is not positive. The state is never clipped.
    """
    q_ref = reference.q
    N, n = q_ref.shape
    h = loop.period_s / substeps
    q_out, dq_out, tau_out = np.empty((3, N * substeps, n))
    q, v = (x.copy() for x in start)
    control, cell = Control(model, loop, reference, q, v), reference.disturbances
    if cell is None:
        friction = Friction(model, reference.dq, v, h)
    else:
        friction = Friction(cell.on_plant(model), reference.dq, v, h, stribeck=cell.stribeck)
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
            reason = _lost(q, q_ref[k], bound, k * loop.period_s)
        if reason is not None:
            break
    far = np.flatnonzero(~(np.abs(q_out[:rows:substeps] - q_ref[: -(-rows // substeps)]) < bound).all(axis=1))
    if reason is None and far.size:
        k = int(far[0])
        reason, rows = _lost(q_out[k * substeps], q_ref[k], bound, k * loop.period_s), k * substeps
    dq = dq_out[:rows]
    return Simulated(q_out[:rows], dq, np.diff(dq, axis=0, append=v[None]) / h, tau_out[:rows], reason)


def _lost(q: Array, q_ref: Array, bound: Array, t_s: float) -> str:
    j = int(np.argmin(np.abs(q - q_ref) < bound))
    return f"the simulated robot leaves its reference at joint {j + 1}, {t_s:.3f} s"
