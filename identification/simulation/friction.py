"""Implicit friction with stick phases, so that light joints do not chatter in a simulation."""

import numpy as np
from scipy.linalg import lapack

from ..arrays import Array
from ..model import DirectModel

STICTION = 1e-3  # of a direction's speed scale: Coulomb friction builds up linearly below this speed
MODE_PASSES = 8  # of the search for which directions stick; nearly always one or two are needed


class Friction:
    """Implicit friction: solves (M + h V) dv = force - h (V v + Sᵀ f + offset), where f in each direction slips or sticks.

    A direction slips at its full Coulomb level, or sticks: then its friction grows linearly up to a creep speed `v_s`. The
    modes of the step before are tried first; a direction that would turn round sticks, one that exceeds v_s slips.
    """

    def __init__(self, model: DirectModel, dq_ref: Array, v: Array, h: float) -> None:
        self._model, self._h, self._S, self._ST = model, h, model.directions, model.directions.T.copy()
        self._v_s = STICTION * np.maximum(np.abs(dq_ref @ self._ST).max(axis=0, initial=0.0), 1e-9)
        self._resists = (model.up + model.down) > 0
        self._slope = np.where(self._resists, (model.up + model.down) / (2 * self._v_s), 0.0)
        self._one_sided = bool(model.viscous_up.any() or model.viscous_down.any())
        self._V, self._hV = model.viscous, h * model.viscous
        self._turn(np.sign(self._S @ v))

    def _turn(self, mode: Array) -> None:
        """Take up the modes (c,): +1 and -1 slip that way, 0 sticks."""
        model, h = self._model, self._h
        self._mode, self._stuck = mode, bool((mode == 0).any())
        stuck = mode == 0
        level = np.where(stuck, (model.up - model.down) / 2, np.where(mode > 0, model.up, -model.down))
        self._slipping = h * (level @ self._S + model.offset)
        self._creep = h * (self._ST * (self._slope * stuck)) @ self._S

    def step(self, M: Array, force: Array, v: Array) -> Array | None:
        """Speed (n,) after a step under the impulse `force`; None where no positive definite matrix is to be solved with."""
        if self._one_sided:
            self._V = self._model.viscous + self._model.viscous_up * (v > 0) + self._model.viscous_down * (v < 0)
            self._hV = self._h * self._V
        M, force = M + self._hV, force - self._hV.dot(v)
        for _ in range(MODE_PASSES):
            if self._stuck:
                _, dv, info = lapack.dposv(M + self._creep, force - self._slipping - self._creep.dot(v))
            else:
                _, dv, info = lapack.dposv(M, force - self._slipping)
            if info:
                return None
            w = v + dv
            after, mode = self._S.dot(w), self._mode
            if not self._stuck and min((mode * after).tolist(), default=1.0) > 0:
                break
            stuck = mode == 0
            found = np.where(stuck & (np.abs(after) > self._v_s), np.sign(after), mode)
            found = np.where(~stuck & (mode * after < 0), np.where(self._resists, 0.0, -mode), found)
            if (found == mode).all():
                break
            self._turn(found)
        return np.asarray(w)
